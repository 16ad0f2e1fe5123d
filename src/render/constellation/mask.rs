//! Mask pass: distance and density → the number of the first sample in smoke, for every pixel of a view. Runs when the view,
//! the volume or its moment has changed.

use bevy::prelude::*;
use bevy::render::render_resource::binding_types::{sampler, texture_3d, texture_storage_2d, uniform_buffer};
use bevy::render::render_resource::{
    BindGroupLayoutEntries, Buffer, Extent3d, PipelineCache, Sampler, SamplerBindingType, ShaderStages, ShaderType,
    StorageTextureAccess, TextureDescriptor, TextureDimension, TextureFormat, TextureSampleType, TextureUsages,
    TextureView, TextureViewDescriptor,
};
use bevy::render::renderer::RenderDevice;
use bevy::shader::Shader;

use super::View;
use crate::render::pass::{ComputePass, Job, workgroups};

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_constellation_mask";

/// Sample numbers.
const FORMAT: TextureFormat = TextureFormat::R32Uint;

/// The `Mask` of `constellation_mask.wgsl`.
#[derive(ShaderType, Clone, Debug, PartialEq)]
pub(in crate::render) struct MaskUniform {
    pub bundle_from_clip: Mat4,
    pub eye: Vec4,
    pub half_extent: Vec3,
    pub cell: f32,
    pub size: UVec2,
    pub step: f32,
    pub skip_empty: u32,
}

impl MaskUniform {
    pub fn new(view: &View) -> Self {
        let smoke = &view.smoke;
        Self {
            bundle_from_clip: smoke.bundle_from_clip,
            eye: smoke.eye,
            half_extent: smoke.half_extent,
            cell: smoke.cell,
            size: view.size,
            step: view.settings.view_step * smoke.cell,
            skip_empty: u32::from(view.settings.skip_empty),
        }
    }
}

pub(super) fn pass(shader: &Handle<Shader>, cache: &PipelineCache) -> ComputePass {
    let entries = BindGroupLayoutEntries::sequential(
        ShaderStages::COMPUTE,
        (
            uniform_buffer::<MaskUniform>(false),
            texture_3d(TextureSampleType::Float { filterable: true }),
            sampler(SamplerBindingType::Filtering),
            texture_storage_2d(FORMAT, StorageTextureAccess::WriteOnly),
        ),
    );
    ComputePass::new(LABEL, &entries, shader, "find_first", vec![], cache)
}

/// A texture for so many pixels; where there is no mask, one pixel to bind.
pub(in crate::render) fn texture(size: UVec2, device: &RenderDevice) -> TextureView {
    let texture = device.create_texture(&TextureDescriptor {
        label: Some("smoke_constellation_mask"),
        size: Extent3d { width: size.x, height: size.y, depth_or_array_layers: 1 },
        mip_level_count: 1,
        sample_count: 1,
        dimension: TextureDimension::D2,
        format: FORMAT,
        usage: TextureUsages::STORAGE_BINDING | TextureUsages::TEXTURE_BINDING | TextureUsages::COPY_SRC,
        view_formats: &[],
    });
    texture.create_view(&TextureViewDescriptor::default())
}

pub(in crate::render) fn job(
    pass: &ComputePass,
    uniform: &Buffer,
    (volume, sampler): (&TextureView, &Sampler),
    mask: &TextureView,
    size: UVec2,
    device: &RenderDevice,
    cache: &PipelineCache,
) -> Job {
    let bind_group = pass.bind(device, cache, (uniform.as_entire_binding(), volume, sampler, mask));
    Job { bind_group, workgroups: workgroups(size.extend(1), UVec3::new(8, 8, 1)) }
}
