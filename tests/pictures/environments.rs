//! The light around the smoke: environment maps, images, coefficients.

use bevy::asset::RenderAssetUsages;
use bevy::prelude::*;
use bevy::render::render_resource::{
    Extent3d, TextureDimension, TextureFormat, TextureViewDescriptor, TextureViewDimension,
};
use bevy_smoke::prelude::*;

use crate::scene::*;

fn picture(
    environment: SmokeEnvironment,
    map: impl FnOnce(&mut Assets<Image>) -> Option<EnvironmentMapLight>,
) -> Vec<[f32; 4]> {
    let mut app = app();
    // No light but what the tests give.
    app.app.insert_resource(GlobalAmbientLight::NONE);
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

/// A cube map of which one face shines.
fn one_face(images: &mut Assets<Image>, face: usize, rotation: Quat) -> EnvironmentMapLight {
    let side = 16;
    let texels = (0..6).flat_map(|f| vec![[if f == face { 10.0 } else { 0.0 }, 0.0, 0.0, 1.0]; side * side]);
    let data = texels.flatten().flat_map(|v: f32| half::f16::from_f32(v).to_le_bytes()).collect();
    let size = Extent3d { width: side as u32, height: side as u32, depth_or_array_layers: 6 };
    let format = TextureFormat::Rgba16Float;
    let mut image = Image::new(size, TextureDimension::D2, data, format, RenderAssetUsages::default());
    let dimension = Some(TextureViewDimension::Cube);
    image.texture_view_descriptor = Some(TextureViewDescriptor { dimension, ..default() });
    let map = images.add(image);
    EnvironmentMapLight { diffuse_map: map.clone(), specular_map: map, intensity: 1.0, rotation, ..default() }
}

fn by_face(face: usize, rotation: Quat) -> Vec<[f32; 4]> {
    picture(SmokeEnvironment::Camera, |images| Some(one_face(images, face, rotation)))
}

#[test]
fn the_environment_maps_rotation_is_honoured() {
    // A quarter turn about Z takes +X (face 0) to +Y (face 2), and its inverse would take it to -Y (face 3).
    let turned = by_face(0, Quat::from_rotation_z(std::f32::consts::FRAC_PI_2));
    let (above, below) = (by_face(2, Quat::IDENTITY), by_face(3, Quat::IDENTITY));
    assert!(error(&below, &above) > 0.1, "{}", error(&below, &above));
    assert!(error(&turned, &above) < 2e-3, "{}", error(&turned, &above));
}

#[test]
fn cube_maps_are_left_handed() {
    // Bevy shows face 4, +Z of the map, in the direction -Z: behind the smoke for this camera, whose forward-scattering
    // smoke is then brighter than with the light at its back.
    let brightness = |pixels: &[[f32; 4]]| pixels.iter().map(|pixel| f64::from(pixel[0])).sum::<f64>();
    let (behind, at_the_back) = (by_face(4, Quat::IDENTITY), by_face(5, Quat::IDENTITY));
    assert!(brightness(&behind) > 1.5 * brightness(&at_the_back));
}

/// Two cameras that turn one map differently are lit each by its own, and neither disturbs the other.
#[test]
fn cameras_may_turn_one_map_differently() {
    let mut app = app();
    app.app.insert_resource(GlobalAmbientLight::NONE);
    let (volume, medium, _, transform) = smoke(&mut app);
    app.app.world_mut().spawn((volume, SmokeMedium { g: 0.6, ..medium }, SmokeEnvironment::Camera, transform));
    let quarter = Quat::from_rotation_z(std::f32::consts::FRAC_PI_2);
    let map = one_face(&mut app.app.world_mut().resource_mut::<Assets<Image>>(), 0, quarter);
    let first = camera(&app);
    app.app.world_mut().spawn(first).insert(map.clone());
    // The other draws first, into an image of its own, and is seen only by what it changes.
    let other = Image::new_target_texture(SIZE.x, SIZE.y, TextureFormat::Rgba16Float, None);
    let other = app.app.world_mut().resource_mut::<Assets<Image>>().add(other);
    let second = camera(&app);
    let target = bevy::camera::RenderTarget::Image(other.into());
    let turned_back = EnvironmentMapLight { rotation: quarter.inverse(), ..map };
    app.app.world_mut().spawn(second).insert((Camera { order: -1, ..default() }, target, turned_back));
    let found = draw(&mut app);
    let expected = by_face(2, Quat::IDENTITY);
    assert!(error(&found, &expected) < 2e-3, "{}", error(&found, &expected));
    let before = dispatches(&app);
    app.app.update();
    assert_eq!(before[..6], dispatches(&app)[..6], "a static scene");
}

/// Light in any unit is drawn without overflow, and what the picture's format cannot hold is cut, not infinite.
#[test]
fn extreme_radiance_stays_finite() {
    for radiance in [1e-12, 1e7, 1e30] {
        let bright = picture(SmokeEnvironment::constant(Vec3::splat(radiance), 1.0), |_| None);
        assert!(bright.iter().flatten().all(|value| (0.0..=65_504.0).contains(value)));
        assert!(coverage(&bright) > 100.0);
        assert!(radiance < 1.0 || bright.iter().any(|pixel| pixel[0] == 65_504.0));
    }
    // The same light in another unit, brought back by its intensity, is the same picture.
    let plain = picture(SmokeEnvironment::constant(Vec3::ONE, 1.0), |_| None);
    let scaled = picture(SmokeEnvironment::constant(Vec3::splat(1e9), 1e-9), |_| None);
    assert!(error(&scaled, &plain) < 1e-3, "{}", error(&scaled, &plain));
}

#[test]
fn an_equirect_image_lights_as_its_coefficients_do() {
    // L = 1 + x/2 + y/4 + z/5: exact in two bands, and different in every direction.
    let (width, height) = (128u32, 64u32);
    let radiance = |u: f32, v: f32| {
        let (phi, theta) = (u * std::f32::consts::TAU, v * std::f32::consts::PI);
        1.0 + 0.5 * phi.sin() * theta.sin() + 0.25 * theta.cos() - 0.2 * phi.cos() * theta.sin()
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
    let linear = color * (4.0 * pi / 3.0).sqrt();
    (coefficients[3], coefficients[1], coefficients[2]) = (-0.5 * linear, -0.25 * linear, 0.2 * linear);
    let expected = picture(SmokeEnvironment::Coefficients { coefficients, intensity: 2.0 }, |_| None);
    assert!(error(&found, &expected) < 2e-3, "{}", error(&found, &expected));
}

#[test]
fn without_light_smoke_is_black() {
    let dark = picture(SmokeEnvironment::Camera, |_| None);
    assert!(coverage(&dark) > 100.0);
    assert!(dark.iter().all(|pixel| pixel[..3] == [0.0; 3]));
}
