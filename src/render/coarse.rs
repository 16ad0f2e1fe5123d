//! Coarse pass: density → the coarse grid that optical depths are marched through. Runs after the density pass.

use bevy::prelude::*;
use bevy::render::render_resource::binding_types::{texture_3d, texture_storage_3d, uniform_buffer};
use bevy::render::render_resource::{
    BindGroupLayoutEntries, PipelineCache, ShaderStages, StorageTextureAccess, TextureSampleType,
};
use bevy::render::renderer::{RenderContext, RenderDevice};
use bevy::shader::Shader;

use super::frame::{FILTERED_FORMAT, FrameUniform, GpuSmokeFrame};
use super::pass::{ComputePass, Job, workgroups};
use super::{SmokePasses, SmokeRenderStats, SmokeWork};

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_coarse";

pub(super) fn pass(shader: &Handle<Shader>, cache: &PipelineCache) -> ComputePass {
    let entries = BindGroupLayoutEntries::sequential(
        ShaderStages::COMPUTE,
        (
            uniform_buffer::<FrameUniform>(false),
            texture_3d(TextureSampleType::Float { filterable: false }),
            texture_storage_3d(FILTERED_FORMAT, StorageTextureAccess::WriteOnly),
        ),
    );
    ComputePass::new(LABEL, &entries, shader, "average", vec![], cache)
}

pub(super) fn job(pass: &ComputePass, frame: &GpuSmokeFrame, device: &RenderDevice, cache: &PipelineCache) -> Job {
    let bindings = (frame.uniform.as_entire_binding(), &frame.density, &frame.coarse);
    let padded = frame.shape.coarse().dims + 2;
    Job { bind_group: pass.bind(device, cache, bindings), workgroups: workgroups(padded, UVec3::splat(4)) }
}

/// Averages the density of every moment that is new.
pub(super) fn coarse(
    work: Res<SmokeWork>,
    passes: Res<SmokePasses>,
    cache: Res<PipelineCache>,
    stats: Res<SmokeRenderStats>,
    mut ctx: RenderContext,
) {
    passes.coarse.run(&work.coarse, &cache, &stats.coarse, &mut ctx);
}
