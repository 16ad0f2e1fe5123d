//! Outgoing pass: light at the probes, straight and scattered → radiance toward the eye, a quadratic fit an RBF; the
//! columns to the lamps likewise. Runs when the light changed, and, where the phase function is not isotropic, when the eye moved relative to the smoke.

use bevy::prelude::*;
use bevy::render::render_resource::binding_types::{
    storage_buffer_read_only_sized, storage_buffer_sized, uniform_buffer,
};
use bevy::render::render_resource::{
    BindGroup, BindGroupLayoutEntries, Buffer, PipelineCache, ShaderStages, ShaderType,
};
use bevy::render::renderer::{RenderContext, RenderDevice};
use bevy::shader::{Shader, ShaderDefVal};

use super::frame::{FrameUniform, GpuSmokeFrame};
use super::lighting::LightingUniform;
use super::pass::ComputePass;
use super::{SmokePasses, SmokeRenderStats, SmokeWork};

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_outgoing";

/// Bytes of the `Fit` of `lighting.wgsl`.
const FIT_BYTES: u64 = 7 * 16;
/// Bytes an RBF takes in the pass's output.
pub(super) const OUTGOING_BYTES: u64 = FIT_BYTES;
/// Bytes an RBF takes in the fitted columns: twice four lamps.
pub(super) const SHADE_BYTES: u64 = 2 * FIT_BYTES;

/// The `Look` of `outgoing.wgsl`.
#[derive(ShaderType, Clone, Debug, PartialEq)]
pub(super) struct LookUniform {
    /// Bundle space: the eye (w = 1) or the direction of parallel rays (w = 0).
    pub eye: Vec4,
}

pub(super) fn pass(shader: &Handle<Shader>, cache: &PipelineCache) -> ComputePass {
    pass_with(shader, vec![], cache)
}

/// A variant of the pass.
pub(super) fn pass_with(shader: &Handle<Shader>, defs: Vec<ShaderDefVal>, cache: &PipelineCache) -> ComputePass {
    let entries = BindGroupLayoutEntries::sequential(
        ShaderStages::COMPUTE,
        (
            uniform_buffer::<FrameUniform>(false),
            uniform_buffer::<LightingUniform>(false),
            uniform_buffer::<LookUniform>(false),
            storage_buffer_read_only_sized(false, None),
            storage_buffer_read_only_sized(false, None),
            storage_buffer_read_only_sized(false, None),
            storage_buffer_read_only_sized(false, None),
            storage_buffer_read_only_sized(false, None),
            storage_buffer_read_only_sized(false, None),
            storage_buffer_sized(false, None),
            storage_buffer_sized(false, None),
        ),
    );
    ComputePass::new(LABEL, &entries, shader, "leave", defs, cache)
}

/// What one dispatch reads and writes.
pub(super) struct Bindings<'a> {
    pub frame: &'a GpuSmokeFrame,
    pub lighting: &'a Buffer,
    pub look: &'a Buffer,
    pub probes: &'a Buffer,
    pub escapes: &'a Buffer,
    pub gathered: &'a Buffer,
    pub rows: &'a Buffer,
    pub columns: &'a Buffer,
    pub outgoing: &'a Buffer,
    pub shades: &'a Buffer,
}

pub(super) fn bind(pass: &ComputePass, b: Bindings, device: &RenderDevice, cache: &PipelineCache) -> BindGroup {
    pass.bind(
        device,
        cache,
        (
            b.frame.uniform.as_entire_binding(),
            b.lighting.as_entire_binding(),
            b.look.as_entire_binding(),
            b.frame.rbfs.as_entire_binding(),
            b.probes.as_entire_binding(),
            b.escapes.as_entire_binding(),
            b.gathered.as_entire_binding(),
            b.rows.as_entire_binding(),
            b.columns.as_entire_binding(),
            b.outgoing.as_entire_binding(),
            b.shades.as_entire_binding(),
        ),
    )
}

/// One thread an RBF.
pub(super) fn workgroups(frame: &GpuSmokeFrame) -> UVec3 {
    UVec3::new(frame.rbf_count.div_ceil(64), 1, 1)
}

/// Turns the probes' radiance toward the eye.
pub(super) fn outgoing(
    work: Res<SmokeWork>,
    passes: Res<SmokePasses>,
    cache: Res<PipelineCache>,
    stats: Res<SmokeRenderStats>,
    mut ctx: RenderContext,
) {
    passes.outgoing.run(&work.outgoing, &cache, &stats.outgoing, &mut ctx);
}
