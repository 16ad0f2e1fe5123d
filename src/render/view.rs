//! View pass: marches each view's rays through its volumes, far to near, and composites them over the opaque scene.

use bevy::core_pipeline::tonemapping::{
    Tonemapping, TonemappingLuts, get_lut_bind_group_layout_entries, get_lut_bindings,
};
use bevy::prelude::*;
use bevy::render::camera::ExtractedCamera;
use bevy::render::diagnostic::RecordDiagnostics;
use bevy::render::render_asset::RenderAssets;
use bevy::render::render_resource::binding_types::{
    sampler, texture_3d, texture_depth_2d, texture_depth_2d_multisampled, uniform_buffer,
};
use bevy::render::render_resource::{
    BindGroup, BindGroupEntries, BindGroupEntry, BindGroupLayoutDescriptor, BindGroupLayoutEntries, BindingResource,
    BlendComponent, BlendState, Buffer, CachedRenderPipelineId, ColorTargetState, ColorWrites, FragmentState,
    MultisampleState, PipelineCache, PrimitiveState, PrimitiveTopology, RenderPassDescriptor, RenderPipelineDescriptor,
    Sampler, SamplerBindingType, ShaderStages, ShaderType, SpecializedRenderPipeline, SpecializedRenderPipelines,
    TextureFormat, TextureSampleType, TextureUsages, TextureView, VertexState,
};
use bevy::render::renderer::{RenderContext, RenderDevice, ViewQuery};
use bevy::render::texture::{FallbackImage, GpuImage};
use bevy::render::view::{
    ExtractedView, Msaa, ViewDepthTexture, ViewTarget, ViewUniform, ViewUniformOffset, ViewUniforms,
};
use bevy::shader::{Shader, ShaderDefVal};

use super::SmokeRenderStats;
use super::extract::ExtractedSmoke;
use super::lighting::{LampUniform, LightingUniform, MAX_LAMPS};

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_view";

/// The `Smoke` of `view.wgsl`.
#[derive(ShaderType, Clone, Debug, PartialEq)]
pub(super) struct SmokeUniform {
    pub bundle_from_clip: Mat4,
    pub eye: Vec4,
    pub rectangle: Vec4,
    pub half_extent: Vec3,
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
    pub emission: Emission,
    pub bind_group: BindGroup,
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
}

/// The pass's layouts and shader.
#[derive(Resource, Clone)]
pub(crate) struct ViewPass {
    volume_layout: BindGroupLayoutDescriptor,
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
        Self { volume_layout: BindGroupLayoutDescriptor::new("smoke_view_volume", &entries), shader: shader.clone() }
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
}

impl ViewPassKey {
    /// Layout of the group that the view binds: its uniform, its depth and, where the shader tone-maps, a table.
    fn view_layout(&self) -> BindGroupLayoutDescriptor {
        let depth = if self.samples > 1 { texture_depth_2d_multisampled() } else { texture_depth_2d() };
        let mut entries = BindGroupLayoutEntries::sequential(
            ShaderStages::VERTEX_FRAGMENT,
            (uniform_buffer::<ViewUniform>(true), depth),
        )
        .to_vec();
        if self.tonemapping.is_some() {
            let luts = get_lut_bind_group_layout_entries();
            let luts = (2..).zip(luts).map(|(binding, entry)| entry.build(binding, ShaderStages::FRAGMENT));
            entries.extend(luts);
        }
        BindGroupLayoutDescriptor::new("smoke_view", &entries)
    }

    fn shader_defs(&self) -> Vec<ShaderDefVal> {
        let mut defs = Vec::new();
        if self.samples > 1 {
            defs.push("MULTISAMPLED".into());
        }
        #[cfg(feature = "reference")]
        if self.emission == Emission::Printed {
            defs.push("PRINTED_EMISSION".into());
        }
        if let Some(tonemapping) = self.tonemapping {
            defs.push("TONEMAP_IN_SHADER".into());
            defs.push(ShaderDefVal::UInt("TONEMAPPING_LUT_TEXTURE_BINDING_INDEX".into(), 2));
            defs.push(ShaderDefVal::UInt("TONEMAPPING_LUT_SAMPLER_BINDING_INDEX".into(), 3));
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
        RenderPipelineDescriptor {
            label: Some(LABEL.into()),
            layout: vec![key.view_layout(), self.volume_layout.clone()],
            vertex: VertexState {
                shader: self.shader.clone(),
                shader_defs: key.shader_defs(),
                entry_point: Some("vertex".into()),
                ..default()
            },
            primitive: PrimitiveState { topology: PrimitiveTopology::TriangleStrip, ..default() },
            multisample: MultisampleState { count: key.samples, ..default() },
            fragment: Some(FragmentState {
                shader: self.shader.clone(),
                shader_defs: key.shader_defs(),
                entry_point: Some("fragment".into()),
                targets: vec![Some(ColorTargetState {
                    format: key.target_format,
                    blend: Some(BlendState { color: over, alpha: over }),
                    write_mask: ColorWrites::ALL,
                })],
            }),
            ..default()
        }
    }
}

/// A view's pipelines.
#[derive(Component)]
pub(super) struct ViewSmokePipeline {
    id: CachedRenderPipelineId,
    /// For the volumes that emit as printed, if there are any.
    #[cfg(feature = "reference")]
    printed: Option<CachedRenderPipelineId>,
    layout: BindGroupLayoutDescriptor,
    key: ViewPassKey,
}

/// Picks the pipeline of every view that may draw smoke.
pub(super) fn prepare_view_pipelines(
    mut commands: Commands,
    cache: Res<PipelineCache>,
    mut pipelines: ResMut<SpecializedRenderPipelines<ViewPass>>,
    pass: Res<ViewPass>,
    smoke: Res<ExtractedSmoke>,
    views: Query<(Entity, &ExtractedView, &ExtractedCamera, &Msaa, Option<&Tonemapping>), With<Camera3d>>,
) {
    for (entity, view, camera, msaa, tonemapping) in &views {
        if smoke.volumes.is_empty() {
            commands.entity(entity).remove::<ViewSmokePipeline>();
            continue;
        }
        let tonemapping = tonemapping.copied().filter(|_| !camera.hdr);
        let emission = Emission::Exact;
        let key = ViewPassKey { target_format: view.target_format, samples: msaa.samples(), tonemapping, emission };
        commands.entity(entity).insert(ViewSmokePipeline {
            id: pipelines.specialize(&cache, &pass, key),
            #[cfg(feature = "reference")]
            printed: smoke.volumes.values().any(|volume| volume.paper.is_some()).then(|| {
                let key = ViewPassKey { emission: Emission::Printed, ..key };
                pipelines.specialize(&cache, &pass, key)
            }),
            layout: key.view_layout(),
            key,
        });
    }
}

/// Lets the pass read the views' depth.
pub(super) fn prepare_depth_usages(mut cameras: Query<&mut Camera3d>, smoke: Res<ExtractedSmoke>) {
    if smoke.volumes.is_empty() {
        return;
    }
    for mut camera in &mut cameras {
        camera.depth_texture_usages.0 |= TextureUsages::TEXTURE_BINDING.bits();
    }
}

/// The tables that tone mapping in the shader reads.
#[derive(bevy::ecs::system::SystemParam)]
pub(super) struct ToneMappingTables<'w> {
    images: Res<'w, RenderAssets<GpuImage>>,
    luts: Res<'w, TonemappingLuts>,
    fallback: Res<'w, FallbackImage>,
}

/// Draws the view's volumes.
pub(super) fn view(
    view: ViewQuery<(
        &ViewTarget,
        &ViewDepthTexture,
        &ViewUniformOffset,
        &ExtractedCamera,
        &ViewSmoke,
        &ViewSmokePipeline,
    )>,
    view_uniforms: Res<ViewUniforms>,
    cache: Res<PipelineCache>,
    tables: ToneMappingTables,
    stats: Res<SmokeRenderStats>,
    mut ctx: RenderContext,
) {
    let (target, depth, offset, camera, smoke, pipeline) = view.into_inner();
    let Some(view_uniforms) = view_uniforms.uniforms.binding() else {
        return;
    };
    let render_pipeline = |emission: Emission| match emission {
        Emission::Exact => cache.get_render_pipeline(pipeline.id),
        #[cfg(feature = "reference")]
        Emission::Printed => cache.get_render_pipeline(pipeline.printed?),
    };
    // Pipelines compile while the app runs.
    if smoke.0.iter().any(|volume| render_pipeline(volume.emission).is_none()) {
        return;
    }
    let mut resources = vec![view_uniforms, BindingResource::TextureView(depth.view())];
    if let Some(tonemapping) = &pipeline.key.tonemapping {
        let (lut, sampler) = get_lut_bindings(&tables.images, &tables.luts, tonemapping, &tables.fallback);
        resources.extend([BindingResource::TextureView(lut), BindingResource::Sampler(sampler)]);
    }
    let entries: Vec<BindGroupEntry> =
        (0..).zip(resources).map(|(binding, resource)| BindGroupEntry { binding, resource }).collect();
    let layout = cache.get_bind_group_layout(&pipeline.layout);
    let view_bind_group = ctx.render_device().create_bind_group(LABEL, &layout, &entries);

    let recorder = ctx.diagnostic_recorder();
    let recorder = recorder.as_deref();
    let mut pass = ctx.begin_tracked_render_pass(RenderPassDescriptor {
        label: Some(LABEL),
        color_attachments: &[Some(target.get_color_attachment())],
        depth_stencil_attachment: None,
        timestamp_writes: None,
        occlusion_query_set: None,
        multiview_mask: None,
    });
    let span = recorder.pass_span(&mut pass, LABEL);
    if let Some(viewport) = &camera.viewport {
        pass.set_camera_viewport(viewport);
    }
    pass.set_bind_group(0, &view_bind_group, &[offset.offset]);
    for volume in &smoke.0 {
        if let Some(render_pipeline) = render_pipeline(volume.emission) {
            pass.set_render_pipeline(render_pipeline);
        }
        pass.set_bind_group(1, &volume.bind_group, &[]);
        pass.draw(0..4, 0..pipeline.key.samples);
        stats.view.add(1);
    }
    span.end(&mut pass);
}
