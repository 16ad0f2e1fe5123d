//! Shadow mask: the pixels of a view whose meshes smoke does not shade.
//!
//! The mesh-shadow pass cannot tell whose pixel it shades. Where a view that it shades sees meshes that are to be left alone,
//! just these are drawn into a mask first, against the view's own depth. Each is drawn by the pipeline of its own material, all
//! but the fragment stage: whatever the vertex stage does to a mesh (skins, morph targets, a material's own shader), its pixels
//! are those that the opaque pass has drawn. Views without such meshes have no mask.

use core::ops::Range;

use bevy::asset::AssetEventSystems;
use bevy::camera::{MainPassResolutionOverride, Viewport};
use bevy::core_pipeline::core_3d::{Opaque3d, Opaque3dBatchSetKey, Opaque3dBinKey};
use bevy::light::NotShadowReceiver;
use bevy::material::RenderPhaseType;
use bevy::pbr::{
    DrawMaterial, MeshPipeline, PreparedMaterial, RenderMaterialInstances, RenderMeshInstances,
    SpecializedMaterialPipelineCache,
};
use bevy::platform::collections::HashMap;
use bevy::prelude::*;
use bevy::render::batching::gpu_preprocessing::{GpuPreprocessingMode, GpuPreprocessingSupport};
use bevy::render::camera::ExtractedCamera;
use bevy::render::diagnostic::RecordDiagnostics;
use bevy::render::erased_render_asset::ErasedRenderAssets;
use bevy::render::mesh::allocator::MeshAllocator;
use bevy::render::render_phase::{
    AddRenderCommand, BinnedPhaseItem, BinnedRenderPhasePlugin, BinnedRenderPhaseType, CachedRenderPipelinePhaseItem,
    DrawFunctionId, DrawFunctions, InputUniformIndex, PhaseItem, PhaseItemExtraIndex, ViewBinnedRenderPhases,
};
use bevy::render::render_resource::binding_types::{texture_2d, texture_2d_multisampled};
use bevy::render::render_resource::{
    BindGroup, BindGroupEntries, BindGroupLayoutDescriptor, BindGroupLayoutEntries, CachedRenderPipelineId,
    CompareFunction, FragmentState, LoadOp, Operations, PipelineCache, RenderPassColorAttachment,
    RenderPassDepthStencilAttachment, RenderPassDescriptor, ShaderStages, StoreOp, TextureDescriptor, TextureDimension,
    TextureFormat, TextureSampleType, TextureUsages, TextureView,
};
use bevy::render::renderer::{RenderContext, RenderDevice, ViewQuery};
use bevy::render::sync_world::MainEntity;
use bevy::render::texture::TextureCache;
use bevy::render::view::{
    ExtractedView, NoIndirectDrawing, RenderVisibleEntities, RetainedViewEntity, ViewDepthTexture,
};
use bevy::render::{Extract, ExtractSchedule, GpuResourceAppExt, Render, RenderApp, RenderDebugFlags, RenderSystems};
use bevy::shader::Shader;

use super::SmokeRenderStats;
use super::extract::{ExtractedSmoke, extract_smoke};
use super::mesh_shadows::ViewMeshShadows;
use crate::shadows::NoSmokeShadow;

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_shadow_mask";

/// Finds the meshes that smoke does not shade, and draws them into masks.
pub(super) struct ShadowMaskPlugin;

impl Plugin for ShadowMaskPlugin {
    fn build(&self, app: &mut App) {
        app.add_plugins(BinnedRenderPhasePlugin::<ShadowMask3d, MeshPipeline>::new(RenderDebugFlags::default()))
            .add_systems(
                PostUpdate,
                find_unlit_meshes.after(AssetEventSystems).run_if(resource_exists::<Assets<StandardMaterial>>),
            );
        app.sub_app_mut(RenderApp)
            .init_resource::<UnshadedMeshes>()
            .init_resource::<DrawFunctions<ShadowMask3d>>()
            .add_render_command::<ShadowMask3d, DrawMaterial>()
            .init_gpu_resource::<QueuedMeshes>()
            .init_gpu_resource::<MaskPipelines>()
            .add_systems(ExtractSchedule, extract_unshaded_meshes.after(extract_smoke))
            .add_systems(
                Render,
                queue_unshaded_meshes.in_set(RenderSystems::QueueMeshes).run_if(
                    resource_exists::<ShadowMaskPass>.and_then(resource_exists::<SpecializedMaterialPipelineCache>),
                ),
            );
    }
}

/// Beside a mesh whose material is unlit: what shows its colour whatever the light is shows it in a shadow, too.
#[derive(Component)]
#[component(storage = "SparseSet")]
struct Unlit;

/// Finds the meshes with unlit materials, in the main world.
fn find_unlit_meshes(
    mut commands: Commands,
    materials: Res<Assets<StandardMaterial>>,
    changed: Query<
        (Entity, &MeshMaterial3d<StandardMaterial>, Has<Unlit>),
        Or<(Changed<MeshMaterial3d<StandardMaterial>>, AssetChanged<MeshMaterial3d<StandardMaterial>>)>,
    >,
    mut removed: RemovedComponents<MeshMaterial3d<StandardMaterial>>,
) {
    for entity in removed.read() {
        if let Ok(mut entity) = commands.get_entity(entity) {
            entity.try_remove::<Unlit>();
        }
    }
    for (entity, material, was_unlit) in &changed {
        let is_unlit = materials.get(material).is_some_and(|material| material.unlit);
        if is_unlit {
            commands.entity(entity).try_insert(Unlit);
        } else if was_unlit {
            commands.entity(entity).try_remove::<Unlit>();
        }
    }
}

/// All meshes that smoke does not shade.
#[derive(Resource, Default)]
struct UnshadedMeshes(Vec<MainEntity>);

fn extract_unshaded_meshes(
    mut unshaded: ResMut<UnshadedMeshes>,
    smoke: Res<ExtractedSmoke>,
    meshes: Extract<Query<Entity, (With<Mesh3d>, Or<(With<NoSmokeShadow>, With<NotShadowReceiver>, With<Unlit>)>)>>,
) {
    unshaded.0.clear();
    if !smoke.camera_shadows.is_empty() {
        unshaded.0.extend(meshes.iter().map(MainEntity::from));
    }
}

/// A mesh to draw into a mask: as Bevy's opaque pass draws it, by another pipeline.
pub(super) struct ShadowMask3d(Opaque3d);

impl PhaseItem for ShadowMask3d {
    fn entity(&self) -> Entity {
        self.0.entity()
    }

    fn main_entity(&self) -> MainEntity {
        self.0.main_entity()
    }

    fn draw_function(&self) -> DrawFunctionId {
        self.0.draw_function()
    }

    fn batch_range(&self) -> &Range<u32> {
        self.0.batch_range()
    }

    fn batch_range_mut(&mut self) -> &mut Range<u32> {
        self.0.batch_range_mut()
    }

    fn extra_index(&self) -> PhaseItemExtraIndex {
        self.0.extra_index()
    }

    fn batch_range_and_extra_index_mut(&mut self) -> (&mut Range<u32>, &mut PhaseItemExtraIndex) {
        self.0.batch_range_and_extra_index_mut()
    }
}

impl BinnedPhaseItem for ShadowMask3d {
    type BatchSetKey = Opaque3dBatchSetKey;
    type BinKey = Opaque3dBinKey;

    fn new(
        batch_set_key: Self::BatchSetKey,
        bin_key: Self::BinKey,
        representative_entity: (Entity, MainEntity),
        batch_range: Range<u32>,
        extra_index: PhaseItemExtraIndex,
    ) -> Self {
        Self(Opaque3d::new(batch_set_key, bin_key, representative_entity, batch_range, extra_index))
    }
}

impl CachedRenderPipelinePhaseItem for ShadowMask3d {
    fn cached_pipeline(&self) -> CachedRenderPipelineId {
        self.0.cached_pipeline()
    }
}

/// The pass's shader.
#[derive(Resource)]
pub(super) struct ShadowMaskPass {
    shader: Handle<Shader>,
}

impl ShadowMaskPass {
    pub fn new(shader: &Handle<Shader>) -> Self {
        Self { shader: shader.clone() }
    }

    /// A material's pipeline with this pass's fragment stage.
    fn queue(
        &self,
        material: CachedRenderPipelineId,
        phase: RenderPhaseType,
        cache: &PipelineCache,
    ) -> CachedRenderPipelineId {
        let mut descriptor = cache.get_render_pipeline_descriptor(material).clone();
        descriptor.label = Some(LABEL.into());
        descriptor.fragment = Some(FragmentState {
            shader: self.shader.clone(),
            entry_point: Some("fragment".into()),
            targets: vec![Some(FORMAT.into())],
            ..default()
        });
        descriptor.multisample.alpha_to_coverage_enabled = false;
        if let Some(depth) = &mut descriptor.depth_stencil {
            depth.depth_write_enabled = Some(false);
            // Opaque meshes are tested as they were when drawn; what is seen through holes of others is not theirs.
            if matches!(phase, RenderPhaseType::AlphaMask) {
                depth.depth_compare = Some(CompareFunction::Equal);
            }
        }
        cache.queue_render_pipeline(descriptor)
    }
}

/// The pipelines made of materials' own.
#[derive(Resource, Default)]
struct MaskPipelines(HashMap<CachedRenderPipelineId, CachedRenderPipelineId>);

/// What a view's phase holds of a mesh.
#[derive(Clone, PartialEq)]
pub(super) struct QueuedMesh {
    entity: MainEntity,
    batch_set_key: Opaque3dBatchSetKey,
    bin_key: Opaque3dBinKey,
    input: InputUniformIndex,
    batching: BinnedRenderPhaseType,
}

/// What views' phases hold.
#[derive(Resource, Default)]
pub(super) struct QueuedMeshes(HashMap<RetainedViewEntity, Vec<QueuedMesh>>);

/// Fills the phases of the views that see such meshes.
fn queue_unshaded_meshes(
    unshaded: Res<UnshadedMeshes>,
    smoke: Res<ExtractedSmoke>,
    pass: Res<ShadowMaskPass>,
    mut phases: ResMut<ViewBinnedRenderPhases<ShadowMask3d>>,
    mut queued: ResMut<QueuedMeshes>,
    mut pipelines: ResMut<MaskPipelines>,
    mut cache: ResMut<PipelineCache>,
    material_pipelines: Res<SpecializedMaterialPipelineCache>,
    materials: Res<ErasedRenderAssets<PreparedMaterial>>,
    material_instances: Res<RenderMaterialInstances>,
    mesh_instances: Res<RenderMeshInstances>,
    allocator: Res<MeshAllocator>,
    preprocessing: Res<GpuPreprocessingSupport>,
    draw_functions: Res<DrawFunctions<ShadowMask3d>>,
    views: Query<
        (&ExtractedView, &RenderVisibleEntities, Has<NoIndirectDrawing>),
        (With<ExtractedCamera>, With<Camera3d>),
    >,
) {
    let draw_function = draw_functions.read().id::<DrawMaterial>();
    let mut mask_pipeline = |material, phase| {
        *pipelines.0.entry(material).or_insert_with(|| {
            // A pipeline of this frame's has no descriptor yet.
            cache.process_queue();
            pass.queue(material, phase, &cache)
        })
    };
    let mut mesh_of_view = |entity: MainEntity, view: &RetainedViewEntity| {
        let pipeline = *material_pipelines.get(view)?.get(&entity)?;
        let material = materials.get(material_instances.instances.get(&entity)?.asset_id)?;
        let phase = material.properties.render_phase_type;
        if !matches!(phase, RenderPhaseType::Opaque | RenderPhaseType::AlphaMask) {
            return None;
        }
        let instance = mesh_instances.render_mesh_queue_data(entity)?;
        Some(QueuedMesh {
            entity,
            batch_set_key: Opaque3dBatchSetKey {
                pipeline: mask_pipeline(pipeline, phase),
                draw_function,
                material_bind_group_index: Some(material.binding.group.0),
                slabs: allocator.mesh_slabs(&instance.mesh_asset_id())?,
                lightmap_slab: instance.shared.lightmap_slab_index().map(|index| *index),
            },
            bin_key: Opaque3dBinKey { asset_id: instance.mesh_asset_id().into() },
            input: instance.current_uniform_index,
            batching: BinnedRenderPhaseType::mesh(instance.should_batch(), &preprocessing),
        })
    };

    let mut next = HashMap::default();
    for (view, visible, is_direct) in &views {
        let key = view.retained_view_entity;
        let Some(visible) = visible.get::<Mesh3d>() else { continue };
        if !smoke.camera_shadows.contains_key(&key.main_entity) {
            continue;
        }
        let is_visible = |entity: &MainEntity| {
            visible.entities_cpu_culling.binary_search(&(Entity::PLACEHOLDER, *entity)).is_ok()
                || visible.entities_gpu_culling.contains_key(entity)
        };
        let meshes: Vec<_> = unshaded
            .0
            .iter()
            .filter(|entity| is_visible(entity))
            .filter_map(|entity| mesh_of_view(*entity, &key))
            .collect();
        if meshes.is_empty() {
            continue;
        }
        let mode = if is_direct { GpuPreprocessingMode::PreprocessingOnly } else { GpuPreprocessingMode::Culling };
        phases.prepare_for_new_frame(key, preprocessing.min(mode));
        let phase = phases.get_mut(&key).expect("it was just prepared");
        let before = queued.0.remove(&key).unwrap_or_default();
        if before != meshes {
            for mesh in before {
                phase.remove(mesh.entity);
            }
            for mesh in meshes.iter().cloned() {
                let entity = (Entity::PLACEHOLDER, mesh.entity);
                phase.add(mesh.batch_set_key, mesh.bin_key, entity, mesh.input, mesh.batching);
            }
        }
        next.insert(key, meshes);
    }
    phases.retain(|view, _| next.contains_key(view));
    queued.0 = next;
}

const FORMAT: TextureFormat = TextureFormat::R8Unorm;

/// What the mesh-shadow pass binds to read a mask, as a group of its own.
pub(super) fn layout(samples: u32) -> BindGroupLayoutDescriptor {
    let float = TextureSampleType::Float { filterable: false };
    let mask = if samples > 1 { texture_2d_multisampled(float) } else { texture_2d(float) };
    BindGroupLayoutDescriptor::new(LABEL, &BindGroupLayoutEntries::single(ShaderStages::FRAGMENT, mask))
}

/// A view's mask; only of views that need one.
#[derive(Component)]
pub(super) struct ViewShadowMask {
    texture: TextureView,
    pub bind_group: BindGroup,
}

pub(super) fn prepare_shadow_masks(
    mut commands: Commands,
    views: Query<(Entity, &ExtractedView, &ViewDepthTexture, Has<ViewShadowMask>), With<ExtractedCamera>>,
    shaded: Query<(), With<ViewMeshShadows>>,
    queued: Res<QueuedMeshes>,
    mut textures: ResMut<TextureCache>,
    device: Res<RenderDevice>,
    cache: Res<PipelineCache>,
) {
    for (entity, view, depth, had_mask) in &views {
        if !queued.0.contains_key(&view.retained_view_entity) || !shaded.contains(entity) {
            if had_mask {
                commands.entity(entity).remove::<ViewShadowMask>();
            }
            continue;
        }
        let samples = depth.texture.sample_count();
        let texture = textures.get(
            &device,
            TextureDescriptor {
                label: Some(LABEL),
                size: depth.texture.size(),
                mip_level_count: 1,
                sample_count: samples,
                dimension: TextureDimension::D2,
                format: FORMAT,
                usage: TextureUsages::RENDER_ATTACHMENT | TextureUsages::TEXTURE_BINDING,
                view_formats: &[],
            },
        );
        let bind_group = device.create_bind_group(
            LABEL,
            &cache.get_bind_group_layout(&layout(samples)),
            &BindGroupEntries::single(&texture.default_view),
        );
        commands.entity(entity).insert(ViewShadowMask { texture: texture.default_view, bind_group });
    }
}

/// Draws the view's mask.
pub(super) fn shadow_mask(
    world: &World,
    view: ViewQuery<(
        &ExtractedView,
        &ExtractedCamera,
        Option<&MainPassResolutionOverride>,
        &ViewDepthTexture,
        &ViewShadowMask,
    )>,
    phases: Res<ViewBinnedRenderPhases<ShadowMask3d>>,
    stats: Res<SmokeRenderStats>,
    mut ctx: RenderContext,
) {
    let view_entity = view.entity();
    let (view, camera, resolution, depth, mask) = view.into_inner();
    let Some(phase) = phases.get(&view.retained_view_entity) else { return };
    let recorder = ctx.diagnostic_recorder();
    let recorder = recorder.as_deref();
    let mut pass = ctx.begin_tracked_render_pass(RenderPassDescriptor {
        label: Some(LABEL),
        color_attachments: &[Some(RenderPassColorAttachment {
            view: &mask.texture,
            depth_slice: None,
            resolve_target: None,
            ops: Operations { load: LoadOp::Clear(default()), store: StoreOp::Store },
        })],
        // Without operations it is read only.
        depth_stencil_attachment: Some(RenderPassDepthStencilAttachment {
            view: depth.view(),
            depth_ops: None,
            stencil_ops: None,
        }),
        timestamp_writes: None,
        occlusion_query_set: None,
        multiview_mask: None,
    });
    let span = recorder.pass_span(&mut pass, LABEL);
    if let Some(viewport) = Viewport::from_viewport_and_override(camera.viewport.as_ref(), resolution) {
        pass.set_camera_viewport(&viewport);
    }
    if let Err(failure) = phase.render(&mut pass, world, view_entity) {
        error_once!("the mask of smoke's shadows was not drawn: {failure} (said once)");
    }
    stats.shadow_mask.add(1);
    span.end(&mut pass);
}
