//! Shadows of smoke on meshes, of spheres on smoke, and of meshes on meshes.

use bevy::camera::Viewport;
use bevy::core_pipeline::prepass::{DeferredPrepass, DepthPrepass};
use bevy::diagnostic::DiagnosticsStore;
use bevy::light::EnvironmentMapLight;
use bevy::pbr::DefaultOpaqueRendererMethod;
use bevy::prelude::*;
use bevy::render::render_resource::TextureFormat;
use bevy_smoke::headless::Headless;
use bevy_smoke::prelude::*;
use bevy_smoke::render::SmokeRenderStats;

use crate::scene::*;

pub const PICTURE: UVec2 = UVec2::new(128, 96);

/// A white floor under a constant sky and a sun, with the camera that looks down on it from the side.
pub fn stage() -> (Headless, Entity) {
    let mut app = Headless::new(PICTURE, TextureFormat::Rgba16Float).unwrap();
    stand(&mut app);
    let eye = Transform::from_xyz(0.0, 3.0, 9.0).looking_at(Vec3::new(0.0, 1.2, 0.0), Vec3::Y);
    let camera = camera(&app);
    let camera = app.app.world_mut().spawn(camera).insert(eye).id();
    (app, camera)
}

/// The floor and its light.
fn stand(app: &mut Headless) {
    let world = app.app.world_mut();
    let floor = world.resource_mut::<Assets<Mesh>>().add(Plane3d::default().mesh().size(40.0, 40.0));
    let material = StandardMaterial { perceptual_roughness: 1.0, reflectance: 0.0, ..Color::WHITE.into() };
    let material = world.resource_mut::<Assets<StandardMaterial>>().add(material);
    world.spawn((Mesh3d(floor), MeshMaterial3d(material)));
    let sun = DirectionalLight { illuminance: 2.0, ..default() };
    world.spawn((sun, Transform::default().looking_to(Vec3::new(1.0, -1.0, 0.3), Vec3::Y)));
    world.insert_resource(GlobalAmbientLight { brightness: 0.5, ..default() });
}

/// Smoke that stands on the floor, lit by what lights the floor.
pub fn plume(app: &mut Headless, at: Vec3) -> Entity {
    let (volume, medium, _, transform) = smoke(app);
    app.app.world_mut().spawn((volume, medium, transform.with_translation(at))).id()
}

/// The picture of the floor alone.
fn clear() -> Vec<[f32; 4]> {
    let (mut app, _) = stage();
    for _ in 0..20 {
        app.app.update();
    }
    app.float_pixels()
}

/// The pixel that shows a point of the world.
fn pixel(point: Vec3) -> usize {
    let eye = Transform::from_xyz(0.0, 3.0, 9.0).looking_at(Vec3::new(0.0, 1.2, 0.0), Vec3::Y);
    let p = eye.compute_affine().inverse().transform_point3(point);
    let scale = (0.5 * PICTURE.y as f32) / 0.3_f32.tan() / -p.z;
    let at = (PICTURE.as_vec2() / 2.0 + Vec2::new(p.x, -p.y) * scale).as_uvec2();
    (at.x + PICTURE.x * at.y) as usize
}

/// The sky's share of the floor's light: π/2 lux, the sun's being 2 cos θ.
const SKY: f32 = 1.571 / (1.571 + 1.383);

/// In the shadow that the sun throws from the middle of the smoke.
const SHADOW: Vec3 = Vec3::new(1.6, 0.0, 0.5);

#[test]
fn smoke_darkens_the_floor_and_nothing_far_away() {
    let (mut app, _) = stage();
    plume(&mut app, Vec3::Y * 1.7);
    let shaded = draw(&mut app);
    save_radiance("floor", PICTURE, &shaded);
    let clear = clear();
    let share = |at: Vec3| shaded[pixel(at)][0] / clear[pixel(at)][0];
    // A sun of 1.37 lux there and a sky of 1.57: what the smoke leaves of both.
    assert!(share(SHADOW) > 0.3 && share(SHADOW) < 0.85, "{}", share(SHADOW));
    // Beside the smoke only the sky is missing, and little of it.
    let beside = share(Vec3::new(-1.2, 0.0, 0.8));
    assert!(beside > 0.9 && beside < 0.995, "{beside}");
    // The corners see none of it, to the last bit: nor does the void.
    let far = [Vec3::new(-9.0, 0.0, -19.0), Vec3::new(9.5, 0.0, -19.5)].map(pixel);
    assert!(far.into_iter().chain([0]).all(|i| shaded[i] == clear[i]));
}

#[test]
fn shadows_are_the_same_however_the_view_is_drawn() {
    let picture = |deferred: bool, msaa: Msaa| {
        let (mut app, camera) = stage();
        plume(&mut app, Vec3::Y * 1.7);
        let world = app.app.world_mut();
        world.entity_mut(camera).insert(msaa);
        if deferred {
            world.insert_resource(DefaultOpaqueRendererMethod::deferred());
            world.entity_mut(camera).insert((DepthPrepass, DeferredPrepass));
        }
        draw(&mut app)
    };
    let forward = picture(false, Msaa::Off);
    for (name, other) in [("deferred", picture(true, Msaa::Off)), ("multisampled", picture(false, Msaa::Sample4))] {
        let at = [SHADOW, Vec3::new(-1.2, 0.0, 0.8), Vec3::new(2.0, 0.0, 0.6)].map(pixel);
        for i in at {
            // The deferred buffer's 8-bit albedo costs 1 %, the samples' places within a pixel at the shadow's edge 2 %.
            let ratio = other[i][0] / forward[i][0];
            assert!((ratio - 1.0).abs() < 0.03, "{name}: {ratio}");
        }
        save_radiance(&format!("floor_{name}"), PICTURE, &other);
    }
}

/// Split screen, one half without shadows: each is what a camera of its own image would see.
#[test]
fn cameras_see_their_own_shadows() {
    let half = UVec2::new(PICTURE.x / 2, PICTURE.y);
    let eyes = [(3.0, true), (-3.0, false)].map(|(x, smoke)| {
        let eye = Transform::from_xyz(x, 3.0, 9.0).looking_at(Vec3::new(0.0, 1.0, 0.0), Vec3::Y);
        (eye, SmokeShadows { smoke, ..default() })
    });
    let alone = eyes.map(|eye| {
        let mut app = Headless::new(half, TextureFormat::Rgba16Float).unwrap();
        stand(&mut app);
        plume(&mut app, Vec3::Y * 1.7);
        let camera = camera(&app);
        app.app.world_mut().spawn(camera).insert(eye);
        draw(&mut app)
    });
    let mut app = Headless::new(PICTURE, TextureFormat::Rgba16Float).unwrap();
    stand(&mut app);
    plume(&mut app, Vec3::Y * 1.7);
    for (i, eye) in eyes.into_iter().enumerate() {
        let physical_position = UVec2::new(half.x * i as u32, 0);
        let viewport = Some(Viewport { physical_position, physical_size: half, ..default() });
        let clear_color = if i == 0 { ClearColorConfig::Custom(Color::NONE) } else { ClearColorConfig::None };
        let camera = camera(&app);
        app.app.world_mut().spawn(camera).insert(eye).insert(Camera {
            viewport,
            order: i as isize,
            clear_color,
            ..default()
        });
    }
    let both = draw(&mut app);
    save_radiance("split_shadows", PICTURE, &both);
    for (i, alone) in alone.iter().enumerate() {
        let of_half = |y: u32| &both[(PICTURE.x * y + half.x * i as u32) as usize..][..half.x as usize];
        let seen: Vec<[f32; 4]> = (0..half.y).flat_map(of_half).copied().collect();
        // f16 pixels; the second camera's picture is blended over what was there.
        let floor = |pixels: &[[f32; 4]]| pixels[(half.x * (half.y - 12)) as usize..].to_vec();
        assert!(rms(&floor(&seen), &floor(alone)) < 1e-3, "camera {i}: {}", rms(&floor(&seen), &floor(alone)));
    }
    // The first alone sees the shadow.
    let darkest = |pixels: &[[f32; 4]]| {
        let floor = pixels[(half.x * half.y * 2 / 3) as usize..].iter().map(|pixel| pixel[0]);
        floor.fold(f32::INFINITY, f32::min)
    };
    assert!(darkest(&alone[0]) < 0.8 * darkest(&alone[1]), "{} {}", darkest(&alone[0]), darkest(&alone[1]));
}

/// A scene without smoke has none of its passes, whatever its cameras ask for and whatever could shade.
#[test]
fn scenes_without_smoke_are_left_alone() {
    let (mut app, camera) = stage();
    let world = app.app.world_mut();
    world.spawn(SmokeOccluder::new([(Vec3::Y, 0.5)]));
    world.entity_mut(camera).insert(SmokeShadows::default());
    for _ in 0..10 {
        app.app.update();
    }
    let dispatches = app.app.world().resource::<SmokeRenderStats>().dispatches();
    assert!(dispatches.iter().all(|count| *count == 0), "{dispatches:?}");
    let diagnostics = app.app.world().resource::<DiagnosticsStore>();
    let spans: Vec<_> = diagnostics.iter().filter(|span| span.path().as_str().contains("smoke")).collect();
    assert!(spans.is_empty());
}

#[test]
fn volumes_shade_each_other_and_the_same_ground() {
    let alone = |at: Vec3| {
        let (mut app, _) = stage();
        plume(&mut app, at);
        draw(&mut app)
    };
    // The second stands in the sun's shadow of the first.
    let (first, second) = (Vec3::new(-1.6, 1.7, 0.0), Vec3::new(-0.2, 1.7, 0.4));
    let (mut app, _) = stage();
    plume(&mut app, first);
    plume(&mut app, second);
    let both = draw(&mut app);
    save_radiance("two_volumes", PICTURE, &both);
    let (clear, a, b) = (clear(), alone(first), alone(second));
    // On the ground behind both, sun and sky are each dimmed twice: by less than the shares of the sum multiplied, where
    // both take much of the sun.
    let behind = pixel(Vec3::new(1.5, 0.0, 0.9));
    let share = |picture: &[[f32; 4]]| picture[behind][0] / clear[behind][0];
    assert!(share(&both) < share(&a).min(share(&b)), "{} {} {}", share(&both), share(&a), share(&b));
    assert!(share(&both) > share(&a) * share(&b) - 0.01);
    // The second's own light is less for the first's shadow.
    let lit = |picture: &[[f32; 4]]| {
        (0..3).map(|i| picture[pixel(second + Vec3::Y * (0.2 * i as f32 - 1.0))][0]).sum::<f32>()
    };
    assert!(lit(&both) < 0.97 * lit(&b), "{} of {}", lit(&both), lit(&b));
}

#[test]
fn spheres_shade_smoke_and_meshes_where_they_are_asked_to() {
    let sphere = SmokeOccluder::new([(Vec3::ZERO, 0.7)]);
    let at = Transform::from_xyz(-1.6, 3.2, -0.5);
    let picture = |occluder: bool, on_meshes: bool, smoke: bool| {
        let (mut app, camera) = stage();
        if smoke {
            plume(&mut app, Vec3::Y * 1.7);
        }
        let world = app.app.world_mut();
        if occluder {
            world.spawn((sphere.clone(), at));
        }
        world.entity_mut(camera).insert(SmokeShadows { occluders: on_meshes, ..default() });
        for _ in 0..20 {
            app.app.update();
        }
        app.float_pixels()
    };
    let (open, shaded) = (picture(false, false, true), picture(true, false, true));
    let middle = pixel(Vec3::new(0.0, 1.7, 0.0));
    assert!(shaded[middle][0] < 0.9 * open[middle][0], "{} of {}", shaded[middle][0], open[middle][0]);
    save_radiance("sphere_on_smoke", PICTURE, &shaded);
    // On meshes only where the camera asks, with smoke or without; in closed form, a share 1 − r²h/d³ of a constant sky.
    let beneath = pixel(Vec3::new(-1.6, 0.0, -0.5));
    assert_eq!(picture(true, false, false)[beneath], picture(false, false, false)[beneath]);
    let (on_meshes, clear) = (picture(true, true, false), clear());
    let expected = 1.0 - SKY * 0.49 / 3.2_f32.powi(2);
    let found = on_meshes[beneath][0] / clear[beneath][0];
    // Four bands hold a small ball's shadow to 5 %, which is 0.1 % of the light.
    assert!((found - expected).abs() < 4e-3, "{found} for {expected}");
    save_radiance("sphere_on_floor", PICTURE, &on_meshes);
}

/// An environment map is known to the shadows of spheres from the first frame on, before there is smoke.
#[test]
fn spheres_take_their_share_of_an_environment_map() {
    let picture = |occluder: bool| {
        let (mut app, camera) = stage();
        let world = app.app.world_mut();
        world.insert_resource(GlobalAmbientLight::NONE);
        let mut images = world.resource_mut::<Assets<Image>>();
        let map = EnvironmentMapLight { intensity: 0.5, ..EnvironmentMapLight::solid_color(&mut images, Color::WHITE) };
        world.entity_mut(camera).insert((map, SmokeShadows { occluders: true, ..default() }));
        if occluder {
            world.spawn((SmokeOccluder::new([(Vec3::ZERO, 0.7)]), Transform::from_xyz(-1.6, 3.2, -0.5)));
        }
        for _ in 0..20 {
            app.app.update();
        }
        app.float_pixels()
    };
    let (shaded, clear) = (picture(true), picture(false));
    let beneath = pixel(Vec3::new(-1.6, 0.0, -0.5));
    let expected = 1.0 - SKY * 0.49 / 3.2_f32.powi(2);
    let found = shaded[beneath][0] / clear[beneath][0];
    assert!((found - expected).abs() < 4e-3, "{found} for {expected}");
    let away = pixel(Vec3::new(2.5, 0.0, 1.0));
    assert!(shaded[away][0] > 0.98 * clear[away][0], "{} of {}", shaded[away][0], clear[away][0]);
}
