//! Mesh-shadow pass: shades the opaque meshes of a view by the smoke around them, between the opaque pass and the smoke's
//! own. No material takes part: surfaces are found by the view's depth, lights and shadow maps in what Bevy binds for its
//! own deferred lighting, and what is drawn so far is multiplied by the share of light that is left.

use bevy::camera::{MainPassResolutionOverride, Viewport};
use bevy::core_pipeline::tonemapping::Tonemapping;
use bevy::pbr::{
    MeshPipeline, MeshPipelineKey, MeshViewBindGroup, TONEMAPPING_LUT_SAMPLER_BINDING_INDEX,
    TONEMAPPING_LUT_TEXTURE_BINDING_INDEX, ViewKeyCache,
};
use bevy::prelude::*;
use bevy::render::camera::ExtractedCamera;
use bevy::render::diagnostic::RecordDiagnostics;
use bevy::render::render_resource::binding_types::{
    sampler, storage_buffer_read_only_sized, texture_3d, texture_depth_2d, texture_depth_2d_multisampled,
    uniform_buffer,
};
use bevy::render::render_resource::{
    BindGroupEntry, BindGroupLayoutDescriptor, BindGroupLayoutEntries, BindingResource, BlendComponent, BlendFactor,
    BlendOperation, BlendState, Buffer, CachedRenderPipelineId, ColorTargetState, ColorWrites, FragmentState,
    MultisampleState, PipelineCache, PrimitiveState, RenderPassDescriptor, RenderPipelineDescriptor, Sampler,
    SamplerBindingType, ShaderStages, ShaderType, SpecializedRenderPipeline, SpecializedRenderPipelines,
    TextureSampleType, TextureView, VertexState,
};
use bevy::render::renderer::{RenderContext, RenderDevice, RenderQueue, ViewQuery};
use bevy::render::view::{ExtractedView, ViewDepthTexture, ViewTarget};
use bevy::shader::{Shader, ShaderDefVal};

use super::SmokeRenderStats;
use super::casters::{CasterUniform, MAX_CASTERS};
use super::frame::uniform;
use super::shadow_mask::{self, ViewShadowMask};
use super::sky::SkyUniform;
use crate::sh::{SphereRule, VISIBILITY_ENTRIES, log_visibilities};

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_mesh_shadows";

/// Bevy's own limit of directional lights a view; as in `mesh_shadows.wgsl`.
const MAX_SUNS: usize = 10;

/// The `MeshShadows` of `mesh_shadows.wgsl`.
#[derive(ShaderType, Clone, Debug, Default, PartialEq)]
pub(super) struct MeshShadowUniform {
    pub sky: SkyUniform,
    pub caster_count: u32,
    pub sun_count: u32,
    pub sphere_count: u32,
    pub casters: [CasterUniform; MAX_CASTERS],
}

impl MeshShadowUniform {
    pub fn new(sky: SkyUniform, casters: Vec<CasterUniform>, suns: usize, spheres: usize) -> Self {
        let (sun_count, sphere_count) = (suns.min(MAX_SUNS) as u32, spheres as u32);
        let mut uniform = Self { sky, sun_count, sphere_count, ..default() };
        for (slot, caster) in uniform.casters.iter_mut().zip(casters) {
            *slot = caster;
            uniform.caster_count += 1;
        }
        uniform
    }
}

/// What a view binds to shade its meshes; absent where nothing shades them.
#[derive(Component)]
pub(super) struct ViewMeshShadows {
    pub uniform: Buffer,
    pub environment: Buffer,
    pub densities: TextureView,
    pub probes: TextureView,
    pub sampler: Sampler,
    /// Where spheres shade the meshes as well: the tables and the spheres.
    pub occluders: Option<[Buffer; 2]>,
}

/// The `Occlusion` of `mesh_shadows.wgsl`.
#[derive(ShaderType, Clone, Debug)]
struct OcclusionUniform {
    directions: [Vec4; 32],
    log_visibility: [Vec4; VISIBILITY_ENTRIES],
}

/// The tables that the shadows of spheres take.
pub(super) fn occlusion_tables(device: &RenderDevice, queue: &RenderQueue) -> Buffer {
    let rule = SphereRule::new(4);
    let table = log_visibilities();
    let tables = OcclusionUniform {
        directions: core::array::from_fn(|j| {
            let (direction, weight) = rule.nodes()[j];
            direction.as_vec3().extend(weight as f32)
        }),
        log_visibility: table.map(|factors| Vec4::from_array(factors.map(|factor| factor as f32))),
    };
    uniform(device, queue, "smoke_occlusion", tables)
}

/// The pass's shader, and Bevy's mesh pipeline, whose view bindings it shares.
#[derive(Resource, Clone)]
pub(crate) struct MeshShadowPass {
    mesh_pipeline: MeshPipeline,
    shader: Handle<Shader>,
}

impl MeshShadowPass {
    /// None in an app without Bevy's PBR.
    pub fn new(mesh_pipeline: Option<&MeshPipeline>, shader: &Handle<Shader>) -> Option<Self> {
        Some(Self { mesh_pipeline: mesh_pipeline?.clone(), shader: shader.clone() })
    }
}

fn layout(samples: u32, occluders: bool) -> BindGroupLayoutDescriptor {
    let depth = if samples > 1 { texture_depth_2d_multisampled() } else { texture_depth_2d() };
    let entries = BindGroupLayoutEntries::sequential(
        ShaderStages::VERTEX_FRAGMENT,
        (
            uniform_buffer::<MeshShadowUniform>(false),
            uniform_buffer::<[Vec4; 16]>(false),
            depth,
            texture_3d(TextureSampleType::Float { filterable: true }),
            texture_3d(TextureSampleType::Float { filterable: true }),
            sampler(SamplerBindingType::Filtering),
        ),
    );
    let mut entries = entries.to_vec();
    if occluders {
        entries.push(uniform_buffer::<OcclusionUniform>(false).build(6, ShaderStages::FRAGMENT));
        entries.push(storage_buffer_read_only_sized(false, None).build(7, ShaderStages::FRAGMENT));
    }
    BindGroupLayoutDescriptor::new(LABEL, &entries)
}

/// What a view asks of the pipeline.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct MeshShadowKey {
    view: MeshPipelineKey,
    /// Whether spheres shade the view's meshes.
    occluders: bool,
    /// Whether some of the meshes are not shaded.
    masked: bool,
}

impl SpecializedRenderPipeline for MeshShadowPass {
    type Key = MeshShadowKey;

    fn specialize(&self, MeshShadowKey { view: key, occluders, masked }: Self::Key) -> RenderPipelineDescriptor {
        let samples = key.msaa_samples();
        let mut shader_defs = shader_defs(key);
        if occluders {
            shader_defs.push("OCCLUDERS".into());
        }
        if masked {
            shader_defs.push("MASKED".into());
        }
        let mask = masked.then(|| shadow_mask::layout(samples));
        let view = self.mesh_pipeline.get_view_layout(key.into());
        let multiply = BlendComponent {
            src_factor: BlendFactor::Dst,
            dst_factor: BlendFactor::Zero,
            operation: BlendOperation::Add,
        };
        let keep = BlendComponent { src_factor: BlendFactor::Zero, dst_factor: BlendFactor::One, ..multiply };
        RenderPipelineDescriptor {
            label: Some(LABEL.into()),
            layout: [view.main_layout, view.binding_array_layout, layout(samples, occluders)]
                .into_iter()
                .chain(mask)
                .collect(),
            vertex: VertexState {
                shader: self.shader.clone(),
                shader_defs: shader_defs.clone(),
                entry_point: Some("vertex".into()),
                ..default()
            },
            primitive: PrimitiveState::default(),
            multisample: MultisampleState { count: samples, ..default() },
            fragment: Some(FragmentState {
                shader: self.shader.clone(),
                shader_defs,
                entry_point: Some("fragment".into()),
                targets: vec![Some(ColorTargetState {
                    format: key.target_format(),
                    blend: Some(BlendState { color: multiply, alpha: keep }),
                    write_mask: ColorWrites::COLOR,
                })],
            }),
            ..default()
        }
    }
}

/// What the shader and the parts of Bevy's that it imports ask of a view.
fn shader_defs(key: MeshPipelineKey) -> Vec<ShaderDefVal> {
    let mut defs: Vec<ShaderDefVal> = Vec::new();
    if key.msaa_samples() > 1 {
        defs.push("MULTISAMPLED".into());
        defs.push(ShaderDefVal::UInt("SAMPLES".into(), key.msaa_samples()));
    }
    if key.contains(MeshPipelineKey::NORMAL_PREPASS) {
        defs.push("NORMAL_PREPASS".into());
    }
    let filter = key.intersection(MeshPipelineKey::SHADOW_FILTER_METHOD_RESERVED_BITS);
    let filters = [
        (MeshPipelineKey::SHADOW_FILTER_METHOD_HARDWARE_2X2, "SHADOW_FILTER_METHOD_HARDWARE_2X2"),
        (MeshPipelineKey::SHADOW_FILTER_METHOD_GAUSSIAN, "SHADOW_FILTER_METHOD_GAUSSIAN"),
        (MeshPipelineKey::SHADOW_FILTER_METHOD_TEMPORAL, "SHADOW_FILTER_METHOD_TEMPORAL"),
    ];
    defs.extend(filters.into_iter().filter(|(bits, _)| filter == *bits).map(|(_, name)| name.into()));
    if key.contains(MeshPipelineKey::TONEMAP_IN_SHADER) {
        defs.push("TONEMAP_IN_SHADER".into());
        let (texture, sampler) = (TONEMAPPING_LUT_TEXTURE_BINDING_INDEX, TONEMAPPING_LUT_SAMPLER_BINDING_INDEX);
        defs.push(ShaderDefVal::UInt("TONEMAPPING_LUT_TEXTURE_BINDING_INDEX".into(), texture));
        defs.push(ShaderDefVal::UInt("TONEMAPPING_LUT_SAMPLER_BINDING_INDEX".into(), sampler));
        defs.push(tonemapping_of(key).into());
    }
    defs
}

fn tonemapping_of(key: MeshPipelineKey) -> &'static str {
    let method = key.intersection(MeshPipelineKey::TONEMAP_METHOD_RESERVED_BITS);
    let methods = [
        (MeshPipelineKey::TONEMAP_METHOD_NONE, Tonemapping::None),
        (MeshPipelineKey::TONEMAP_METHOD_REINHARD, Tonemapping::Reinhard),
        (MeshPipelineKey::TONEMAP_METHOD_REINHARD_LUMINANCE, Tonemapping::ReinhardLuminance),
        (MeshPipelineKey::TONEMAP_METHOD_ACES_FITTED, Tonemapping::AcesFitted),
        (MeshPipelineKey::TONEMAP_METHOD_AGX, Tonemapping::AgX),
        (
            MeshPipelineKey::TONEMAP_METHOD_SOMEWHAT_BORING_DISPLAY_TRANSFORM,
            Tonemapping::SomewhatBoringDisplayTransform,
        ),
        (MeshPipelineKey::TONEMAP_METHOD_TONY_MC_MAPFACE, Tonemapping::TonyMcMapface),
        (MeshPipelineKey::TONEMAP_METHOD_BLENDER_FILMIC, Tonemapping::BlenderFilmic),
        (MeshPipelineKey::TONEMAP_METHOD_PBR_NEUTRAL, Tonemapping::KhronosPbrNeutral),
    ];
    let found = methods.into_iter().find(|(bits, _)| method == *bits);
    super::view::tonemapping_def(found.map_or(Tonemapping::None, |(_, tonemapping)| tonemapping))
}

/// A view's pipeline.
#[derive(Component)]
pub(super) struct ViewMeshShadowPipeline {
    id: CachedRenderPipelineId,
    samples: u32,
}

/// Picks the pipeline of every view that may be shaded.
pub(super) fn prepare_mesh_shadow_pipelines(
    mut commands: Commands,
    cache: Res<PipelineCache>,
    mut pipelines: ResMut<SpecializedRenderPipelines<MeshShadowPass>>,
    pass: Res<MeshShadowPass>,
    keys: Res<ViewKeyCache>,
    views: Query<(Entity, &ExtractedView), (With<ExtractedCamera>, With<Camera3d>)>,
    shaded: Query<(&ViewMeshShadows, Has<ViewShadowMask>)>,
) {
    for (entity, view) in &views {
        match (keys.get(&view.retained_view_entity), shaded.get(entity)) {
            (Some(key), Ok((shadows, masked))) => {
                let key = MeshShadowKey { view: *key, occluders: shadows.occluders.is_some(), masked };
                let id = pipelines.specialize(&cache, &pass, key);
                commands.entity(entity).insert(ViewMeshShadowPipeline { id, samples: key.view.msaa_samples() });
            }
            _ => {
                commands.entity(entity).remove::<ViewMeshShadowPipeline>();
            }
        }
    }
}

/// Shades the view's meshes.
pub(super) fn mesh_shadows(
    view: ViewQuery<(
        &ViewTarget,
        &ViewDepthTexture,
        &ExtractedCamera,
        Option<&MainPassResolutionOverride>,
        &MeshViewBindGroup,
        &ViewMeshShadows,
        &ViewMeshShadowPipeline,
        Option<&ViewShadowMask>,
    )>,
    cache: Res<PipelineCache>,
    stats: Res<SmokeRenderStats>,
    mut ctx: RenderContext,
) {
    let (target, depth, camera, resolution, mesh_view, shadows, pipeline, mask) = view.into_inner();
    // Pipelines compile while the app runs.
    let Some(render_pipeline) = cache.get_render_pipeline(pipeline.id) else { return };
    let mut resources = vec![
        shadows.uniform.as_entire_binding(),
        shadows.environment.as_entire_binding(),
        BindingResource::TextureView(depth.view()),
        BindingResource::TextureView(&shadows.densities),
        BindingResource::TextureView(&shadows.probes),
        BindingResource::Sampler(&shadows.sampler),
    ];
    resources.extend(shadows.occluders.iter().flatten().map(|buffer| buffer.as_entire_binding()));
    let entries: Vec<BindGroupEntry> =
        (0..).zip(resources).map(|(binding, resource)| BindGroupEntry { binding, resource }).collect();
    let bind_group = ctx.render_device().create_bind_group(
        LABEL,
        &cache.get_bind_group_layout(&layout(pipeline.samples, shadows.occluders.is_some())),
        &entries,
    );
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
    if let Some(viewport) = Viewport::from_viewport_and_override(camera.viewport.as_ref(), resolution) {
        pass.set_camera_viewport(&viewport);
    }
    pass.set_render_pipeline(render_pipeline);
    pass.set_bind_group(0, &mesh_view.main, &mesh_view.main_offsets);
    pass.set_bind_group(1, &mesh_view.binding_array, &[]);
    pass.set_bind_group(2, &bind_group, &[]);
    if let Some(mask) = mask {
        pass.set_bind_group(3, &mask.bind_group, &[]);
    }
    pass.draw(0..3, 0..pipeline.samples);
    stats.mesh_shadows.add(1);
    span.end(&mut pass);
}
