//! The light around the smoke: environment maps, images, coefficients.

use bevy::asset::RenderAssetUsages;
use bevy::prelude::*;
use bevy::render::render_resource::{Extent3d, TextureDimension, TextureFormat};
use bevy_smoke::prelude::*;

use crate::scene::*;

fn picture(
    environment: SmokeEnvironment,
    map: impl FnOnce(&mut Assets<Image>) -> Option<EnvironmentMapLight>,
) -> Vec<[f32; 4]> {
    let mut app = app();
    let (volume, medium, _, transform) = smoke(&mut app);
    // Forward scattering shows where light comes from.
    app.app.world_mut().spawn((volume, SmokeMedium { g: 0.6, ..medium }, environment, transform));
    let camera = camera(&app);
    let map = map(&mut app.app.world_mut().resource_mut::<Assets<Image>>());
    let mut camera = app.app.world_mut().spawn(camera);
    if let Some(map) = map {
        camera.insert(map);
    }
    draw(&mut app)
}

/// Relative RMS difference.
fn error(a: &[[f32; 4]], b: &[[f32; 4]]) -> f64 {
    rms(a, b) / rms(b, &vec![[0.0; 4]; b.len()])
}

#[test]
fn the_cameras_environment_map_lights_the_smoke() {
    let map = |intensity: f32| {
        move |images: &mut Assets<Image>| {
            let color = Color::linear_rgb(0.5, 0.25, 1.0);
            Some(EnvironmentMapLight { intensity, ..EnvironmentMapLight::solid_color(images, color) })
        }
    };
    let expected = picture(SmokeEnvironment::constant(Vec3::new(0.5, 0.25, 1.0), 3.0), |_| None);
    let found = picture(SmokeEnvironment::Camera, map(3.0));
    // The map's integral is off by 7e-4 (32 samples a face), the pictures are f16.
    assert!(error(&found, &expected) < 2e-3, "{}", error(&found, &expected));
    // And its intensity is honoured.
    assert!(error(&picture(SmokeEnvironment::Camera, map(1.5)), &expected) > 0.1);
}

#[test]
fn the_environment_maps_rotation_is_honoured() {
    let (red, green) = (Color::linear_rgb(1.0, 0.0, 0.0), Color::linear_rgb(0.0, 1.0, 0.0));
    let map = |top: Color, bottom: Color, rotation: Quat| {
        move |images: &mut Assets<Image>| {
            let gray = Color::linear_rgb(0.2, 0.2, 0.2);
            Some(EnvironmentMapLight {
                rotation,
                ..EnvironmentMapLight::hemispherical_gradient(images, top, gray, bottom)
            })
        }
    };
    let upright = picture(SmokeEnvironment::Camera, map(red, green, Quat::IDENTITY));
    let swapped = picture(SmokeEnvironment::Camera, map(green, red, Quat::IDENTITY));
    let turned = picture(SmokeEnvironment::Camera, map(green, red, Quat::from_rotation_z(std::f32::consts::PI)));
    assert!(error(&swapped, &upright) > 0.02, "{}", error(&swapped, &upright));
    assert!(error(&turned, &upright) < 2e-3, "{}", error(&turned, &upright));
}

#[test]
fn an_equirect_image_lights_as_its_coefficients_do() {
    // L = 1 + x + y/2: exact in two bands.
    let (width, height) = (128u32, 64u32);
    let radiance = |u: f32, v: f32| {
        let (phi, theta) = (u * std::f32::consts::TAU, v * std::f32::consts::PI);
        1.0 + phi.sin() * theta.sin() + 0.5 * theta.cos()
    };
    let data: Vec<u8> = (0..width * height)
        .map(|i| radiance(((i % width) as f32 + 0.5) / width as f32, ((i / width) as f32 + 0.5) / height as f32))
        .flat_map(|l| [l, 0.5 * l, l, 1.0])
        .flat_map(f32::to_le_bytes)
        .collect();
    let image = Image::new(
        Extent3d { width, height, depth_or_array_layers: 1 },
        TextureDimension::D2,
        data,
        TextureFormat::Rgba32Float,
        RenderAssetUsages::default(),
    );
    let mut app = app();
    let (volume, medium, _, transform) = smoke(&mut app);
    let image = app.app.world_mut().resource_mut::<Assets<Image>>().add(image);
    let medium = SmokeMedium { g: 0.6, ..medium };
    app.app.world_mut().spawn((volume, medium, SmokeEnvironment::equirect(image, 2.0), transform));
    let camera = camera(&app);
    app.app.world_mut().spawn(camera);
    let found = draw(&mut app);

    let mut coefficients = [Vec3::ZERO; 16];
    let color = Vec3::new(1.0, 0.5, 1.0);
    let pi = std::f32::consts::PI;
    coefficients[0] = color * (4.0 * pi).sqrt();
    coefficients[3] = -color * (4.0 * pi / 3.0).sqrt();
    coefficients[1] = -0.5 * color * (4.0 * pi / 3.0).sqrt();
    let expected = picture(SmokeEnvironment::Coefficients { coefficients, intensity: 2.0 }, |_| None);
    assert!(error(&found, &expected) < 2e-3, "{}", error(&found, &expected));
}

#[test]
fn without_light_smoke_is_black() {
    let dark = picture(SmokeEnvironment::Camera, |_| None);
    assert!(coverage(&dark) > 100.0);
    assert!(dark.iter().all(|pixel| pixel[..3] == [0.0; 3]));
}
