//! Where models are drawn and timed, by the plug-in.

use bevy::prelude::*;
use serde::{Deserialize, Serialize};

use super::Subject;
use crate::cli::frame_timer::TimedApp;
use crate::cli::render::{average, environment, medium, spawn_camera, spawn_light, turn_light};
use crate::prelude::*;
use crate::quality::model::Setting;
use crate::reference::compare::image_error;
use crate::reference::path::Events;
use crate::render::SmokeRenderStats;

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
    /// Against the path-traced picture; None where there is none.
    pub error: Option<f64>,
    /// Against the picture of the full model.
    pub change: f64,
    /// Median milliseconds of a frame in which extinction and light change, less those of a frame without smoke.
    pub milliseconds: f64,
}

/// A windowless app in which scenes are shown one after the other.
pub struct Stage {
    pub app: TimedApp,
    rays: u32,
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
        Ok(Self { app: TimedApp::new(UVec2::from(size) * rays)?, rays })
    }

    pub fn show<'a>(&'a mut self, subject: &'a Subject, events: Events) -> anyhow::Result<Show<'a>> {
        let (scene, animation) = (&subject.reference.scene, &subject.animation);
        let mut entities = vec![spawn_camera(&mut self.app.headless, scene)];
        self.app.measure_empty();
        let world = self.app.world_mut();
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
        self.app.arrive();
        let mut show = Show { stage: self, subject, events, entities, environment, unit, full: [vec![], vec![]] };
        show.full = show.draw(SmokeModel::FULL);
        Ok(show)
    }
}

impl Show<'_> {
    /// What predictions are made for.
    pub fn setting(&self) -> anyhow::Result<Setting> {
        let choice = self.stage.app.headless.app.world().resource::<SmokeRenderStats>().quality(self.entities[0]);
        Ok(choice.ok_or_else(|| anyhow::anyhow!("{}: the camera sees no smoke", self.subject.reference.name))?.setting)
    }

    /// The picture of a model, as drawn and averaged over pixels.
    fn draw(&mut self, model: SmokeModel) -> [Vec<[f32; 4]>; 2] {
        let mut volume = self.stage.app.world_mut().entity_mut(self.entities[0]);
        volume.insert((SmokeQuality::Model(model), self.environment.clone(), medium(&self.subject.reference.scene)));
        self.stage.app.draw(2);
        let pixels = self.stage.app.headless.float_pixels();
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

    /// What a model changes in the picture as drawn: for scenes as none has been path-traced.
    pub fn measure_change(&mut self, model: SmokeModel) -> anyhow::Result<Measurement> {
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
        self.stage.app.smoke_ms(FRAMES, |world, frame| {
            turn_light(world, volume, 0.02);
            let mut medium = world.get_mut::<SmokeMedium>(volume).expect("it is smoke");
            medium.sigma_t *= if frame.is_multiple_of(2) { 1.0001 } else { 1.0 / 1.0001 };
        })
    }
}

impl Drop for Show<'_> {
    fn drop(&mut self) {
        self.stage.app.clear(self.entities.drain(..));
    }
}

fn rgb(pixels: &[[f32; 4]]) -> Vec<[f32; 3]> {
    pixels.iter().map(|&[r, g, b, _]| [r, g, b]).collect()
}
