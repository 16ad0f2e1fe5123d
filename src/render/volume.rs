//! Volume pass: outgoing radiance of the RBFs, and lamps → source radiance of every cell, beside its density, in the 3D texture
//! that the view pass marches. Runs after the outgoing pass.

use bevy::prelude::*;
use bevy::render::render_resource::binding_types::{
    storage_buffer_read_only_sized, texture_3d, texture_storage_3d, uniform_buffer,
};
use bevy::render::render_resource::{
    BindGroup, BindGroupLayoutEntries, Buffer, PipelineCache, ShaderStages, StorageTextureAccess, TextureSampleType,
    TextureView,
};
use bevy::render::renderer::{RenderContext, RenderDevice};
use bevy::shader::{Shader, ShaderDefVal};

use super::frame::{FILTERED_FORMAT, FrameUniform, GpuSmokeFrame};
use super::lighting::LightingUniform;
use super::outgoing::LookUniform;
use super::pass::ComputePass;
use super::surroundings::SurroundingsUniform;
use super::{SmokePasses, SmokeRenderStats, SmokeWork};
use crate::density::GridShape;

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_volume";

pub(super) fn pass(shader: &Handle<Shader>, cache: &PipelineCache) -> ComputePass {
    pass_with(shader, vec![], cache)
}

/// A variant of the pass.
pub(super) fn pass_with(shader: &Handle<Shader>, defs: Vec<ShaderDefVal>, cache: &PipelineCache) -> ComputePass {
    let storage = || storage_buffer_read_only_sized(false, None);
    let entries = BindGroupLayoutEntries::sequential(
        ShaderStages::COMPUTE,
        (
            uniform_buffer::<FrameUniform>(false),
            uniform_buffer::<LightingUniform>(false),
            uniform_buffer::<LookUniform>(false),
            storage(),
            storage(),
            storage(),
            storage(),
            storage(),
            texture_3d(TextureSampleType::Float { filterable: false }),
            texture_storage_3d(FILTERED_FORMAT, StorageTextureAccess::WriteOnly),
            uniform_buffer::<SurroundingsUniform>(false),
            storage(),
        ),
    );
    ComputePass::new(LABEL, &entries, shader, "reconstruct", defs, cache)
}

/// What one dispatch reads and writes.
pub(super) struct Bindings<'a> {
    pub frame: &'a GpuSmokeFrame,
    pub lighting: &'a Buffer,
    pub look: &'a Buffer,
    pub outgoing: &'a Buffer,
    pub shades: &'a Buffer,
    pub volume: &'a TextureView,
    pub surroundings: &'a Buffer,
    pub spheres: &'a Buffer,
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
            b.frame.bin_offsets.as_entire_binding(),
            b.frame.bin_indices.as_entire_binding(),
            b.outgoing.as_entire_binding(),
            b.shades.as_entire_binding(),
            &b.frame.density,
            b.volume,
            b.surroundings.as_entire_binding(),
            b.spheres.as_entire_binding(),
        ),
    )
}

/// One thread a cell of the padded grid.
pub(super) fn workgroups(shape: GridShape) -> UVec3 {
    super::pass::workgroups(shape.dims + 2, UVec3::new(8, 8, 4))
}

/// Reconstructs the source radiance of every volume whose light or look changed.
pub(super) fn volume(
    work: Res<SmokeWork>,
    passes: Res<SmokePasses>,
    cache: Res<PipelineCache>,
    stats: Res<SmokeRenderStats>,
    mut ctx: RenderContext,
) {
    passes.volume.run(&work.volume, &cache, &stats.volume, &mut ctx);
}
