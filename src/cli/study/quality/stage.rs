//! Where models are drawn and timed, by the plug-in.

use std::time::Instant;

use bevy::prelude::*;
use bevy::render::render_resource::TextureFormat;
use bevy::render::renderer::RenderAdapterInfo;
use serde::Serialize;

use super::Subject;
use crate::cli::exr_io::ExrImage;
use crate::cli::render::{average, environment, medium, spawn_camera, spawn_light, turn_light};
use crate::headless::Headless;
use crate::prelude::*;
use crate::quality::model::Setting;
use crate::reference::compare::image_error;
use crate::render::SmokeRenderStats;

/// Rays a pixel along a side: as the reference averages over a pixel's area.
const RAYS: u32 = 2;
/// Frames that are timed.
const FRAMES: usize = 4;

/// A model, drawn and timed.
#[derive(Clone, Debug, Serialize)]
pub struct Measurement {
    pub scene: String,
    pub held_out: bool,
    /// Whether the fit is made of it.
    pub is_fitted: bool,
    #[serde(serialize_with = "as_debug")]
    pub model: SmokeModel,
    #[serde(serialize_with = "as_debug")]
    pub setting: Setting,
    /// Against the path-traced picture; None at another size than that.
    pub error: Option<f64>,
    /// Against the picture of the full model.
    pub change: f64,
    /// Median milliseconds of a whole frame in which extinction and light change, by the clock: spans of passes are not to be
    /// trusted on software adapters, which put off work.
    pub milliseconds: f64,
}

fn as_debug<T: std::fmt::Debug, S: serde::Serializer>(value: &T, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&format_args!("{value:?}"))
}

/// A scene in a windowless app.
pub struct Stage<'a> {
    subject: &'a Subject,
    headless: Headless,
    volume: Entity,
    environment: SmokeEnvironment,
    unit: f32,
    rays: u32,
    /// Path-traced halves.
    reference: [Vec<[f32; 3]>; 2],
    alpha: Vec<f32>,
    /// The full model's picture, at the size drawn and averaged over pixels.
    full: [Vec<[f32; 4]>; 2],
}

impl<'a> Stage<'a> {
    pub fn new(subject: &'a Subject) -> anyhow::Result<Self> {
        Self::with_rays(subject, RAYS)
    }

    pub fn with_rays(subject: &'a Subject, rays: u32) -> anyhow::Result<Self> {
        let Subject { scene, animation, folder, .. } = subject;
        let size = scene.camera.size;
        let mut headless = Headless::new((UVec2::from(size) * rays).to_array().into(), TextureFormat::Rgba16Float)?;
        spawn_camera(&mut headless, scene);
        let world = headless.app.world_mut();
        let (environment, unit) = environment(world, scene)?;
        let (center, side) = scene.placement.center_and_side(animation.shape, animation.placement);
        let animation = world.resource_mut::<Assets<SmokeAnimation>>().add(animation.clone());
        let volume = (
            SmokeVolume::new(animation),
            SmokeScattering::MULTIPLE,
            medium(scene),
            environment.clone(),
            Transform::from_translation(center.as_vec3()).with_scale(Vec3::splat(side as f32)),
        );
        let volume = world.spawn(volume).id();
        for light in &scene.lights {
            spawn_light(world, light, unit);
        }
        headless.settle()?;
        let read = |name: &str| ExrImage::read(&folder.join(name));
        let reference = [read("full_a.exr")?.rgb()?, read("full_b.exr")?.rgb()?];
        let alpha = read("alpha.exr")?.alpha()?.to_vec();
        let mut stage =
            Self { subject, headless, volume, environment, unit, rays, reference, alpha, full: [vec![], vec![]] };
        stage.full = stage.draw(SmokeModel::FULL);
        Ok(stage)
    }

    pub fn adapter(&self) -> String {
        self.headless.app.world().resource::<RenderAdapterInfo>().name.clone()
    }

    /// What predictions are made for.
    pub fn setting(&self) -> anyhow::Result<Setting> {
        let choice = self.headless.app.world().resource::<SmokeRenderStats>().quality(self.volume);
        Ok(choice.ok_or_else(|| anyhow::anyhow!("{}: the camera sees no smoke", self.subject.name))?.setting)
    }

    /// The picture of a model, as drawn and averaged over pixels.
    fn draw(&mut self, model: SmokeModel) -> [Vec<[f32; 4]>; 2] {
        let mut volume = self.headless.app.world_mut().entity_mut(self.volume);
        volume.insert((SmokeQuality::Model(model), self.environment.clone(), medium(&self.subject.scene)));
        for _ in 0..2 {
            self.headless.app.update();
        }
        let pixels = self.headless.float_pixels();
        let averaged = average(&pixels, self.subject.scene.camera.size, self.rays, self.unit);
        [pixels, averaged]
    }

    pub fn measure(&mut self, model: SmokeModel, is_fitted: bool) -> anyhow::Result<Measurement> {
        let [_, picture] = self.draw(model);
        let (picture, full) = (rgb(&picture), rgb(&self.full[1]));
        let error = image_error([&picture, &picture], self.reference.each_ref().map(Vec::as_slice), &self.alpha)?;
        let change = image_error([&picture, &picture], [&full, &full], &self.alpha)?;
        let (setting, times) = (self.setting()?, self.time());
        Ok(self.measurement(model, is_fitted, setting, Some(error.relative), change.relative, times))
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
        let Subject { name, held_out, .. } = self.subject;
        let (scene, held_out) = (name.clone(), *held_out);
        Measurement { scene, held_out, is_fitted: is_fitted && !held_out, model, setting, error, change, milliseconds }
    }

    /// What a frame takes in which all light is computed anew.
    fn time(&mut self) -> f64 {
        let mut times = Vec::new();
        for frame in 0..FRAMES + 1 {
            turn_light(self.headless.app.world_mut(), self.volume, 0.02);
            let mut medium = self.headless.app.world_mut().get_mut::<SmokeMedium>(self.volume).expect("it is smoke");
            medium.sigma_t *= if frame % 2 == 0 { 1.0001 } else { 1.0 / 1.0001 };
            let start = Instant::now();
            self.headless.app.update();
            self.headless.wait();
            times.push(1e3 * start.elapsed().as_secs_f64());
        }
        // The first is of what came before, too.
        times.remove(0);
        times.sort_by(f64::total_cmp);
        times[times.len() / 2]
    }
}

fn rgb(pixels: &[[f32; 4]]) -> Vec<[f32; 3]> {
    pixels.iter().map(|&[r, g, b, _]| [r, g, b]).collect()
}
