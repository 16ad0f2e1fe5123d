//! View pass: marches each view's rays through its volumes, far to near, and composites them over the opaque scene. Where
//! transparent meshes are in the way, the same pipelines draw slabs among them ([`slabs`](super::slabs)).

use core::ops::Range;

use bevy::camera::{MainPassResolutionOverride, Viewport};
use bevy::core_pipeline::core_3d::{CORE_3D_DEPTH_FORMAT, Transparent3d};
use bevy::core_pipeline::tonemapping::{
    Tonemapping, TonemappingLuts, get_lut_bind_group_layout_entries, get_lut_bindings,
};
use bevy::pbr::ExtractedAtmosphere;
use bevy::prelude::*;
use bevy::render::camera::ExtractedCamera;
use bevy::render::diagnostic::RecordDiagnostics;
use bevy::render::render_asset::RenderAssets;
use bevy::render::render_phase::{TrackedRenderPass, ViewSortedRenderPhases};
use bevy::render::render_resource::binding_types::{
    sampler, texture_2d, texture_3d, texture_depth_2d, texture_depth_2d_multisampled, uniform_buffer,
};
use bevy::render::render_resource::{
    BindGroup, BindGroupEntries, BindGroupEntry, BindGroupLayoutDescriptor, BindGroupLayoutEntries, BindingResource,
    BlendComponent, BlendState, Buffer, CachedRenderPipelineId, ColorTargetState, ColorWrites, CompareFunction,
    DepthStencilState, FragmentState, MultisampleState, PipelineCache, PrimitiveState, PrimitiveTopology,
    RenderPassDescriptor, RenderPipeline, RenderPipelineDescriptor, Sampler, SamplerBindingType, ShaderStages,
    ShaderType, SpecializedRenderPipeline, SpecializedRenderPipelines, TextureFormat, TextureSampleType, TextureUsages,
    TextureView, VertexState,
};
use bevy::render::renderer::{RenderContext, RenderDevice, ViewQuery};
use bevy::render::texture::{FallbackImage, GpuImage};
use bevy::render::view::{
    ExtractedView, Msaa, ViewDepthTexture, ViewTarget, ViewUniform, ViewUniformOffset, ViewUniforms,
};
use bevy::shader::{Shader, ShaderDefVal};

use super::extract::{ExtractedSmoke, ExtractedVolume};
use super::half_resolution::{self, ViewHalfResolution};
use super::lighting::{LampUniform, LightingUniform, MAX_LAMPS};
use super::slabs::{MAX_SLABS, SlabsUniform, ViewSlabs};
use super::{SmokeRenderStats, constellation};

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_view";

/// The `Smoke` of `view.wgsl`.
#[derive(ShaderType, Clone, Debug, PartialEq)]
pub(super) struct SmokeUniform {
    pub bundle_from_clip: Mat4,
    pub eye: Vec4,
    pub rectangle: Vec4,
    pub half_extent: Vec3,
    pub step: f32,
    pub cell: f32,
    pub sigma: f32,
    pub radiance_scale: f32,
    pub g: f32,
    pub glow_count: u32,
    pub glows: [Glow; MAX_LAMPS],
}

/// The `Glow` of `view.wgsl`.
#[derive(ShaderType, Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Glow {
    pub position: Vec3,
    pub softening: f32,
    pub color: Vec3,
    pub spot_scale: f32,
    pub axis: Vec3,
    pub spot_offset: f32,
}

impl Glow {
    /// The glows of the lamps in a box, or nearer to it than their light is softened, and how many they are.
    pub fn all(lighting: &LightingUniform, half_extent: Vec3) -> (u32, [Self; MAX_LAMPS]) {
        let mut glows = [Self::default(); MAX_LAMPS];
        let albedo = lighting.scatter[0].truncate();
        let reach = 3.0 * lighting.softening.sqrt();
        let near = |lamp: &&LampUniform| {
            lamp.is_sun == 0 && (lamp.position.abs() - half_extent).max(Vec3::ZERO).length() < reach
        };
        let mut count = 0;
        for lamp in lighting.lamps[..lighting.lamp_count as usize].iter().filter(near) {
            glows[count as usize] = Self {
                position: lamp.position,
                softening: lighting.softening,
                color: albedo * lamp.color,
                spot_scale: lamp.spot_scale,
                axis: lamp.axis,
                spot_offset: lamp.spot_offset,
            };
            count += 1;
        }
        (count, glows)
    }
}

/// The volumes that a view draws, far to near; never none.
#[derive(Component)]
pub(super) struct ViewSmoke(pub Vec<ViewSmokeVolume>);

/// A volume that a view draws.
pub(super) struct ViewSmokeVolume {
    pub distance: f32,
    /// Where its box begins and ends along the view's axis, as [`Placed::depths`](super::placed::Placed::depths).
    pub depths: Range<f32>,
    pub emission: Emission,
    pub half_resolution: bool,
    pub bind_group: BindGroup,
    /// Draws whose light adds up to the volume's, where light can be added up: 1, or more by a constellation.
    pub draws: u32,
}

/// What a step of the march emits, and what the 3D texture holds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Emission {
    /// J (1 − exp(−σ D Δ)); J.
    #[default]
    Exact,
    /// J D σ Δ, as printed by Zhou et al. 2008; J D.
    #[cfg(feature = "reference")]
    Printed,
    /// J (1 − exp(−σ D Δ)) with J summed over a light constellation at every step; distance to smoke.
    Constellation,
}

/// The pass's layouts and shader.
#[derive(Resource, Clone)]
pub(crate) struct ViewPass {
    volume_layout: BindGroupLayoutDescriptor,
    constellation_layout: BindGroupLayoutDescriptor,
    shader: Handle<Shader>,
}

impl ViewPass {
    pub fn new(shader: &Handle<Shader>) -> Self {
        let entries = BindGroupLayoutEntries::sequential(
            ShaderStages::VERTEX_FRAGMENT,
            (
                uniform_buffer::<SmokeUniform>(false),
                texture_3d(TextureSampleType::Float { filterable: true }),
                sampler(SamplerBindingType::Filtering),
            ),
        );
        Self {
            volume_layout: BindGroupLayoutDescriptor::new("smoke_view_volume", &entries),
            constellation_layout: constellation::layout(),
            shader: shader.clone(),
        }
    }

    /// Layout of what is bound for a volume that is drawn by its constellation.
    pub fn constellation_layout(&self) -> &BindGroupLayoutDescriptor {
        &self.constellation_layout
    }

    /// Binds one volume.
    pub fn bind(
        &self,
        (uniform, volume, sampler): (&Buffer, &TextureView, &Sampler),
        device: &RenderDevice,
        cache: &PipelineCache,
    ) -> BindGroup {
        let layout = cache.get_bind_group_layout(&self.volume_layout);
        let entries = BindGroupEntries::sequential((uniform.as_entire_binding(), volume, sampler));
        device.create_bind_group("smoke_view_volume", &layout, &entries)
    }
}

/// What tells one view's pipeline from another's.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct ViewPassKey {
    target_format: TextureFormat,
    samples: u32,
    /// The tone mapping to apply in the shader: that of a view whose target holds display colours.
    tonemapping: Option<Tonemapping>,
    emission: Emission,
    /// Whether it draws slabs in Bevy's transparent pass, which has a depth attachment.
    slabs: bool,
    resolution: Resolution,
}

/// What part in drawing at half resolution a pipeline has.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Resolution {
    /// None: it marches every pixel.
    Full,
    /// It marches pixels of half the size.
    Half,
    /// It blends these, and marches where that will not do.
    Upsampled,
}

/// Bindings of the view's group.
const LUT_BINDING: u32 = 2;
const SLABS_BINDING: u32 = 4;
const HALF_BINDING: u32 = 5;

impl ViewPassKey {
    /// Layout of the group that the view binds: its uniform, its depth, a table where the shader tone-maps, and the slabs
    /// where there are any.
    fn view_layout(&self) -> BindGroupLayoutDescriptor {
        let depth = if self.samples > 1 { texture_depth_2d_multisampled() } else { texture_depth_2d() };
        let mut entries = BindGroupLayoutEntries::sequential(
            ShaderStages::VERTEX_FRAGMENT,
            (uniform_buffer::<ViewUniform>(true), depth),
        )
        .to_vec();
        if self.tonemapping.is_some() {
            let luts = get_lut_bind_group_layout_entries();
            let luts = (LUT_BINDING..).zip(luts).map(|(binding, entry)| entry.build(binding, ShaderStages::FRAGMENT));
            entries.extend(luts);
        }
        if self.slabs {
            entries.push(uniform_buffer::<SlabsUniform>(false).build(SLABS_BINDING, ShaderStages::VERTEX));
        }
        if self.resolution == Resolution::Upsampled {
            let halves = [HALF_BINDING, HALF_BINDING + 1].map(|binding| {
                texture_2d(TextureSampleType::Float { filterable: false }).build(binding, ShaderStages::FRAGMENT)
            });
            entries.extend(halves);
        }
        BindGroupLayoutDescriptor::new("smoke_view", &entries)
    }

    fn shader_defs(&self) -> Vec<ShaderDefVal> {
        let mut defs = Vec::new();
        if self.samples > 1 {
            defs.push("MULTISAMPLED".into());
        }
        if self.slabs {
            defs.push("SLABS".into());
        }
        if self.slabs || self.emission == Emission::Constellation {
            defs.push(ShaderDefVal::UInt("SAMPLES".into(), self.samples));
        }
        match self.resolution {
            Resolution::Full => {}
            Resolution::Half => defs.push("HALF".into()),
            Resolution::Upsampled => defs.push("UPSAMPLED".into()),
        }
        #[cfg(feature = "reference")]
        if self.emission == Emission::Printed {
            defs.push("PRINTED_EMISSION".into());
        }
        if self.emission == Emission::Constellation {
            defs.push("CONSTELLATION".into());
        }
        if let Some(tonemapping) = self.tonemapping {
            defs.push("TONEMAP_IN_SHADER".into());
            defs.push(ShaderDefVal::UInt("TONEMAPPING_LUT_TEXTURE_BINDING_INDEX".into(), LUT_BINDING));
            defs.push(ShaderDefVal::UInt("TONEMAPPING_LUT_SAMPLER_BINDING_INDEX".into(), LUT_BINDING + 1));
            defs.push(tonemapping_def(tonemapping).into());
        }
        defs
    }
}

/// The name by which Bevy's shaders know a method of tone mapping.
pub(super) fn tonemapping_def(tonemapping: Tonemapping) -> &'static str {
    match tonemapping {
        Tonemapping::None => "TONEMAP_METHOD_NONE",
        Tonemapping::Reinhard => "TONEMAP_METHOD_REINHARD",
        Tonemapping::ReinhardLuminance => "TONEMAP_METHOD_REINHARD_LUMINANCE",
        Tonemapping::AcesFitted => "TONEMAP_METHOD_ACES_FITTED",
        Tonemapping::AgX => "TONEMAP_METHOD_AGX",
        Tonemapping::SomewhatBoringDisplayTransform => "TONEMAP_METHOD_SOMEWHAT_BORING_DISPLAY_TRANSFORM",
        Tonemapping::TonyMcMapface => "TONEMAP_METHOD_TONY_MC_MAPFACE",
        Tonemapping::BlenderFilmic => "TONEMAP_METHOD_BLENDER_FILMIC",
        Tonemapping::KhronosPbrNeutral => "TONEMAP_METHOD_PBR_NEUTRAL",
    }
}

impl SpecializedRenderPipeline for ViewPass {
    type Key = ViewPassKey;

    fn specialize(&self, key: ViewPassKey) -> RenderPipelineDescriptor {
        // Premultiplied: what is behind keeps the transmittance, 1 - alpha.
        let over = BlendComponent::OVER;
        let target = |format, blend| Some(ColorTargetState { format, blend, write_mask: ColorWrites::ALL });
        let targets = match key.resolution {
            Resolution::Half => {
                vec![target(half_resolution::COLOR_FORMAT, None), target(half_resolution::DEPTH_FORMAT, None)]
            }
            _ => vec![target(key.target_format, Some(BlendState { color: over, alpha: over }))],
        };
        let volume_layout = match key.emission {
            Emission::Constellation => &self.constellation_layout,
            _ => &self.volume_layout,
        };
        RenderPipelineDescriptor {
            label: Some(LABEL.into()),
            layout: vec![key.view_layout(), volume_layout.clone()],
            vertex: VertexState {
                shader: self.shader.clone(),
                shader_defs: key.shader_defs(),
                entry_point: Some("vertex".into()),
                ..default()
            },
            primitive: PrimitiveState { topology: PrimitiveTopology::TriangleStrip, ..default() },
            // The march ends at the depth; the test, which the pass has anyway, lets all through.
            depth_stencil: key.slabs.then(|| DepthStencilState {
                format: CORE_3D_DEPTH_FORMAT,
                depth_write_enabled: Some(false),
                depth_compare: Some(CompareFunction::Always),
                stencil: default(),
                bias: default(),
            }),
            multisample: MultisampleState { count: key.samples, ..default() },
            fragment: Some(FragmentState {
                shader: self.shader.clone(),
                shader_defs: key.shader_defs(),
                entry_point: Some("fragment".into()),
                targets,
            }),
            ..default()
        }
    }
}

/// The pipelines that draw a view's volumes.
pub(super) struct Pipelines {
    exact: CachedRenderPipelineId,
    /// For the volumes that emit as printed, if there are any.
    #[cfg(feature = "reference")]
    printed: Option<CachedRenderPipelineId>,
    /// For the volumes that are drawn by a constellation, if there are any; nobody else waits for it.
    constellation: Option<CachedRenderPipelineId>,
    layout: BindGroupLayoutDescriptor,
    key: ViewPassKey,
}

impl Pipelines {
    fn get<'a>(&self, emission: Emission, cache: &'a PipelineCache) -> Option<&'a RenderPipeline> {
        match emission {
            Emission::Exact => cache.get_render_pipeline(self.exact),
            #[cfg(feature = "reference")]
            Emission::Printed => cache.get_render_pipeline(self.printed?),
            Emission::Constellation => cache.get_render_pipeline(self.constellation?),
        }
    }

    /// Pipelines compile while the app runs.
    pub fn are_ready(&self, cache: &PipelineCache) -> bool {
        let ready = self.get(Emission::Exact, cache).is_some();
        #[cfg(feature = "reference")]
        let ready = ready && (self.printed.is_none() || self.get(Emission::Printed, cache).is_some());
        ready
    }

    /// What the view binds.
    pub fn bind_view(
        &self,
        view_uniforms: BindingResource,
        depth: &TextureView,
        slabs: Option<&Buffer>,
        halves: Option<[&TextureView; 2]>,
        tables: &ToneMappingTables,
        device: &RenderDevice,
        cache: &PipelineCache,
    ) -> BindGroup {
        let mut entries = vec![
            BindGroupEntry { binding: 0, resource: view_uniforms },
            BindGroupEntry { binding: 1, resource: BindingResource::TextureView(depth) },
        ];
        if let Some(tonemapping) = &self.key.tonemapping {
            let (lut, sampler) = get_lut_bindings(&tables.images, &tables.luts, tonemapping, &tables.fallback);
            entries.push(BindGroupEntry { binding: LUT_BINDING, resource: BindingResource::TextureView(lut) });
            entries.push(BindGroupEntry { binding: LUT_BINDING + 1, resource: BindingResource::Sampler(sampler) });
        }
        entries
            .extend(slabs.map(|slabs| BindGroupEntry { binding: SLABS_BINDING, resource: slabs.as_entire_binding() }));
        for (binding, half) in (HALF_BINDING..).zip(halves.into_iter().flatten()) {
            entries.push(BindGroupEntry { binding, resource: BindingResource::TextureView(half) });
        }
        device.create_bind_group(LABEL, &cache.get_bind_group_layout(&self.layout), &entries)
    }

    /// Draws volumes as wholes (slab 0) or one slab of each, the view's group being bound; how many draws it took.
    pub fn draw<'a>(
        &self,
        volumes: impl Iterator<Item = &'a ViewSmokeVolume>,
        slab: u32,
        cache: &'a PipelineCache,
        pass: &mut TrackedRenderPass<'a>,
    ) -> u32 {
        let samples = self.key.samples;
        let mut draws = 0;
        for volume in volumes {
            let Some(pipeline) = self.get(volume.emission, cache) else { continue };
            pass.set_render_pipeline(pipeline);
            pass.set_bind_group(1, &volume.bind_group, &[]);
            // What is tone-mapped cannot be added up.
            for draw in 0..if self.key.tonemapping.is_some() { 1 } else { volume.draws } {
                let first = draw * MAX_SLABS as u32 + slab;
                pass.draw(0..4, first * samples..(first + 1) * samples);
                draws += 1;
            }
        }
        draws
    }
}

/// A view's pipelines.
#[derive(Component)]
pub(super) struct ViewSmokePipelines {
    pub whole: Pipelines,
    /// Of views that have something to draw in Bevy's transparent pass.
    pub slabs: Option<Pipelines>,
    /// Of views that may draw at half resolution: those to the picture of half the size, and from there.
    pub halves: Option<[Pipelines; 2]>,
}

/// Picks the pipelines of every view that may draw smoke.
pub(super) fn prepare_view_pipelines(
    mut commands: Commands,
    cache: Res<PipelineCache>,
    mut pipelines: ResMut<SpecializedRenderPipelines<ViewPass>>,
    pass: Res<ViewPass>,
    smoke: Res<ExtractedSmoke>,
    phases: Res<ViewSortedRenderPhases<Transparent3d>>,
    views: Query<
        (Entity, &ExtractedView, &ExtractedCamera, &Msaa, Option<&Tonemapping>, Has<ExtractedAtmosphere>),
        With<Camera3d>,
    >,
) {
    let any = |is_such: fn(&ExtractedVolume) -> bool| smoke.volumes.values().any(is_such);
    let wants_half = any(ExtractedVolume::may_draw_half);
    #[cfg(feature = "reference")]
    let wants_printed = any(|volume| volume.paper.is_some());
    let wants_constellation = any(|volume| volume.constellation.is_some());
    // The other methods are never drawn at half resolution.
    let is_whole = |key: ViewPassKey| key.resolution == Resolution::Full;
    let mut specialize = |key: ViewPassKey| Pipelines {
        exact: pipelines.specialize(&cache, &pass, key),
        #[cfg(feature = "reference")]
        printed: (is_whole(key) && wants_printed).then(|| {
            let key = ViewPassKey { emission: Emission::Printed, ..key };
            pipelines.specialize(&cache, &pass, key)
        }),
        constellation: (is_whole(key) && wants_constellation).then(|| {
            let key = ViewPassKey { emission: Emission::Constellation, ..key };
            pipelines.specialize(&cache, &pass, key)
        }),
        layout: key.view_layout(),
        key,
    };
    for (entity, view, camera, msaa, tonemapping, has_atmosphere) in &views {
        if smoke.volumes.is_empty() {
            commands.entity(entity).remove::<ViewSmokePipelines>();
            continue;
        }
        let whole = ViewPassKey {
            target_format: view.target_format,
            samples: msaa.samples(),
            tonemapping: tonemapping.copied().filter(|_| !camera.hdr),
            emission: Emission::Exact,
            slabs: false,
            resolution: Resolution::Full,
        };
        let transparent = phases.get(&view.retained_view_entity).is_some_and(|phase| !phase.items.is_empty());
        commands.entity(entity).insert(ViewSmokePipelines {
            whole: specialize(whole),
            slabs: (transparent || has_atmosphere).then(|| specialize(ViewPassKey { slabs: true, ..whole })),
            halves: (wants_half && whole.samples == 1).then(|| {
                // The picture of half the size holds radiance.
                let half = ViewPassKey { resolution: Resolution::Half, tonemapping: None, ..whole };
                [half, ViewPassKey { resolution: Resolution::Upsampled, ..whole }].map(&mut specialize)
            }),
        });
    }
}

/// Lets the passes read the views' depth, or copy it.
pub(super) fn prepare_depth_usages(mut cameras: Query<(&mut Camera3d, Has<ViewSlabs>)>, smoke: Res<ExtractedSmoke>) {
    if smoke.is_empty() {
        return;
    }
    for (mut camera, has_slabs) in &mut cameras {
        let copied = if has_slabs { TextureUsages::COPY_SRC } else { TextureUsages::empty() };
        camera.depth_texture_usages.0 |= (TextureUsages::TEXTURE_BINDING | copied).bits();
    }
}

/// The tables that tone mapping in the shader reads.
#[derive(bevy::ecs::system::SystemParam)]
pub(super) struct ToneMappingTables<'w> {
    images: Res<'w, RenderAssets<GpuImage>>,
    luts: Res<'w, TonemappingLuts>,
    fallback: Res<'w, FallbackImage>,
}

/// Draws the view's volumes, or copies the depth where Bevy's transparent pass will draw them.
pub(super) fn view(
    view: ViewQuery<(
        &ViewTarget,
        &ViewDepthTexture,
        &ViewUniformOffset,
        &ExtractedCamera,
        Option<&MainPassResolutionOverride>,
        &ViewSmoke,
        &ViewSmokePipelines,
        Option<&ViewSlabs>,
        Option<&ViewHalfResolution>,
    )>,
    view_uniforms: Res<ViewUniforms>,
    cache: Res<PipelineCache>,
    tables: ToneMappingTables,
    stats: Res<SmokeRenderStats>,
    mut ctx: RenderContext,
) {
    let (target, depth, offset, camera, resolution, smoke, pipelines, slabs, half) = view.into_inner();
    if let Some(slabs) = slabs {
        slabs.copy_depth(depth, ctx.command_encoder());
        return;
    }
    let Some(view_uniforms) = view_uniforms.uniforms.binding() else {
        return;
    };
    let ViewSmokePipelines { whole, halves, .. } = pipelines;
    if !whole.are_ready(&cache) {
        return;
    }
    let view_bind_group =
        whole.bind_view(view_uniforms, depth.view(), None, None, &tables, ctx.render_device(), &cache);
    let viewport = Viewport::from_viewport_and_override(camera.viewport.as_ref(), resolution);

    let recorder = ctx.diagnostic_recorder();
    let recorder = recorder.as_deref();
    if let (Some(half), Some([to_half, from_half])) = (half, halves) {
        // Volumes are drawn one by one: all share the picture of half the size.
        let span = recorder.time_span(ctx.command_encoder(), LABEL);
        for volume in &smoke.0 {
            let (pipelines, bind_group) = match volume.half_resolution {
                true => {
                    stats.view.add(half.draw(volume, to_half, offset.offset, &cache, &mut ctx));
                    (from_half, &half.upsampled)
                }
                false => (whole, &view_bind_group),
            };
            let mut pass = begin(target, viewport.as_ref(), &mut ctx);
            pass.set_bind_group(0, bind_group, &[offset.offset]);
            stats.view.add(pipelines.draw([volume].into_iter(), 0, &cache, &mut pass));
        }
        span.end(ctx.command_encoder());
        return;
    }
    let mut pass = begin(target, viewport.as_ref(), &mut ctx);
    let span = recorder.pass_span(&mut pass, LABEL);
    pass.set_bind_group(0, &view_bind_group, &[offset.offset]);
    stats.view.add(whole.draw(smoke.0.iter(), 0, &cache, &mut pass));
    span.end(&mut pass);
}

/// Begins to draw to a view.
fn begin<'a>(target: &ViewTarget, viewport: Option<&Viewport>, ctx: &'a mut RenderContext) -> TrackedRenderPass<'a> {
    let mut pass = ctx.begin_tracked_render_pass(RenderPassDescriptor {
        label: Some(LABEL),
        color_attachments: &[Some(target.get_color_attachment())],
        depth_stencil_attachment: None,
        timestamp_writes: None,
        occlusion_query_set: None,
        multiview_mask: None,
    });
    if let Some(viewport) = viewport {
        pass.set_camera_viewport(viewport);
    }
    pass
}
