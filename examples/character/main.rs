//! A figure that walks through smoke and shades it: spheres that follow its joints stand for it.
//!
//! `cargo run --features cli --example character` opens a window. Without a display, `… --example character -- --png FILE`
//! writes a picture, and `… -- --frames FOLDER COUNT` numbered pictures of a walk, 30 a second.

mod figure;

use std::f32::consts::TAU;
use std::process::ExitCode;
use std::time::Duration;

use bevy::camera::Exposure;
use bevy::light::CascadeShadowConfigBuilder;
use bevy::mesh::skinning::SkinnedMeshInverseBindposes;
use bevy::prelude::*;
use bevy::render::render_resource::TextureFormat;
use bevy::time::TimeUpdateStrategy;
use bevy_smoke::headless::Headless;
use bevy_smoke::prelude::*;

const USAGE: &str = "usage: character [--png FILE | --frames FOLDER COUNT]";

#[allow(dead_code, reason = "the tests use the scene, not the program")]
fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let drawn = match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        [] => return window(),
        ["--png", file] => pictures(1, |_| file.into()),
        ["--frames", folder, count] if count.parse().is_ok_and(|count: u32| count > 0) => {
            pictures(count.parse().expect("checked"), |frame| format!("{folder}/{frame:04}.png"))
        }
        _ => Err(USAGE.into()),
    };
    match drawn {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::from(2)
        }
    }
}

fn window() -> ExitCode {
    let exit = App::new()
        .add_plugins((DefaultPlugins, SmokePlugin))
        .add_systems(Startup, setup)
        .add_systems(Update, walk)
        .run();
    if exit.is_success() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Draws so many frames into files.
fn pictures(count: u32, name: impl Fn(u32) -> String) -> Result<(), String> {
    let size = UVec2::new(960, 600);
    let mut headless = Headless::new(size, TextureFormat::Rgba8UnormSrgb).map_err(|error| format!("error: {error}"))?;
    headless.app.add_systems(Startup, setup).add_systems(Update, walk);
    headless.draw_cameras_to_image();
    ready(&mut headless);
    for frame in 0..count {
        let (file, pixels) = (name(frame), headless.pixels());
        image::save_buffer(&file, &pixels, size.x, size.y, image::ColorType::Rgba8)
            .map_err(|error| format!("error: {file}: {error}"))?;
        println!("{file}");
        headless.app.insert_resource(TimeUpdateStrategy::ManualDuration(Duration::from_secs(1) / 30));
        headless.app.update();
    }
    Ok(())
}

/// Draws the first moment until smoke, meshes and the spheres of the figure are there.
pub fn ready(headless: &mut Headless) {
    headless.app.insert_resource(TimeUpdateStrategy::ManualDuration(Duration::ZERO));
    let fitted = |app: &mut App| app.world_mut().query::<&SmokeOccluder>().iter(app.world()).count() > 0;
    headless.settle().expect("the smoke's bundle is there");
    while !fitted(&mut headless.app) {
        headless.app.update();
        std::thread::sleep(Duration::from_millis(2));
    }
    for _ in 0..3 {
        headless.app.update();
    }
}

/// What walks round and round.
#[derive(Component)]
pub struct Walker {
    /// Metres walked.
    walked: f32,
}

/// The figure's way: a circle about a point, at a speed in m/s.
const RADIUS: f32 = 2.2;
const MIDDLE: Vec3 = Vec3::new(0.0, 0.0, -2.0);
const SPEED: f32 = 1.25;

pub fn setup(
    mut commands: Commands,
    assets: Res<AssetServer>,
    mut images: ResMut<Assets<Image>>,
    mut meshes: ResMut<Assets<Mesh>>,
    mut poses: ResMut<Assets<SkinnedMeshInverseBindposes>>,
    mut materials: ResMut<Assets<StandardMaterial>>,
) {
    commands.spawn((
        SmokeVolume::new(assets.load("billow.smoke")),
        SmokePlayback::default().starting_at_frame(36),
        SmokeMedium { sigma_t: 4.0, albedo: LinearRgba::rgb(0.95, 0.94, 0.93), g: 0.3 },
        Transform::from_xyz(0.25, 2.95, -0.35).with_scale(Vec3::splat(6.2)),
    ));

    let skin = materials.add(StandardMaterial { perceptual_roughness: 0.7, ..Color::srgb(0.75, 0.3, 0.16).into() });
    let bindposes = poses.add(figure::inverse_bindposes());
    let walker = figure::spawn(&mut commands, meshes.add(figure::mesh()), bindposes, skin, Transform::IDENTITY);
    // The spheres are fitted to the mesh, and follow its joints.
    commands.entity(walker).insert((Walker { walked: 2.6 }, SmokeOccluderFit::solid(48)));

    commands.spawn((
        Mesh3d(meshes.add(Plane3d::default().mesh().size(120.0, 120.0))),
        MeshMaterial3d(materials.add(StandardMaterial {
            perceptual_roughness: 0.95,
            reflectance: 0.2,
            ..Color::srgb(0.36, 0.34, 0.31).into()
        })),
    ));

    commands.spawn((
        DirectionalLight {
            illuminance: 2600.0,
            color: Color::srgb(1.0, 0.8, 0.58),
            shadow_maps_enabled: true,
            ..default()
        },
        CascadeShadowConfigBuilder { maximum_distance: 20.0, num_cascades: 2, ..default() }.build(),
        Transform::from_xyz(-5.0, 2.3, 0.6).looking_at(Vec3::ZERO, Vec3::Y),
    ));
    let (sky, horizon, below) =
        (Color::srgb(0.45, 0.62, 1.0), Color::srgb(0.8, 0.78, 0.8), Color::srgb(0.22, 0.2, 0.18));
    let haze = Color::srgb(0.16, 0.22, 0.31);
    commands.spawn((
        Camera3d::default(),
        Camera { clear_color: ClearColorConfig::Custom(haze), ..default() },
        Exposure::INDOOR,
        EnvironmentMapLight {
            intensity: 50.0,
            ..EnvironmentMapLight::hemispherical_gradient(&mut images, sky, horizon, below)
        },
        DistanceFog { color: haze, falloff: FogFalloff::Linear { start: 9.0, end: 45.0 }, ..default() },
        Transform::from_xyz(0.3, 1.2, 4.7).looking_at(Vec3::new(0.15, 1.25, 0.0), Vec3::Y),
    ));
}

/// Moves figures on, step by step.
pub fn walk(
    time: Res<Time>,
    mut walkers: Query<(&mut Walker, &mut Transform), Without<figure::Joint>>,
    mut joints: Query<(&figure::Joint, &mut Transform)>,
) {
    for (mut walker, mut transform) in &mut walkers {
        walker.walked += SPEED * time.delta_secs();
        let heading = Quat::from_rotation_y(walker.walked / RADIUS);
        // Forward is +Z of the figure.
        *transform =
            Transform::from_translation(MIDDLE + heading * Vec3::new(-RADIUS, 0.0, 0.0)).with_rotation(heading);
        let pose = figure::walk(TAU * walker.walked / figure::STRIDE);
        for (joint, mut place) in &mut joints {
            *place = pose[joint.0];
        }
    }
}
