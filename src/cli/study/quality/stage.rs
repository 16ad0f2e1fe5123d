//! Where models are drawn and timed, by the plug-in.

use bevy::prelude::*;
use bevy::render::render_resource::TextureFormat;
use bevy::render::renderer::RenderAdapterInfo;
use serde::{Deserialize, Serialize};

use super::Subject;
use crate::cli::frame_timer;
use crate::cli::render::{average, environment, medium, spawn_camera, spawn_light, turn_light};
use crate::headless::Headless;
use crate::prelude::*;
use crate::quality::model::Setting;
use crate::reference::compare::image_error;
use crate::reference::path::Events;
use crate::render::SmokeRenderStats;

/// Frames without smoke, whose median is taken off the others'.
const EMPTY_FRAMES: u32 = 9;
/// Frames until what has been spawned is drawn.
const ARRIVAL: u32 = 4;
/// Frames that are timed, at least.
const FRAMES: u32 = 4;

/// A model, drawn and timed.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Measurement {
    pub scene: String,
    pub held_out: bool,
    /// Whether the fit is made of it.
    pub is_fitted: bool,
    pub model: SmokeModel,
    pub setting: Setting,
    /// Against the path-traced picture; None at another size than that.
    pub error: Option<f64>,
    /// Against the picture of the full model.
    pub change: f64,
    /// Median milliseconds of a frame in which extinction and light change, less those of a frame without smoke.
    pub milliseconds: f64,
}

/// A windowless app in which scenes are shown one after the other.
pub struct Stage {
    headless: Headless,
    rays: u32,
    /// Milliseconds of a frame without smoke.
    empty_ms: f64,
}

/// A scene on a stage.
pub struct Show<'a> {
    stage: &'a mut Stage,
    subject: &'a Subject,
    events: Events,
    /// All that the scene consists of, the smoke first.
    entities: Vec<Entity>,
    environment: SmokeEnvironment,
    unit: f32,
    /// The full model's picture, at the size drawn and averaged over pixels.
    full: [Vec<[f32; 4]>; 2],
}

impl Stage {
    /// For pictures of such a size, with so many rays a pixel along a side.
    pub fn new(size: [u32; 2], rays: u32) -> anyhow::Result<Self> {
        let headless = frame_timer::headless(UVec2::from(size) * rays, TextureFormat::Rgba16Float)?;
        Ok(Self { headless, rays, empty_ms: 0.0 })
    }

    pub fn show<'a>(&'a mut self, subject: &'a Subject, events: Events) -> anyhow::Result<Show<'a>> {
        let (scene, animation) = (&subject.reference.scene, &subject.animation);
        let mut entities = vec![spawn_camera(&mut self.headless, scene)];
        if self.empty_ms == 0.0 {
            self.empty_ms = frame_timer::median_frame(&mut self.headless, EMPTY_FRAMES, |_, _| ());
        }
        let world = self.headless.app.world_mut();
        let (environment, unit) = environment(world, scene)?;
        let (center, side) = scene.placement.center_and_side(animation.shape, animation.placement);
        let animation = world.resource_mut::<Assets<SmokeAnimation>>().add(animation.clone());
        let volume = (
            SmokeVolume::new(animation),
            if events == Events::All { SmokeScattering::MULTIPLE } else { SmokeScattering::SINGLE },
            medium(scene),
            environment.clone(),
            Transform::from_translation(center.as_vec3()).with_scale(Vec3::splat(side as f32)),
        );
        entities.insert(0, world.spawn(volume).id());
        entities.extend(scene.lights.iter().map(|light| spawn_light(world, light, unit)));
        // Assets have to reach the GPU, pipelines to be made.
        (0..ARRIVAL).for_each(|_| self.headless.app.update());
        let mut show = Show { stage: self, subject, events, entities, environment, unit, full: [vec![], vec![]] };
        show.full = show.draw(SmokeModel::FULL);
        Ok(show)
    }

    /// Whether the GPU says what a frame takes.
    pub fn on_gpu(&self) -> bool {
        frame_timer::on_gpu(&self.headless)
    }

    pub fn adapter(&self) -> String {
        self.headless.app.world().resource::<RenderAdapterInfo>().name.clone()
    }
}

impl Show<'_> {
    /// What predictions are made for.
    pub fn setting(&self) -> anyhow::Result<Setting> {
        let choice = self.stage.headless.app.world().resource::<SmokeRenderStats>().quality(self.entities[0]);
        Ok(choice.ok_or_else(|| anyhow::anyhow!("{}: the camera sees no smoke", self.subject.reference.name))?.setting)
    }

    /// The picture of a model, as drawn and averaged over pixels.
    fn draw(&mut self, model: SmokeModel) -> [Vec<[f32; 4]>; 2] {
        let mut volume = self.stage.headless.app.world_mut().entity_mut(self.entities[0]);
        volume.insert((SmokeQuality::Model(model), self.environment.clone(), medium(&self.subject.reference.scene)));
        for _ in 0..2 {
            self.stage.headless.app.update();
        }
        let pixels = self.stage.headless.float_pixels();
        let averaged = average(&pixels, self.subject.reference.scene.camera.size, self.stage.rays, self.unit);
        [pixels, averaged]
    }

    pub fn measure(&mut self, model: SmokeModel, is_fitted: bool) -> anyhow::Result<Measurement> {
        let [_, picture] = self.draw(model);
        let (picture, full) = (rgb(&picture), rgb(&self.full[1]));
        let reference = &self.subject.reference;
        let error = reference.error(&picture, self.events)?;
        let change = image_error([&picture, &picture], [&full, &full], &reference.alpha)?;
        let (setting, times) = (self.setting()?, self.time());
        Ok(self.measurement(model, is_fitted, setting, Some(error), change.relative, times))
    }

    /// Half resolution at the size drawn.
    pub fn measure_half(&mut self) -> anyhow::Result<Measurement> {
        let model = SmokeModel { half_resolution: true, ..SmokeModel::FULL };
        let [picture, _] = self.draw(model);
        let full = &self.full[0];
        let alpha: Vec<f32> = full.iter().map(|pixel| pixel[3]).collect();
        let (picture, full) = (rgb(&picture), rgb(full));
        let change = image_error([&picture, &picture], [&full, &full], &alpha)?;
        let (setting, times) = (self.setting()?, self.time());
        Ok(self.measurement(model, true, setting, None, change.relative, times))
    }

    fn measurement(
        &self,
        model: SmokeModel,
        is_fitted: bool,
        setting: Setting,
        error: Option<f64>,
        change: f64,
        milliseconds: f64,
    ) -> Measurement {
        let (scene, held_out) = (self.subject.reference.name.clone(), self.subject.held_out);
        Measurement { scene, held_out, is_fitted: is_fitted && !held_out, model, setting, error, change, milliseconds }
    }

    /// What a frame takes in which all light is computed anew.
    fn time(&mut self) -> f64 {
        let volume = self.entities[0];
        let ms = frame_timer::median_frame(&mut self.stage.headless, FRAMES, |world, frame| {
            turn_light(world, volume, 0.02);
            let mut medium = world.get_mut::<SmokeMedium>(volume).expect("it is smoke");
            medium.sigma_t *= if frame.is_multiple_of(2) { 1.0001 } else { 1.0 / 1.0001 };
        });
        (ms - self.stage.empty_ms).max(1e-3)
    }
}

impl Drop for Show<'_> {
    fn drop(&mut self) {
        let app = &mut self.stage.headless.app;
        for entity in self.entities.drain(..) {
            app.world_mut().despawn(entity);
        }
        // Let go of before the next one comes.
        (0..2).for_each(|_| app.update());
    }
}

fn rgb(pixels: &[[f32; 4]]) -> Vec<[f32; 3]> {
    pixels.iter().map(|&[r, g, b, _]| [r, g, b]).collect()
}
