//! A floor under the smoke.

use anyhow::ensure;
use bevy::camera::ScalingMode;
use bevy::math::DVec3;
use bevy::prelude::*;
use bevy::render::render_resource::TextureFormat;
use rayon::prelude::*;
use serde::Serialize;

use super::Smoke;
use crate::cli::path::in_bundle_space;
use crate::cli::render::{MESH_FRAMES, medium, spawn_light};
use crate::cli::scene::{Scene, SceneLight};
use crate::cli::surfaces::environment_map;
use crate::headless::Headless;
use crate::prelude::*;
use crate::reference::irradiance::{Columns, Irradiance, Receiving};
use crate::reference::path::{Environment, Light};
use crate::reference::surface::Surfaces;
use crate::render::SmokeRenderStats;

/// From the smoke's lowest cell down to the floor, in heights of its box.
const BELOW: f64 = 0.2;
/// Sides of the floor that is looked at, in sides of the box.
const SIDES: f64 = 4.0;
/// Toward the sun: 45° high.
const SUN: DVec3 = DVec3::new(0.5, core::f64::consts::FRAC_1_SQRT_2, 0.5);
/// A point is in shadow where it gets less than this share of its light.
const SHADOW: f64 = 0.95;

/// What came of a light. Errors are root mean squares over the points in shadow; 0.01 is one per cent.
#[derive(Serialize)]
pub struct FloorRow {
    pub light: &'static str,
    /// Points in shadow.
    pub points: usize,
    /// Share of the light that is left where it is darkest.
    pub darkest: f64,
    /// Over the irradiance.
    pub error: f64,
    /// Over what of it the smoke takes.
    pub error_of_shadow: f64,
    /// The largest error over the irradiance of its point.
    pub worst: f64,
}

/// The floor under the sky alone, and under the sky and a sun that gives it as much.
pub fn study(scene: &Scene, smoke: &Smoke, points: u32) -> anyhow::Result<Vec<FloorRow>> {
    let floor = Floor::new(smoke, points);
    let radiance = |w: DVec3| scene.environment.radiance(w).unwrap_or_default();
    let none = Surfaces::default();
    let mut receiving = Receiving {
        columns: Columns::new(&smoke.density),
        sigma: scene.sigma_t * smoke.side,
        environment: Environment::Function(&radiance),
        lights: &[],
        surfaces: &none,
    };
    let sky: Vec<Irradiance> = floor.points().map(|x| receiving.sky(x, DVec3::Y)).collect();
    let irradiance = sky[0].clear / SUN.y;
    let sun = SceneLight::Sun { direction: SUN.normalize(), irradiance, angle_deg: 0.0 };
    let suns: [Light; 1] = [in_bundle_space(&sun, smoke.center, smoke.side)];
    receiving.lights = &suns;
    let both: Vec<Irradiance> = floor.points().zip(&sky).map(|(x, sky)| *sky + receiving.lights(x, DVec3::Y)).collect();
    Ok(vec![
        row("sky", &sky, &floor.draw(scene, smoke, &[])?),
        row("sky and sun", &both, &floor.draw(scene, smoke, &[sun])?),
    ])
}

/// A square of floor, seen from above by parallel rays.
struct Floor {
    /// Its height, and the heights of a box, in bundle units.
    y: f64,
    height: f64,
    points: u32,
}

impl Floor {
    fn new(smoke: &Smoke, points: u32) -> Self {
        let shape = smoke.density.shape;
        let occupied = (0..shape.len()).filter(|&index| smoke.density.values[index] > 0.0);
        let lowest = occupied.map(|index| shape.cell(index).y).min().unwrap_or(0);
        let (half, cell) = (f64::from(shape.half_extent().y), f64::from(shape.cell_size()));
        Self { y: f64::from(lowest) * cell - half - BELOW * 2.0 * half, height: 2.0 * half, points }
    }

    /// The points in bundle space, as a picture shows them from above with −Z up: rows from the top.
    fn points(&self) -> impl IndexedParallelIterator<Item = DVec3> {
        let place = |i: u32| SIDES * ((f64::from(i) + 0.5) / f64::from(self.points) - 0.5);
        (0..self.points * self.points)
            .into_par_iter()
            .map(move |i| DVec3::new(place(i % self.points), self.y, place(i / self.points)))
    }

    /// The share of light that the plug-in leaves at every point.
    fn draw(&self, scene: &Scene, smoke: &Smoke, lights: &[SceneLight]) -> anyhow::Result<Vec<Vec3>> {
        let mut headless = Headless::new(UVec2::splat(self.points), TextureFormat::Rgba16Float)?;
        let shows = headless.radiance_camera();
        let world = headless.app.world_mut();
        let side = smoke.side as f32;
        let animation = world.resource_mut::<Assets<SmokeAnimation>>().add(smoke.animation.clone());
        let at = Transform::from_translation(smoke.center.as_vec3()).with_scale(Vec3::splat(side));
        world.spawn((SmokeVolume::new(animation), medium(scene), SmokeEnvironment::Camera, at));
        let mesh = Plane3d::default().mesh().size(2.0 * SIDES as f32 * side, 2.0 * SIDES as f32 * side);
        let mesh = world.resource_mut::<Assets<Mesh>>().add(mesh);
        let material = StandardMaterial { perceptual_roughness: 1.0, reflectance: 0.0, ..Color::WHITE.into() };
        let material = world.resource_mut::<Assets<StandardMaterial>>().add(material);
        let floor = smoke.center + DVec3::Y * self.y * smoke.side;
        world.spawn((Mesh3d(mesh), MeshMaterial3d(material), Transform::from_translation(floor.as_vec3())));
        for light in lights {
            spawn_light(world, light, 1.0);
        }
        let map = environment_map(world, scene, 1.0)?;
        // Between the smoke and the floor.
        let above = (0.5 * BELOW * self.height * smoke.side) as f32;
        let eye = Transform::from_translation(floor.as_vec3() + Vec3::Y * above).looking_to(Vec3::NEG_Y, Vec3::NEG_Z);
        let projection = OrthographicProjection {
            scaling_mode: ScalingMode::FixedVertical { viewport_height: SIDES as f32 * side },
            near: 0.0,
            far: 2.0 * above,
            ..OrthographicProjection::default_3d()
        };
        let camera = world.spawn((shows, map, Projection::Orthographic(projection), eye)).id();

        let pass = SmokeRenderStats::PASSES.iter().position(|name| *name == "smoke_mesh_shadows");
        let pass = pass.expect("it is one of the passes");
        let drawn = |headless: &Headless| headless.app.world().resource::<SmokeRenderStats>().dispatches()[pass] > 0;
        for _ in 0..100 {
            headless.app.update();
            if drawn(&headless) {
                break;
            }
            // Assets load on other threads.
            std::thread::sleep(std::time::Duration::from_millis(10));
        }
        ensure!(drawn(&headless), "no shadow was drawn");
        let mut picture = |smoke| {
            headless.app.world_mut().entity_mut(camera).insert(SmokeShadows { smoke, ..default() });
            (0..MESH_FRAMES).for_each(|_| headless.app.update());
            headless.float_pixels().into_iter().map(|[r, g, b, _]| Vec3::new(r, g, b))
        };
        let (shaded, clear) = (picture(true), picture(false));
        Ok(shaded.zip(clear).map(|(shaded, clear)| shaded / clear).collect())
    }
}

fn row(light: &'static str, truth: &[Irradiance], drawn: &[Vec3]) -> FloorRow {
    let left = |e: &Irradiance| e.shaded.element_sum() / e.clear.element_sum();
    let shadow: Vec<(DVec3, &Irradiance)> = truth
        .iter()
        .zip(drawn)
        .filter(|(e, _)| left(e) < SHADOW)
        .map(|(e, share)| (e.clear * share.as_dvec3() - e.shaded, e))
        .collect();
    let mean = |f: &dyn Fn(&(DVec3, &Irradiance)) -> f64| shadow.iter().map(f).sum::<f64>();
    let squared = mean(&|(error, _)| error.length_squared());
    FloorRow {
        light,
        points: shadow.len(),
        darkest: shadow.iter().map(|(_, e)| left(e)).fold(1.0, f64::min),
        error: (squared / mean(&|(_, e)| e.shaded.length_squared())).sqrt(),
        error_of_shadow: (squared / mean(&|(_, e)| (e.clear - e.shaded).length_squared())).sqrt(),
        worst: shadow.iter().map(|(error, e)| error.length() / e.shaded.length()).fold(0.0, f64::max),
    }
}
