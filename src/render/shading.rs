//! What shades the meshes of each view: smoke by its shadow probes and densities, and the spheres of occluders.

use bevy::platform::collections::HashMap;
use bevy::prelude::*;
use bevy::render::render_resource::Buffer;
use bevy::render::sync_world::MainEntity;
use bevy::render::view::{ExtractedView, RetainedViewEntity};

use super::SmokeWork;
use super::casters::{CasterUniform, Casters, MAX_CASTERS};
use super::extract::{ExtractedSmoke, ExtractedVolume};
use super::light::Lit;
use super::lit::Cached;
use super::mesh_shadows::{MeshShadowUniform, ViewMeshShadows, occlusion_tables};
use super::prepare::Gpu;
use super::shadow_probes::ShadowProbes;
use super::surroundings::sphere_buffer;

/// What outlives a frame of it.
#[derive(Default)]
pub(super) struct Shading {
    probes: ShadowProbes,
    seen: HashMap<RetainedViewEntity, SeenShading>,
    /// Made where they are first needed.
    occlusion_tables: Option<Buffer>,
    /// The spheres of all occluders, and where they are on the GPU.
    spheres: Option<(Vec<Vec4>, Buffer)>,
}

/// A view's.
struct SeenShading {
    uniform: Cached<MeshShadowUniform>,
    last_used: u32,
}

/// What shades a view's meshes in a frame; something does.
pub(super) struct ShadedBy {
    casters: Vec<CasterUniform>,
    spheres: usize,
}

impl ShadedBy {
    /// None where nothing does.
    pub fn of_view(view: &ExtractedView, smoke: &ExtractedSmoke, casters: &Casters) -> Option<Self> {
        let camera = smoke.camera_shadows.get(&view.retained_view_entity.main_entity)?;
        let seen = |entity: &MainEntity| smoke.volumes[entity].layers.intersects(&camera.layers);
        let casting = casters.current.iter().filter(|_| camera.shadows.smoke);
        let casters: Vec<_> = casting.filter(|caster| seen(&caster.entity)).map(|caster| caster.uniform).collect();
        let spheres = if camera.shadows.occluders { smoke.spheres.len() } else { 0 };
        (!casters.is_empty() || spheres > 0).then_some(Self { casters, spheres })
    }
}

impl Shading {
    /// What a view binds for it, under a light from all around.
    pub fn shade(
        &mut self,
        view: &ExtractedView,
        by: ShadedBy,
        lit: &Lit,
        smoke: &ExtractedSmoke,
        casters: &Casters,
        now: u32,
        gpu: &Gpu,
        work: &mut SmokeWork,
    ) -> ViewMeshShadows {
        let spheres = by.spheres;
        let probed = self.probes.update(lit, casters, now, gpu, work);
        let suns = smoke.lamps.iter().filter(|lamp| lamp.is_sun()).count();
        let uniform = MeshShadowUniform::new(probed.sky, by.casters, suns, spheres);
        let seen = self
            .seen
            .entry(view.retained_view_entity)
            .or_insert_with(|| SeenShading { uniform: Cached::new(uniform.clone(), gpu), last_used: now });
        seen.last_used = now;
        seen.uniform.set(uniform, gpu);
        let occluders = (spheres > 0).then(|| {
            let tables = self.occlusion_tables.get_or_insert_with(|| occlusion_tables(gpu.device, gpu.queue)).clone();
            if self.spheres.as_ref().is_none_or(|(there, _)| *there != smoke.spheres) {
                self.spheres = Some((smoke.spheres.clone(), sphere_buffer(&smoke.spheres, gpu)));
            }
            [tables, self.spheres.as_ref().expect("just made where it was missing").1.clone()]
        });
        ViewMeshShadows {
            uniform: seen.uniform.buffer().clone(),
            environment: probed.environment.clone(),
            densities: casters.densities().unwrap_or(gpu.nothing).clone(),
            probes: probed.probes.clone(),
            sampler: gpu.sampler.clone(),
            occluders,
        }
    }

    pub fn retain(&mut self, in_use: impl Fn(u32) -> bool) {
        self.probes.retain(&in_use);
        self.seen.retain(|_, seen| in_use(seen.last_used));
        if self.seen.is_empty() {
            self.spheres = None;
        }
    }
}

/// The volumes that cast shadows in a frame: those that do, where any view sees shadows.
pub(super) fn casting<'a>(smoke: &ExtractedSmoke, views: impl Iterator<Item = &'a ExtractedView>) -> Vec<MainEntity> {
    let eye = |view: &ExtractedView| {
        let camera = smoke.camera_shadows.get(&view.retained_view_entity.main_entity)?;
        camera.shadows.smoke.then_some((view.world_from_view.translation(), &camera.layers))
    };
    let eyes: Vec<_> = views.filter_map(eye).collect();
    // From the nearest eye that sees its shadow.
    let distance = |volume: &ExtractedVolume| {
        let center = Vec3::from(volume.world_from_bundle.translation);
        let seeing = eyes.iter().filter(|(_, layers)| layers.intersects(&volume.layers));
        seeing.map(|(eye, _)| eye.distance(center)).min_by(f32::total_cmp)
    };
    let casts = |(_, volume): &(_, &ExtractedVolume)| volume.casts && volume.medium.sigma_t > 0.0;
    let mut casting: Vec<_> =
        smoke.volumes.iter().filter(casts).filter_map(|(e, volume)| Some((distance(volume)?, *e))).collect();
    // Nearest first; equal distances keep the order of their entities.
    casting.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    if casting.len() > MAX_CASTERS {
        warn_once!(
            "{} smoke volumes cast shadows, of which the {MAX_CASTERS} nearest to a camera do: give others Bevy's \
             NotShadowCaster (said once)",
            casting.len()
        );
        casting.truncate(MAX_CASTERS);
    }
    casting.into_iter().map(|(_, entity)| entity).collect()
}
