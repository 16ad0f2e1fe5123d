//! The windowless app in which points of the chart are drawn, one after the other, and timed.

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context;
use bevy::camera::visibility::RenderLayers;
use bevy::diagnostic::{Diagnostic, DiagnosticPath, DiagnosticsStore};
use bevy::light::VolumetricFog;
use bevy::math::DVec3;
use bevy::prelude::*;
use bevy::render::render_resource::TextureFormat;
use bevy::render::renderer::RenderAdapterInfo;

use super::fog::{self, FogLight};
use super::settings::Setting;
use crate::bundle::{SmokeAnimation, SmokeFrames};
use crate::cli::render::{average, environment, median, medium, read_equirect, spawn_camera, turn_light};
use crate::cli::scene::{Environment, Scene};
use crate::constellation::SmokeConstellation;
use crate::density::DensityGrid;
use crate::headless::Headless;
use crate::paper::SmokePaper;
use crate::prelude::*;
use crate::reference::path::{self, EquirectImage, Events};
use crate::reference::{self, Grid, Medium, Ray};
use crate::render::SmokeRenderStats;
use crate::sh::ShRgb;

/// Rays a pixel of the reference along each side: the picture whose time is measured is so much larger.
const RAYS: u32 = 2;
/// Radians that the light turns by from frame to frame: enough to be lit anew, and not to be seen.
const TURN: f64 = 1e-4;
/// Frames without smoke, whose median is taken off the others'.
const EMPTY_FRAMES: u32 = 9;
/// Frames until what has been spawned is drawn.
const ARRIVAL: u32 = 4;
/// A point whose frames take longer in all is drawn no more.
const LONG: Duration = Duration::from_secs(4);

/// What a point is drawn of.
pub(super) struct Inputs<'a> {
    pub scene: &'a Scene,
    pub grid: &'a DensityGrid,
    /// A bundle of the grid, where the setting takes one.
    pub animation: Option<&'a SmokeAnimation>,
}

/// A point's picture and time.
pub(super) struct Drawn {
    halves: [Vec<[f32; 3]>; 2],
    pub ms: f64,
    pub gpu_ms: Option<f64>,
}

impl Drawn {
    /// Brightens the picture.
    pub fn scale(&mut self, by: f32) {
        self.halves.iter_mut().flatten().flatten().for_each(|value| *value *= by);
    }

    /// Two independent halves, or the picture twice.
    pub fn halves(&self) -> [&[[f32; 3]]; 2] {
        [&self.halves[0], if self.halves[1].is_empty() { &self.halves[0] } else { &self.halves[1] }]
    }
}

pub(super) struct Stage {
    headless: Headless,
    /// Pixels of a reference.
    pixels: [u32; 2],
    /// Milliseconds of a frame without smoke.
    empty_ms: f64,
}

impl Stage {
    /// For references of so many pixels.
    pub fn new(pixels: [u32; 2]) -> anyhow::Result<Self> {
        let headless = Headless::new(pixels.map(|side| side * RAYS).into(), TextureFormat::Rgba16Float)?;
        Ok(Self { headless, pixels, empty_ms: 0.0 })
    }

    pub fn adapter(&self) -> String {
        self.headless.app.world().resource::<RenderAdapterInfo>().name.clone()
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
        let camera = spawn_camera(&mut self.headless, inputs.scene);
        self.headless.app.world_mut().entity_mut(camera).insert(RenderLayers::default());
        if self.empty_ms == 0.0 {
            self.wait(EMPTY_FRAMES);
            let times = (0..EMPTY_FRAMES).map(|_| self.frame()).collect();
            self.empty_ms = median(times).unwrap_or_default();
        }
        let (subjects, unit) = self.spawn(setting, inputs, events, camera)?;
        // Assets have to reach the GPU, pipelines to be made: with one light, where lights are what takes time.
        self.wait(ARRIVAL);
        if let Setting::Constellation { lights } = setting {
            let settings = SmokeConstellation { lights: *lights, ..default() };
            self.headless.app.world_mut().entity_mut(subjects[0]).insert(settings);
        }
        self.headless.app.world_mut().resource_mut::<DiagnosticsStore>().iter_mut().for_each(Diagnostic::clear_history);
        let mut times = Vec::new();
        let started = Instant::now();
        // One more than is asked for, of which the first is warmer than it should be or colder; as few as there must be of
        // those that take long.
        for i in 0..=frames {
            self.stir(subjects[0], i);
            times.push(self.frame());
            if started.elapsed() > LONG {
                break;
            }
        }
        if times.len() > 1 {
            times.remove(0);
        }
        let pixels = average(&self.headless.float_pixels(), self.pixels, RAYS, unit);
        let gpu_ms = self.gpu_ms();
        let world = self.headless.app.world_mut();
        for entity in subjects.into_iter().chain([camera]) {
            world.despawn(entity);
        }
        // Let go of before the next one comes.
        self.wait(2);
        let rgb = pixels.into_iter().map(|[r, g, b, _]| [r, g, b]).collect();
        let ms = (median(times).unwrap_or_default() - self.empty_ms).max(1e-3);
        Ok(Drawn { halves: [rgb, Vec::new()], ms, gpu_ms })
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
        let world = self.headless.app.world_mut();
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
        let scattering = match events {
            Events::Single => SmokeScattering::SINGLE,
            Events::All => SmokeScattering::MULTIPLE,
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
        let mut volume = world.spawn(smoke);
        match setting {
            Setting::Rbf { model, .. } => drop(volume.insert(SmokeQuality::Model(*model))),
            Setting::Auto { error } => drop(volume.insert(SmokeQuality::Error(*error))),
            Setting::Paper { .. } => drop(volume.insert(SmokePaper::default())),
            Setting::Constellation { .. } => drop(volume.insert(SmokeConstellation { lights: 1, ..default() })),
            _ => {}
        }
        Ok((vec![volume.id()], unit))
    }

    /// Goes on to another moment, which looks the same, under light that has turned by nothing that is seen.
    fn stir(&mut self, volume: Entity, frame: u32) {
        let world = self.headless.app.world_mut();
        let angle = if frame.is_multiple_of(2) { TURN } else { -TURN };
        if let Some(mut playback) = world.get_mut::<SmokePlayback>(volume) {
            playback.seek(f64::from(frame + 1) / 1000.0);
        }
        turn_light(world, volume, angle);
    }

    /// Draws so many frames.
    fn wait(&mut self, frames: u32) {
        for _ in 0..frames {
            self.frame();
        }
    }

    /// Draws a frame, to its end; milliseconds.
    fn frame(&mut self) -> f64 {
        let start = Instant::now();
        self.headless.app.update();
        self.headless.wait();
        1e3 * start.elapsed().as_secs_f64()
    }

    /// Sum of the medians of the passes that ran, where all of them have times.
    fn gpu_ms(&mut self) -> Option<f64> {
        // CPU drivers have none of compute passes.
        if self.headless.app.world().resource::<RenderAdapterInfo>().device_type == wgpu::DeviceType::Cpu {
            return None;
        }
        // They arrive a few frames late.
        self.wait(4);
        let diagnostics = self.headless.app.world().resource::<DiagnosticsStore>();
        let times = SmokeRenderStats::PASSES.iter().filter_map(|pass| {
            let path = DiagnosticPath::new(format!("render/{pass}/elapsed_gpu"));
            let values: Vec<f64> = diagnostics.get(&path)?.values().copied().collect();
            median(values)
        });
        let times: Vec<f64> = times.collect();
        (!times.is_empty()).then(|| times.iter().sum())
    }

    /// The path tracer's picture.
    fn trace(&self, paths: u32, inputs: &Inputs, events: Events) -> anyhow::Result<Drawn> {
        let Inputs { scene, grid, .. } = inputs;
        let (center, side) = scene.placement.center_and_side(grid.shape, grid.placement);
        let density = Grid { shape: grid.shape, values: grid.values.iter().map(|&d| f64::from(d)).collect() };
        let image = match &scene.environment {
            Environment::Equirect(path) => {
                let ([width, _], texels) = read_equirect(path)?;
                Some(EquirectImage::new(width as usize, texels.into_iter().map(Vec3::from).collect()))
            }
            Environment::Lobes { .. } => None,
        };
        let lobes = |w| scene.environment.radiance(w).unwrap_or_default();
        let environment = image.as_ref().map_or(path::Environment::Function(&lobes), path::Environment::Image);
        let medium = Medium { sigma: scene.sigma_t * side, albedo: scene.albedo, g: scene.g };
        let traced = path::Scene::new(&density, medium, environment, &[]);
        let eye = (scene.camera.eye - center) / side;
        let pixels = self.pixels;
        let camera = |x, y| Ray::new(eye, scene.camera.direction(pixels, x, y));
        let start = Instant::now();
        let halves = [1, 2].map(|seed| {
            let image = path::render(&traced, pixels, camera, events, paths / 2, seed, &|_| ());
            image.into_iter().map(|rgb: DVec3| rgb.as_vec3().to_array()).collect()
        });
        Ok(Drawn { halves, ms: 1e3 * start.elapsed().as_secs_f64(), gpu_ms: None })
    }
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
