//! Sharp lights in smoke: a fire inside it, a spot light from above, and next to no light from anywhere else.
//!
//! `cargo run --example lamps`

use bevy::camera::Exposure;
use bevy::prelude::*;
use bevy_smoke::prelude::*;

fn main() {
    App::new()
        .add_plugins((DefaultPlugins, SmokePlugin))
        .add_systems(Startup, setup)
        .add_systems(Update, flicker)
        .run();
}

/// The light of the fire, which flickers about this many lumens.
#[derive(Component)]
pub struct Fire(f32);

pub fn setup(
    mut commands: Commands,
    assets: Res<AssetServer>,
    mut meshes: ResMut<Assets<Mesh>>,
    mut materials: ResMut<Assets<StandardMaterial>>,
) {
    commands.spawn((
        SmokeVolume::new(assets.load("plume.smoke")),
        SmokeMedium { sigma_t: 5.0, albedo: LinearRgba::rgb(0.9, 0.9, 0.9), g: 0.3 },
        Transform::from_xyz(0.0, 1.5, 0.0).with_scale(Vec3::splat(3.0)),
    ));
    commands.spawn((
        Mesh3d(meshes.add(Plane3d::default().mesh().size(20.0, 20.0))),
        MeshMaterial3d(materials.add(Color::srgb(0.3, 0.28, 0.25))),
    ));

    // Bevy's own lights light smoke and meshes alike.
    let fire = 2000.0;
    commands.spawn((
        Fire(fire),
        PointLight { color: Color::srgb(1.0, 0.5, 0.15), intensity: fire, range: 10.0, ..default() },
        Transform::from_xyz(0.0, 0.35, 0.0),
    ));
    commands.spawn((
        SpotLight {
            color: Color::srgb(0.6, 0.75, 1.0),
            intensity: 60_000.0,
            range: 20.0,
            inner_angle: 0.12,
            outer_angle: 0.16,
            ..default()
        },
        Transform::from_xyz(3.0, 4.5, 1.0).looking_at(Vec3::new(0.0, 1.9, 0.0), Vec3::Y),
    ));
    commands.spawn((
        Camera3d::default(),
        Camera { clear_color: ClearColorConfig::Custom(Color::srgb(0.01, 0.012, 0.02)), ..default() },
        Exposure::INDOOR,
        AmbientLight { brightness: 2.0, ..default() },
        Transform::from_xyz(0.0, 1.7, 5.2).looking_at(Vec3::new(0.0, 1.45, 0.0), Vec3::Y),
    ));
}

/// Only the light changes: the smoke itself is not unpacked again.
fn flicker(time: Res<Time>, mut fires: Query<(&Fire, &mut PointLight)>) {
    let t = time.elapsed_secs();
    for (fire, mut light) in &mut fires {
        light.intensity = fire.0 * (1.0 + 0.2 * (7.0 * t).sin() * (11.3 * t).sin());
    }
}
