//! Pair-matrix pass: RBFs + coarse density → how much of what each RBF sees around it is each other one. Runs when the
//! density or the extinction changed, where light scatters more than once.

use bevy::prelude::*;
use bevy::render::render_resource::binding_types::{
    sampler, storage_buffer_read_only_sized, storage_buffer_sized, texture_3d, uniform_buffer,
};
use bevy::render::render_resource::{
    BindGroup, BindGroupLayoutEntries, Buffer, PipelineCache, Sampler, SamplerBindingType, ShaderStages,
    TextureSampleType,
};
use bevy::render::renderer::{RenderContext, RenderDevice};
use bevy::shader::Shader;

use super::footprint::Footprints;
use super::frame::{FrameUniform, GpuSmokeFrame};
use super::lighting::LightingUniform;
use super::pass::ComputePass;
use super::{SmokePasses, SmokeRenderStats, SmokeWork};

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_pair_matrix";

/// Bytes of what goes with a row.
pub(super) const ROW_BYTES: u64 = 16 * 4;

pub(super) fn pass(shader: &Handle<Shader>, cache: &PipelineCache) -> ComputePass {
    let entries = BindGroupLayoutEntries::sequential(
        ShaderStages::COMPUTE,
        (
            uniform_buffer::<FrameUniform>(false),
            uniform_buffer::<LightingUniform>(false),
            uniform_buffer::<Footprints>(false),
            storage_buffer_read_only_sized(false, None),
            texture_3d(TextureSampleType::Float { filterable: true }),
            sampler(SamplerBindingType::Filtering),
            storage_buffer_sized(false, None),
            storage_buffer_sized(false, None),
        ),
    );
    ComputePass::new(LABEL, &entries, shader, "relate", vec![], cache)
}

/// What one dispatch reads and writes.
pub(super) struct Bindings<'a> {
    pub frame: &'a GpuSmokeFrame,
    pub lighting: &'a Buffer,
    pub footprints: &'a Buffer,
    pub sampler: &'a Sampler,
    pub matrix: &'a Buffer,
    pub rows: &'a Buffer,
}

pub(super) fn bind(pass: &ComputePass, b: Bindings, device: &RenderDevice, cache: &PipelineCache) -> BindGroup {
    pass.bind(
        device,
        cache,
        (
            b.frame.uniform.as_entire_binding(),
            b.lighting.as_entire_binding(),
            b.footprints.as_entire_binding(),
            b.frame.rbfs.as_entire_binding(),
            &b.frame.coarse,
            b.sampler,
            b.matrix.as_entire_binding(),
            b.rows.as_entire_binding(),
        ),
    )
}

/// One workgroup a row.
pub(super) fn workgroups(frame: &GpuSmokeFrame) -> UVec3 {
    UVec3::new(frame.rbf_count, 1, 1)
}

/// Relates the RBFs of every volume whose density or extinction changed.
pub(super) fn pair_matrix(
    work: Res<SmokeWork>,
    passes: Res<SmokePasses>,
    cache: Res<PipelineCache>,
    stats: Res<SmokeRenderStats>,
    mut ctx: RenderContext,
) {
    passes.pair_matrix.run(&work.pair_matrix, &cache, &stats.pair_matrix, &mut ctx);
}
