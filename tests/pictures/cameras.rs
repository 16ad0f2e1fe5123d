//! Where the eye is, how it projects, and into what.

use bevy::camera::Viewport;
use bevy::camera::visibility::RenderLayers;
use bevy::core_pipeline::tonemapping::Tonemapping;
use bevy::prelude::*;
use bevy::render::render_resource::TextureFormat;
use bevy_smoke::headless::Headless;
use bevy_smoke::prelude::*;

use crate::scene::*;

/// Moving, turning and scaling the volume with its camera and its light changes nothing but the scale of its depth.
#[test]
fn placement_is_relative() {
    let picture = |world: Transform, sigma_t: f32| {
        let mut app = app();
        let (volume, medium, _, transform) = smoke(&mut app);
        // A light from +X in the volume's axes, before it is turned: order-4 coefficients, 1 + x.
        let mut coefficients = [Vec3::ZERO; 16];
        coefficients[0] = Vec3::splat(3.544_907_7);
        let axis = world.rotation * Vec3::X * (4.0 * std::f32::consts::PI / 3.0_f32).sqrt();
        (coefficients[3], coefficients[1], coefficients[2]) =
            (Vec3::splat(-axis.x), Vec3::splat(-axis.y), Vec3::splat(axis.z));
        let environment = SmokeEnvironment::Coefficients { coefficients, intensity: 1.0 };
        let medium = SmokeMedium { sigma_t, g: 0.4, ..medium };
        app.app.world_mut().spawn((volume, medium, environment, world * transform));
        let camera = camera(&app);
        let camera = app.app.world_mut().spawn(camera).id();
        let mut entity = app.app.world_mut().entity_mut(camera);
        let placed = world * *entity.get::<Transform>().unwrap();
        // A camera has no scale of its own.
        *entity.get_mut::<Transform>().unwrap() = placed.with_scale(Vec3::ONE);
        draw(&mut app)
    };
    let still = picture(Transform::IDENTITY, 4.0);
    let rotation = Quat::from_euler(EulerRot::XYZ, 0.3, 1.9, -0.7);
    let moved = Transform::from_xyz(10.0, -4.0, 7.0).with_rotation(rotation).with_scale(Vec3::splat(2.0));
    // Twice as large is twice as deep: half the extinction gives the same picture.
    let moved = picture(moved, 2.0);
    let (error, level) = (rms(&still, &moved), rms(&still, &vec![[0.0; 4]; still.len()]));
    assert!(coverage(&still) > 100.0);
    // f32 positions ten metres out, and f16 pictures.
    assert!(error < 2e-3 * level, "{error} of {level}");
}

/// From inside, smoke fills the view, and walking out of it changes the picture little by little.
#[test]
fn camera_inside() {
    let size = UVec2::splat(96);
    let picture = |z: f32| {
        let mut app = Headless::new(size, TextureFormat::Rgba16Float).unwrap();
        let volume = smoke(&mut app);
        app.app.world_mut().spawn(volume);
        let camera = camera(&app);
        let camera = app.app.world_mut().spawn(camera).id();
        let mut transform = Transform::from_xyz(0.1, -0.9, z);
        transform.look_at(Vec3::new(0.0, 0.6, 0.0), Vec3::Y);
        app.app.world_mut().entity_mut(camera).insert(transform);
        draw(&mut app)
    };
    let inside = picture(0.2);
    let filled = inside.iter().filter(|pixel| pixel[3] > 0.5).count();
    assert!(filled * 10 > inside.len() * 8, "{filled} of {} pixels", inside.len());
    assert!(rms(&inside, &picture(0.202)) < 0.01, "a step of 2 mm jumps");
    save_radiance("inside", size, &inside);
}

/// Opaque black behind the smoke: Bevy blends the second camera's output by its alpha.
fn over_black() -> Camera {
    Camera { clear_color: ClearColorConfig::Custom(Color::BLACK), ..default() }
}

/// Split screen: each half is what a camera of its own image would see, and shares the lighting of the other.
#[test]
fn two_cameras_share_the_light() {
    let half = UVec2::new(SIZE.x / 2, SIZE.y);
    let eyes = [Transform::from_xyz(0.0, 0.0, 6.0), Transform::from_xyz(6.0, 0.0, 0.0).looking_at(Vec3::ZERO, Vec3::Y)];
    let alone: Vec<Vec<[f32; 4]>> = eyes
        .iter()
        .map(|&eye| {
            let mut app = Headless::new(half, TextureFormat::Rgba16Float).unwrap();
            let volume = smoke(&mut app);
            app.app.world_mut().spawn(volume);
            let camera = camera(&app);
            app.app.world_mut().spawn(camera).insert((eye, over_black()));
            draw(&mut app)
        })
        .collect();

    let mut app = app();
    let volume = smoke(&mut app);
    app.app.world_mut().spawn(volume);
    for (order, eye) in (0..).zip(eyes) {
        let camera = camera(&app);
        let viewport =
            Viewport { physical_position: UVec2::new(order as u32 * half.x, 0), physical_size: half, ..default() };
        let clear_color = if order == 0 { ClearColorConfig::Custom(Color::BLACK) } else { ClearColorConfig::None };
        let settings = Camera { viewport: Some(viewport), order, clear_color, ..default() };
        app.app.world_mut().spawn(camera).insert((settings, eye));
    }
    let both = draw(&mut app);
    save_radiance("split_screen", SIZE, &both);
    for (order, alone) in alone.iter().enumerate() {
        let seen: Vec<[f32; 4]> = (0..half.element_product())
            .map(|i| both[((i / half.x) * SIZE.x + order as u32 * half.x + i % half.x) as usize])
            .collect();
        assert!(rms(&seen, &vec![[0.0, 0.0, 0.0, 1.0]; seen.len()]) > 0.1);
        assert!(rms(&seen, alone) < 1e-3, "half {order}: {}", rms(&seen, alone));
    }
    let [lighting @ .., view] = dispatches(&app);
    assert_eq!(lighting, [0, 1, 1, 1, 1, 1, 1, 1]);
    assert!(view >= 2);
}

/// `Visibility`, `RenderLayers` and the frustum hide smoke as they hide meshes, and hidden smoke costs nothing.
#[test]
fn hidden_smoke_is_not_drawn() {
    let draws = |change: &dyn Fn(&mut EntityWorldMut)| {
        let mut app = app();
        let volume = smoke(&mut app);
        let mut entity = app.app.world_mut().spawn(volume);
        change(&mut entity);
        let camera = camera(&app);
        app.app.world_mut().spawn(camera);
        for _ in 0..10 {
            app.app.update();
        }
        assert_eq!(coverage(&app.float_pixels()) > 0.0, dispatches(&app)[8] > 0);
        dispatches(&app)
    };
    assert!(draws(&|_| {})[8] > 0);
    assert_eq!(
        draws(&|volume| {
            volume.insert(Visibility::Hidden);
        }),
        [0; 9]
    );
    assert_eq!(
        draws(&|volume| {
            volume.insert(RenderLayers::layer(3));
        }),
        [0; 9]
    );
    // To the side of the frustum: culled, not only off the screen.
    let aside = draws(&|volume| {
        volume.insert(Transform::from_xyz(40.0, 0.0, 0.0));
    });
    // Its shadow may be in view, so its density is known. Bounds are known one frame after the asset: until then the volume
    // counts as seen, and is lit once.
    assert!(aside == [0, 1, 1, 0, 0, 0, 0, 0, 0] || aside == [0, 1, 1, 1, 1, 1, 1, 1, 0], "{aside:?}");
    let behind = draws(&|volume| {
        volume.insert(Transform::from_xyz(0.0, 0.0, 40.0));
    });
    assert_eq!(behind[6], 0);
}

/// A display target holds what the radiance target holds, encoded and, where asked for, tone-mapped.
#[test]
fn display_targets_match_radiance_targets() {
    let mut app = app();
    let volume = smoke(&mut app);
    app.app.world_mut().spawn(volume);
    let camera_bundle = camera(&app);
    app.app.world_mut().spawn(camera_bundle);
    let radiance = draw(&mut app);
    let display = |tonemapping: Tonemapping| {
        let mut app = Headless::new(SIZE, TextureFormat::Rgba8UnormSrgb).unwrap();
        let volume = smoke(&mut app);
        app.app.world_mut().spawn(volume);
        let camera = camera(&app);
        app.app.world_mut().spawn(camera).remove::<bevy::camera::Hdr>().insert(tonemapping);
        app.settle().unwrap();
        app.app.update();
        app.pixels()
    };
    let encoded = |value: f32| f32::from(Srgba::from(LinearRgba::rgb(value, value, value)).to_u8_array()[0]);
    let plain = display(Tonemapping::None);
    let reinhard = display(Tonemapping::Reinhard);
    for (i, pixel) in radiance.iter().enumerate() {
        for c in 0..3 {
            let found = f32::from(plain[4 * i + c]);
            assert!((found - encoded(pixel[c])).abs() <= 1.0, "{found} for {pixel:?}");
            // Reinhard's L / (1 + L) on the smoke's own colour, premultiplied by its opacity.
            let own = pixel[c] / pixel[3].max(1e-5);
            let mapped = encoded(pixel[3] * own / (1.0 + own));
            let found = f32::from(reinhard[4 * i + c]);
            assert!((found - mapped).abs() <= 1.5, "{found}, not {mapped}, for {pixel:?}");
        }
    }
    let tony = display(Tonemapping::TonyMcMapface);
    assert!(tony.as_chunks::<4>().0.iter().any(|pixel| pixel[0] > 60));
}

/// A non-uniform scale has a defined result: the box is stretched, and extinction follows the cube root of its volume.
#[test]
fn non_uniform_scale_is_drawn() {
    let picture = |scale: Vec3, sigma_t: f32| {
        let mut app = app();
        let (volume, medium, environment, _) = smoke(&mut app);
        let transform = Transform::from_scale(scale);
        app.app.world_mut().spawn((volume, SmokeMedium { sigma_t, ..medium }, environment, transform));
        let camera = parallel_camera(&app, Transform::from_xyz(0.0, 0.0, 9.0));
        app.app.world_mut().spawn(camera);
        draw(&mut app)
    };
    // Looked at along z, a box twice as deep covers the same pixels; its extinction grows by the cube root of 2.
    let (stretched, uniform) =
        (picture(Vec3::new(3.0, 3.0, 6.0), 2.0), picture(Vec3::splat(3.0), 2.0 * 2.0_f32.cbrt()));
    assert!(coverage(&uniform) > 100.0);
    assert!(rms(&stretched, &uniform) < 1e-3, "{}", rms(&stretched, &uniform));
    // A box without volume is not drawn, and nothing breaks.
    let mut app = app();
    let (volume, medium, environment, _) = smoke(&mut app);
    app.app.world_mut().spawn((volume, medium, environment, Transform::from_scale(Vec3::new(1.0, 0.0, 1.0))));
    let camera = camera(&app);
    app.app.world_mut().spawn(camera);
    for _ in 0..5 {
        app.app.update();
    }
    assert_eq!(dispatches(&app)[6], 0);
}
