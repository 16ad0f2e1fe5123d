//! Smoke over mountains, from morning to night: sun, sky and smoke shade the terrain, sun and sky light the smoke.
//!
//! `cargo run --features cli --example terrain` opens a window. `… --example terrain -- --png FILE` writes a picture instead and
//! needs no display; with `--frames N` it writes N pictures of a day, numbered. `--help` lists the rest.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use bevy::asset::RenderAssetUsages;
use bevy::camera::Exposure;
use bevy::diagnostic::{Diagnostic, DiagnosticPath, DiagnosticsStore};
use bevy::light::{CascadeShadowConfigBuilder, Skybox};
use bevy::mesh::{Indices, PrimitiveTopology};
use bevy::prelude::*;
use bevy::render::render_resource::{
    Extent3d, TextureDimension, TextureFormat, TextureViewDescriptor, TextureViewDimension,
};
use bevy::time::TimeUpdateStrategy;
use bevy_smoke::headless::Headless;
use bevy_smoke::prelude::*;
use bevy_smoke::render::SmokeRenderStats;

const USAGE: &str = "\
usage: terrain [OPTIONS]          in a window, a day a minute
       terrain --png FILE [OPTIONS]
  --hour H       the time of day, from 0 to 24 (17.4; in a window time goes on from there)
  --frames N     N frames: with --png a day in numbered files, FILE_0001.png and so on
  --still        time stands still in all frames: nothing is lit anew
  --no-coupling  smoke and terrain do not shade each other
  --size WxH     960x540 by default
  --stats        after the last frame, print what passes took";

/// Vertices a side of the terrain, and its side in metres.
const VERTICES: u32 = 190;
const SIDE: f32 = 64.0;
/// The luminance (cd/m²) that the colours of the sky are multiples of.
const LUMINANCE: f32 = 200.0;
/// Texels a side of the sky's six faces.
const SKY_TEXELS: u32 = 48;

/// What the command line asks for.
#[derive(Clone, Debug)]
pub struct Options {
    pub png: Option<PathBuf>,
    pub hour: f32,
    pub frames: Option<u32>,
    pub still: bool,
    pub coupled: bool,
    pub size: UVec2,
    pub stats: bool,
}

impl Default for Options {
    fn default() -> Self {
        let size = UVec2::new(960, 540);
        Self { png: None, hour: 17.4, frames: None, still: false, coupled: true, size, stats: false }
    }
}

#[allow(dead_code, reason = "the tests use the scene, not the program")]
fn main() -> ExitCode {
    let options = match options(std::env::args().skip(1)) {
        Ok(Some(options)) => options,
        Ok(None) => {
            println!("{USAGE}");
            return ExitCode::SUCCESS;
        }
        Err(error) => {
            eprintln!("error: {error}\n{USAGE}");
            return ExitCode::from(2);
        }
    };
    if options.png.is_none() && options.frames.is_none() {
        return window(options);
    }
    match pictures(options) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

fn options(mut arguments: impl Iterator<Item = String>) -> Result<Option<Options>, String> {
    let mut options = Options::default();
    while let Some(name) = arguments.next() {
        let mut value = || arguments.next().ok_or(format!("{name} needs a value"));
        match name.as_str() {
            "--png" => options.png = Some(value()?.into()),
            "--hour" => options.hour = value()?.parse().map_err(|error| format!("--hour: {error}"))?,
            "--frames" => options.frames = Some(value()?.parse().map_err(|error| format!("--frames: {error}"))?),
            "--still" => options.still = true,
            "--no-coupling" => options.coupled = false,
            "--size" => {
                let size = value()?;
                let sides = size.split_once('x').and_then(|(w, h)| Some(UVec2::new(w.parse().ok()?, h.parse().ok()?)));
                options.size = sides.filter(|size| size.min_element() > 0).ok_or(format!("--size {size}: not WxH"))?;
            }
            "--stats" => options.stats = true,
            "--help" | "-h" => return Ok(None),
            _ => return Err(format!("{name}: no such option")),
        }
    }
    if options.stats && options.png.is_none() && options.frames.is_none() {
        return Err("--stats needs --frames or --png".into());
    }
    Ok(Some(options))
}

fn window(options: Options) -> ExitCode {
    let still = options.still;
    let mut app = App::new();
    app.add_plugins((DefaultPlugins, SmokePlugin)).add_systems(Startup, setup(options)).add_systems(Update, light_day);
    if !still {
        app.add_systems(Update, pass_time.before(light_day));
    }
    if app.run().is_success() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Draws frames without a window, and writes them where they are wanted.
fn pictures(options: Options) -> Result<(), String> {
    let Options { png, hour, frames, still, size, stats, .. } = options.clone();
    let count = frames.unwrap_or(1);
    let mut headless = Headless::new(size, TextureFormat::Rgba8UnormSrgb).map_err(|error| error.to_string())?;
    // The same pictures however long drawing takes.
    headless.app.insert_resource(TimeUpdateStrategy::ManualDuration(Duration::ZERO));
    headless.app.add_systems(Startup, setup(options)).add_systems(Update, light_day);
    headless.draw_cameras_to_image();
    headless.settle().map_err(|error| error.to_string())?;
    // Meshes and their textures take a few frames more, and spheres are fitted beside.
    let world = headless.app.world_mut();
    let mut fits = world.query_filtered::<(), (With<SmokeOccluderFit>, Without<SmokeOccluder>)>();
    while fits.iter(headless.app.world()).next().is_some() {
        headless.app.update();
    }
    for _ in 0..4 {
        headless.app.update();
    }
    headless.wait();
    headless.app.world_mut().resource_mut::<DiagnosticsStore>().iter_mut().for_each(Diagnostic::clear_history);
    let before = headless.app.world().resource::<SmokeRenderStats>().dispatches();
    let mut frame_ms = Vec::new();
    for frame in 0..count {
        if !still && count > 1 {
            headless.app.world_mut().resource_mut::<Hour>().0 = (hour + 24.0 * frame as f32 / count as f32) % 24.0;
            headless.app.insert_resource(TimeUpdateStrategy::ManualDuration(Duration::from_secs(1) / 30));
        }
        let start = Instant::now();
        headless.app.update();
        headless.wait();
        frame_ms.push(start.elapsed().as_secs_f64() * 1000.0);
        if let Some(png) = &png {
            let file = if frames.is_some() { numbered(png, frame + 1) } else { png.clone() };
            image::save_buffer(&file, &headless.pixels(), size.x, size.y, image::ColorType::Rgba8)
                .map_err(|error| format!("{}: {error}", file.display()))?;
            println!("{}", file.display());
        }
    }
    if stats {
        print_stats(&headless, before, frame_ms);
    }
    Ok(())
}

/// `FILE.png` with a number: `FILE_0001.png`.
fn numbered(file: &Path, number: u32) -> PathBuf {
    let stem = file.file_stem().unwrap_or_default().to_string_lossy();
    let extension = file.extension().unwrap_or("png".as_ref()).to_string_lossy();
    file.with_file_name(format!("{stem}_{number:04}.{extension}"))
}

/// Dispatches and medians of milliseconds a frame: of smoke's passes and of Bevy's, by the GPU's own clock where it has one.
fn print_stats(headless: &Headless, before: [u32; SmokeRenderStats::PASSES.len()], frame_ms: Vec<f64>) {
    let median = |mut values: Vec<f64>| {
        values.sort_by(f64::total_cmp);
        values.get(values.len() / 2).copied()
    };
    let world = headless.app.world();
    let diagnostics = world.resource::<DiagnosticsStore>();
    let gpu_ms = |pass: &str| {
        let path = DiagnosticPath::new(format!("render/{pass}/elapsed_gpu"));
        median(diagnostics.get(&path).map(Diagnostic::values).into_iter().flatten().copied().collect())
    };
    let show = |ms: Option<f64>| ms.map_or("-".into(), |ms| format!("{ms:.3}"));
    let frames = frame_ms.len();
    println!("{:<28}{:>12}{:>10}", "pass", "dispatches", "GPU ms");
    let after = world.resource::<SmokeRenderStats>().dispatches();
    for (i, pass) in SmokeRenderStats::PASSES.into_iter().enumerate() {
        println!("{pass:<28}{:>12}{:>10}", after[i] - before[i], show(gpu_ms(pass)));
    }
    for pass in ["shadow_passes", "main_opaque_pass_3d", "main_transparent_pass_3d"] {
        println!("{pass:<28}{:>12}{:>10}", "", show(gpu_ms(pass)));
    }
    println!("{:<28}{frames:>12}{:>10}", "frame, by the clock", show(median(frame_ms)));
}

/// The time of day, from 0 to 24.
#[derive(Resource, Clone, Copy)]
pub struct Hour(pub f32);

/// The sky's cubemaps: what is seen of it, and the light that it gives.
#[derive(Resource)]
pub struct Sky {
    radiance: Handle<Image>,
    irradiance: Handle<Image>,
}

/// Spawns terrain, smoke, light and camera.
pub fn setup(
    options: Options,
) -> impl FnMut(Commands, Res<AssetServer>, ResMut<Assets<Image>>, ResMut<Assets<Mesh>>, ResMut<Assets<StandardMaterial>>)
{
    move |mut commands, assets, mut images, mut meshes, mut materials| {
        let coupled = options.coupled;
        commands.insert_resource(Hour(options.hour));
        // The sky is all the ambient light there is.
        commands.insert_resource(GlobalAmbientLight { brightness: 0.0, ..default() });

        let ground = StandardMaterial { perceptual_roughness: 1.0, reflectance: 0.1, ..default() };
        let mut mountains = commands.spawn((Mesh3d(meshes.add(terrain())), MeshMaterial3d(materials.add(ground))));
        if coupled {
            // Spheres under the ground, which keep light from below off the smoke.
            mountains.insert(SmokeOccluderFit::ground(64));
        }

        // A fire behind the ridge.
        let base = Vec2::new(1.5, -6.5);
        let size = 15.0;
        commands.spawn((
            SmokeVolume::new(assets.load("billow.smoke")),
            SmokePlayback::ping_pong().with_range(24..=47).with_speed(0.5).starting_at_frame(40),
            SmokeMedium { sigma_t: 70.0 / size, albedo: LinearRgba::rgb(0.98, 0.97, 0.96), g: 0.3 },
            Transform::from_xyz(base.x, height(base) + 0.42 * size, base.y).with_scale(Vec3::splat(size)),
        ));

        let sun = DirectionalLight { shadow_maps_enabled: true, ..default() };
        let cascades = CascadeShadowConfigBuilder {
            num_cascades: 3,
            maximum_distance: 90.0,
            first_cascade_far_bound: 16.0,
            ..default()
        };
        commands.spawn((sun, cascades.build()));

        // Drawn as time goes on.
        let [radiance, irradiance] = [(); 2].map(|()| images.add(sky_image(1, |_| Vec3::ZERO)));
        commands.spawn((
            Camera3d::default(),
            Exposure::INDOOR,
            SmokeShadows { smoke: coupled, occluders: coupled },
            Skybox { image: Some(radiance.clone()), brightness: LUMINANCE, ..default() },
            EnvironmentMapLight {
                diffuse_map: irradiance.clone(),
                specular_map: radiance.clone(),
                intensity: LUMINANCE,
                ..default()
            },
            Projection::Perspective(PerspectiveProjection { fov: 0.85, ..default() }),
            Transform::from_xyz(-2.0, 5.5, 15.0).looking_at(Vec3::new(1.5, 8.6, -6.0), Vec3::Y),
        ));
        commands.insert_resource(Sky { radiance, irradiance });
    }
}

/// A day takes a minute.
fn pass_time(time: Res<Time>, mut hour: ResMut<Hour>) {
    hour.0 = (hour.0 + 24.0 / 60.0 * time.delta_secs()) % 24.0;
}

/// Sun, or moon, and sky of the hour.
pub fn light_day(
    hour: Res<Hour>,
    sky: Res<Sky>,
    mut images: ResMut<Assets<Image>>,
    mut suns: Query<(&mut DirectionalLight, &mut Transform)>,
) {
    if !hour.is_changed() {
        return;
    }
    let sun = sun_direction(hour.0);
    for (mut light, mut transform) in &mut suns {
        // The moon is opposite; when one rises the other sets, and neither shines.
        let (toward, irradiance) = if sun.y > 0.0 { (sun, sunlight(sun)) } else { (-sun, moonlight(-sun)) };
        let strongest = irradiance.max_element().max(1e-6);
        let color = irradiance / strongest;
        light.color = Color::linear_rgb(color.x, color.y, color.z);
        light.illuminance = strongest * LUMINANCE;
        *transform = Transform::default().looking_to(-toward, Vec3::Y);
    }
    let radiance = |direction| sky_radiance(direction, sun);
    for (handle, image) in
        [(&sky.radiance, sky_image(SKY_TEXELS, radiance)), (&sky.irradiance, sky_image(8, diffuse_of(radiance)))]
    {
        images.insert(handle.id(), image).expect("the handle is alive");
    }
}

/// Toward the sun: up at noon, at the right at 6 and at the left at 18, in a plane that leans away from the camera: light that
/// comes from behind makes smoke glow.
fn sun_direction(hour: f32) -> Vec3 {
    let angle = (hour - 6.0) / 24.0 * std::f32::consts::TAU;
    Vec3::new(angle.cos(), 0.8 * angle.sin(), -0.55 * angle.sin()).normalize()
}

/// Irradiance of a facing surface, in multiples of the sky's unit: reddened on its long way at dusk.
fn sunlight(sun: Vec3) -> Vec3 {
    let air = 1.0 / (sun.y.max(0.0) + 0.09);
    let reddened = Vec3::new(0.05, 0.13, 0.3) * -air;
    8.5 * smoothstep(-0.02, 0.08, sun.y) * Vec3::new(reddened.x.exp(), reddened.y.exp(), reddened.z.exp())
}

fn moonlight(moon: Vec3) -> Vec3 {
    0.6 * smoothstep(0.0, 0.15, moon.y) * Vec3::new(0.6, 0.75, 1.0)
}

/// Radiance of the sky in a direction, in multiples of its unit.
fn sky_radiance(direction: Vec3, sun: Vec3) -> Vec3 {
    let day = smoothstep(-0.18, 0.3, sun.y);
    let zenith = Vec3::new(0.010, 0.017, 0.042).lerp(Vec3::new(0.06, 0.16, 0.42), day);
    let horizon = Vec3::new(0.026, 0.038, 0.075).lerp(Vec3::new(0.42, 0.52, 0.66), day);
    let toward = direction.dot(sun).max(0.0);
    // Dusk glows along the horizon under the sun, and violet opposite.
    let dusk = (-(sun.y / 0.22).powi(2)).exp();
    let azimuth = direction.with_y(0.0).normalize_or_zero().dot(sun.with_y(0.0).normalize_or_zero());
    let low = (-(direction.y.max(0.0) / 0.22)).exp();
    let warm = Vec3::new(1.0, 0.42, 0.13) * (0.5 + 0.5 * azimuth).powi(3) + Vec3::new(0.16, 0.09, 0.16);
    let clear = horizon.lerp(zenith, direction.y.max(0.0).powf(0.5)) + 0.8 * dusk * low * warm;
    let halo = smoothstep(-0.1, 0.1, sun.y) * (0.30 * toward.powi(6) + 0.9 * toward.powi(60));
    let above = clear + halo * Vec3::new(1.0, 0.8, 0.55).lerp(Vec3::ONE, day * 0.6);
    // Below the horizon there is dim, hazy land.
    above.lerp(horizon * Vec3::new(0.30, 0.29, 0.26), smoothstep(0.0, -0.12, direction.y))
}

/// Irradiance over π in a direction, of radiance seen by way of a few hundred directions.
fn diffuse_of(radiance: impl Fn(Vec3) -> Vec3) -> impl Fn(Vec3) -> Vec3 {
    const COUNT: u32 = 400;
    let golden = std::f32::consts::PI * (3.0 - 5.0_f32.sqrt());
    let samples: Vec<(Vec3, Vec3)> = (0..COUNT)
        .map(|i| {
            let y = 1.0 - (2.0 * i as f32 + 1.0) / COUNT as f32;
            let (sin, cos) = (golden * i as f32).sin_cos();
            let direction = Vec3::new((1.0 - y * y).sqrt() * cos, y, (1.0 - y * y).sqrt() * sin);
            (direction, radiance(direction))
        })
        .collect();
    move |normal| {
        let sum: Vec3 = samples.iter().map(|(direction, radiance)| *radiance * normal.dot(*direction).max(0.0)).sum();
        // Cosines over the sphere average to a quarter.
        4.0 * sum / COUNT as f32
    }
}

/// A cubemap, by the directions of its texels; the render world's alone.
fn sky_image(texels: u32, radiance: impl Fn(Vec3) -> Vec3) -> Image {
    let mut data = Vec::with_capacity(6 * (texels * texels) as usize * 8);
    for face in 0..6 {
        for i in 0..texels * texels {
            let at = |i: u32| 2.0 * (i as f32 + 0.5) / texels as f32 - 1.0;
            let (u, v) = (at(i % texels), at(i / texels));
            // Cubemaps are left-handed: Bevy turns z around.
            let direction = [
                Vec3::new(1.0, -v, -u),
                Vec3::new(-1.0, -v, u),
                Vec3::new(u, 1.0, v),
                Vec3::new(u, -1.0, -v),
                Vec3::new(u, -v, 1.0),
                Vec3::new(-u, -v, -1.0),
            ][face];
            let color = radiance((direction * Vec3::new(1.0, 1.0, -1.0)).normalize()).extend(1.0);
            data.extend(color.to_array().into_iter().flat_map(|value| half_bits(value).to_le_bytes()));
        }
    }
    let size = Extent3d { width: texels, height: texels, depth_or_array_layers: 6 };
    let usage = RenderAssetUsages::RENDER_WORLD;
    let mut image = Image::new(size, TextureDimension::D2, data, TextureFormat::Rgba16Float, usage);
    let dimension = Some(TextureViewDimension::Cube);
    image.texture_view_descriptor = Some(TextureViewDescriptor { dimension, ..default() });
    image
}

/// A small positive number in half precision.
fn half_bits(value: f32) -> u16 {
    // Exponents are 112 apart; smaller numbers are nought.
    let bits = value.clamp(0.0, 65504.0).to_bits();
    ((bits + 0x1000) >> 13).saturating_sub(112 << 10) as u16
}

/// The terrain: heights on a grid, coloured by height and slope.
fn terrain() -> Mesh {
    let spacing = SIDE / (VERTICES - 1) as f32;
    let point = |x: f32, z: f32| Vec3::new(x, height(Vec2::new(x, z)), z);
    let (mut positions, mut normals, mut colors) = (Vec::new(), Vec::new(), Vec::new());
    for i in 0..VERTICES * VERTICES {
        let at = |i: u32| i as f32 * spacing - 0.5 * SIDE;
        let (x, z) = (at(i % VERTICES), at(i / VERTICES));
        let along_x = point(x + spacing, z) - point(x - spacing, z);
        let along_z = point(x, z + spacing) - point(x, z - spacing);
        let normal = along_z.cross(along_x).normalize();
        positions.push(point(x, z));
        normals.push(normal);
        colors.push(ground_color(point(x, z), normal).to_f32_array());
    }
    let quads = (0..(VERTICES - 1) * (VERTICES - 1)).map(|i| i % (VERTICES - 1) + i / (VERTICES - 1) * VERTICES);
    let corners = |i: u32| [i, i + VERTICES, i + 1, i + 1, i + VERTICES, i + VERTICES + 1];
    Mesh::new(PrimitiveTopology::TriangleList, RenderAssetUsages::default())
        .with_inserted_attribute(Mesh::ATTRIBUTE_POSITION, positions)
        .with_inserted_attribute(Mesh::ATTRIBUTE_NORMAL, normals)
        .with_inserted_attribute(Mesh::ATTRIBUTE_COLOR, colors)
        .with_inserted_indices(Indices::U32(quads.flat_map(corners).collect()))
}

/// Grass in the valleys, rock on slopes, snow on the heights.
fn ground_color(at: Vec3, normal: Vec3) -> LinearRgba {
    let mottled = 0.5 + 0.5 * noise(at.xz() * 0.9);
    let grass = Vec3::new(0.085, 0.105, 0.042).lerp(Vec3::new(0.13, 0.12, 0.055), mottled);
    let rock = Vec3::new(0.17, 0.15, 0.13).lerp(Vec3::new(0.26, 0.235, 0.21), mottled);
    let snow = Vec3::splat(0.82);
    let steep = smoothstep(0.86, 0.68, normal.y);
    let high = smoothstep(5.6, 7.2, at.y + 1.2 * (mottled - 0.5)) * smoothstep(0.6, 0.78, normal.y);
    let color = grass.lerp(rock, steep.max(smoothstep(3.2, 5.4, at.y))).lerp(snow, high);
    LinearRgba::rgb(color.x, color.y, color.z)
}

/// Metres above the valley.
fn height(at: Vec2) -> f32 {
    let warped = at + 1.6 * Vec2::new(noise(at * 0.11), noise(at * 0.11 + 37.0));
    // One ridge across the middle, others all around.
    let ridge = (-((warped.y + 4.0) / 5.5).powi(2)).exp() * (1.0 - 0.35 * (at.x / 20.0).powi(2)).max(0.35);
    let around = smoothstep(14.0, 30.0, Vec2::new(at.x * 0.8, (at.y + 4.0).min(0.0) * 1.1).length());
    let rough = ridged(warped * 0.085);
    (5.2 * ridge + 6.5 * around) * (0.35 + 0.95 * rough) + 1.1 * rough + 0.12 * noise(at * 0.8)
}

/// Ridged fractal noise, from 0 to about 1: sharp where noise is 0, rougher toward the crests.
fn ridged(mut at: Vec2) -> f32 {
    let (mut sum, mut amplitude, mut weight) = (0.0, 0.55, 1.0);
    for _ in 0..6 {
        let crest = (1.0 - noise(at).abs()).powi(2);
        sum += amplitude * weight * crest;
        weight = crest.clamp(0.0, 1.0);
        amplitude *= 0.5;
        at = Vec2::new(0.8 * at.x - 0.6 * at.y, 0.6 * at.x + 0.8 * at.y) * 2.03 + 11.7;
    }
    sum
}

/// Gradient noise, from about −1 to 1 with cells of 1.
fn noise(at: Vec2) -> f32 {
    let (cell, f) = (at.floor(), at.fract_gl());
    let corner = |x: f32, y: f32| {
        let i = (cell + Vec2::new(x, y)).as_ivec2();
        let mut hash = (i.x as u32).wrapping_mul(0x9E37_79B1) ^ (i.y as u32).wrapping_mul(0x85EB_CA77);
        hash = (hash ^ (hash >> 15)).wrapping_mul(0x2C1B_3C6D);
        hash = (hash ^ (hash >> 12)).wrapping_mul(0x297A_2D39) ^ (hash >> 15);
        let angle = hash as f32 / u32::MAX as f32 * std::f32::consts::TAU;
        Vec2::from_angle(angle).dot(f - Vec2::new(x, y))
    };
    let t = f * f * f * (f * (f * 6.0 - 15.0) + 10.0);
    let (low, high) = (corner(0.0, 0.0).lerp(corner(1.0, 0.0), t.x), corner(0.0, 1.0).lerp(corner(1.0, 1.0), t.x));
    1.4 * low.lerp(high, t.y)
}

/// From 0 at `from` to 1 at `to`.
fn smoothstep(from: f32, to: f32, x: f32) -> f32 {
    let t = ((x - from) / (to - from)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}
