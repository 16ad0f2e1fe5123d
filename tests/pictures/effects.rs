//! Smoke with Bevy's other effects. `SMOKE_PICTURES` shows them all.

use bevy::anti_alias::fxaa::Fxaa;
use bevy::anti_alias::taa::TemporalAntiAliasing;
use bevy::camera::MainPassResolutionOverride;
use bevy::core_pipeline::tonemapping::DebandDither;
use bevy::light::{FogVolume, VolumetricFog, VolumetricLight};
use bevy::pbr::{DistanceFog, FogFalloff};
use bevy::post_process::bloom::Bloom;
use bevy::post_process::dof::{DepthOfField, DepthOfFieldMode};
use bevy::post_process::motion_blur::MotionBlur;
use bevy::prelude::*;
use bevy::render::render_resource::TextureFormat;
use bevy::render::view::ExtractedView;
use bevy::render::{Render, RenderApp, RenderSystems};
use bevy_smoke::headless::Headless;

use crate::scene::*;

/// What is in a picture: smoke; a mesh in front of it and one behind.
#[derive(Clone, Copy)]
struct Things {
    smoke: bool,
    meshes: bool,
}

const SMOKE: Things = Things { smoke: true, meshes: false };
const MESHES: Things = Things { smoke: false, meshes: true };
const BOTH: Things = Things { smoke: true, meshes: true };

/// A camera's picture, the camera being as `change` makes it, after so many frames.
fn picture<B: Bundle>(size: UVec2, things: Things, frames: u32, change: impl FnOnce(&mut World) -> B) -> Vec<[f32; 4]> {
    let mut app = Headless::new(size, TextureFormat::Rgba16Float).unwrap();
    let tilt = Quat::from_rotation_z(0.3);
    let colors = [LinearRgba::rgb(0.1, 0.1, 1.0), LinearRgba::rgb(1.0, 0.8, 0.1)];
    if things.meshes {
        mesh(&mut app, Rectangle::new(0.5, 2.0), colors[0], Transform::from_xyz(0.3, 0.0, 1.0).with_rotation(tilt));
        mesh(&mut app, Rectangle::new(1.0, 2.0), colors[1], Transform::from_xyz(-0.4, 0.0, -1.0).with_rotation(tilt));
    }
    let volume = smoke(&mut app);
    if things.smoke {
        app.app.world_mut().spawn(volume);
    }
    let camera = camera(&app);
    let camera = app.app.world_mut().spawn(camera).id();
    let bundle = change(app.app.world_mut());
    app.app.world_mut().entity_mut(camera).insert(bundle);
    if things.smoke {
        app.settle().unwrap();
    }
    for _ in 0..frames {
        app.app.update();
    }
    let pixels = app.float_pixels();
    assert!(pixels.iter().flatten().all(|value| value.is_finite()));
    pixels
}

/// A picture of 16 samples a pixel.
fn supersampled(things: Things) -> Vec<[f32; 4]> {
    let fine = picture(SIZE * 4, things, 10, |_| ());
    (0..SIZE.element_product())
        .map(|i| {
            let (x, y) = (4 * (i % SIZE.x), 4 * (i / SIZE.x));
            let at = |j: u32, c: usize| fine[((y + j / 4) * 4 * SIZE.x + x + j % 4) as usize][c];
            std::array::from_fn(|c| (0..16).map(|j| at(j, c)).sum::<f32>() / 16.0)
        })
        .collect()
}

/// Smoke follows the jitter of temporal anti-aliasing, and converges with the meshes in it to the picture of many samples.
#[test]
fn temporal_anti_aliasing_converges() {
    // Its alpha is 1 everywhere.
    let opaque = |pixels: Vec<[f32; 4]>| pixels.into_iter().map(|[r, g, b, _]| [r, g, b, 1.0]).collect::<Vec<_>>();
    let smoothed = |things: Things| opaque(picture(SIZE, things, 100, |_| TemporalAntiAliasing::default()));
    let (expected, off, on) = (opaque(supersampled(BOTH)), opaque(picture(SIZE, BOTH, 6, |_| ())), smoothed(BOTH));
    save_radiance("effect_taa", SIZE, &on);
    let (error_off, error_on) = (rms(&off, &expected), rms(&on, &expected));
    let smoke = rms(&smoothed(SMOKE), &opaque(supersampled(SMOKE)));
    println!("against 16 samples a pixel: {error_off:.4} without, {error_on:.4} with it; smoke alone {smoke:.4}");
    // Edges are averaged as display colours, and the first frames, without smoke, are forgotten slowly.
    assert!(error_on < 0.95 * error_off, "{error_on} with it, {error_off} without");
    assert!(smoke < 0.012, "{smoke}");
}

/// Half as many pixels in the main pass: the smoke is where the meshes are.
#[test]
fn resolution_override() {
    let half = SIZE / 2;
    let mut app = app();
    mesh(&mut app, Rectangle::new(0.5, 2.0), LinearRgba::BLUE, Transform::from_xyz(0.3, 0.0, 1.0));
    let volume = smoke(&mut app);
    app.app.world_mut().spawn(volume);
    let camera_bundle = camera(&app);
    app.app.world_mut().spawn(camera_bundle);
    // As DLSS does it, in the render world.
    let scale = move |mut commands: Commands, views: Query<Entity, (With<Camera3d>, With<ExtractedView>)>| {
        for view in &views {
            commands.entity(view).insert(MainPassResolutionOverride(half));
        }
    };
    app.app.sub_app_mut(RenderApp).add_systems(Render, scale.in_set(RenderSystems::CreateViews));
    let scaled = draw(&mut app);
    let mut small = Headless::new(half, TextureFormat::Rgba16Float).unwrap();
    mesh(&mut small, Rectangle::new(0.5, 2.0), LinearRgba::BLUE, Transform::from_xyz(0.3, 0.0, 1.0));
    let volume = smoke(&mut small);
    small.app.world_mut().spawn(volume);
    let camera_bundle = camera(&small);
    small.app.world_mut().spawn(camera_bundle);
    let small = draw(&mut small);
    let corner: Vec<[f32; 4]> =
        (0..half.element_product()).map(|i| scaled[(i / half.x * SIZE.x + i % half.x) as usize]).collect();
    assert!(rms(&corner, &small) < 1e-3, "{}", rms(&corner, &small));
}

/// Fog by distance is on meshes, and smoke veils it with them: it neither fogs smoke nor hides it.
#[test]
fn distance_fog_is_on_meshes_alone() {
    let fog = |_: &mut World| DistanceFog {
        color: Color::linear_rgb(0.5, 0.5, 0.5),
        falloff: FogFalloff::Linear { start: 0.0, end: 10.0 },
        ..default()
    };
    let (meshes, fogged) = (picture(SIZE, MESHES, 10, |_| ()), picture(SIZE, MESHES, 10, fog));
    let (clear, both) = (picture(SIZE, BOTH, 6, |_| ()), picture(SIZE, BOTH, 6, fog));
    save_radiance("effect_distance_fog", SIZE, &both);
    for i in 0..both.len() {
        for c in 0..3 {
            let (change, behind) = (both[i][c] - clear[i][c], fogged[i][c] - meshes[i][c]);
            assert!(change.abs() <= behind.abs() + 3e-3 && change * behind >= -1e-5, "{change} for {behind}");
        }
    }
}

/// Everything else Bevy adds after the main pass draws smoke that can be seen, and no number that is not finite.
#[test]
fn effects_draw_smoke() {
    let meshes = picture(SIZE, MESHES, 10, |_| ());
    let check = |name: &str, pixels: Vec<[f32; 4]>| {
        save_radiance(&format!("effect_{name}"), SIZE, &pixels);
        // The top of the column, beside the meshes.
        let smoky = (0..pixels.len()).filter(|i| pixels[*i][0] - meshes[*i][0] > 0.1).count();
        assert!(smoky > 200, "{name}: {smoky} pixels show smoke");
    };
    check("none", picture(SIZE, BOTH, 6, |_| ()));
    check("fxaa", picture(SIZE, BOTH, 6, |_| Fxaa::default()));
    check("bloom", picture(SIZE, BOTH, 6, |_| Bloom::NATURAL));
    check("deband", picture(SIZE, BOTH, 6, |_| DebandDither::Enabled));
    check("motion_blur", picture(SIZE, BOTH, 6, |_| MotionBlur { shutter_angle: 1.0, samples: 4 }));
    let lens =
        DepthOfField { mode: DepthOfFieldMode::Gaussian, focal_distance: 5.0, aperture_f_stops: 0.02, ..default() };
    check("depth_of_field", picture(SIZE, BOTH, 6, |_| lens));
    let fog = |world: &mut World| {
        let sun = DirectionalLight { illuminance: 1.0, shadow_maps_enabled: true, ..default() };
        world.spawn((sun, VolumetricLight, Transform::default().looking_to(Vec3::NEG_Y, Vec3::X)));
        world.spawn((FogVolume { density_factor: 0.05, ..default() }, Transform::from_scale(Vec3::splat(8.0))));
        VolumetricFog { ambient_intensity: 0.1, ..default() }
    };
    check("volumetric_fog", picture(SIZE, BOTH, 6, fog));
}
