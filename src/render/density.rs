//! Density pass: RBFs + hashed residuals of two baked frames → density of every cell. Runs when a volume's moment has
//! changed.

use bevy::prelude::*;
use bevy::render::render_resource::binding_types::{
    storage_buffer_read_only_sized, texture_storage_3d, uniform_buffer,
};
use bevy::render::render_resource::{BindGroupLayoutEntries, PipelineCache, ShaderStages, StorageTextureAccess};
use bevy::render::renderer::{RenderContext, RenderDevice};
use bevy::shader::Shader;

use super::frame::{DENSITY_FORMAT, FrameUniform, GpuSmokeFrame};
use super::pass::{ComputePass, Job, workgroups};
use super::{SmokePasses, SmokeRenderStats, SmokeWork};

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_density";

pub(super) fn pass(shader: &Handle<Shader>, cache: &PipelineCache) -> ComputePass {
    let storage = || storage_buffer_read_only_sized(false, None);
    let entries = BindGroupLayoutEntries::sequential(
        ShaderStages::COMPUTE,
        (
            uniform_buffer::<FrameUniform>(false),
            storage(),
            storage(),
            storage(),
            storage(),
            storage(),
            texture_storage_3d(DENSITY_FORMAT, StorageTextureAccess::WriteOnly),
        ),
    );
    ComputePass::new(LABEL, &entries, shader, "reconstruct", vec![], cache)
}

pub(super) fn job(pass: &ComputePass, frame: &GpuSmokeFrame, device: &RenderDevice, cache: &PipelineCache) -> Job {
    let [from, to] = frame.residuals().expect("baked smoke has residuals");
    let bind_group = pass.bind(
        device,
        cache,
        (
            frame.uniform.as_entire_binding(),
            frame.rbfs.as_entire_binding(),
            frame.bin_offsets.as_entire_binding(),
            frame.bin_indices.as_entire_binding(),
            from.as_entire_binding(),
            to.as_entire_binding(),
            &frame.density,
        ),
    );
    Job { bind_group, workgroups: workgroups(frame.shape.dims, UVec3::new(8, 8, 4)) }
}

/// Unpacks the density of every moment that is new.
pub(super) fn density(
    work: Res<SmokeWork>,
    passes: Res<SmokePasses>,
    cache: Res<PipelineCache>,
    stats: Res<SmokeRenderStats>,
    mut ctx: RenderContext,
) {
    passes.density.run(&work.density, &cache, &stats.density, &mut ctx);
}
