//! The windowless app in which points of the chart are drawn, one after the other, and timed.

use std::sync::Arc;
use std::time::Instant;

use anyhow::Context;
use bevy::camera::visibility::RenderLayers;
use bevy::light::VolumetricFog;
use bevy::math::DVec3;
use bevy::prelude::*;

use super::fog::{self, FogLight};
use super::settings::Setting;
use crate::bundle::{SmokeAnimation, SmokeFrames};
use crate::cli::frame_timer::TimedApp;
use crate::cli::path as tracing;
use crate::cli::render::{average, environment, medium, read_equirect, spawn_camera, spawn_light, turn_light};
use crate::cli::scene::{Environment, Scene};
use crate::constellation::SmokeConstellation;
use crate::density::DensityGrid;
use crate::paper::SmokePaper;
use crate::prelude::*;
use crate::reference::path::{self, Events};
use crate::reference::{self, Grid};
use crate::sh::ShRgb;

/// Rays a pixel of the reference along each side: the picture whose time is measured is so much larger.
const RAYS: u32 = 2;
/// Radians that the light turns by from frame to frame: enough to be lit anew, and not to be seen.
const TURN: f64 = 1e-4;

/// What a point is drawn of.
pub(super) struct Inputs<'a> {
    pub scene: &'a Scene,
    pub grid: &'a DensityGrid,
    /// A bundle of the grid, where the setting takes one.
    pub animation: Option<&'a SmokeAnimation>,
}

/// A point's picture and time.
pub(super) struct Drawn {
    pub pixels: Vec<[f32; 3]>,
    pub ms: f64,
}

impl Drawn {
    /// Brightens the picture.
    pub fn scale(&mut self, by: f32) {
        self.pixels.iter_mut().flatten().for_each(|value| *value *= by);
    }
}

pub(super) struct Stage {
    pub app: TimedApp,
    /// Pixels of a reference.
    pixels: [u32; 2],
}

impl Stage {
    /// For references of so many pixels.
    pub fn new(pixels: [u32; 2]) -> anyhow::Result<Self> {
        Ok(Self { app: TimedApp::new(UVec2::from(pixels) * RAYS)?, pixels })
    }

    /// Pixels of the pictures whose time is measured.
    pub fn size(&self) -> UVec2 {
        UVec2::from(self.pixels) * RAYS
    }

    pub fn draw(&mut self, setting: &Setting, inputs: &Inputs, events: Events, frames: u32) -> anyhow::Result<Drawn> {
        match setting {
            Setting::Path { paths } => self.trace(*paths, inputs, events),
            _ => self.draw_on_gpu(setting, inputs, events, frames),
        }
    }

    /// Draws a picture with the plug-in, or with Bevy's fog, in a scene of its own; then frames in which smoke moves and light
    /// turns, though by nothing that is seen.
    fn draw_on_gpu(
        &mut self,
        setting: &Setting,
        inputs: &Inputs,
        events: Events,
        frames: u32,
    ) -> anyhow::Result<Drawn> {
        let camera = spawn_camera(&mut self.app.headless, inputs.scene);
        self.app.world_mut().entity_mut(camera).insert(RenderLayers::default());
        self.app.measure_empty();
        let (subjects, unit) = self.spawn(setting, inputs, events, camera)?;
        // With one light, where lights are what takes time.
        self.app.arrive();
        if let Setting::Constellation { lights } = setting {
            let settings = SmokeConstellation { lights: *lights, ..default() };
            self.app.world_mut().entity_mut(subjects[0]).insert(settings);
        }
        let ms = self.app.smoke_ms(frames, |world, frame| stir(world, subjects[0], frame));
        let pixels = average(&self.app.headless.float_pixels(), self.pixels, RAYS, unit);
        self.app.clear(subjects.into_iter().chain([camera]));
        let rgb = pixels.into_iter().map(|[r, g, b, _]| [r, g, b]).collect();
        Ok(Drawn { pixels: rgb, ms })
    }

    /// Spawns what a setting draws; the first entity is the smoke. Returns the radiance that 1 in the picture stands for, too.
    fn spawn(
        &mut self,
        setting: &Setting,
        inputs: &Inputs,
        events: Events,
        camera: Entity,
    ) -> anyhow::Result<(Vec<Entity>, f32)> {
        let Inputs { scene, grid, animation } = inputs;
        let (center, side) = scene.placement.center_and_side(grid.shape, grid.placement);
        let transform = Transform::from_translation(center.as_vec3()).with_scale(Vec3::splat(side as f32));
        let world = self.app.world_mut();
        let (mut environment, unit) = environment(world, scene)?;
        if let Setting::Fog { steps, ambient } = setting {
            let light = FogLight::of(&coefficients(scene)?);
            let (entities, fog) = fog::spawn(world, scene, grid, transform, &light, unit, (*steps, *ambient));
            world.entity_mut(camera).insert(fog);
            return Ok((entities, unit));
        }
        world.entity_mut(camera).remove::<VolumetricFog>();
        if let SmokeEnvironment::Coefficients { coefficients, .. } = &mut environment {
            coefficients[setting.order().pow(2)..].fill(Vec3::ZERO);
        }
        let scattering = match (events, setting) {
            // A constellation's light scatters once, whatever is asked for.
            (Events::Single, _) | (_, Setting::Constellation { .. }) => SmokeScattering::SINGLE,
            (Events::All, _) => SmokeScattering::MULTIPLE,
        };
        let density = match animation {
            Some(animation) => {
                let twice = twice(animation).context("a bundle has frames")?;
                SmokeDensity::Animation(world.resource_mut::<Assets<SmokeAnimation>>().add(twice))
            }
            None => {
                let image = world.resource_mut::<Assets<Image>>().add(LiveDensity::image_of(grid));
                let lattice = if let Setting::Live { lattice } = setting { *lattice } else { LiveDensity::LATTICE };
                SmokeDensity::Live(LiveDensity { lattice, max_density: grid.max(), ..LiveDensity::new(image) })
            }
        };
        let playback = SmokePlayback::at_frame(0);
        let smoke = (SmokeVolume { density }, playback, scattering, medium(scene), environment, transform);
        let lights: Vec<Entity> = scene.lights.iter().map(|light| spawn_light(world, light, unit)).collect();
        let mut volume = world.spawn(smoke);
        match setting {
            Setting::Rbf { model, .. } => drop(volume.insert(SmokeQuality::Model(*model))),
            Setting::Auto { error } => drop(volume.insert(SmokeQuality::Error(*error))),
            Setting::Paper { .. } => drop(volume.insert(SmokePaper::default())),
            Setting::Constellation { .. } => drop(volume.insert(SmokeConstellation { lights: 1, ..default() })),
            _ => {}
        }
        Ok(([vec![volume.id()], lights].concat(), unit))
    }

    /// The path tracer's picture.
    fn trace(&self, paths: u32, inputs: &Inputs, events: Events) -> anyhow::Result<Drawn> {
        let Inputs { scene, grid, .. } = inputs;
        let density = Grid { shape: grid.shape, values: grid.values.iter().map(|&d| f64::from(d)).collect() };
        let stage = tracing::Stage::new(scene, &density, grid.placement)?;
        let (traced, size) = (stage.scene(), self.pixels);
        let camera = |x, y| stage.ray(size, x, y);
        let start = Instant::now();
        let image = path::render(&traced, size, camera, events, paths, 1, &|_| ());
        let pixels = image.into_iter().map(|rgb: DVec3| rgb.as_vec3().to_array()).collect();
        Ok(Drawn { pixels, ms: 1e3 * start.elapsed().as_secs_f64() })
    }
}

/// Goes on to another moment, which looks the same, under light that has turned by nothing that is seen.
fn stir(world: &mut World, volume: Entity, frame: u32) {
    let angle = if frame.is_multiple_of(2) { TURN } else { -TURN };
    if let Some(mut playback) = world.get_mut::<SmokePlayback>(volume) {
        // Far enough to be another moment than the frame before, and less than a frame of the animation in all.
        playback.seek(f64::from(frame + 10) / 1e4);
    }
    turn_light(world, volume, angle);
}

/// An animation of one frame twice, so that there is time to pass in it.
fn twice(animation: &SmokeAnimation) -> Option<SmokeAnimation> {
    let frame = animation.frames.get(0)?;
    // Another frame to the renderer: it has another address.
    let frames = SmokeFrames::Memory(vec![Arc::new((**frame).clone()), Arc::new((**frame).clone())]);
    Some(SmokeAnimation { frames, ..animation.clone() })
}

/// A scene's light from all around.
fn coefficients(scene: &Scene) -> anyhow::Result<ShRgb> {
    match &scene.environment {
        Environment::Equirect(path) => {
            let ([width, _], texels) = read_equirect(path)?;
            let texels: Vec<DVec3> = texels.into_iter().map(|rgb| Vec3::from(rgb).as_dvec3()).collect();
            Ok(reference::environment::equirect(width as usize, &texels))
        }
        lobes => lobes.coefficients().context("lobes have coefficients"),
    }
}
