//! Debug views: each shows what it says, by numbers.

use bevy::math::DVec3;
use bevy::prelude::*;
use bevy_smoke::bundle::{SmokeFrame, SmokeFrames};
use bevy_smoke::density::{GridShape, Placement};
use bevy_smoke::headless::Headless;
use bevy_smoke::prelude::*;
use bevy_smoke::rbf::{Rbf, RbfModel};
use bevy_smoke::residual::{HashedResidual, QuantizationLaw};

use crate::scene::*;

const SIGMA: f32 = 2.0;

/// A box of 24³ cells, a metre wide: density 1 on its left and ½ on its right, all of it residual, and one Gaussian in the
/// middle of the left half, which the residual takes away again.
fn halves(app: &mut Headless) -> Handle<SmokeAnimation> {
    let shape = GridShape::new(UVec3::splat(24));
    let rbf = Rbf { center: [-0.25, 0.0, 0.0], radius: 0.16, weight: 0.5 };
    let gaussians = RbfModel { rbfs: vec![rbf] }.rasterize(shape);
    let quantized: Vec<i8> = (0..shape.len())
        .map(|index| {
            let density = if shape.cell(index).x < 12 { 1.0 } else { 0.5 };
            ((density - 2.0 * gaussians[index]) * 127.0).round() as i8
        })
        .collect();
    let law = QuantizationLaw { max: 1.0, exponent: 1.0 };
    let frame = SmokeFrame::new(RbfModel { rbfs: vec![rbf] }, HashedResidual::build(shape, &quantized, law).unwrap());
    let max_density = frame.decode().iter().copied().fold(0.0, f32::max);
    let animation = SmokeAnimation {
        shape,
        placement: Placement { center: DVec3::ZERO, voxel_size: 0.04 },
        frames_per_second: 30.0,
        max_density,
        frames: SmokeFrames::from(vec![frame]),
    };
    app.app.world_mut().resource_mut::<Assets<SmokeAnimation>>().add(animation)
}

/// The halves, seen along Z by parallel rays, 32 pixels a metre.
fn halves_seen(view: SmokeDebugView) -> Vec<[f32; 4]> {
    let mut app = app();
    let animation = halves(&mut app);
    let camera = parallel_camera(&app, Transform::from_xyz(0.0, 0.0, 6.0));
    let world = app.app.world_mut();
    world.spawn((
        SmokeVolume::new(animation),
        SmokeMedium { sigma_t: SIGMA, ..default() },
        SmokeEnvironment::constant(Vec3::ONE, 3.0),
        Transform::from_scale(Vec3::splat(2.0)),
        view,
    ));
    world.spawn(camera);
    draw(&mut app)
}

/// The pixel at a place in metres.
fn at(pixels: &[[f32; 4]], x: f32, y: f32) -> [f32; 4] {
    let pixel = |metres: f32| ((metres / 3.2 + 0.5) * 64.0) as usize;
    pixels[pixel(-y) * 64 + pixel(x)]
}

fn assert_near(name: &str, found: [f32; 4], expected: [f32; 4]) {
    let far = found.iter().zip(expected).any(|(a, b)| (a - b).abs() > 0.02);
    assert!(!far, "{name} is {found:?} and not {expected:?}");
}

/// Two metres of a colour and a density.
fn slab(color: [f32; 3], density: f32) -> [f32; 4] {
    let alpha = 1.0 - (-SIGMA * density * 2.0).exp();
    [color[0] * alpha, color[1] * alpha, color[2] * alpha, alpha]
}

#[test]
fn fields_are_shown_in_their_colours() {
    let (red, green, blue) = ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]);
    // Away from the Gaussian; colours within 2 %: the largest density is 1 and 8 bits are rounded.
    let density = halves_seen(SmokeDebugView::Density);
    save_radiance("debug_density", SIZE, &density);
    assert_near("density on the left", at(&density, -0.5, 0.7), slab(red, 1.0));
    assert_near("density on the right", at(&density, 0.5, 0.0), slab(green, 0.5));

    let residual = halves_seen(SmokeDebugView::Residual);
    save_radiance("debug_residual", SIZE, &residual);
    assert_near("residual on the left", at(&residual, -0.5, 0.7), slab(red, 1.0));
    assert_near("residual on the right", at(&residual, 0.5, 0.0), slab(red, 0.5));

    let rbfs = halves_seen(SmokeDebugView::Rbfs);
    save_radiance("debug_rbfs", SIZE, &rbfs);
    assert_eq!(at(&rbfs, 0.5, 0.0)[3], 0.0, "there is no Gaussian on the right");
    // Through the middle of the Gaussian: the optical depth is σ w r √π, two metres a bundle unit.
    let depth = SIGMA * 0.5 * 0.16 * std::f32::consts::PI.sqrt() * 2.0;
    let middle = at(&rbfs, -0.5, 0.0);
    assert!((middle[3] - (1.0 - (-depth).exp())).abs() < 0.02, "{middle:?}");
    // Half the largest density and less is between green and blue.
    assert!(middle[0] == 0.0 && middle[1] > 0.3 * middle[3] && middle[2] > 0.1 * middle[3], "{middle:?} {blue:?}");
}

#[test]
fn light_is_shown_by_how_often_it_has_scattered() {
    let seen = |view: SmokeDebugView, scattering: SmokeScattering| {
        let mut app = app();
        let parts = smoke(&mut app);
        let camera = camera(&app);
        app.app.world_mut().spawn((parts, scattering, view));
        // A lamp in the smoke, whose glow is light that has scattered once.
        app.app.world_mut().spawn((PointLight { intensity: 3.0, ..default() }, Transform::from_xyz(0.1, -0.5, 0.0)));
        app.app.world_mut().spawn(camera);
        draw(&mut app)
    };
    let full = seen(SmokeDebugView::None, SmokeScattering::MULTIPLE);
    let once = seen(SmokeDebugView::Single, SmokeScattering::MULTIPLE);
    let again = seen(SmokeDebugView::Multiple, SmokeScattering::MULTIPLE);
    save_radiance("debug_multiple", SIZE, &again);
    assert!(rms(&once, &seen(SmokeDebugView::None, SmokeScattering::SINGLE)) < 1e-6, "the picture with one event");
    // Whatever the settings are.
    assert!(rms(&again, &seen(SmokeDebugView::Multiple, SmokeScattering::SINGLE)) < 1e-6);
    let sum: Vec<[f32; 4]> =
        once.iter().zip(&again).map(|(a, b)| [a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3]]).collect();
    let size = rms(&full, &vec![[0.0; 4]; full.len()]);
    let (error, share) = (rms(&sum, &full) / size, rms(&once, &full) / size);
    println!("once and again are the picture within {error:.4}; once alone within {share:.4}");
    // Bounds of the fits, which differ, are met by few.
    assert!(error < 0.01 && share > 10.0 * error);
}

#[test]
fn markers_are_where_probes_and_spheres_are() {
    let mut app = app();
    let animation = halves(&mut app);
    let camera = parallel_camera(&app, Transform::from_xyz(0.0, 0.0, 6.0));
    let world = app.app.world_mut();
    let volume = world
        .spawn((
            SmokeVolume::new(animation),
            SmokeMedium { sigma_t: 0.0, ..default() },
            SmokeEnvironment::constant(Vec3::ONE, 1.0),
            Transform::from_scale(Vec3::splat(2.0)),
        ))
        .id();
    world.spawn((SmokeOccluder::new([(Vec3::ZERO, 0.2)]), Transform::from_xyz(0.8, 0.8, 0.0)));
    world.spawn(camera);
    let plain = draw(&mut app);
    let mut shown = |view: SmokeDebugView| {
        app.app.world_mut().entity_mut(volume).insert(view);
        for _ in 0..4 {
            app.app.update();
        }
        app.float_pixels()
    };
    // Seen along Z: the probe before the centre hides it; the others are a radius away, 0.32 m, octahedra of 0.03 m that fall
    // between pixels of 0.05 m or on one.
    let probes = shown(SmokeDebugView::Probes);
    let places = [(-0.5, 0.0), (-0.82, 0.0), (-0.18, 0.0), (-0.5, 0.32), (-0.5, -0.32)];
    for (i, pixel) in probes.iter().enumerate().filter(|(_, pixel)| pixel[3] > 0.0) {
        let center = |index: usize| (index as f32 + 0.5) / 20.0 - 1.6;
        let (x, y) = (center(i % 64), -center(i / 64));
        let near = places.iter().any(|place| (x - place.0).abs() + (y - place.1).abs() < 0.05);
        assert!(near && pixel[0] > 0.9 && pixel[1] > 0.5, "{pixel:?} at {x}, {y}");
    }
    let count = probes.iter().filter(|pixel| pixel[3] > 0.0).count();
    assert!((3..=10).contains(&count), "{count} pixels");
    let spheres = shown(SmokeDebugView::Spheres);
    let [red, green, blue, _] = at(&spheres, 0.8, 0.8);
    assert!(red > 0.9 && green < 0.1 && blue > 0.9, "a sphere is magenta");
    // A disk of radius 0.2 m, of 20 pixels a metre: 50 pixels.
    let count = spheres.iter().filter(|pixel| pixel[3] > 0.0).count();
    assert!((40..=60).contains(&count), "{count}");
    assert!(rms(&plain, &shown(SmokeDebugView::None)) < 1e-6, "and they go");
    shown(SmokeDebugView::Spheres);
    app.app.world_mut().entity_mut(volume).remove::<SmokeDebugView>();
    app.app.update();
    app.app.update();
    assert!(rms(&plain, &app.float_pixels()) < 1e-6, "with the last view, too");
}
