//! What the tests build their scenes from.

use bevy::camera::{Exposure, Hdr};
use bevy::core_pipeline::tonemapping::{DebandDither, Tonemapping};
use bevy::prelude::*;
use bevy::render::render_resource::TextureFormat;
use bevy_smoke::bundle;
use bevy_smoke::headless::Headless;
use bevy_smoke::prelude::*;
use bevy_smoke::render::SmokeRenderStats;

pub const SIZE: UVec2 = UVec2::new(64, 64);

/// Exposure 1: radiance is drawn as it is.
pub const UNEXPOSED: Exposure = Exposure { ev100: -0.263_034_4 };

/// A radiance image of `SIZE`.
pub fn app() -> Headless {
    Headless::new(SIZE, TextureFormat::Rgba16Float).unwrap()
}

/// The plume that the examples use.
pub fn plume(app: &mut Headless) -> Handle<SmokeAnimation> {
    let bytes = std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/assets/plume.smoke")).unwrap();
    let animation = bundle::read(&bytes).unwrap();
    app.app.world_mut().resource_mut::<Assets<SmokeAnimation>>().add(animation)
}

/// Grey smoke 3 metres tall under a white sky.
pub fn smoke(app: &mut Headless) -> (SmokeVolume, SmokeMedium, SmokeEnvironment, Transform) {
    (
        SmokeVolume::new(plume(app)),
        SmokeMedium { sigma_t: 5.0, albedo: LinearRgba::rgb(0.8, 0.7, 0.6), g: 0.0 },
        SmokeEnvironment::constant(Vec3::ONE, 1.0),
        Transform::from_scale(Vec3::splat(3.0)),
    )
}

/// A camera that shows radiance as it is, over nothing.
pub fn camera(app: &Headless) -> impl Bundle + use<> {
    (
        Camera3d::default(),
        Camera { clear_color: ClearColorConfig::Custom(Color::NONE), ..default() },
        app.target(),
        (Hdr, Msaa::Off, Tonemapping::None, DebandDither::Disabled, UNEXPOSED),
        Projection::Perspective(PerspectiveProjection { fov: 0.6, ..default() }),
        Transform::from_xyz(0.0, 0.0, 6.0),
    )
}

/// The same with parallel rays, 3.2 metres high.
pub fn parallel_camera(app: &Headless, eye: Transform) -> impl Bundle + use<> {
    let mut projection = OrthographicProjection::default_3d();
    projection.scaling_mode = bevy::camera::ScalingMode::FixedVertical { viewport_height: 3.2 };
    (
        Camera3d::default(),
        Camera { clear_color: ClearColorConfig::Custom(Color::NONE), ..default() },
        app.target(),
        (Hdr, Msaa::Off, Tonemapping::None, DebandDither::Disabled, UNEXPOSED),
        Projection::Orthographic(projection),
        eye,
    )
}

/// An unlit mesh of one linear colour.
pub fn mesh(app: &mut Headless, mesh: impl Into<Mesh>, color: LinearRgba, transform: Transform) {
    let world = app.app.world_mut();
    let mesh = world.resource_mut::<Assets<Mesh>>().add(mesh.into());
    let material = StandardMaterial { base_color: color.into(), unlit: true, ..default() };
    let material = world.resource_mut::<Assets<StandardMaterial>>().add(material);
    world.spawn((Mesh3d(mesh), MeshMaterial3d(material), transform));
}

/// The picture once smoke has appeared, and once more: meshes, too, need a few frames.
pub fn draw(app: &mut Headless) -> Vec<[f32; 4]> {
    app.settle().unwrap();
    for _ in 0..3 {
        app.app.update();
    }
    let pixels = app.float_pixels();
    assert!(pixels.iter().flatten().all(|value| value.is_finite()));
    pixels
}

/// Dispatches so far of the passes of the product: environment, density, coarse, pair matrix, incident light, scattering,
/// outgoing, volume, view.
pub fn dispatches(app: &Headless) -> [u32; 9] {
    let all = app.app.world().resource::<SmokeRenderStats>().dispatches();
    let passes = [
        "environment",
        "density",
        "coarse",
        "pair_matrix",
        "incident_light",
        "scattering",
        "outgoing",
        "volume",
        "view",
    ];
    passes.map(|pass| {
        let name = format!("smoke_{pass}");
        all[SmokeRenderStats::PASSES.iter().position(|other| *other == name).expect("it is one of the passes")]
    })
}

/// Root mean square of the difference of two pictures.
pub fn rms(a: &[[f32; 4]], b: &[[f32; 4]]) -> f64 {
    assert_eq!(a.len(), b.len());
    let square = |(x, y): (&f32, &f32)| (f64::from(*x) - f64::from(*y)).powi(2);
    let sum: f64 = a.iter().flatten().zip(b.iter().flatten()).map(square).sum();
    (sum / (4 * a.len()) as f64).sqrt()
}

/// The sum of a picture's alpha.
pub fn coverage(pixels: &[[f32; 4]]) -> f64 {
    pixels.iter().map(|pixel| f64::from(pixel[3])).sum()
}

/// Writes a picture of sRGB bytes where `SMOKE_PICTURES` asks for it; small ones enlarged, pixel by pixel.
pub fn save(name: &str, size: UVec2, rgba: &[u8]) {
    let Ok(folder) = std::env::var("SMOKE_PICTURES") else { return };
    let enlarged = 256_u32.div_ceil(size.x);
    let picture = image::RgbImage::from_fn(size.x * enlarged, size.y * enlarged, |x, y| {
        let at = 4 * (y / enlarged * size.x + x / enlarged) as usize;
        image::Rgb([rgba[at], rgba[at + 1], rgba[at + 2]])
    });
    picture.save(std::path::Path::new(&folder).join(name).with_extension("png")).unwrap();
}

/// The same of linear radiance over black, as sRGB.
pub fn save_radiance(name: &str, size: UVec2, pixels: &[[f32; 4]]) {
    let bytes: Vec<u8> =
        pixels.iter().flat_map(|&[r, g, b, _]| Srgba::from(LinearRgba::rgb(r, g, b)).to_u8_array()).collect();
    save(name, size, &bytes);
}
