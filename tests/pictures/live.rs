//! Smoke whose density a texture holds.

use std::time::Duration;

use bevy::asset::RenderAssetUsages;
use bevy::prelude::*;
use bevy::render::render_resource::{Extent3d, TextureDimension, TextureFormat};
use bevy::time::TimeUpdateStrategy;
use bevy_smoke::bundle;
use bevy_smoke::headless::Headless;
use bevy_smoke::prelude::*;
use bevy_smoke::render::SmokeRenderStats;

use crate::examples::live;
use crate::scene::*;

/// The density of the plume that the examples use, as a texture that does not change.
fn plume_texture(app: &mut Headless) -> SmokeVolume {
    let bytes = std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/assets/plume.smoke")).unwrap();
    let animation = bundle::read(&bytes).unwrap();
    let density = animation.frames.get(0).unwrap().decode();
    let dims = animation.shape.dims;
    let image = Image::new(
        Extent3d { width: dims.x, height: dims.y, depth_or_array_layers: dims.z },
        TextureDimension::D3,
        bytemuck::cast_slice(&density).to_vec(),
        TextureFormat::R32Float,
        RenderAssetUsages::RENDER_WORLD,
    );
    let image = app.app.world_mut().resource_mut::<Assets<Image>>().add(image);
    let live = LiveDensity { max_density: animation.max_density, ..LiveDensity::new(image) };
    SmokeVolume { density: SmokeDensity::Live(live.still()) }
}

/// Over smoke pixels: relative to the picture `b`.
fn error(a: &[[f32; 4]], b: &[[f32; 4]]) -> f64 {
    let seen = || a.iter().zip(b).filter(|(_, b)| b[3] > 0.02);
    let sum = |of: &dyn Fn(&[f32; 4], &[f32; 4]) -> f64| seen().map(|(a, b)| of(a, b)).sum::<f64>();
    let square = |x: f32| f64::from(x).powi(2);
    let difference = sum(&|a, b| (0..3).map(|c| square(a[c] - b[c])).sum());
    (difference / sum(&|_, b| (0..3).map(|c| square(b[c])).sum())).sqrt()
}

#[test]
fn a_texture_looks_like_the_bundle_of_the_same_density() {
    let picture = |scattering: SmokeScattering, live: bool| {
        let mut app = app();
        let (volume, medium, _, transform) = smoke(&mut app);
        let volume = if live { plume_texture(&mut app) } else { volume };
        let coefficients = {
            // A sky that is brighter on one side.
            let mut coefficients = [Vec3::ZERO; 16];
            coefficients[0] = Vec3::splat(3.5);
            coefficients[1] = Vec3::new(-0.8, -0.9, -1.0);
            coefficients[3] = Vec3::new(1.2, 1.0, 0.8);
            coefficients
        };
        let environment = SmokeEnvironment::Coefficients { coefficients, intensity: 1.0 };
        let camera = camera(&app);
        let world = app.app.world_mut();
        world.spawn((volume, medium, environment, transform, SmokePlayback::at_frame(0), scattering));
        world.spawn(camera);
        draw(&mut app)
    };
    for (name, scattering) in [("single", SmokeScattering::SINGLE), ("multiple", SmokeScattering::MULTIPLE)] {
        let [live, baked] = [true, false].map(|live| picture(scattering, live));
        save_radiance(&format!("live_{name}"), SIZE, &live);
        let error = error(&live, &baked);
        println!("{name}: {:.2} % from the baked picture", 100.0 * error);
        // Both are 1 to 2 % from the truth on a plume like this, and not in the same places.
        assert!(error < 0.03, "{name}: {error}");
        // Alpha is that of the same density, but for the 8 bits of the bundle's residual, which are in both.
        let alpha = |p: &[[f32; 4]]| p.iter().map(|p| [p[3]; 4]).collect::<Vec<_>>();
        assert!(rms(&alpha(&live), &alpha(&baked)) < 1e-3);
    }
}

#[test]
fn a_texture_that_stands_still_costs_nothing() {
    let mut app = app();
    let volume = plume_texture(&mut app);
    let (_, medium, environment, transform) = smoke(&mut app);
    let camera = camera(&app);
    let volume = app.app.world_mut().spawn((volume, medium, environment, transform)).id();
    app.app.world_mut().spawn(camera);
    draw(&mut app);
    let count = |app: &Headless, pass: &str| {
        let at = SmokeRenderStats::PASSES.iter().position(|other| *other == pass).unwrap();
        app.app.world().resource::<SmokeRenderStats>().dispatches()[at]
    };
    let passes = ["smoke_live", "smoke_lattice", "smoke_pair_matrix", "smoke_volume"];
    let before = passes.map(|pass| count(&app, pass));
    assert_eq!(before, [1, 5, 1, 1]);
    app.app.update();
    assert_eq!(passes.map(|pass| count(&app, pass)), before);
    // One that changes is lit anew in every frame.
    let mut smoke = app.app.world_mut().get_mut::<SmokeVolume>(volume).unwrap();
    let SmokeDensity::Live(live) = &mut smoke.density else { unreachable!() };
    live.changes = true;
    app.app.update();
    app.app.update();
    assert_eq!(passes.map(|pass| count(&app, pass)), before.map(|n| 3 * n));
}

/// What is drawn is what the compute shader has just written, and it shades the ground.
#[test]
fn a_compute_shader_writes_smoke() {
    let size = UVec2::new(160, 120);
    let (format, folder) = (TextureFormat::Rgba8UnormSrgb, AssetPlugin::default().file_path);
    let vent = |app: &mut App| {
        app.add_plugins(live::VentPlugin);
    };
    let mut headless = Headless::with_plugins(size, format, folder, vent).unwrap();
    headless.draw_cameras_to_image();
    headless.app.insert_resource(TimeUpdateStrategy::ManualDuration(Duration::ZERO));
    headless.app.add_systems(Startup, live::setup);
    headless.settle().unwrap();
    let mut picture = |seconds: f32, name: &str| {
        let step = Duration::from_secs_f32(seconds);
        headless.app.insert_resource(TimeUpdateStrategy::ManualDuration(step));
        headless.app.update();
        headless.app.insert_resource(TimeUpdateStrategy::ManualDuration(Duration::ZERO));
        (0..4).for_each(|_| headless.app.update());
        let pixels = headless.pixels();
        save(name, size, &pixels);
        pixels.as_chunks::<4>().0.to_vec()
    };
    let (first, later) = (picture(0.5, "live_1"), picture(1.0, "live_2"));
    let changed = |a: &[[u8; 4]], b: &[[u8; 4]]| {
        a.iter().zip(b).filter(|(a, b)| a.iter().zip(*b).any(|(a, b)| a.abs_diff(*b) > 8)).count()
    };
    assert!(changed(&first, &later) > 300, "smoke moves: {}", changed(&first, &later));
    // Without the smoke the ground, the lower third of the picture, is lighter where its shadow was.
    let world = headless.app.world_mut();
    let volumes: Vec<Entity> = world.query_filtered::<Entity, With<SmokeVolume>>().iter(world).collect();
    world.despawn(volumes[0]);
    (0..4).for_each(|_| headless.app.update());
    let pixels = headless.pixels();
    save("live_3", size, &pixels);
    let clear = pixels.as_chunks::<4>().0;
    let ground = 2 * later.len() / 3;
    let shaded = later[ground..].iter().zip(&clear[ground..]).filter(|(a, b)| a[0].saturating_add(8) < b[0]).count();
    assert!(shaded > 150, "smoke shades the ground: {shaded} pixels");
}

/// A texture that cannot be read is one error, and no smoke.
#[test]
fn a_flat_texture_is_refused() {
    let mut app = app();
    let image = app.app.world_mut().resource_mut::<Assets<Image>>().add(Image::default());
    let (_, medium, environment, transform) = smoke(&mut app);
    let camera = camera(&app);
    app.app.world_mut().spawn((SmokeVolume::live(image), medium, environment, transform));
    app.app.world_mut().spawn(camera);
    for _ in 0..5 {
        app.app.update();
    }
    assert_eq!(coverage(&app.float_pixels()), 0.0);
}
