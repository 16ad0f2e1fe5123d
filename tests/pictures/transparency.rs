//! Smoke among transparent meshes.

use bevy::core_pipeline::oit::OrderIndependentTransparencySettings;
use bevy::core_pipeline::tonemapping::{DebandDither, Tonemapping};
use bevy::prelude::*;
use bevy::render::render_resource::TextureFormat;
use bevy_smoke::headless::Headless;
use bevy_smoke::prelude::*;

use crate::scene::*;

const OPACITY: f32 = 0.5;

/// Panes across the view, all of one mesh and one material, so that Bevy would draw them together.
fn panes(app: &mut Headless, color: LinearRgba, depths: &[f32]) {
    let world = app.app.world_mut();
    let mesh = world.resource_mut::<Assets<Mesh>>().add(Rectangle::new(8.0, 8.0));
    let alpha_mode = if color.alpha < 1.0 { AlphaMode::Blend } else { AlphaMode::Opaque };
    let material = StandardMaterial { base_color: color.into(), unlit: true, alpha_mode, ..default() };
    let material = world.resource_mut::<Assets<StandardMaterial>>().add(material);
    for &z in depths {
        world.spawn((Mesh3d(mesh.clone()), MeshMaterial3d(material.clone()), Transform::from_xyz(0.0, 0.0, z)));
    }
}

/// Panes at depths, with smoke of an albedo at the origin where it is given, for cameras as `change` makes them.
fn picture<B: Bundle>(
    panes_of: (LinearRgba, &[f32]),
    smoke_albedo: Option<f32>,
    change: impl Fn() -> B,
) -> Vec<[f32; 4]> {
    let mut app = app();
    panes(&mut app, panes_of.0, panes_of.1);
    let (volume, medium, environment, transform) = smoke(&mut app);
    if let Some(albedo) = smoke_albedo {
        let medium = SmokeMedium { albedo: LinearRgba::gray(albedo), sigma_t: 2.0, ..medium };
        app.app.world_mut().spawn((volume, medium, environment, transform));
    }
    let camera = parallel_camera(&app, Transform::from_xyz(0.0, 0.0, 5.0));
    let camera = app.app.world_mut().spawn(camera).id();
    // Smoke shades opaque meshes alone: what is compared here is how it veils.
    let unshaded = SmokeShadows { smoke: false, occluders: false };
    app.app.world_mut().entity_mut(camera).insert((change(), unshaded));
    if smoke_albedo.is_some() {
        draw(&mut app);
    }
    // Panes take a few frames, and smoke among them one more.
    for _ in 0..6 {
        app.app.update();
    }
    app.float_pixels()
}

/// One thing over another, both premultiplied.
fn over(front: [f32; 4], back: [f32; 4]) -> [f32; 4] {
    std::array::from_fn(|i| front[i] + (1.0 - front[3]) * back[i])
}

fn composite(layers: &[&[[f32; 4]]]) -> Vec<[f32; 4]> {
    (0..layers[0].len()).map(|i| layers.iter().rev().fold([0.0; 4], |back, layer| over(layer[i], back))).collect()
}

/// Panes behind all smoke are behind it, panes in front are in front, with and without MSAA.
#[test]
fn smoke_goes_between_panes() {
    let pane = LinearRgba::new(1.0, 0.2, 0.1, OPACITY);
    for msaa in [Msaa::Off, Msaa::Sample4] {
        let change = || msaa;
        let alone = picture((pane, &[]), Some(0.8), change);
        let glass = picture((pane, &[0.0]), None, change);
        assert!(glass.iter().all(|pixel| (pixel[0] - OPACITY).abs() < 1e-3), "{:?}", glass[0]);
        let cases: [(&[f32], Vec<&[[f32; 4]]>); 3] = [
            (&[3.0, -3.0], vec![&glass, &alone, &glass]),
            (&[-3.0, -2.5], vec![&alone, &glass, &glass]),
            (&[3.0], vec![&glass, &alone]),
        ];
        let cases = if msaa == Msaa::Off { &cases[..] } else { &cases[..1] };
        for (depths, layers) in cases {
            let error = rms(&picture((pane, depths), Some(0.8), change), &composite(layers));
            // f16 after each of up to four blends.
            assert!(error < 1e-3, "{msaa:?}, panes at {depths:?}: {error}");
        }
    }
}

/// A pane within the smoke has the smoke behind it behind it and the rest in front, to the pixel: it is dimmed as an opaque
/// mesh in its place would be.
#[test]
fn panes_in_smoke_are_in_their_place() {
    for (msaa, depths) in [(Msaa::Off, &[-0.9, -0.3, 0.15, 0.9][..]), (Msaa::Sample4, &[0.1])] {
        let change = || msaa;
        let mut before = 0.0;
        for &z in depths {
            let pane = picture((LinearRgba::new(1.0, 1.0, 1.0, OPACITY), &[z]), Some(0.0), change);
            let opaque = picture((LinearRgba::WHITE, &[z]), Some(0.0), change);
            for (pane, opaque) in pane.iter().zip(&opaque) {
                // f16, and a step of the march more or less at the pane.
                assert!((pane[0] - OPACITY * opaque[0]).abs() < 3e-3, "{msaa:?}, at {z}: {pane:?} for {opaque:?}");
            }
            // Nearer panes are seen better, without a jump.
            let mean = pane.iter().map(|pixel| pixel[0]).sum::<f32>() / pane.len() as f32;
            assert!(mean > before, "{mean} at {z} after {before}");
            before = mean;
        }
    }
}

/// Where many transparent meshes are in smoke, several go between two slabs, and nothing is lost: smoke that absorbs dims what
/// is behind all of it by the transmittance of the whole.
#[test]
fn many_panes_in_smoke() {
    let depths: Vec<f32> = (0..40).map(|i| -0.975 + 0.05 * i as f32).collect();
    let invisible = LinearRgba::new(1.0, 1.0, 1.0, 0.0);
    let whole = picture((invisible, &[]), Some(0.8), || Msaa::Off);
    let cut = picture((invisible, &depths), Some(0.8), || Msaa::Off);
    // Every slab's march has steps of its own.
    assert!(rms(&whole, &cut) < 2e-3, "{}", rms(&whole, &cut));
}

/// Without HDR the target holds display colours, and smoke among panes is tone-mapped there as it is alone.
#[test]
fn panes_without_hdr() {
    let picture = |depths: &[f32], tonemapping: Tonemapping| {
        let mut app = Headless::new(SIZE, TextureFormat::Rgba8UnormSrgb).unwrap();
        panes(&mut app, LinearRgba::new(1.0, 1.0, 1.0, 0.0), depths);
        let volume = smoke(&mut app);
        app.app.world_mut().spawn(volume);
        let target = app.target();
        let at = Transform::from_xyz(0.0, 0.0, 6.0);
        app.app.world_mut().spawn((
            Camera3d::default(),
            target,
            tonemapping,
            DebandDither::Disabled,
            UNEXPOSED,
            Msaa::Off,
            at,
        ));
        app.settle().unwrap();
        for _ in 0..3 {
            app.app.update();
        }
        app.pixels()
    };
    for tonemapping in [Tonemapping::None, Tonemapping::Reinhard, Tonemapping::TonyMcMapface] {
        let (alone, behind) = (picture(&[], tonemapping), picture(&[-3.0], tonemapping));
        assert!(alone.iter().zip(&behind).all(|(a, b)| a.abs_diff(*b) <= 1), "{tonemapping:?}");
    }
}

/// Order-independent transparency composites its meshes after all smoke, wherever they are.
#[test]
fn order_independent_panes_are_in_front() {
    let pane = LinearRgba::new(1.0, 0.2, 0.1, OPACITY);
    let change = || (OrderIndependentTransparencySettings::default(), Msaa::Off);
    let alone = picture((pane, &[]), Some(0.8), change);
    let glass = picture((pane, &[0.0]), None, change);
    for z in [-3.0, 3.0] {
        let error = rms(&picture((pane, &[z]), Some(0.8), change), &composite(&[&glass, &alone]));
        assert!(error < 1e-3, "pane at {z}: {error}");
    }
}
