//! Single scattering from a light constellation (Navarro et al. 2008), in the place of the passes from pair matrix to
//! volume, for the volumes that ask for it: a plug-in of its own, that shares moments of smoke, lights and the view pass with
//! the others. [`crate::reference::constellation`] is its twin.
//!
//! | pass | reads | writes | once per |
//! |---|---|---|---|
//! | `lights` | an environment | directions and colours of its lights | environment, as a volume uses it |
//! | `distance` | density | 3D texture of distance to smoke, and density | moment of smoke |
//! | `mask` | that | the first sample in smoke of every pixel | volume and view that moves |
//!
//! The [view pass](super::view) then marches the texture from that sample on, and sums the lights at each; only this is per
//! frame in a static scene.

pub(super) mod distance;
pub(super) mod lights;
pub(super) mod mask;
mod shading;

use bevy::core_pipeline::schedule::camera_driver;
use bevy::platform::collections::HashMap;
use bevy::prelude::*;
use bevy::render::RenderApp;
use bevy::render::render_resource::{BindGroup, PipelineCache, TextureView, TextureViewId};
use bevy::render::renderer::{RenderContext, RenderGraph, RenderGraphSystems};
use bevy::render::sync_world::MainEntity;
use bevy::render::view::RetainedViewEntity;

use self::distance::{DistanceMap, DistancePass};
pub(super) use self::lights::Environment;
use self::lights::{Constellation, LightsJob, LightsPass};
pub(super) use self::shading::layout;
use self::shading::{Seen, Shown};
use super::frame::GpuSmokeFrame;
use super::light::LightKey;
use super::lighting::LightingUniform;
use super::lit::Cached;
use super::pass::{ComputePass, Job};
use super::prepare::Gpu;
use super::surroundings::Surroundings;
use super::view::SmokeUniform;
use super::{SmokeRenderStats, SmokeSystems, coarse};
use crate::constellation::{ConstellationShading, SmokeConstellation};
use crate::scattering::{ScatteringChoice, ScatteringEvents};
use crate::shaders::ConstellationShaders;

pub use self::distance::LABEL as DISTANCE_LABEL;
pub use self::lights::LABEL as LIGHTS_LABEL;
pub use self::mask::LABEL as MASK_LABEL;

/// Adds the passes to an app that draws smoke.
pub(super) struct ConstellationPlugin;

impl Plugin for ConstellationPlugin {
    fn build(&self, app: &mut App) {
        let Some(render_app) = app.get_sub_app_mut(RenderApp) else { return };
        render_app.init_resource::<Constellations>().init_resource::<ConstellationWork>().add_systems(
            RenderGraph,
            constellation
                .after(coarse::coarse)
                .in_set(RenderGraphSystems::Render)
                .in_set(SmokeSystems::Light)
                .before(camera_driver)
                .run_if(resource_exists::<ConstellationPasses>),
        );
    }
}

/// The compute passes.
#[derive(Resource)]
pub(super) struct ConstellationPasses {
    pub lights: LightsPass,
    pub distance: DistancePass,
    pub mask: ComputePass,
}

impl ConstellationPasses {
    pub fn new(shaders: &ConstellationShaders, cache: &PipelineCache) -> Self {
        Self {
            lights: LightsPass::new(&shaders.radiance, &shaders.lights, cache),
            distance: DistancePass::new(&shaders.distance, cache),
            mask: mask::pass(&shaders.mask, cache),
        }
    }

    fn all(&self) -> impl Iterator<Item = &ComputePass> {
        self.lights.passes().into_iter().chain(self.distance.passes()).chain([&self.mask])
    }

    /// Whether every pipeline is there.
    pub fn are_ready(&self, cache: &PipelineCache) -> bool {
        self.all().all(|pass| pass.is_ready(cache))
    }
}

/// The dispatches of this frame.
#[derive(Resource, Default)]
pub(super) struct ConstellationWork {
    lights: Vec<LightsJob>,
    distance: Vec<[Job; 3]>,
    mask: Vec<Job>,
}

/// Everything that outlives a frame.
#[derive(Resource, Default)]
pub(super) struct Constellations {
    now: u32,
    volumes: HashMap<(MainEntity, LightKey), Volume>,
    /// By the density that they are of.
    distances: HashMap<TextureViewId, DistanceMap>,
}

/// A volume lit by an environment and lamps.
struct Volume {
    lighting: Cached<LightingUniform>,
    lights: Constellation,
    seen: HashMap<RetainedViewEntity, Seen>,
    last_used: u32,
}

/// A volume as a view draws it in a frame.
pub(super) struct View<'a> {
    pub entity: RetainedViewEntity,
    pub smoke: SmokeUniform,
    /// Pixels of its viewport.
    pub size: UVec2,
    pub moment: &'a GpuSmokeFrame,
    pub settings: SmokeConstellation,
    pub lighting: LightingUniform,
    pub environment: Environment<'a>,
    pub surroundings: &'a Surroundings,
    /// The densities of all casters.
    pub densities: &'a TextureView,
}

impl Constellations {
    /// Starts a frame.
    pub fn begin(&mut self, now: u32, work: &mut ConstellationWork) {
        self.now = now;
        *work = ConstellationWork::default();
    }

    /// Lists what is to be done before a view draws a volume, and what it then binds.
    pub fn see(
        &mut self,
        key: (MainEntity, LightKey),
        view: View,
        passes: &ConstellationPasses,
        gpu: &Gpu,
        work: &mut ConstellationWork,
    ) -> BindGroup {
        let now = self.now;
        let map = self.distances.entry(view.moment.density.id());
        let map = map.or_insert_with(|| DistanceMap::new(view.moment, &passes.distance, gpu.device, gpu.cache));
        if !map.is_of(view.moment) {
            *map = DistanceMap::new(view.moment, &passes.distance, gpu.device, gpu.cache);
        }
        map.update(view.moment, now, work);

        let volume = self.volumes.entry(key).or_insert_with(|| Volume {
            lighting: Cached::new(view.lighting.clone(), gpu),
            lights: Constellation::new(&passes.lights, gpu),
            seen: HashMap::default(),
            last_used: now,
        });
        volume.last_used = now;
        volume.lighting.set(view.lighting.clone(), gpu);
        volume.lights.update(&view.environment, &view.lighting, view.settings.lights, &passes.lights, gpu, work);

        let shown = Shown {
            texture: &map.texture,
            lighting: volume.lighting.buffer(),
            lights: volume.lights.buffer(),
            surroundings: view.surroundings,
            densities: view.densities,
        };
        let seen = volume.seen.entry(view.entity).or_insert_with(|| Seen::new(&shown, &view, passes, gpu));
        if !seen.is_of(&shown, &view) {
            *seen = Seen::new(&shown, &view, passes, gpu);
        }
        seen.update(view, map.version(), now, gpu, work)
    }

    /// Whether a volume and light are in use.
    pub fn has(&self, key: &(MainEntity, LightKey)) -> bool {
        self.volumes.contains_key(key)
    }

    /// Lets go of what is not in use.
    pub fn retain(&mut self, now: u32, in_use: impl Fn(u32) -> bool) {
        // They are large, quickly made, and follow densities that may change every frame.
        self.distances.retain(|_, map| now.wrapping_sub(map.last_used) <= 1);
        self.volumes.retain(|_, volume| in_use(volume.last_used));
        for volume in self.volumes.values_mut() {
            volume.seen.retain(|_, seen| in_use(seen.last_used));
        }
    }
}

/// Light scatters once; says so where it was asked to scatter more.
pub(super) fn choose_scattering(volume: MainEntity, events: ScatteringEvents) -> ScatteringChoice {
    if events == ScatteringEvents::Multiple {
        warn_once!(
            "smoke volume {volume:?} has SmokeConstellation, whose light scatters once: its SmokeScattering asks for more, \
             in vain (said once)"
        );
    }
    ScatteringChoice { multiple: false, auto: false, share: None }
}

/// Draws by which a volume's light is summed: a draw sums as many lights as `lights_a_draw` of `constellation.wgsl` says.
pub(super) fn draws(settings: &SmokeConstellation) -> u32 {
    match settings.shading {
        ConstellationShading::SelfShadow => settings.lights.div_ceil(settings.lights.div_ceil(16).max(4)),
        _ => 1,
    }
}

/// Runs the passes.
fn constellation(
    work: Res<ConstellationWork>,
    passes: Res<ConstellationPasses>,
    cache: Res<PipelineCache>,
    stats: Res<SmokeRenderStats>,
    mut ctx: RenderContext,
) {
    let jobs: Vec<_> = work.lights.iter().flat_map(|job| passes.lights.jobs(job)).collect();
    ComputePass::run_all(LIGHTS_LABEL, &jobs, &cache, &stats.constellation_lights, &mut ctx);
    let jobs: Vec<_> = work.distance.iter().flat_map(|jobs| passes.distance.passes().into_iter().zip(jobs)).collect();
    ComputePass::run_all(DISTANCE_LABEL, &jobs, &cache, &stats.constellation_distance, &mut ctx);
    passes.mask.run(&work.mask, &cache, &stats.constellation_mask, &mut ctx);
}
