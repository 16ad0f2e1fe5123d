//! Source-radiance pass: environment + coarse density → single-scattering source radiance at every RBF's tetrahedral
//! probes, as spherical harmonics in the look direction. Runs when light, medium or density changed.

use bevy::prelude::*;
use bevy::render::render_resource::binding_types::{
    sampler, storage_buffer_read_only_sized, storage_buffer_sized, texture_3d, uniform_buffer,
};
use bevy::render::render_resource::{
    BindGroup, BindGroupLayoutEntries, Buffer, PipelineCache, Sampler, SamplerBindingType, ShaderStages, ShaderType,
    TextureSampleType,
};
use bevy::render::renderer::{RenderContext, RenderDevice};
use bevy::shader::Shader;

use super::frame::{FrameUniform, GpuSmokeFrame};
use super::pass::ComputePass;
use super::{SmokePasses, SmokeRenderStats, SmokeWork};

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_source_radiance";

/// Probes around an RBF: the corners of a tetrahedron.
pub(super) const PROBES: u32 = 4;

/// The `Lighting` of `lighting.wgsl`.
#[derive(ShaderType, Clone, Debug, PartialEq)]
pub(super) struct LightingUniform {
    pub environment_from_bundle: Mat3,
    pub albedo: Vec3,
    pub sigma: f32,
    pub bands: Vec4,
}

pub(super) fn pass(shader: &Handle<Shader>, cache: &PipelineCache) -> ComputePass {
    let entries = BindGroupLayoutEntries::sequential(
        ShaderStages::COMPUTE,
        (
            uniform_buffer::<FrameUniform>(false),
            uniform_buffer::<LightingUniform>(false),
            storage_buffer_read_only_sized(false, None),
            storage_buffer_read_only_sized(false, None),
            texture_3d(TextureSampleType::Float { filterable: true }),
            sampler(SamplerBindingType::Filtering),
            storage_buffer_sized(false, None),
        ),
    );
    ComputePass::new(LABEL, &entries, shader, "gather", vec![], cache)
}

/// What one dispatch reads and writes.
pub(super) struct Bindings<'a> {
    pub frame: &'a GpuSmokeFrame,
    pub lighting: &'a Buffer,
    pub environment: &'a Buffer,
    pub sampler: &'a Sampler,
    pub probes: &'a Buffer,
}

pub(super) fn bind(pass: &ComputePass, b: Bindings, device: &RenderDevice, cache: &PipelineCache) -> BindGroup {
    pass.bind(
        device,
        cache,
        (
            b.frame.uniform.as_entire_binding(),
            b.lighting.as_entire_binding(),
            b.frame.rbfs.as_entire_binding(),
            b.environment.as_entire_binding(),
            &b.frame.coarse,
            b.sampler,
            b.probes.as_entire_binding(),
        ),
    )
}

/// One workgroup a probe.
pub(super) fn workgroups(frame: &GpuSmokeFrame) -> UVec3 {
    UVec3::new(frame.rbf_count, PROBES, 1)
}

/// Lights the probes of every volume whose light, medium or density changed.
pub(super) fn source_radiance(
    work: Res<SmokeWork>,
    passes: Res<SmokePasses>,
    cache: Res<PipelineCache>,
    stats: Res<SmokeRenderStats>,
    mut ctx: RenderContext,
) {
    passes.source_radiance.run(&work.source_radiance, &cache, &stats.source_radiance, &mut ctx);
}
