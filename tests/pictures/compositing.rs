//! Smoke over backgrounds, between meshes, and over other smoke.

use bevy::light::NotShadowCaster;
use bevy::prelude::*;
use bevy::render::render_resource::TextureFormat;
use bevy_smoke::headless::Headless;
use bevy_smoke::prelude::*;

use crate::scene::*;

/// A background seen through smoke that only absorbs is exactly the background times the transmittance.
#[test]
fn absorbing_smoke_shows_its_transmittance() {
    let draw_over = |clear: LinearRgba| {
        let mut app = app();
        let (volume, medium, environment, transform) = smoke(&mut app);
        let black = SmokeMedium { albedo: LinearRgba::BLACK, ..medium };
        app.app.world_mut().spawn((volume, black, environment, transform));
        let camera = camera(&app);
        let camera = app.app.world_mut().spawn(camera).id();
        app.app.world_mut().entity_mut(camera).get_mut::<Camera>().unwrap().clear_color =
            ClearColorConfig::Custom(clear.into());
        draw(&mut app)
    };
    let alpha = draw_over(LinearRgba::NONE);
    let background = LinearRgba::rgb(0.5, 0.25, 2.0);
    let seen = draw_over(background);
    assert!(alpha.iter().any(|pixel| pixel[3] > 0.9) && alpha.iter().any(|pixel| pixel[3] == 0.0));
    for (alpha, seen) in alpha.iter().zip(&seen) {
        assert_eq!(alpha[..3], [0.0; 3], "albedo 0 scatters nothing");
        let transmittance = 1.0 - alpha[3];
        for (value, whole) in seen.iter().zip(background.to_f32_array()).take(3) {
            // Both pictures are f16: alpha is off by up to 2^-11 near 1, the colour by 2^-11 of itself.
            assert!(
                (value - whole * transmittance).abs() <= 1.5 * whole * 2.0_f32.powi(-11),
                "{seen:?} under {alpha:?}"
            );
        }
    }
}

/// Meshes in front hide smoke to the last bit; meshes behind are seen through it.
#[test]
fn smoke_between_meshes() {
    let picture = |with_smoke: bool, depths: &[f32]| {
        let mut app = app();
        for &z in depths {
            let color = LinearRgba::rgb(0.9, 0.1, 0.1);
            mesh(&mut app, Rectangle::new(1.0, 1.0), color, Transform::from_xyz(0.0, -0.3, z));
        }
        let camera = camera(&app);
        app.app.world_mut().spawn(camera);
        let volume = smoke(&mut app);
        if with_smoke {
            app.app.world_mut().spawn(volume);
            draw(&mut app)
        } else {
            for _ in 0..10 {
                app.app.update();
            }
            app.float_pixels()
        }
    };
    let center = (SIZE.x * (SIZE.y / 2 + 4) + SIZE.x / 2) as usize;
    let mesh_alone = picture(false, &[2.0]);
    assert_eq!(mesh_alone[center][3], 1.0);
    let in_front = picture(true, &[2.0]);
    assert_eq!(in_front[center], mesh_alone[center]);
    let smoke_alone = picture(true, &[])[center];
    assert!(smoke_alone[3] > 0.5);
    // Behind: smoke over mesh.
    let behind = picture(true, &[-2.0]);
    let expected = smoke_alone[0] + (1.0 - smoke_alone[3]) * picture(false, &[-2.0])[center][0];
    assert!((behind[center][0] - expected).abs() < 2e-3, "{} for {expected}", behind[center][0]);
}

/// A mesh inside cuts the march short: what is seen of it from the front, times what is seen of it from the back along the
/// same line, is the transmittance of the whole line.
#[test]
fn smoke_around_a_mesh() {
    let half_turn = Quat::from_rotation_y(std::f32::consts::PI);
    let picture = |back: bool, with_mesh: bool| {
        let mut app = app();
        let turned = Transform::from_rotation(if back { half_turn } else { Quat::IDENTITY });
        if with_mesh {
            mesh(&mut app, Rectangle::new(8.0, 8.0), LinearRgba::WHITE, turned);
        }
        let (volume, medium, environment, transform) = smoke(&mut app);
        let black = SmokeMedium { albedo: LinearRgba::BLACK, sigma_t: 2.0, ..medium };
        app.app.world_mut().spawn((volume, black, environment, transform));
        let camera = parallel_camera(&app, turned * Transform::from_xyz(0.0, 0.0, 5.0));
        app.app.world_mut().spawn(camera);
        draw(&mut app)
    };
    let (front, back, whole) = (picture(false, true), picture(true, true), picture(false, false));
    let mut veiled = 0;
    for (i, whole) in whole.iter().enumerate() {
        // From behind, left is right.
        let (x, row) = (i % SIZE.x as usize, i - i % SIZE.x as usize);
        let (near, far) = (front[i][0], back[row + SIZE.x as usize - 1 - x][0]);
        // Three f16 values, and a step of the march more or less at the mesh.
        assert!((near * far - (1.0 - whole[3])).abs() < 3e-3, "{near} times {far}, for {whole:?}");
        veiled += usize::from(near < 0.95 && far < 0.95);
    }
    assert!(veiled > 100, "{veiled} pixels have smoke on both sides of the mesh");
}

/// Volumes are composited whole, the farther one first, whatever the order in which they were spawned.
#[test]
fn overlapping_volumes_are_composited_far_to_near() {
    let near = (Transform::from_xyz(0.3, 0.0, 0.6).with_scale(Vec3::splat(2.5)), LinearRgba::rgb(0.9, 0.2, 0.2));
    let far = (Transform::from_xyz(-0.2, 0.1, 0.0).with_scale(Vec3::splat(3.0)), LinearRgba::rgb(0.2, 0.9, 0.3));
    let picture = |volumes: &[(Transform, LinearRgba)]| {
        let mut app = app();
        for &(transform, albedo) in volumes {
            let (volume, medium, environment, _) = smoke(&mut app);
            // Each is lit as if it were alone.
            let volume = (volume, SmokeMedium { albedo, ..medium }, environment, transform, NotShadowCaster);
            app.app.world_mut().spawn(volume);
        }
        let camera = camera(&app);
        app.app.world_mut().spawn(camera);
        draw(&mut app)
    };
    let (near_alone, far_alone) = (picture(&[near]), picture(&[far]));
    let expected: Vec<[f32; 4]> =
        near_alone.iter().zip(&far_alone).map(|(n, f)| std::array::from_fn(|i| n[i] + (1.0 - n[3]) * f[i])).collect();
    let both = picture(&[near, far]);
    // f16 after each of two blends.
    assert!(rms(&both, &expected) < 5e-4, "{}", rms(&both, &expected));
    assert_eq!(both, picture(&[far, near]), "the order of spawning shows");
    save_radiance("overlapping", SIZE, &both);
}

/// With MSAA every sample of a pixel sees the smoke in front of its own depth: edges match a supersampled picture.
#[test]
fn multisampled_edges_match_supersampled_ones() {
    let picture = |scale: u32, msaa: Msaa| {
        let mut app = Headless::new(SIZE * scale, TextureFormat::Rgba16Float).unwrap();
        let colors = [LinearRgba::rgb(0.1, 0.1, 1.0), LinearRgba::rgb(1.0, 0.8, 0.1)];
        let tilt = Quat::from_rotation_z(0.3);
        mesh(&mut app, Rectangle::new(0.5, 2.0), colors[0], Transform::from_xyz(0.3, 0.0, 1.0).with_rotation(tilt));
        mesh(&mut app, Rectangle::new(1.0, 2.0), colors[1], Transform::from_xyz(-0.4, 0.0, -1.0).with_rotation(tilt));
        let volume = smoke(&mut app);
        app.app.world_mut().spawn(volume);
        let camera = camera(&app);
        let camera = app.app.world_mut().spawn(camera).id();
        app.app.world_mut().entity_mut(camera).insert(msaa);
        draw(&mut app)
    };
    let fine = picture(4, Msaa::Off);
    let expected: Vec<[f32; 4]> = (0..SIZE.element_product())
        .map(|i| {
            let (x, y) = (4 * (i % SIZE.x), 4 * (i / SIZE.x));
            let mean = |c: usize| {
                let at = |j: u32| fine[((y + j / 4) * 4 * SIZE.x + x + j % 4) as usize][c];
                (0..16).map(at).sum::<f32>() / 16.0
            };
            std::array::from_fn(mean)
        })
        .collect();
    let (off, on) = (picture(1, Msaa::Off), picture(1, Msaa::Sample4));
    let (error_off, error_on) = (rms(&off, &expected), rms(&on, &expected));
    println!("error against 16 samples a pixel: {error_off:.4} without MSAA, {error_on:.4} with 4 samples");
    // Four samples of an edge's coverage are within 1/8 of it, one is within 1/2.
    assert!(error_on < 0.5 * error_off, "{error_on} with MSAA, {error_off} without");
    // Away from the edges, where nothing is behind, MSAA changes nothing that f16 could tell.
    let corner = (SIZE.x * 20 + 44) as usize;
    assert!((0..4).all(|c| (off[corner][c] - on[corner][c]).abs() < 2e-3), "{:?} {:?}", off[corner], on[corner]);
    save_radiance("msaa_off", SIZE, &off);
    save_radiance("msaa_4", SIZE, &on);
}
