//! A window to look at smoke in: bundles and density files, by name or dropped into it, with the panel that lights and
//! tunes them beside it.
//!
//! `cargo run --features cli,egui --example lab -- [FILE…]`
//!
//! A bundle (`.smoke`) plays. A density file (`.vdb`, `.npy`) is baked in the background, several at once as a sequence, into
//! a bundle beside it. An image (`.hdr`, `.exr`) becomes the smoke's environment. What has been set up is saved, as a scene
//! that a game loads, by the panel's button, and opened again (`.scn.ron`). F1 closes the panel and opens it again; drag to
//! turn the camera, scroll to come nearer.

pub mod bake;
pub mod camera;
pub mod open;

use std::path::PathBuf;

use bevy::asset::UnapprovedPathMode;
use bevy::camera::Exposure;
use bevy::light::CascadeShadowConfigBuilder;
use bevy::prelude::*;
use bevy::render::diagnostic::RenderDiagnosticsPlugin;
use bevy::window::FileDragAndDrop;
use bevy_smoke::panel::{SmokePanel, SmokePanelPlugin};
use bevy_smoke::prelude::*;

fn main() -> AppExit {
    let files: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    let window = Window { title: "bevy_smoke lab".into(), resolution: (1280, 800).into(), ..default() };
    App::new()
        .add_plugins((
            DefaultPlugins
                .set(WindowPlugin { primary_window: Some(window), ..default() })
                // Files may be anywhere.
                .set(AssetPlugin { unapproved_path_mode: UnapprovedPathMode::Allow, ..default() }),
            RenderDiagnosticsPlugin,
            SmokePlugin,
            SmokePanelPlugin,
            camera::OrbitPlugin,
            open::OpenPlugin,
            bake::BakePlugin,
        ))
        .add_systems(Startup, (setup, move |mut queue: ResMut<open::Queue>| queue.add(first(&files))).chain())
        .add_systems(Update, (drop_files, toggle))
        .run()
}

/// The files to begin with: those that were named, or one of the examples'.
fn first(files: &[PathBuf]) -> Vec<PathBuf> {
    if files.is_empty() { vec!["billow.smoke".into()] } else { files.to_vec() }
}

/// Light, ground, camera, and smoke that shows nothing as yet.
pub fn setup(
    mut commands: Commands,
    mut images: ResMut<Assets<Image>>,
    mut meshes: ResMut<Assets<Mesh>>,
    mut materials: ResMut<Assets<StandardMaterial>>,
) {
    commands.insert_resource(GlobalAmbientLight { brightness: 0.0, ..default() });
    commands.spawn((
        Name::new("smoke"),
        SmokeVolume::default(),
        SmokeMedium { sigma_t: 8.0, ..default() },
        // Its lower end stands on the ground.
        Transform::from_xyz(0.0, 1.5, 0.0).with_scale(Vec3::splat(3.0)),
    ));
    commands.spawn((
        Name::new("ground"),
        Mesh3d(meshes.add(Plane3d::default().mesh().size(40.0, 40.0))),
        MeshMaterial3d(materials.add(StandardMaterial {
            base_color: Color::linear_rgb(0.1, 0.09, 0.08),
            perceptual_roughness: 0.9,
            ..default()
        })),
    ));
    let cascades = CascadeShadowConfigBuilder { num_cascades: 2, maximum_distance: 25.0, ..default() };
    commands.spawn((
        Name::new("sun"),
        DirectionalLight { illuminance: 900.0, shadow_maps_enabled: true, ..default() },
        cascades.build(),
        Transform::default().looking_to(Vec3::new(-1.0, -0.8, -0.35), Vec3::Y),
    ));
    commands.spawn((
        Name::new("lamp"),
        PointLight { color: Color::srgb(1.0, 0.6, 0.3), intensity: 40_000.0, ..default() },
        Transform::from_xyz(1.2, 1.0, 0.8),
    ));
    let sky = EnvironmentMapLight::hemispherical_gradient(
        &mut images,
        Color::srgb(0.6, 0.75, 1.0),
        Color::srgb(0.75, 0.75, 0.75),
        Color::srgb(0.2, 0.18, 0.16),
    );
    commands.spawn((
        Name::new("camera"),
        Camera3d::default(),
        Camera { clear_color: ClearColorConfig::Custom(Color::srgb(0.2, 0.26, 0.34)), ..default() },
        Exposure::INDOOR,
        EnvironmentMapLight { intensity: 180.0, ..sky },
        camera::Orbit { center: Vec3::new(-0.9, 1.4, 0.0), distance: 6.5, turn: 0.25, tilt: -0.12 },
    ));
}

fn drop_files(mut dropped: MessageReader<FileDragAndDrop>, mut queue: ResMut<open::Queue>) {
    let paths = dropped.read().filter_map(|event| match event {
        FileDragAndDrop::DroppedFile { path_buf, .. } => Some(path_buf.clone()),
        _ => None,
    });
    queue.add(paths.collect());
}

fn toggle(keys: Res<ButtonInput<KeyCode>>, mut panel: ResMut<SmokePanel>) {
    if keys.just_pressed(KeyCode::F1) {
        panel.open = !panel.open;
    }
}
