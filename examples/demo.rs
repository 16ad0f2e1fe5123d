//! Smoke in a scene: one mesh in front of it, one behind, and one standing in it.
//!
//! `cargo run --features cli --example demo` opens a window; `… --example demo -- --png FILE` writes a picture instead
//! and needs no display.

use std::process::ExitCode;
use std::time::Duration;

use bevy::camera::Exposure;
use bevy::prelude::*;
use bevy::render::render_resource::TextureFormat;
use bevy::time::TimeUpdateStrategy;
use bevy_smoke::headless::Headless;
use bevy_smoke::prelude::*;

const USAGE: &str = "usage: demo [--png FILE]";

#[allow(dead_code, reason = "the tests use the scene, not the program")]
fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        [] => window(),
        ["--png", file] => picture(file),
        _ => {
            eprintln!("{USAGE}");
            ExitCode::from(2)
        }
    }
}

fn window() -> ExitCode {
    let exit = App::new()
        .add_plugins((DefaultPlugins, SmokePlugin))
        .add_systems(Startup, setup)
        .add_systems(Update, turn_camera)
        .run();
    if exit.is_success() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Draws one frame into a file.
fn picture(file: &str) -> ExitCode {
    let size = UVec2::new(640, 480);
    let drawn = Headless::new(size, TextureFormat::Rgba8UnormSrgb).and_then(|mut headless| {
        // The same picture however long drawing takes.
        headless.app.insert_resource(TimeUpdateStrategy::ManualDuration(Duration::ZERO));
        headless.app.add_systems(Startup, setup);
        headless.draw_cameras_to_image();
        headless.settle()?;
        // Meshes and their textures take a few frames more.
        for _ in 0..3 {
            headless.app.update();
        }
        Ok(headless.pixels())
    });
    let saved = drawn.map_err(|error| error.to_string()).and_then(|pixels| {
        image::save_buffer(file, &pixels, size.x, size.y, image::ColorType::Rgba8).map_err(|error| error.to_string())
    });
    match saved {
        Ok(()) => {
            println!("{file}: smoke behind a sphere, before a wall, around a pillar");
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

pub fn setup(
    mut commands: Commands,
    assets: Res<AssetServer>,
    mut images: ResMut<Assets<Image>>,
    mut meshes: ResMut<Assets<Mesh>>,
    mut materials: ResMut<Assets<StandardMaterial>>,
) {
    commands.spawn((
        SmokeVolume::new(assets.load("billow.smoke")),
        // Pictures show it risen.
        SmokePlayback::default().starting_at_frame(36),
        SmokeMedium { sigma_t: 9.0, albedo: LinearRgba::rgb(0.95, 0.94, 0.92), g: 0.2 },
        Transform::from_xyz(0.0, 1.7, 0.0).with_scale(Vec3::splat(3.4)),
    ));

    let mut mesh = |mesh: Mesh, color: Color, transform: Transform| {
        let material = StandardMaterial { perceptual_roughness: 0.8, ..StandardMaterial::from(color) };
        commands.spawn((Mesh3d(meshes.add(mesh)), MeshMaterial3d(materials.add(material)), transform));
    };
    let (ground, red, blue, yellow) = (
        Color::srgb(0.35, 0.38, 0.33),
        Color::srgb(0.8, 0.15, 0.1),
        Color::srgb(0.1, 0.25, 0.7),
        Color::srgb(0.8, 0.6, 0.1),
    );
    mesh(Plane3d::default().mesh().size(30.0, 30.0).build(), ground, Transform::IDENTITY);
    mesh(Sphere::new(0.5).into(), red, Transform::from_xyz(-0.4, 0.5, 1.2));
    mesh(Cuboid::new(2.2, 1.6, 0.2).into(), blue, Transform::from_xyz(0.6, 1.4, -1.6));
    mesh(Cylinder::new(0.1, 2.6).into(), yellow, Transform::from_xyz(0.15, 1.3, 0.0));

    commands.spawn((
        DirectionalLight { illuminance: 250.0, ..default() },
        Transform::from_xyz(4.0, 6.0, 3.0).looking_at(Vec3::ZERO, Vec3::Y),
    ));
    let (sky, horizon, below) =
        (Color::srgb(0.7, 0.82, 1.0), Color::srgb(0.9, 0.85, 0.8), Color::srgb(0.25, 0.22, 0.2));
    commands.spawn((
        Camera3d::default(),
        Camera { clear_color: ClearColorConfig::Custom(Color::srgb(0.25, 0.38, 0.55)), ..default() },
        Exposure::INDOOR,
        EnvironmentMapLight {
            intensity: 220.0,
            ..EnvironmentMapLight::hemispherical_gradient(&mut images, sky, horizon, below)
        },
        Transform::from_xyz(0.0, 1.8, 5.4).looking_at(Vec3::new(0.0, 1.6, 0.0), Vec3::Y),
    ));
}

/// A slow turn around the smoke.
fn turn_camera(time: Res<Time>, mut cameras: Query<&mut Transform, With<Camera3d>>) {
    for mut transform in &mut cameras {
        transform.rotate_around(Vec3::new(0.0, 1.4, 0.0), Quat::from_rotation_y(0.2 * time.delta_secs()));
    }
}
