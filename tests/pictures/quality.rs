//! Parts of the model that can be had for less: what they change in the picture, and what they save.

use bevy::prelude::*;
use bevy::render::render_resource::TextureFormat;
use bevy_smoke::headless::Headless;
use bevy_smoke::prelude::*;
use bevy_smoke::render::SmokeRenderStats;

use crate::scene::*;

const FULL: SmokeModel = SmokeModel::FULL;

/// The plume under a sky that is brighter on one side, scattering forward.
fn picture(model: SmokeModel) -> Vec<[f32; 4]> {
    let mut app = app();
    let (volume, medium, _, transform) = smoke(&mut app);
    let mut coefficients = [Vec3::ZERO; 16];
    coefficients[0] = Vec3::splat(3.5);
    coefficients[1] = Vec3::splat(-1.5);
    coefficients[8] = Vec3::splat(0.6);
    let environment = SmokeEnvironment::Coefficients { coefficients, intensity: 1.0 };
    let medium = SmokeMedium { g: 0.4, ..medium };
    app.app.world_mut().spawn((volume, medium, environment, transform, SmokeQuality::Model(model)));
    let camera = camera(&app);
    app.app.world_mut().spawn(camera);
    draw(&mut app)
}

/// What an artist may do without costs a few percent of the picture, not more; and it is done without: the picture changes.
#[test]
fn less_model_changes_the_picture_a_little() {
    let full = picture(FULL);
    let level = rms(&full, &vec![[0.0; 4]; full.len()]);
    assert_eq!(full, picture(SmokeModel { rbfs: 100_000, ..FULL }), "more than there are is all");
    for (model, most) in [
        (SmokeModel { rbfs: 50, ..FULL }, 0.03),
        (SmokeModel { probes: 1, ..FULL }, 0.04),
        (SmokeModel { order: 3, ..FULL }, 0.03),
        (SmokeModel { directions: 32, ..FULL }, 0.03),
        (SmokeModel { directions: 16, ..FULL }, 0.06),
        (SmokeModel { sweeps: 5, ..FULL }, 0.01),
        (SmokeModel { step: 2.0, ..FULL }, 0.03),
    ] {
        let error = rms(&picture(model), &full) / level;
        println!("{model:?}: {:.2} %", 100.0 * error);
        assert!(error > 0.0 || model.sweeps == 5, "{model:?} changes nothing");
        assert!(error < most, "{model:?}: {error}");
    }
}

/// At half resolution smoke ends at the meshes in it, before it and behind it as it does at full resolution: what is off is
/// off where smoke itself changes from pixel to pixel, no more with meshes than without.
#[test]
fn half_resolution_keeps_the_edges_of_meshes() {
    let size = UVec2::new(241, 180);
    let blue = LinearRgba::rgb(0.125, 0.125, 1.0);
    let picture = |half_resolution: bool, with_meshes: bool, msaa: Msaa| {
        let mut app = Headless::new(size, TextureFormat::Rgba16Float).unwrap();
        if with_meshes {
            let colors = [blue, LinearRgba::rgb(1.0, 0.8, 0.1), LinearRgba::rgb(0.1, 0.7, 0.1)];
            let tilt = Quat::from_rotation_z(0.3);
            mesh(&mut app, Rectangle::new(0.3, 2.0), colors[0], Transform::from_xyz(0.5, 0.0, 1.7).with_rotation(tilt));
            mesh(
                &mut app,
                Rectangle::new(1.0, 2.0),
                colors[1],
                Transform::from_xyz(-0.4, 0.3, -1.7).with_rotation(tilt),
            );
            mesh(&mut app, Sphere::new(0.3), colors[2], Transform::from_xyz(0.0, 0.2, 0.1));
        }
        let volume = smoke(&mut app);
        let quality = SmokeQuality::Model(SmokeModel { half_resolution, ..FULL });
        app.app.world_mut().spawn((volume, quality));
        let camera = camera(&app);
        let camera = app.app.world_mut().spawn(camera).id();
        app.app.world_mut().entity_mut(camera).insert(msaa);
        draw(&mut app)
    };
    // How far half resolution is off: root mean square over that of the picture, and the most at any pixel.
    let compare = |full: &[[f32; 4]], half: &[[f32; 4]]| {
        let apart = |(a, b): (&[f32; 4], &[f32; 4])| (0..4).map(|c| (a[c] - b[c]).abs()).fold(0.0, f32::max);
        let level = rms(full, &vec![[0.0; 4]; full.len()]);
        (rms(full, half) / level, full.iter().zip(half).map(apart).fold(0.0, f32::max))
    };
    let (full, half) = (picture(false, true, Msaa::Off), picture(true, true, Msaa::Off));
    save_radiance("half_resolution", size, &half);
    let (error, worst) = compare(&full, &half);
    let (alone, worst_alone) = compare(&picture(false, false, Msaa::Off), &picture(true, false, Msaa::Off));
    println!("half resolution: {:.2} % off, {worst:.3} at most", 100.0 * error);
    println!("without meshes: {:.2} % off, {worst_alone:.3} at most", 100.0 * alone);
    assert!(error > 0.0 && error < 0.02, "{error}");
    // An edge at which smoke leaked would be off by as much as the smoke before or behind it is bright, 0.5 and more.
    assert!(worst < 1.05 * worst_alone && worst < 0.25, "{worst}, {worst_alone} without meshes");
    // The mesh in front keeps its colour to the last bit: nothing leaks before it.
    let is_in_front = |pixel: &[f32; 4]| pixel[..3] == blue.to_f32_array()[..3];
    let in_front = full.iter().zip(&half).filter(|(pixel, _)| is_in_front(pixel));
    assert!(in_front.clone().count() > 1000);
    assert!(in_front.clone().all(|(full, half)| full == half));
    // With MSAA there is no half resolution.
    assert_eq!(picture(false, true, Msaa::Sample4), picture(true, true, Msaa::Sample4));
}

/// Light waits for its turn; density and the view do not.
#[test]
fn light_is_computed_every_few_frames() {
    let mut app = app();
    let (volume, medium, environment, transform) = smoke(&mut app);
    let quality = SmokeQuality::Model(SmokeModel { lighting_interval: 4, ..FULL });
    let volume = app.app.world_mut().spawn((volume, medium, environment, transform, quality)).id();
    let camera = camera(&app);
    app.app.world_mut().spawn(camera);
    draw(&mut app);
    let before = dispatches(&app);
    let mut brightness = Vec::new();
    for frame in 0..12 {
        let mut entity = app.app.world_mut().entity_mut(volume);
        entity.get_mut::<SmokeMedium>().unwrap().albedo = LinearRgba::rgb(0.5, 0.5, 0.02 * frame as f32);
        app.app.update();
        brightness.push(app.float_pixels().iter().map(|pixel| f64::from(pixel[2])).sum::<f64>());
    }
    let now = dispatches(&app);
    let made: Vec<u32> = now.iter().zip(before).map(|(now, before)| now - before).collect();
    // Incident light, scattering; the view.
    assert!((3..=4).contains(&made[4]) && made[5] == made[4], "{made:?}");
    assert_eq!(made[8], 12);
    // In the end nothing is left undone.
    for _ in 0..4 {
        app.app.update();
    }
    let settled = dispatches(&app);
    app.app.update();
    assert_eq!(dispatches(&app)[4], settled[4]);
    let changes = brightness.windows(2).filter(|pair| pair[0] != pair[1]).count();
    assert!((2..=4).contains(&changes), "{brightness:?}");
}

/// Light that waits for its turn is as bright as it was, however bright what will be computed is.
#[test]
fn what_waits_to_be_lit_shows_as_it_was_lit() {
    let mut app = app();
    let (volume, medium, _, transform) = smoke(&mut app);
    let quality = SmokeQuality::Model(SmokeModel { lighting_interval: 60, ..FULL });
    let sky = SmokeEnvironment::constant;
    let volume = app.app.world_mut().spawn((volume, medium, sky(Vec3::ONE, 1.0), transform, quality)).id();
    let camera = camera(&app);
    app.app.world_mut().spawn(camera);
    let before = draw(&mut app);
    app.app.world_mut().entity_mut(volume).insert(sky(Vec3::X, 100.0));
    app.app.update();
    assert!(rms(&before, &app.float_pixels()) == 0.0, "not its turn");
    for _ in 0..60 {
        app.app.update();
    }
    let bright: Vec<[f32; 4]> = before.iter().map(|&[r, _, _, a]| [100.0 * r, 0.0, 0.0, a]).collect();
    let size = rms(&bright, &vec![[0.0; 4]; bright.len()]);
    // Both are of half floats.
    assert!(rms(&bright, &app.float_pixels()) < 2e-3 * size, "its turn");
}

/// What chooses itself keeps its word against the full model's picture, says why, and does not change while little does.
#[test]
fn a_quality_is_chosen_and_explained() {
    let most = 0.04;
    let chosen = |quality: SmokeQuality| {
        let mut app = app();
        let smoke = smoke(&mut app);
        let volume = app.app.world_mut().spawn((smoke, quality)).id();
        let camera = camera(&app);
        let camera = app.app.world_mut().spawn(camera).id();
        let picture = draw(&mut app);
        let choice = |app: &Headless| app.app.world().resource::<SmokeRenderStats>().quality(volume).unwrap();
        let first = choice(&app);
        for frame in 0..40 {
            let mut entity = app.app.world_mut().entity_mut(camera);
            entity.get_mut::<Transform>().unwrap().translation.x = 0.02 * (frame as f32).sin();
            app.app.update();
        }
        assert_eq!(choice(&app).model, first.model, "it changes as the camera sways");
        (picture, first)
    };
    let (full, asked_for) = chosen(SmokeQuality::default());
    assert_eq!(asked_for.model, FULL);
    let (auto, choice) = chosen(SmokeQuality::Error(most));
    println!("{choice}");
    assert!(choice.is_met && choice.error <= most && choice.milliseconds < 0.7 * asked_for.milliseconds);
    assert!(choice.to_string().contains("the cheapest within 4.0 %"), "{choice}");
    let error = rms(&auto, &full) / rms(&full, &vec![[0.0; 4]; full.len()]);
    println!("{:.2} % off the full model's picture", 100.0 * error);
    // Predictions are good to a quarter or so.
    assert!(error < 1.3 * f64::from(most), "{error}");
}
