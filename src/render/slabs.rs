//! Smoke among transparent meshes.
//!
//! Bevy draws transparent meshes one after another, the farthest first by the depth of their centres. Where some of them are
//! behind smoke, or in it, its volumes are cut there, across the view's axis, and the slabs between the cuts are drawn in Bevy's
//! transparent pass, each between the meshes behind it and those in front of it: as items of the `Transparent3d` phase. A mesh
//! that moves through smoke is veiled more and more, without a jump. Meshes across the axis are in their place to the pixel;
//! others are as if they were, at the depth of their centre.
//!
//! That pass writes depth, so the slabs' rays end at a copy of it. Views whose transparent meshes are all in front of the
//! smoke, or that have none, need neither: there the view pass draws volumes as wholes.

use core::ops::Range;

use bevy::core_pipeline::core_3d::{Transparent3d, TransparentSortingInfo3d};
use bevy::core_pipeline::oit::OrderIndependentTransparencySettings;
use bevy::pbr::{ExtractedAtmosphere, Transmissive3d};
use bevy::prelude::*;
use bevy::render::render_asset::RenderAssets;
use bevy::render::render_phase::{
    Draw, DrawError, DrawFunctions, PhaseItemExtraIndex, SortedRenderPhase, TrackedRenderPass, ViewSortedRenderPhases,
};
use bevy::render::render_resource::encase::{ShaderType, UniformBuffer};
use bevy::render::render_resource::{
    BindGroup, BufferInitDescriptor, BufferUsages, CachedRenderPipelineId, CommandEncoder, PipelineCache, Texture,
    TextureDescriptor, TextureDimension, TextureUsages,
};
use bevy::render::renderer::RenderDevice;
use bevy::render::sync_world::MainEntity;
use bevy::render::texture::{GpuImage, TextureCache};
use bevy::render::view::{ExtractedView, RenderVisibleEntities, ViewDepthTexture, ViewUniformOffset, ViewUniforms};

use super::SmokeRenderStats;
use super::extract::ExtractedSmoke;
use super::placed::Placed;
use super::prepare::volumes_in;
use super::view::{ToneMappingTables, ViewSmoke, ViewSmokePipelines};

/// As in `view.wgsl`: the most slabs that a view's smoke is cut into; where more meshes are in it, several go between two slabs.
pub(super) const MAX_SLABS: usize = 8;

/// The `slabs` of `view.wgsl`.
#[derive(ShaderType)]
pub(super) struct SlabsUniform {
    ends: [Vec4; MAX_SLABS],
}

/// The slabs that a view draws in Bevy's transparent pass; never none.
#[derive(Component)]
pub(super) struct ViewSlabs {
    /// Depths where they begin and end, as [`Placed::depths`]; the farthest first.
    slabs: Vec<Range<f32>>,
    resources: Option<SlabResources>,
}

/// What drawing slabs takes.
struct SlabResources {
    depth: Texture,
    bind_group: BindGroup,
}

impl ViewSlabs {
    /// Copies what the opaque pass has left.
    pub fn copy_depth(&self, depth: &ViewDepthTexture, encoder: &mut CommandEncoder) {
        if let Some(resources) = &self.resources {
            let size = depth.texture.size();
            encoder.copy_texture_to_texture(depth.texture.as_image_copy(), resources.depth.as_image_copy(), size);
        }
    }
}

/// The slabs of smoke between `smoke.start` and `smoke.end` that go among items at ascending depths: the number of items
/// behind each, and its ends. None where all of the smoke is behind all items.
fn cut(smoke: Range<f32>, items: &[f32]) -> Vec<(usize, Range<f32>)> {
    let behind = items.partition_point(|depth| *depth <= smoke.start);
    let within = items.partition_point(|depth| *depth < smoke.end) - behind;
    if behind + within == 0 {
        return Vec::new();
    }
    let slabs = (within + 1).min(MAX_SLABS);
    // Evenly among the items, so that none of the groups between two slabs is large.
    let position = |slab: usize| behind + slab * (within + 1) / slabs;
    (0..slabs)
        .map(|slab| {
            let start = if slab == 0 { f32::NEG_INFINITY } else { items[position(slab) - 1] };
            let end = if slab + 1 == slabs { f32::INFINITY } else { items[position(slab + 1) - 1] };
            (position(slab), start..end)
        })
        .collect()
}

/// Puts slabs among the sorted transparent meshes of the views that need them.
pub(super) fn cut_at_transparent_meshes(
    mut commands: Commands,
    smoke: Res<ExtractedSmoke>,
    images: Res<RenderAssets<GpuImage>>,
    mut phases: ResMut<ViewSortedRenderPhases<Transparent3d>>,
    transmissive: Option<Res<ViewSortedRenderPhases<Transmissive3d>>>,
    draw_functions: Res<DrawFunctions<Transparent3d>>,
    cache: Res<PipelineCache>,
    views: Query<
        (
            Entity,
            &ExtractedView,
            &RenderVisibleEntities,
            Option<&ViewSmokePipelines>,
            Has<ExtractedAtmosphere>,
            Has<OrderIndependentTransparencySettings>,
        ),
        With<Camera3d>,
    >,
) {
    let Some(draw_function) = draw_functions.read().get_id::<DrawSlab>() else {
        return;
    };
    for (entity, view, visible, pipelines, has_atmosphere, is_order_independent) in &views {
        commands.entity(entity).remove::<ViewSlabs>();
        let Some(phase) = phases.get_mut(&view.retained_view_entity) else {
            continue;
        };
        // Until its pipelines are there, the smoke is drawn as a whole.
        if !pipelines.and_then(|pipelines| pipelines.slabs.as_ref()).is_some_and(|slabs| slabs.are_ready(&cache)) {
            continue;
        }
        let Some(depths) = depths_of_smoke(view, visible, &smoke, &images) else {
            continue;
        };
        // Glass shows what was drawn before it, so the smoke has to be.
        let glass = transmissive.as_ref().and_then(|phases| phases.get(&view.retained_view_entity));
        let has_glass = glass.is_some_and(|phase| !phase.items.is_empty());
        // Meshes of order-independent transparency are composited after the pass, whatever their place in it.
        let slabs = match is_order_independent || (has_glass && !has_atmosphere) {
            true => Vec::new(),
            false => {
                draw_gizmos_last(phase);
                let items: Vec<f32> =
                    phase.items.values().filter(|item| !is_on_top(item)).map(|item| item.distance).collect();
                cut(depths, &items)
            }
        };
        // The sky that an atmosphere draws over all that is far away comes after the view pass, too.
        let slabs = match slabs.is_empty() && has_atmosphere {
            true => vec![(0, f32::NEG_INFINITY..f32::INFINITY)],
            false => slabs,
        };
        if slabs.is_empty() {
            continue;
        }
        // From the nearest, so that the places of the others stay.
        for (slab, (position, _)) in slabs.iter().enumerate().rev() {
            let item = slab_item(slab as u32, draw_function);
            let key = item.entity;
            phase.items.shift_insert(*position, key, item);
            phase.transient_items.push(key);
        }
        let slabs = slabs.into_iter().map(|(_, depths)| depths).collect();
        commands.entity(entity).insert(ViewSlabs { slabs, resources: None });
    }
}

/// Where the smoke that a view sees begins and ends.
fn depths_of_smoke(
    view: &ExtractedView,
    visible: &RenderVisibleEntities,
    smoke: &ExtractedSmoke,
    images: &RenderAssets<GpuImage>,
) -> Option<Range<f32>> {
    volumes_in(visible)
        .filter_map(|volume| {
            let extracted = smoke.volumes.get(volume)?;
            Some(Placed::new(*volume, extracted, extracted.content.shape(images)?)?.depths(view))
        })
        .reduce(|a, b| a.start.min(b.start)..a.end.max(b.end))
}

fn is_on_top(item: &Transparent3d) -> bool {
    matches!(item.sorting_info, TransparentSortingInfo3d::AlwaysOnTop)
}

/// Bevy sorts what should be on top to the beginning; smoke is not to cover it.
fn draw_gizmos_last(phase: &mut SortedRenderPhase<Transparent3d>) {
    if phase.items.values().any(is_on_top) {
        phase.items.sort_by_key(|_, item| is_on_top(item));
    }
}

fn slab_item(slab: u32, draw_function: bevy::render::render_phase::DrawFunctionId) -> Transparent3d {
    // Not a mesh, which ends batches of meshes here; not an entity either, but a key that no mesh has.
    let key = (Entity::from_raw_u32(slab).expect("a small number"), MainEntity::from(Entity::PLACEHOLDER));
    Transparent3d {
        sorting_info: TransparentSortingInfo3d::AlwaysOnTop,
        distance: 0.0,
        pipeline: CachedRenderPipelineId::INVALID,
        entity: key,
        draw_function,
        batch_range: slab..slab + 1,
        extra_index: PhaseItemExtraIndex::None,
        indexed: false,
    }
}

/// Makes the copy of the depth, and what views with slabs bind.
pub(super) fn prepare_slabs(
    mut views: Query<(&mut ViewSlabs, &ExtractedView, &ViewDepthTexture, &ViewSmokePipelines)>,
    mut textures: ResMut<TextureCache>,
    view_uniforms: Res<ViewUniforms>,
    tables: ToneMappingTables,
    device: Res<RenderDevice>,
    cache: Res<PipelineCache>,
) {
    for (mut view_slabs, view, depth, pipelines) in &mut views {
        let (Some(view_uniforms), Some(pipelines)) = (view_uniforms.uniforms.binding(), &pipelines.slabs) else {
            continue;
        };
        let copy = textures.get(
            &device,
            TextureDescriptor {
                label: Some("smoke_depth"),
                size: depth.texture.size(),
                mip_level_count: 1,
                sample_count: depth.texture.sample_count(),
                dimension: TextureDimension::D2,
                format: depth.texture.format(),
                // Multisampled textures have to be attachments.
                usage: TextureUsages::COPY_DST | TextureUsages::TEXTURE_BINDING | TextureUsages::RENDER_ATTACHMENT,
                view_formats: &[],
            },
        );
        let mut uniform = SlabsUniform { ends: [Vec4::ZERO; MAX_SLABS] };
        for (ends, slab) in uniform.ends.iter_mut().zip(&view_slabs.slabs) {
            *ends = Vec4::new(ndc_depth(view, slab.start), ndc_depth(view, slab.end), 0.0, 0.0);
        }
        let mut contents = UniformBuffer::new(Vec::<u8>::new());
        contents.write(&uniform).expect("a Vec grows as it is written to");
        let buffer = device.create_buffer_with_data(&BufferInitDescriptor {
            label: Some("smoke_slabs"),
            contents: contents.as_ref(),
            usage: BufferUsages::UNIFORM,
        });
        let bind_group =
            pipelines.bind_view(view_uniforms, &copy.default_view, Some(&buffer), None, &tables, &device, &cache);
        view_slabs.resources = Some(SlabResources { depth: copy.texture, bind_group });
    }
}

/// The depth in normalised device coordinates, from 0, far, to 1, near, of a Z in view space.
fn ndc_depth(view: &ExtractedView, z: f32) -> f32 {
    if z == f32::NEG_INFINITY {
        return 0.0;
    }
    let clip = view.clip_from_view * Vec4::new(0.0, 0.0, z, 1.0);
    // At the eye or behind it.
    if clip.w <= 0.0 || !clip.z.is_finite() { 1.0 } else { (clip.z / clip.w).clamp(0.0, 1.0) }
}

/// Draws one slab of every volume that is in it.
pub(super) struct DrawSlab;

impl Draw<Transparent3d> for DrawSlab {
    fn draw<'w>(
        &mut self,
        world: &'w World,
        pass: &mut TrackedRenderPass<'w>,
        view: Entity,
        item: &Transparent3d,
    ) -> Result<(), DrawError> {
        let view = world.entity(view);
        // Smoke that is not there yet.
        let (Some(smoke), Some(offset), Some(pipelines), Some(slabs)) = (
            view.get::<ViewSmoke>(),
            view.get::<ViewUniformOffset>(),
            view.get::<ViewSmokePipelines>().and_then(|pipelines| pipelines.slabs.as_ref()),
            view.get::<ViewSlabs>(),
        ) else {
            return Ok(());
        };
        let Some(resources) = &slabs.resources else { return Ok(()) };
        let slab = item.batch_range.start;
        let ends = &slabs.slabs[slab as usize];
        let volumes = smoke.0.iter().filter(|volume| volume.depths.start < ends.end && ends.start < volume.depths.end);
        pass.set_bind_group(0, &resources.bind_group, &[offset.offset]);
        let draws = pipelines.draw(volumes, slab, world.resource(), pass);
        world.resource::<SmokeRenderStats>().view.add(draws);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn smoke_is_cut_where_meshes_are_in_it() {
        let smoke = -8.0..-4.0;
        let slab = |position, start, end| (position, start..end);
        let (far, near) = (f32::NEG_INFINITY, f32::INFINITY);
        assert_eq!(cut(smoke.clone(), &[]), []);
        assert_eq!(cut(smoke.clone(), &[-4.0, -1.0]), [], "all in front");
        assert_eq!(cut(smoke.clone(), &[-10.0, -8.0]), [slab(2, far, near)], "all behind");
        let cuts = cut(smoke.clone(), &[-10.0, -7.0, -5.0, -1.0]);
        assert_eq!(cuts, [slab(1, far, -7.0), slab(2, -7.0, -5.0), slab(3, -5.0, near)]);
    }

    #[test]
    fn slabs_are_few_and_leave_nothing_out() {
        let items: Vec<f32> = (0..1000).map(|i| -10.0 + 0.01 * i as f32).collect();
        let slabs = cut(-8.0..-4.0, &items);
        assert_eq!(slabs.len(), MAX_SLABS);
        assert_eq!((slabs[0].1.start, slabs[MAX_SLABS - 1].1.end), (f32::NEG_INFINITY, f32::INFINITY));
        for pair in slabs.windows(2) {
            let ((position, slab), (next_position, next)) = (&pair[0], &pair[1]);
            assert_eq!(slab.end, next.start);
            assert_eq!(items[next_position - 1], next.start);
            assert!((45..60).contains(&(next_position - position)), "{position} {next_position}");
        }
    }
}
