//! Where the cases are drawn, and traced.

use bevy::asset::RenderAssetUsages;
use bevy::math::DVec3;
use bevy::prelude::*;
use bevy::render::render_resource::{Extent3d, TextureDimension, TextureFormat};

use super::Method;
use super::cases::{BRIGHT, BRIGHT_RADIANCE, Case, Light, TEXELS};
use crate::headless::Headless;
use crate::paper::SmokePaper;
use crate::prelude::*;
use crate::reference::path::{self, EquirectImage, Events};
use crate::reference::{Grid, Medium, Ray};
use crate::render::SolverReport;
use crate::scattering::ScatteringSolver;
use crate::sh::{ShRgb, SphereRule};

/// Pixels of a picture.
pub const SIZE: UVec2 = UVec2::new(24, 30);
/// Rays a pixel along each side.
const RAYS: u32 = 4;
/// The camera's distance in boxes, and vertical field of view.
const DISTANCE: f64 = 2.5;
const FOV: f64 = 0.5;

/// A picture, and what the solver said of it.
pub struct Picture {
    /// Rows from the top: radiance without background, and 1 − transmittance.
    pub pixels: Vec<[f32; 4]>,
    pub report: Option<SolverReport>,
}

/// A windowless app in which one case is drawn after the other.
pub struct Stage {
    headless: Headless,
    camera: Entity,
}

impl Stage {
    pub fn new() -> anyhow::Result<Self> {
        let mut headless = Headless::new(SIZE * RAYS, TextureFormat::Rgba16Float)?;
        let shows = headless.radiance_camera();
        let camera = headless.app.world_mut().spawn(shows).id();
        Ok(Self { headless, camera })
    }

    /// Draws a case in a volume of its own: what comes before it, then the case itself for one frame.
    pub fn draw(&mut self, case: &Case, method: Method) -> Picture {
        let world = self.headless.app.world_mut();
        let smoke = world.resource_mut::<Assets<SmokeAnimation>>().add((*case.smoke).clone());
        let width = case.width as f32;
        let projection = PerspectiveProjection { fov: FOV as f32, near: 1e-3 * width, far: 100.0 * width, ..default() };
        let eye = Transform::from_xyz(0.0, 0.0, DISTANCE as f32 * width).looking_at(Vec3::ZERO, Vec3::Y);
        world.entity_mut(self.camera).insert((Projection::Perspective(projection), eye));
        let first = case.before.as_deref().unwrap_or(case);
        let lit = (medium(first), self.environment(first));
        let transform = Transform::from_scale(Vec3::splat(width));
        let world = self.headless.app.world_mut();
        let solver =
            if method == Method::Diffusion { ScatteringSolver::Diffusion } else { ScatteringSolver::Transport };
        let scattering = SmokeScattering { solver, ..SmokeScattering::MULTIPLE };
        let mut volume = world.spawn((SmokeVolume::new(smoke), scattering, transform, lit));
        if method == Method::Paper {
            volume.insert(SmokePaper::default());
        }
        let volume = volume.id();
        // The asset has to reach the GPU, and the bounds the volume.
        for _ in 0..4 {
            self.headless.app.update();
        }
        if case.before.is_some() {
            let lit = (medium(case), self.environment(case));
            self.headless.app.world_mut().entity_mut(volume).insert(lit);
            self.headless.app.update();
        }
        let fine = self.headless.float_pixels();
        let report = self.headless.solver_reports().first().copied();
        self.headless.app.world_mut().despawn(volume);
        // Forgotten, so that the next case's solver is the only one.
        self.headless.app.update();
        Picture { pixels: average(&fine), report }
    }

    fn environment(&mut self, case: &Case) -> SmokeEnvironment {
        match case.light {
            Light::Texel => {
                let image = self.headless.app.world_mut().resource_mut::<Assets<Image>>().add(texel_image());
                SmokeEnvironment::equirect(image, 1.0)
            }
            light => {
                let coefficients = ShRgb::project(&SphereRule::new(4), |w| light.radiance(w));
                SmokeEnvironment::Coefficients { coefficients: coefficients.0.map(|c| c.as_vec3()), intensity: 1.0 }
            }
        }
    }
}

fn medium(case: &Case) -> SmokeMedium {
    let albedo = case.albedo.as_vec3();
    SmokeMedium {
        sigma_t: case.sigma_t as f32,
        albedo: LinearRgba::rgb(albedo.x, albedo.y, albedo.z),
        g: case.g as f32,
    }
}

fn texels() -> Vec<Vec3> {
    let mut texels = vec![Vec3::ZERO; (TEXELS[0] * TEXELS[1]) as usize];
    texels[(BRIGHT[1] * TEXELS[0] + BRIGHT[0]) as usize] = Vec3::splat(BRIGHT_RADIANCE as f32);
    texels
}

fn texel_image() -> Image {
    let data = texels().into_iter().flat_map(|rgb| rgb.extend(1.0).to_array()).flat_map(f32::to_le_bytes).collect();
    let size = Extent3d { width: TEXELS[0], height: TEXELS[1], depth_or_array_layers: 1 };
    Image::new(size, TextureDimension::D2, data, TextureFormat::Rgba32Float, RenderAssetUsages::default())
}

/// Means over the rays of every pixel.
fn average(fine: &[[f32; 4]]) -> Vec<[f32; 4]> {
    let pixel = |x: u32, y: u32| {
        let mut sum = Vec4::ZERO;
        for (j, i) in (0..RAYS).flat_map(|j| (0..RAYS).map(move |i| (j, i))) {
            sum += Vec4::from(fine[((y * RAYS + j) * SIZE.x * RAYS + x * RAYS + i) as usize]);
        }
        (sum / (RAYS * RAYS) as f32).to_array()
    };
    (0..SIZE.y).flat_map(|y| (0..SIZE.x).map(move |x| pixel(x, y))).collect()
}

/// Two halves of the case, path-traced.
pub fn trace(case: &Case, spp: u32) -> [Vec<[f32; 3]>; 2] {
    let shape = case.smoke.shape;
    let values = case.smoke.frames.get(0).expect("made of one frame").decode().into_iter().map(f64::from).collect();
    let density = Grid { shape, values };
    let image = (case.light == Light::Texel).then(|| EquirectImage::new(TEXELS[0] as usize, texels()));
    let lobes = |w: DVec3| case.light.radiance(w);
    let environment = image.as_ref().map_or(path::Environment::Function(&lobes), path::Environment::Image);
    let medium = Medium { sigma: case.sigma_t * case.width, albedo: case.albedo, g: case.g };
    let scene = path::Scene::new(&density, medium, environment, &[]);
    let eye = DVec3::Z * DISTANCE;
    let [width, height] = SIZE.as_dvec2().to_array();
    let tan = (0.5 * FOV).tan();
    let camera = |x: f64, y: f64| {
        let (u, v) = (2.0 * x / width - 1.0, 1.0 - 2.0 * y / height);
        Ray::new(eye, DVec3::new(u * tan * width / height, v * tan, -1.0).normalize())
    };
    [1, 2].map(|seed| {
        let image = path::render(&scene, SIZE.to_array(), camera, Events::All, spp.div_ceil(2), seed, &|_| ());
        image.into_iter().map(|rgb| rgb.as_vec3().to_array()).collect()
    })
}
