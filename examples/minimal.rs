//! The smallest scene with smoke: a volume, the light around it, and a camera.
//!
//! `cargo run --example minimal`

use bevy::camera::Exposure;
use bevy::prelude::*;
use bevy_smoke::prelude::*;

fn main() {
    App::new().add_plugins((DefaultPlugins, SmokePlugin)).add_systems(Startup, setup).run();
}

pub fn setup(mut commands: Commands, assets: Res<AssetServer>, mut images: ResMut<Assets<Image>>) {
    // The box is one unit tall before it is scaled: this smoke is 3 metres tall.
    commands.spawn((
        SmokeVolume::new(assets.load("plume.smoke")),
        SmokeMedium { sigma_t: 6.0, ..default() },
        Transform::from_scale(Vec3::splat(3.0)),
    ));

    // The camera's environment map lights the smoke: a bright sky over dark ground.
    let sky = Color::srgb(0.75, 0.85, 1.0);
    let horizon = Color::srgb(0.9, 0.8, 0.7);
    let ground = Color::srgb(0.2, 0.17, 0.15);
    commands.spawn((
        Camera3d::default(),
        Exposure::INDOOR,
        EnvironmentMapLight {
            intensity: 400.0,
            ..EnvironmentMapLight::hemispherical_gradient(&mut images, sky, horizon, ground)
        },
        Transform::from_xyz(0.0, 0.5, 4.6).looking_at(Vec3::ZERO, Vec3::Y),
    ));
}
