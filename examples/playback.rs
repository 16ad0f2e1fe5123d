//! Playback by keyboard: pause, step frame by frame, slow motion, backwards, and what happens at the end.
//!
//! `cargo run --example playback` opens a window whose title says what is shown and which keys there are.

use bevy::camera::Exposure;
use bevy::prelude::*;
use bevy_smoke::playback::SmokeStreamingStats;
use bevy_smoke::prelude::*;

/// What the up and down keys go through.
const SPEEDS: [f32; 10] = [-4.0, -1.0, -0.5, -0.1, 0.1, 0.25, 0.5, 1.0, 2.0, 4.0];

const KEYS: &str = "space: pause, left/right: one frame, up/down: speed, M: mode";

fn main() {
    println!("{KEYS}");
    App::new()
        .add_plugins((DefaultPlugins, SmokePlugin))
        .add_systems(Startup, setup)
        .add_systems(Update, (control, tell).chain())
        .add_observer(|looped: On<SmokeLooped>| info!("volume {} started over", looped.entity))
        .add_observer(|finished: On<SmokeFinished>| info!("volume {} reached its end", finished.entity))
        .run();
}

pub fn setup(mut commands: Commands, assets: Res<AssetServer>, mut images: ResMut<Assets<Image>>) {
    commands.spawn((
        SmokeVolume::new(assets.load("billow.smoke")),
        SmokePlayback::default(),
        SmokeMedium { sigma_t: 9.0, albedo: LinearRgba::rgb(0.95, 0.95, 0.95), g: 0.3 },
        Transform::from_scale(Vec3::splat(3.0)),
    ));
    commands.spawn((
        DirectionalLight { illuminance: 500.0, color: Color::srgb(1.0, 0.85, 0.7), ..default() },
        Transform::from_xyz(-3.0, 4.0, 2.0).looking_at(Vec3::ZERO, Vec3::Y),
    ));
    let (sky, horizon, ground) =
        (Color::srgb(0.5, 0.65, 1.0), Color::srgb(0.6, 0.6, 0.7), Color::srgb(0.15, 0.14, 0.13));
    commands.spawn((
        Camera3d::default(),
        Camera { clear_color: ClearColorConfig::Custom(Color::srgb(0.08, 0.1, 0.14)), ..default() },
        Exposure::INDOOR,
        EnvironmentMapLight {
            intensity: 150.0,
            ..EnvironmentMapLight::hemispherical_gradient(&mut images, sky, horizon, ground)
        },
        Transform::from_xyz(0.0, 0.3, 4.6).looking_at(Vec3::ZERO, Vec3::Y),
    ));
}

/// What the keys do to every volume.
pub fn control(keys: Res<ButtonInput<KeyCode>>, mut volumes: Query<&mut SmokePlayback>) {
    let pressed = |key| keys.just_pressed(key);
    if keys.get_just_pressed().len() == 0 {
        return;
    }
    for mut playback in &mut volumes {
        if pressed(KeyCode::Space) {
            playback.paused = !playback.paused;
        }
        // One frame on or back, and stay there.
        let step = f64::from(pressed(KeyCode::ArrowRight)) - f64::from(pressed(KeyCode::ArrowLeft));
        if step != 0.0 {
            playback.paused = true;
            let frame = playback.frame() + step;
            playback.seek_frame(frame.round().max(0.0) as u32);
        }
        let at = SPEEDS.iter().position(|speed| *speed >= playback.speed).unwrap_or(SPEEDS.len() - 1);
        if pressed(KeyCode::ArrowUp) {
            playback.speed = SPEEDS[(at + 1).min(SPEEDS.len() - 1)];
        }
        if pressed(KeyCode::ArrowDown) {
            playback.speed = SPEEDS[at.saturating_sub(1)];
        }
        if pressed(KeyCode::KeyM) {
            playback.mode = match playback.mode {
                PlaybackMode::Loop => PlaybackMode::PingPong,
                PlaybackMode::PingPong => PlaybackMode::Once,
                PlaybackMode::Once => PlaybackMode::Loop,
            };
        }
    }
}

fn tell(
    volume: Single<(&SmokeVolume, &SmokePlayback)>,
    animations: Res<Assets<SmokeAnimation>>,
    stats: Res<SmokeStreamingStats>,
    mut window: Single<&mut Window>,
) {
    let (volume, playback) = *volume;
    let Some(animation) = volume.animation().and_then(|animation| animations.get(animation)) else {
        return;
    };
    let paused = if playback.paused { ", paused" } else { "" };
    let title = format!(
        "frame {:.1} of {}, {:?} at {}×{paused}; {} frames in memory, {} late — {KEYS}",
        playback.frame(),
        animation.frames.len(),
        playback.mode,
        playback.speed,
        stats.resident_frames,
        stats.frames_late,
    );
    if window.title != title {
        window.title = title;
    }
}
