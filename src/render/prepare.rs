//! Decides what must be computed this frame, and for whom.
//!
//! The work forms a tree, and each level is done only when something above it changed:
//!
//! | state | one per | changes with |
//! |---|---|---|
//! | [`Environments`] | environment | its image or coefficients |
//! | [`GpuBakedFrame`](super::baked::GpuBakedFrame) | baked frame that a moment blends | nothing |
//! | [`GpuSmokeFrame`] | moment that volumes show, or live texture | time, in place |
//! | [`LitVolume`] | volume × environment | environment and moment, the medium, the volume's rotation and scale, lamps |
//! | [`SlicedVolume`](super::lit::SlicedVolume) | lit volume, × view where the phase function is not isotropic | the lit volume; the eye in bundle space |

use bevy::camera::MainPassResolutionOverride;
use bevy::platform::collections::HashMap;
use bevy::prelude::*;
use bevy::render::camera::{ExtractedCamera, TemporalJitter};
use bevy::render::render_asset::{ExtractedAssets, RenderAssets};
use bevy::render::render_resource::{
    AddressMode, Buffer, FilterMode, PipelineCache, Sampler, SamplerDescriptor, TextureView,
};
use bevy::render::renderer::{RenderAdapterInfo, RenderDevice, RenderQueue};
use bevy::render::sync_world::MainEntity;
use bevy::render::texture::GpuImage;
use bevy::render::view::{ExtractedView, RenderVisibleEntities};

use super::casters::Casters;
use super::constellation::{self, ConstellationPasses, ConstellationWork, Constellations};
use super::debug::{self, DebugPasses};
use super::extract::{Content, ExtractedSmoke, ExtractedVolume};
use super::footprint::Footprints;
use super::frame::{FILTERED_FORMAT, GpuSmokeFrame, texture_3d};
use super::level::Levels;
use super::light::{Environments, Light, LightKey, Lit};
use super::lit::{FrameLight, LitVolume};
use super::live::LiveFrames;
use super::mesh_shadows::ViewMeshShadows;
use super::moments::Moments;
#[cfg(feature = "reference")]
use super::paper;
use super::placed::{Placed, warn_of_limits};
use super::quality::Qualities;
use super::shading::{ShadedBy, Shading, casting};
use super::slabs::ViewSlabs;
use super::surroundings::{Around, Surroundings};
use super::view::{Emission, Glow, ViewPass, ViewSmoke, ViewSmokeVolume};
use super::{SmokeMemory, SmokePasses, SmokeRenderStats, SmokeWork};
use crate::constellation::ConstellationShading;
use crate::debug::SmokeDebugView;
use crate::scattering::ScatteringSolver;
use crate::volume::SmokeVolume;

/// Frames that computed state is kept while nobody looks at it.
const KEEP_FRAMES: u32 = 300;

/// Everything that outlives a frame.
#[derive(Resource, Default)]
pub(super) struct SmokeCache {
    frame: u32,
    environments: Environments,
    frames: Frames,
    levels: Levels,
    qualities: Qualities,
    volumes: HashMap<(MainEntity, LightKey), LitVolume>,
    casters: Casters,
    shading: Shading,
    surroundings: HashMap<(MainEntity, LightKey), Surroundings>,
    shared: Option<Shared>,
}

/// What volumes show, baked and live.
#[derive(Default)]
struct Frames {
    moments: Moments,
    live: LiveFrames,
}

impl Frames {
    /// What a volume shows, on the GPU; None where it cannot be drawn.
    fn show(
        &mut self,
        entity: MainEntity,
        volume: &ExtractedVolume,
        images: &RenderAssets<GpuImage>,
        gpu: &Gpu,
        work: &mut SmokeWork,
    ) -> Option<&GpuSmokeFrame> {
        match &volume.content {
            Content::Baked(moment) => self.moments.show(entity, moment, gpu, work),
            Content::Live(live) => self.live.show(entity, live, images, gpu, work),
        }
    }

    fn memory(&self) -> SmokeMemory {
        let baked = self.moments.memory();
        let (count, bytes) = self.live.memory();
        SmokeMemory { moments: baked.moments + count, bytes: baked.bytes + bytes, ..baked }
    }
}

/// Where light that scatters more than once adds less than this to single scattering, it does not diffuse.
const DIFFUSION_SHARE: f32 = 0.1;

/// What all volumes share.
struct Shared {
    sampler: Sampler,
    footprints: Buffer,
    nothing: TextureView,
    #[cfg(feature = "reference")]
    paper_tables: Buffer,
}

#[cfg(all(test, feature = "cli"))]
impl SmokeCache {
    /// The one 3D texture there is.
    pub fn only_texture(&self) -> &bevy::render::render_resource::TextureView {
        let mut sliced = self.volumes.values().flat_map(|volume| volume.sliced.values());
        let texture = &sliced.next().expect("a volume has been drawn").texture;
        assert!(sliced.next().is_none(), "more than one volume has been drawn");
        texture
    }
}

#[cfg(feature = "cli")]
impl SmokeCache {
    /// The reports of the solvers of all volumes, as buffers on the GPU.
    pub fn solver_controls(&self) -> impl Iterator<Item = &Buffer> {
        self.volumes.values().filter_map(LitVolume::control)
    }
}

/// What making resources takes.
pub(super) struct Gpu<'a> {
    pub device: &'a RenderDevice,
    pub queue: &'a RenderQueue,
    pub cache: &'a PipelineCache,
    pub passes: &'a SmokePasses,
    pub view_pass: &'a ViewPass,
    /// Once they have been asked for, and are there.
    pub debug: Option<&'a DebugPasses>,
    pub sampler: &'a Sampler,
    pub footprints: &'a Buffer,
    /// In the place of the casters' densities, where there are no casters.
    pub nothing: &'a TextureView,
    #[cfg(feature = "reference")]
    pub paper_tables: &'a Buffer,
}

/// Lists this frame's work, and every view's volumes from far to near.
pub(super) fn prepare_smoke(
    mut commands: Commands,
    mut work: ResMut<SmokeWork>,
    mut smoke_cache: ResMut<SmokeCache>,
    smoke: Res<ExtractedSmoke>,
    images: Res<RenderAssets<GpuImage>>,
    views: Query<(Entity, &ExtractedView, &ExtractedCamera, &RenderVisibleEntities), With<Camera3d>>,
    projections: Query<(Option<&TemporalJitter>, Option<&MainPassResolutionOverride>), With<Camera3d>>,
    targets: Query<(&Msaa, Has<MainPassResolutionOverride>, Has<ViewSlabs>), With<Camera3d>>,
    (device, adapter): (Res<RenderDevice>, Res<RenderAdapterInfo>),
    queue: Res<RenderQueue>,
    pipelines: Res<PipelineCache>,
    changed_images: Res<ExtractedAssets<GpuImage>>,
    (passes, view_pass, stats, debug_passes): (
        Res<SmokePasses>,
        Res<ViewPass>,
        Res<SmokeRenderStats>,
        Option<Res<DebugPasses>>,
    ),
    (constellation_passes, mut constellations, mut constellation_work): (
        Res<ConstellationPasses>,
        ResMut<Constellations>,
        ResMut<ConstellationWork>,
    ),
) {
    work.clear();
    let SmokeCache {
        frame: now,
        environments,
        frames,
        levels,
        qualities,
        volumes,
        casters,
        shading,
        surroundings,
        shared,
    } = &mut *smoke_cache;
    *now = now.wrapping_add(1);
    let changed = || changed_images.added.iter().chain(&changed_images.modified);
    environments.begin(*now, changed());
    frames.moments.begin(*now, &smoke);
    frames.live.begin(*now, changed());
    constellations.begin(*now, &mut constellation_work);
    if !passes.are_ready(&pipelines) {
        // What a pass is given before it is ready is never done.
        for (view, ..) in &views {
            commands.entity(view).remove::<(ViewSmoke, ViewMeshShadows)>();
        }
        return;
    }
    let shared = shared.get_or_insert_with(|| Shared {
        sampler: linear_sampler(&device),
        footprints: Footprints::buffer(&device, &queue),
        nothing: texture_3d(&device, "smoke_nothing", UVec3::ONE, FILTERED_FORMAT),
        #[cfg(feature = "reference")]
        paper_tables: paper::Tables::buffer(&device, &queue),
    });
    let gpu = Gpu {
        device: &device,
        queue: &queue,
        cache: &pipelines,
        passes: &passes,
        view_pass: &view_pass,
        debug: debug_passes.as_deref().filter(|passes| passes.are_ready(&pipelines)),
        sampler: &shared.sampler,
        footprints: &shared.footprints,
        nothing: &shared.nothing,
        #[cfg(feature = "reference")]
        paper_tables: &shared.paper_tables,
    };

    let casting = casting(&smoke, views.iter().map(|(_, view, ..)| view));
    casters.begin(&casting, &device);
    for &entity in &casting {
        let volume = &smoke.volumes[&entity];
        let Some(frame) = frames.show(entity, volume, &images, &gpu, &mut work) else { continue };
        let Some(placed) = Placed::new(entity, volume, frame.shape) else { continue };
        casters.add(entity, &placed, placed.sigma(volume), frame, &mut work);
    }

    // The light of a volume is for all views: they have to be known before.
    qualities.begin();
    for (view_entity, view, _, visible) in &views {
        let can_halve = targets
            .get(view_entity)
            .is_ok_and(|(msaa, is_overridden, has_slabs)| msaa.samples() == 1 && !is_overridden && !has_slabs);
        for &entity in volumes_in(visible) {
            // A constellation is a method of its own.
            let volume = smoke.volumes.get(&entity).filter(|volume| volume.constellation.is_none());
            let Some(volume) = volume else { continue };
            let Some(frame) = frames.show(entity, volume, &images, &gpu, &mut work) else { continue };
            let Some(placed) = Placed::new(entity, volume, frame.shape) else { continue };
            let Some(coverage) = placed.coverage(view) else { continue };
            let multiple = placed.scatters_again(volume, frame);
            qualities.see(entity, (volume, &placed, frame), multiple, &coverage, can_halve);
        }
    }
    // The passes' times are those of one view at a time, and a constellation's among them.
    let seeing = views.iter().filter(|(.., visible)| volumes_in(visible).next().is_some()).count();
    let is_comparable = seeing == 1 && smoke.volumes.values().all(|volume| volume.constellation.is_none());
    qualities.choose(|entity| &smoke.volumes[&entity], smoke.measured.filter(|_| is_comparable), &adapter, &stats);

    for (view_entity, view, camera, visible) in &views {
        let mut drawn = Vec::new();
        let (jitter, resolution) = projections.get(view_entity).unwrap_or_default();
        let clip_from_view = jittered(view, jitter, resolution);
        for &volume_entity in volumes_in(visible) {
            let Some(volume) = smoke.volumes.get(&volume_entity) else {
                continue;
            };
            if volume.debug == SmokeDebugView::Probes || volume.debug.has_passes() && gpu.debug.is_none() {
                continue;
            }
            let Some(light) = Light::of(volume_entity, volume, view, &smoke) else {
                continue;
            };
            let Some(lit) = environments.light(light, &images, &smoke.suns, &gpu, &mut work) else {
                continue;
            };
            let Some(frame) = frames.show(volume_entity, volume, &images, &gpu, &mut work) else {
                continue;
            };
            let Some(placed) = Placed::new(volume_entity, volume, frame.shape) else {
                continue;
            };
            let model = qualities.model(volume_entity);
            let frame = match volume.constellation {
                Some(_) => frame,
                None => levels.of(volume_entity, frame, &volume.content, model.rbfs, *now, &gpu),
            };

            let key = (volume_entity, lit.key);
            let before = volumes.get(&key).map(|volume| volume.choice.multiple);
            let choice = match volume.constellation {
                Some(_) => constellation::choose_scattering(volume_entity, volume.scattering.events),
                None => placed.choose_scattering(volume, frame, before, &device),
            };
            stats.set_scattering(volume_entity, choice);
            let emission = volume.emission();
            // A constellation has the environment's sun among its lights.
            let sun = lit.sun.filter(|_| volume.constellation.is_none());
            let lit = Lit { sun, ..lit };
            // Light that scatters into a forward peak goes on for the solver of transport alone.
            let solver = volume.scattering.solver;
            let diffusion = choice.multiple && solver == ScatteringSolver::Diffusion;
            let transport = choice.multiple && solver == ScatteringSolver::Transport && emission == Emission::Exact;
            if diffusion && choice.is_below(DIFFUSION_SHARE) {
                warn_once!(
                    "smoke volume {volume_entity:?} is solved by diffusion but is thin: light hardly scatters twice in it, \
                     and ScatteringSolver::Transport is more accurate (said once)"
                );
            }
            let (uniform, unit) = placed.lighting(volume, &lit, &smoke, transport);
            let uniform = uniform.reduced(&model, diffusion);
            #[cfg(feature = "reference")]
            let uniform = if volume.paper.is_some() { paper::without_lamps(uniform, volume_entity) } else { uniform };
            if volume.constellation.is_none() {
                qualities.lit_by(volume_entity, uniform.lamp_count);
                warn_of_limits(volume_entity, &uniform, frame.typical_depth().unwrap_or(0.0));
            }
            let around = Around::new(
                volume_entity,
                &placed.world_from_bundle,
                placed.shape.half_extent(),
                &uniform,
                &casters.current,
                &smoke.spheres,
            );
            let surroundings = surroundings.entry(key).or_insert_with(|| Surroundings::new(&gpu));
            surroundings.set(around, &gpu);
            let densities = casters.densities().unwrap_or(&shared.nothing);
            let eye = placed.eye(view);
            let seen = |unit: f32, glows| {
                placed.smoke_uniform(view, clip_from_view, eye, (volume, &model), unit * camera.exposure, glows)
            };
            let (distance, depths) = (placed.distance(view), placed.depths(view));
            if let Some(settings) = volume.constellation {
                // Where smoke shines by itself no lamps do.
                let glows = match settings.shading {
                    ConstellationShading::Alpha => default(),
                    _ => Glow::all(&uniform, placed.shape.half_extent()),
                };
                let Some(uniform_of_view) = seen(unit, glows).filter(|_| constellation_passes.are_ready(&pipelines))
                else {
                    continue;
                };
                let view = constellation::View {
                    entity: view.retained_view_entity,
                    smoke: uniform_of_view,
                    size: resolution.map_or(view.viewport.zw(), |resolution| resolution.0),
                    moment: frame,
                    settings,
                    lighting: uniform,
                    environment: constellation::Environment {
                        map: lit.map,
                        coefficients: lit.coefficients,
                        version: lit.version,
                    },
                    surroundings,
                    densities,
                };
                let bind_group = constellations.see(key, view, &constellation_passes, &gpu, &mut constellation_work);
                let draws = constellation::draws(&settings);
                drawn.push(ViewSmokeVolume { distance, depths, emission, half_resolution: false, bind_group, draws });
                continue;
            }
            let light = FrameLight {
                coefficients: lit.coefficients,
                environment_version: lit.version,
                uniform,
                unit,
                surroundings,
                densities,
                choice,
                solver,
                tolerance: volume.scattering.clamped_tolerance(),
                debug: volume.debug,
                model,
                #[cfg(feature = "reference")]
                paper: volume.paper,
            };
            let lit_volume = volumes
                .entry(key)
                .and_modify(|v| {
                    if !v.is_of(frame, &light) {
                        let mut next = LitVolume::new(frame, &light, &gpu);
                        next.follow(v, frame, &gpu);
                        *v = next;
                    }
                })
                .or_insert_with(|| LitVolume::new(frame, &light, &gpu));
            lit_volume.update(frame, light, *now, &gpu, &mut work);

            // Isotropic smoke looks the same from everywhere: one texture serves all views.
            let isotropic = volume.medium.g == 0.0;
            let (key, look) =
                if isotropic { (None, Vec4::Z.with_w(0.0)) } else { (Some(view.retained_view_entity), eye) };
            // What waits to be lit again shows as it was lit.
            let (lighting, unit) = lit_volume.lit_by();
            let glows = Glow::all(lighting, placed.shape.half_extent());
            let sliced = lit_volume.slice(key, look, frame, *now, &gpu, &mut work);
            if let Some(uniform) = seen(unit, glows).map(|uniform| debug::adapt(uniform, volume.debug)) {
                let bind_group = sliced.see(view.retained_view_entity, uniform, *now, &gpu);
                let half_resolution = model.half_resolution && emission == Emission::Exact;
                drawn.push(ViewSmokeVolume { distance, depths, emission, half_resolution, bind_group, draws: 1 });
            }
        }
        // Far to near; equal distances keep the order of their entities.
        drawn.sort_by(|a, b| b.distance.total_cmp(&a.distance));
        let mut components = commands.entity(view_entity);
        if drawn.is_empty() {
            components.remove::<ViewSmoke>();
        } else {
            components.insert(ViewSmoke(drawn));
        }

        let shaded_by = if sees_meshes(visible) { ShadedBy::of_view(view, &smoke, casters) } else { None };
        let shading = shaded_by.and_then(|shaded_by| {
            let light = Light::of_view(view, &smoke)?;
            let lit = environments.light(light, &images, &smoke.suns, &gpu, &mut work)?;
            Some(shading.shade(view, shaded_by, &lit, &smoke, casters, *now, &gpu, &mut work))
        });
        match shading {
            Some(shadows) => components.insert(shadows),
            None => components.remove::<ViewMeshShadows>(),
        };
    }

    let in_use = |last_used: u32| now.wrapping_sub(last_used) < KEEP_FRAMES;
    environments.retain(in_use);
    shading.retain(in_use);
    let exists = |volume| smoke.volumes.contains_key(&volume);
    frames.moments.retain(in_use, exists);
    frames.live.retain(in_use, exists);
    stats.set_memory(frames.memory());
    levels.retain(in_use);
    let is_chosen = |volume| smoke.volumes.get(&volume).is_some_and(|volume| volume.constellation.is_none());
    qualities.retain(is_chosen, &stats);
    stats.retain_scattering(exists);
    volumes.retain(|(entity, _), volume| in_use(volume.last_used) && smoke.volumes.contains_key(entity));
    constellations.retain(*now, in_use);
    surroundings.retain(|key, _| volumes.contains_key(key) || constellations.has(key));
    for volume in volumes.values_mut() {
        volume.sliced.retain(|_, sliced| in_use(sliced.last_used));
        for sliced in volume.sliced.values_mut() {
            sliced.seen.retain(|_, seen| in_use(seen.last_used));
        }
    }
}

/// The volumes that a view sees.
pub(super) fn volumes_in(visible: &RenderVisibleEntities) -> impl Iterator<Item = &MainEntity> {
    let class = visible.get::<SmokeVolume>().map_or(&[][..], |class| &class.entities_cpu_culling);
    class.iter().map(|(_, volume)| volume)
}

/// Whether a view has meshes that something could shade.
fn sees_meshes(visible: &RenderVisibleEntities) -> bool {
    let class = visible.get::<Mesh3d>();
    class.is_some_and(|class| !class.entities_cpu_culling.is_empty() || !class.entities_gpu_culling.is_empty())
}

/// The projection that a view's meshes are drawn with: moved by a part of a pixel under temporal anti-aliasing.
fn jittered(
    view: &ExtractedView,
    jitter: Option<&TemporalJitter>,
    resolution: Option<&MainPassResolutionOverride>,
) -> Mat4 {
    let mut clip_from_view = view.clip_from_view;
    if let Some(jitter) = jitter {
        let size = resolution.map_or(view.viewport.zw(), |resolution| resolution.0);
        jitter.jitter_projection(&mut clip_from_view, size.as_vec2());
    }
    clip_from_view
}

/// Trilinear, clamped at the edges.
pub(super) fn linear_sampler(device: &RenderDevice) -> Sampler {
    device.create_sampler(&SamplerDescriptor {
        label: Some("smoke_sampler"),
        address_mode_u: AddressMode::ClampToEdge,
        address_mode_v: AddressMode::ClampToEdge,
        address_mode_w: AddressMode::ClampToEdge,
        mag_filter: FilterMode::Linear,
        min_filter: FilterMode::Linear,
        ..default()
    })
}
