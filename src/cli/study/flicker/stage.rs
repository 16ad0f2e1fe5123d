//! Where the bundles are drawn, by the plug-in.

use bevy::prelude::*;
use bevy::render::render_resource::TextureFormat;

use crate::bundle::SmokeAnimation;
use crate::cli::render::{environment, medium, spawn_camera};
use crate::cli::scene::Scene;
use crate::headless::{Headless, HeadlessError};
use crate::prelude::*;
use crate::render::SmokeRenderStats;

/// A windowless app in which every animation has a volume, of which one is seen at a time.
pub struct Stage {
    headless: Headless,
    volumes: Vec<Entity>,
    /// The radiance that 1 in the picture stands for.
    unit: f32,
}

impl Stage {
    /// The scene with each animation where its own file places it; one ray a pixel.
    pub fn new(scene: &Scene, animations: Vec<SmokeAnimation>) -> anyhow::Result<Self> {
        let mut headless = Headless::new(scene.camera.size.into(), TextureFormat::Rgba16Float)?;
        spawn_camera(&mut headless, scene);
        let world = headless.app.world_mut();
        let (environment, unit) = environment(world, scene)?;
        let spawn = |animation: SmokeAnimation| {
            let (center, side) = scene.placement.center_and_side(animation.shape, animation.placement);
            let animation = world.resource_mut::<Assets<SmokeAnimation>>().add(animation);
            let volume = (
                SmokeVolume::new(animation),
                SmokeScattering { events: ScatteringEvents::Single, ..default() },
                medium(scene),
                environment.clone(),
                Transform::from_translation(center.as_vec3()).with_scale(Vec3::splat(side as f32)),
                Visibility::Hidden,
            );
            world.spawn(volume).id()
        };
        let volumes = animations.into_iter().map(spawn).collect();
        Ok(Self { headless, volumes, unit })
    }

    /// The radiance of a frame of an animation, rows from the top.
    pub fn draw(&mut self, animation: usize, frame: u32) -> Result<Vec<[f32; 3]>, HeadlessError> {
        let world = self.headless.app.world_mut();
        for (index, &volume) in self.volumes.iter().enumerate() {
            let visibility = if index == animation { Visibility::Inherited } else { Visibility::Hidden };
            world.entity_mut(volume).insert(visibility);
        }
        show_frame(world, self.volumes[animation], frame);
        self.update_until_drawn()?;
        let pixels = self.headless.float_pixels();
        Ok(pixels.iter().map(|&[r, g, b, _]| [r, g, b].map(|value| value * self.unit)).collect())
    }

    /// Updates once, or the first time until the animation has reached the GPU.
    fn update_until_drawn(&mut self) -> Result<(), HeadlessError> {
        let view = SmokeRenderStats::PASSES.len() - 1;
        let draws = |headless: &Headless| headless.app.world().resource::<SmokeRenderStats>().dispatches()[view];
        let before = draws(&self.headless);
        for _ in 0..60 {
            self.headless.app.update();
            if draws(&self.headless) > before {
                return Ok(());
            }
        }
        Err(HeadlessError::NothingDrawn)
    }
}

/// Makes a volume show exactly this frame of its animation, from 0.
fn show_frame(world: &mut World, volume: Entity, frame: u32) {
    world.entity_mut(volume).insert(SmokePlayback::at_frame(frame));
}
