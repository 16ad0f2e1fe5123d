//! Smoke in the shadow of a ball.

use bevy::math::DVec3;
use bevy::render::render_resource::TextureFormat;
use serde::Serialize;

use super::Smoke;
use crate::cli::input::Smoke as Input;
use crate::cli::path::surfaces_in_bundle_space;
use crate::cli::render::{MESH_FRAMES, PictureKind, average, spawn_scene};
use crate::cli::scene::{Scene, SceneSphere};
use crate::headless::Headless;
use crate::reference::compare::image_error;
use crate::reference::path::{self, Environment, Events, alpha};
use crate::reference::{Medium, Ray};
use crate::scattering::{ScatteringEvents, SmokeScattering};
use crate::volume::LiveDensity;

/// The ball's distance from the middle of the smoke, and its radius, in sides of the box: close by, and clear of it.
const DISTANCE: f64 = 1.1;
const RADIUS: f64 = 0.4;
/// Rays a pixel along each side.
const RAYS: u32 = 4;

/// What came of a ball.
#[derive(Serialize)]
pub struct BallRow {
    pub ball: &'static str,
    pub scattering: &'static str,
    /// Light of the true picture over that without a ball.
    pub left: f64,
    /// Relative error of the picture; 0.01 is one per cent.
    pub error: f64,
}

/// The smoke without a ball, with a black one, and with one that reflects half.
pub fn study(scene: &Scene, smoke: &Smoke, spp: u32) -> anyhow::Result<Vec<BallRow>> {
    let mut rows = Vec::new();
    for (scattering, events) in [("single", Events::Single), ("full", Events::All)] {
        let mut free = None;
        for (ball, albedo) in [("none", None), ("black", Some(0.0)), ("albedo 0.5", Some(0.5))] {
            // Light that scatters once has not been reflected.
            if events == Events::Single && albedo == Some(0.5) {
                continue;
            }
            let mut scene = scene.clone();
            scene.spheres = albedo.map(|albedo| toward_the_light(&scene, smoke, albedo)).into_iter().collect();
            let (halves, alphas) = trace(&scene, smoke, events, spp);
            let picture = draw(&scene, smoke, events)?;
            let error = image_error([&picture, &picture], [&halves[0], &halves[1]], &alphas)?;
            let light: f64 = halves.iter().flatten().flatten().map(|value| f64::from(*value)).sum();
            let left = light / *free.get_or_insert(light);
            rows.push(BallRow { ball, scattering, left, error: error.relative });
        }
    }
    Ok(rows)
}

/// A ball on the side from which most light comes.
fn toward_the_light(scene: &Scene, smoke: &Smoke, albedo: f64) -> SceneSphere {
    let sh = scene.environment.coefficients().unwrap_or_default();
    // Band 1 is the vector that light comes along.
    let direction = DVec3::new(-sh.0[3].element_sum(), -sh.0[1].element_sum(), sh.0[2].element_sum());
    SceneSphere {
        center: smoke.center + direction.normalize_or(DVec3::Y) * (DISTANCE * smoke.side),
        radius: RADIUS * smoke.side,
        albedo: DVec3::splat(albedo),
    }
}

/// Two halves of the true picture, and its alpha.
fn trace(scene: &Scene, smoke: &Smoke, events: Events, spp: u32) -> ([Vec<[f32; 3]>; 2], Vec<f32>) {
    let radiance = |w: DVec3| scene.environment.radiance(w).unwrap_or_default();
    let medium = Medium { sigma: scene.sigma_t * smoke.side, albedo: scene.albedo, g: scene.g };
    let traced = path::Scene::new(&smoke.density, medium, Environment::Function(&radiance), &[])
        .with_surfaces(surfaces_in_bundle_space(scene, smoke.center, smoke.side));
    let size = scene.camera.size;
    let eye = (scene.camera.eye - smoke.center) / smoke.side;
    let camera = |x, y| Ray::new(eye, scene.camera.direction(size, x, y));
    let halves = [1, 2].map(|seed| {
        let image = path::render(&traced, size, camera, events, spp.div_ceil(2), seed, &|_| ());
        image.into_iter().map(|rgb| rgb.as_vec3().to_array()).collect()
    });
    (halves, alpha(&traced, size, camera).into_iter().map(|alpha| alpha as f32).collect())
}

/// The plug-in's picture.
fn draw(scene: &Scene, smoke: &Smoke, events: Events) -> anyhow::Result<Vec<[f32; 3]>> {
    let size = scene.camera.size;
    let mut headless = Headless::new(size.map(|side| side * RAYS).into(), TextureFormat::Rgba16Float)?;
    let events = match events {
        Events::Single => ScatteringEvents::Single,
        Events::All => ScatteringEvents::Multiple,
    };
    let scattering = SmokeScattering { events, ..Default::default() };
    let baked = Input::Baked(smoke.animation.clone());
    let (_, unit) = spawn_scene(&mut headless, scene, baked, LiveDensity::LATTICE, scattering, PictureKind::Exr)?;
    headless.settle()?;
    (0..MESH_FRAMES).for_each(|_| headless.app.update());
    let pixels = average(&headless.float_pixels(), size, RAYS, unit);
    Ok(pixels.into_iter().map(|[r, g, b, _]| [r, g, b]).collect())
}
