//! Smoke lit by a light constellation.

use bevy::asset::RenderAssetUsages;
use bevy::prelude::*;
use bevy::render::render_resource::{Extent3d, TextureDimension, TextureFormat};
use bevy_smoke::headless::Headless;
use bevy_smoke::prelude::*;
use bevy_smoke::render::SmokeRenderStats;

use crate::scene::*;

/// A cube of even smoke, 32 cells a side, as live density.
fn cube(app: &mut Headless) -> SmokeVolume {
    let side = 32;
    let data = vec![1.0_f32; side * side * side].into_iter().flat_map(f32::to_le_bytes).collect();
    let size = Extent3d { width: 32, height: 32, depth_or_array_layers: 32 };
    let format = TextureFormat::R32Float;
    let image = Image::new(size, TextureDimension::D3, data, format, RenderAssetUsages::default());
    let image = app.app.world_mut().resource_mut::<Assets<Image>>().add(image);
    SmokeVolume { density: SmokeDensity::Live(LiveDensity::new(image).still()) }
}

fn spawn(volume: impl Bundle, app: &mut Headless) -> Entity {
    let camera = camera(app);
    app.app.world_mut().spawn(camera);
    app.app.world_mut().spawn(volume).id()
}

fn dispatched(app: &Headless, pass: &str) -> u32 {
    let at = SmokeRenderStats::PASSES.iter().position(|other| *other == pass).expect("it is one of the passes");
    app.app.world().resource::<SmokeRenderStats>().dispatches()[at]
}

/// The pixel in the middle.
fn middle(pixels: &[[f32; 4]]) -> [f32; 4] {
    pixels[(SIZE.y / 2 * SIZE.x + SIZE.x / 2) as usize]
}

#[test]
fn a_cube_lit_by_one_sun_is_as_bright_as_the_closed_form_says() {
    // Light from the eye's own side, along the view: it has come as far into the smoke as what it sends goes out, and
    // J sums to (albedo / 4 pi) E (1 - e^(-2 tau)) / 2, tau = 1.5 through the cube.
    let (sigma_t, side, illuminance) = (1.5_f32, 1.0_f32, 5.0_f32);
    let expected = |albedo: f32, through: f32| albedo / (4.0 * std::f32::consts::PI) * illuminance * through;
    for (shading, through) in [
        (ConstellationShading::SelfShadow, 0.5 * (1.0 - (-2.0 * sigma_t * side).exp())),
        (ConstellationShading::Primary, 1.0 - (-sigma_t * side).exp()),
    ] {
        let mut app = app();
        let volume = cube(&mut app);
        let medium = SmokeMedium { sigma_t, albedo: LinearRgba::rgb(0.9, 0.6, 0.3), g: 0.0 };
        let dark = SmokeEnvironment::constant(Vec3::ZERO, 1.0);
        let settings = SmokeConstellation { shading, ..default() };
        spawn((volume, medium, dark, Transform::from_scale(Vec3::splat(side)), settings), &mut app);
        let light = DirectionalLight { illuminance, color: Color::WHITE, ..default() };
        app.app.world_mut().spawn((light, Transform::default().looking_to(Vec3::NEG_Z, Vec3::Y)));
        let found = middle(&draw(&mut app));
        for (found, albedo) in found.into_iter().zip([0.9, 0.6, 0.3]) {
            let off = found / expected(albedo, through) - 1.0;
            println!("{shading:?}: {found}, {off:.4} off");
            // The grid fades over the outermost half cell: an eighth of a cell less at each face, of 32. Rays through the
            // middle's pixels are half a degree aslant.
            assert!(off.abs() < 0.01, "{shading:?}: {found} is {off} off");
        }
    }
}

#[test]
fn white_smoke_that_light_reaches_unhindered_is_white() {
    // Without shadows, albedo 1 under light L from everywhere sends L (1 - transmittance): whatever the number of lights,
    // and whatever the phase function where there are many.
    for (lights, g) in [(1, 0.0), (23, 0.0), (256, 0.3)] {
        let mut app = app();
        let volume = cube(&mut app);
        let medium = SmokeMedium { sigma_t: 2.0, albedo: LinearRgba::WHITE, g };
        let sky = SmokeEnvironment::constant(Vec3::new(3.0, 2.0, 1.0), 0.5);
        let settings =
            SmokeConstellation { lights, shading: ConstellationShading::Primary, view_step: 1.0, ..default() };
        spawn((volume, medium, sky, Transform::from_scale(Vec3::splat(1.0)), settings), &mut app);
        let found = middle(&draw(&mut app));
        println!("{lights} lights, g {g}: {found:?}");
        for (value, sky) in found.into_iter().zip([1.5, 1.0, 0.5]) {
            assert!((value / (sky * found[3]) - 1.0).abs() < 0.005, "{lights} lights, g {g}: {found:?}");
        }
    }
}

#[test]
fn mask_and_distance_map_change_nothing_but_the_time() {
    let picture = |shading, mask, skip_empty| {
        let mut app = app();
        let smoke = smoke(&mut app);
        let settings = SmokeConstellation { lights: 4, shading, mask, skip_empty, view_step: 1.0, ..default() };
        spawn((smoke, settings), &mut app);
        // A mesh in the smoke ends some rays.
        mesh(&mut app, Sphere::new(0.3), LinearRgba::rgb(0.1, 0.1, 0.1), Transform::from_xyz(0.2, 0.0, 0.0));
        draw(&mut app)
    };
    for shading in [ConstellationShading::Alpha, ConstellationShading::SelfShadow] {
        let plain = picture(shading, false, false);
        save_radiance(&format!("constellation_{shading:?}").to_lowercase(), SIZE, &plain);
        let largest = plain.iter().flatten().fold(0.0f32, |largest, value| largest.max(*value));
        for (mask, skip_empty) in [(true, false), (false, true), (true, true)] {
            let other = picture(shading, mask, skip_empty);
            let off = plain.iter().flatten().zip(other.iter().flatten()).fold(0.0f32, |d, (a, b)| d.max((a - b).abs()));
            println!("{shading:?}, mask {mask}, skip {skip_empty}: {} off", off / largest);
            assert!(off < 0.005 * largest, "{shading:?}, mask {mask}, skip {skip_empty}: {}", off / largest);
        }
    }
}

#[test]
fn draws_and_slabs_add_up() {
    // 20 lights take five draws; a pane in the smoke that cannot be seen cuts it into two slabs.
    let picture = |pane: bool, msaa: Msaa| {
        let mut app = app();
        let smoke = smoke(&mut app);
        let settings = SmokeConstellation { lights: 20, view_step: 2.0, shadow_step: 4.0, ..default() };
        spawn((smoke, settings), &mut app);
        let world = app.app.world_mut();
        let mut cameras = world.query_filtered::<&mut Msaa, With<Camera3d>>();
        cameras.iter_mut(world).for_each(|mut samples| *samples = msaa);
        if pane {
            let mesh = world.resource_mut::<Assets<Mesh>>().add(Rectangle::new(4.0, 4.0));
            let base_color = Color::linear_rgba(1.0, 1.0, 1.0, 0.0);
            let material = StandardMaterial { base_color, alpha_mode: AlphaMode::Blend, unlit: true, ..default() };
            let material = world.resource_mut::<Assets<StandardMaterial>>().add(material);
            world.spawn((Mesh3d(mesh), MeshMaterial3d(material)));
        }
        draw(&mut app)
    };
    let whole = picture(false, Msaa::Off);
    let black = vec![[0.0; 4]; whole.len()];
    for (pane, msaa) in [(true, Msaa::Off), (true, Msaa::Sample4)] {
        let off = rms(&picture(pane, msaa), &whole) / rms(&whole, &black);
        println!("pane {pane}, {msaa:?}: {off:.1e} off");
        // Sums of halves.
        assert!(off < 2e-3, "pane {pane}, {msaa:?}: {off}");
    }
}

#[test]
fn a_constellation_is_found_once_and_needs_no_rbfs() {
    let mut app = app();
    let smoke = smoke(&mut app);
    let settings = SmokeConstellation { lights: 4, ..default() };
    let volume = spawn((smoke, settings, SmokeScattering::MULTIPLE), &mut app);
    draw(&mut app);
    for pass in ["pair_matrix", "incident_light", "scattering", "diffusion", "outgoing", "volume"] {
        assert_eq!(dispatched(&app, &format!("smoke_{pass}")), 0, "{pass}");
    }
    let passes = ["lights", "distance", "mask"].map(|pass| format!("smoke_constellation_{pass}"));
    let count = |app: &Headless| passes.each_ref().map(|pass| dispatched(app, pass));
    let mut before = count(&app);
    assert_eq!(before, [2, 3, 1], "once, and nothing again in a static scene");
    let choice = app.app.world().resource::<SmokeRenderStats>().scattering(volume).unwrap();
    assert!(!choice.multiple, "light scatters once, whatever was asked for");
    let mut after = |app: &mut Headless| {
        app.app.update();
        let now = count(app);
        let difference = core::array::from_fn(|i| now[i] - before[i]);
        before = now;
        difference
    };
    let set = |app: &mut Headless, settings: SmokeConstellation| {
        app.app.world_mut().entity_mut(volume).insert(settings);
    };
    let turned = Transform::from_scale(Vec3::splat(3.0)).with_rotation(Quat::from_rotation_y(0.5));
    app.app.world_mut().entity_mut(volume).insert(turned);
    assert_eq!(after(&mut app), [0, 0, 1], "the volume turns, and the lights about it");
    let brighter = SmokeEnvironment::constant(Vec3::ONE, 2.0);
    app.app.world_mut().entity_mut(volume).insert(brighter);
    assert_eq!(after(&mut app), [0, 0, 0], "intensity is applied as the picture is drawn");
    set(&mut app, SmokeConstellation { lights: 5, ..settings });
    assert_eq!(after(&mut app), [1, 0, 0], "lights are cut anew");
    set(&mut app, SmokeConstellation { lights: 5, mask: false, ..settings });
    assert_eq!(after(&mut app), [0, 0, 0], "no mask");
}

#[test]
fn a_turned_image_turns_its_lights() {
    // A sky with a bright patch, not symmetric in anything. Turning image and smoke and camera together changes nothing, and
    // the lights, found in the image's own axes, are the same ones.
    let (width, height) = (32, 16);
    let texel = |i: u32| {
        let (x, y) = (i % width, i / width);
        let bright = if (20..23).contains(&x) && (3..6).contains(&y) { 30.0 } else { 0.2 + y as f32 * 0.01 };
        [bright, 0.8 * bright, 0.5 * bright + x as f32 * 0.005, 1.0]
    };
    let data: Vec<u8> = (0..width * height).flat_map(texel).flat_map(f32::to_le_bytes).collect();
    let picture = |angle: f32| {
        let mut app = app();
        let (volume, medium, _, _) = smoke(&mut app);
        let size = Extent3d { width, height, depth_or_array_layers: 1 };
        let usage = RenderAssetUsages::default();
        let image = Image::new(size, TextureDimension::D2, data.clone(), TextureFormat::Rgba32Float, usage);
        let image = app.app.world_mut().resource_mut::<Assets<Image>>().add(image);
        let rotation = Quat::from_rotation_y(angle);
        let sky = SmokeEnvironment::Equirect { image, intensity: 1.0, rotation };
        let at = Transform::from_scale(Vec3::splat(3.0)).with_rotation(rotation);
        let settings = SmokeConstellation { lights: 4, view_step: 1.0, shadow_step: 2.0, ..default() };
        spawn((volume, medium, sky, at, settings), &mut app);
        let world = app.app.world_mut();
        let mut cameras = world.query_filtered::<&mut Transform, With<Camera3d>>();
        for mut camera in cameras.iter_mut(world) {
            camera.rotate_around(Vec3::ZERO, rotation);
        }
        draw(&mut app)
    };
    let straight = picture(0.0);
    for angle in [0.37, 1.9] {
        let off = rms(&picture(angle), &straight) / rms(&straight, &vec![[0.0; 4]; straight.len()]);
        println!("turned by {angle}: {off:.1e} off");
        // Rounding, where rays are along the edges of cells.
        assert!(off < 1e-3, "turned by {angle}: {off}");
    }
}
