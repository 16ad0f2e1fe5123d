//! What the view pass binds to draw a volume by its constellation: the bindings of `constellation.wgsl`.

use bevy::prelude::*;
use bevy::render::render_resource::binding_types::{
    sampler, storage_buffer_read_only_sized, texture_2d, texture_3d, uniform_buffer, uniform_buffer_sized,
};
use bevy::render::render_resource::{
    BindGroup, BindGroupEntries, BindGroupLayoutDescriptor, BindGroupLayoutEntries, Buffer, BufferId,
    SamplerBindingType, ShaderStages, ShaderType, TextureSampleType, TextureView, TextureViewId,
};

use super::lights::ConstellationUniform;
use super::mask::{self, MaskUniform};
use super::{ConstellationPasses, ConstellationWork, View};
use crate::constellation::ConstellationShading;
use crate::render::lighting::LightingUniform;
use crate::render::lit::Cached;
use crate::render::pass::Job;
use crate::render::prepare::Gpu;
use crate::render::surroundings::{Surroundings, SurroundingsUniform};
use crate::render::view::SmokeUniform;

/// The `Options` of `constellation.wgsl`.
#[derive(ShaderType, Clone, Debug, PartialEq)]
struct OptionsUniform {
    light_count: u32,
    shading: u32,
    skip_empty: u32,
    masked: u32,
}

/// The `Settings` of `constellation.wgsl`.
#[derive(ShaderType, Clone, Debug, PartialEq)]
pub(super) struct SettingsUniform {
    options: OptionsUniform,
    half_extent: Vec3,
    cell: f32,
    step: f32,
    shadow_step: f32,
}

impl SettingsUniform {
    pub fn new(view: &View) -> Self {
        let (settings, cell) = (&view.settings, view.smoke.cell);
        Self {
            options: OptionsUniform {
                light_count: settings.lights,
                shading: match settings.shading {
                    ConstellationShading::Alpha => 0,
                    ConstellationShading::Primary => 1,
                    ConstellationShading::SelfShadow => 2,
                },
                skip_empty: u32::from(settings.skip_empty),
                masked: u32::from(settings.mask),
            },
            half_extent: view.smoke.half_extent,
            cell,
            step: settings.view_step * cell,
            shadow_step: settings.shadow_step * cell,
        }
    }
}

/// Layout of the volume's group; its first three bindings are those of every volume.
pub(in crate::render) fn layout() -> BindGroupLayoutDescriptor {
    let both = ShaderStages::VERTEX_FRAGMENT;
    let filtered = || texture_3d(TextureSampleType::Float { filterable: true });
    let entries = BindGroupLayoutEntries::sequential(
        ShaderStages::FRAGMENT,
        (
            uniform_buffer::<SmokeUniform>(false).visibility(both),
            filtered(),
            sampler(SamplerBindingType::Filtering),
            uniform_buffer::<SettingsUniform>(false).visibility(both),
            uniform_buffer::<LightingUniform>(false).visibility(both),
            uniform_buffer::<SurroundingsUniform>(false).visibility(both),
            uniform_buffer_sized(false, Some(ConstellationUniform::min_size())),
            storage_buffer_read_only_sized(false, None),
            filtered(),
            texture_2d(TextureSampleType::Uint),
        ),
    );
    BindGroupLayoutDescriptor::new("smoke_view_constellation", &entries)
}

/// What is shown, whoever sees it.
pub(super) struct Shown<'a> {
    pub texture: &'a TextureView,
    pub lighting: &'a Buffer,
    pub lights: &'a Buffer,
    pub surroundings: &'a Surroundings,
    pub densities: &'a TextureView,
}

/// Tells apart what groups bind.
type Resources = ([TextureViewId; 2], [BufferId; 4]);

impl Shown<'_> {
    fn resources(&self) -> Resources {
        let Self { texture, lighting, lights, surroundings, densities } = self;
        let around = [surroundings.uniform.buffer().id(), surroundings.spheres.id()];
        ([texture.id(), densities.id()], [lighting.id(), lights.id(), around[0], around[1]])
    }
}

/// A volume as one view draws it.
pub(super) struct Seen {
    smoke: Cached<SmokeUniform>,
    settings: Cached<SettingsUniform>,
    mask: Cached<MaskUniform>,
    mask_texture: TextureView,
    find: Job,
    bind_group: BindGroup,
    resources: Resources,
    /// Of the texture, when the mask was made.
    masked: Option<u32>,
    pub last_used: u32,
}

impl Seen {
    pub fn new(shown: &Shown, view: &View, passes: &ConstellationPasses, gpu: &Gpu) -> Self {
        let smoke = Cached::new(view.smoke.clone(), gpu);
        let settings = Cached::new(SettingsUniform::new(view), gpu);
        let mask = Cached::new(MaskUniform::new(view), gpu);
        let mask_texture = mask::texture(if view.settings.mask { view.size } else { UVec2::ONE }, gpu.device);
        let volume = (shown.texture, gpu.sampler);
        let find = mask::job(&passes.mask, mask.buffer(), volume, &mask_texture, view.size, gpu.device, gpu.cache);
        let entries = BindGroupEntries::sequential((
            smoke.buffer().as_entire_binding(),
            shown.texture,
            gpu.sampler,
            settings.buffer().as_entire_binding(),
            shown.lighting.as_entire_binding(),
            shown.surroundings.uniform.buffer().as_entire_binding(),
            shown.lights.as_entire_binding(),
            shown.surroundings.spheres.as_entire_binding(),
            shown.densities,
            &mask_texture,
        ));
        let layout = gpu.cache.get_bind_group_layout(gpu.view_pass.constellation_layout());
        let bind_group = gpu.device.create_bind_group("smoke_view_constellation", &layout, &entries);
        let resources = shown.resources();
        Self { smoke, settings, mask, mask_texture, find, bind_group, resources, masked: None, last_used: 0 }
    }

    /// Whether this is of the very resources, and its mask of the view's size.
    pub fn is_of(&self, shown: &Shown, view: &View) -> bool {
        let size = self.mask_texture.texture().size();
        let fits = !view.settings.mask || UVec2::new(size.width, size.height) == view.size;
        fits && self.resources == shown.resources()
    }

    /// What the view binds; lists the mask where it is another. `version` is that of the texture.
    pub fn update(&mut self, view: View, version: u32, now: u32, gpu: &Gpu, work: &mut ConstellationWork) -> BindGroup {
        self.last_used = now;
        let moved = self.mask.set(MaskUniform::new(&view), gpu);
        self.settings.set(SettingsUniform::new(&view), gpu);
        if !view.settings.mask {
            self.masked = None;
        } else if moved || self.masked != Some(version) {
            self.masked = Some(version);
            work.mask.push(self.find.clone());
        }
        self.smoke.set(view.smoke, gpu);
        self.bind_group.clone()
    }
}
