//! What is computed when: nothing twice, and nothing that did not change.

use bevy::prelude::*;
use bevy_smoke::headless::Headless;
use bevy_smoke::prelude::*;

use crate::scene::*;

/// The dispatches that one update makes after a change: environment, density, coarse, source radiance, outgoing, volume.
fn after(app: &mut Headless, change: impl FnOnce(&mut World)) -> [u32; 6] {
    let before = dispatches(app);
    change(app.app.world_mut());
    app.app.update();
    let now = dispatches(app);
    assert_eq!(now[6] - before[6], 1, "the view is drawn every frame");
    std::array::from_fn(|i| now[i] - before[i])
}

fn set<C: Component<Mutability = bevy::ecs::component::Mutable>>(change: impl Fn(&mut C)) -> impl FnOnce(&mut World) {
    move |world| {
        let mut components = world.query_filtered::<&mut C, With<SmokeVolume>>();
        for mut component in components.iter_mut(world) {
            change(&mut component);
        }
    }
}

fn scene(g: f32) -> Headless {
    let mut app = app();
    let (volume, medium, environment, transform) = smoke(&mut app);
    app.app.world_mut().spawn((volume, SmokeMedium { g, ..medium }, environment, transform));
    let camera = camera(&app);
    app.app.world_mut().spawn(camera);
    draw(&mut app);
    app
}

fn move_camera(world: &mut World) {
    let mut cameras = world.query_filtered::<&mut Transform, With<Camera3d>>();
    for mut transform in cameras.iter_mut(world) {
        transform.translation.x += 0.1;
    }
}

#[test]
fn only_what_changed_is_computed() {
    let mut app = scene(0.0);
    assert_eq!(dispatches(&app)[..6], [0, 1, 1, 1, 1, 1], "the first frame, once each");
    assert_eq!(after(&mut app, |_| {}), [0; 6], "a static scene");
    assert_eq!(after(&mut app, move_camera), [0; 6], "isotropic smoke looks the same from everywhere");
    let relit = [0, 0, 0, 1, 1, 1];
    assert_eq!(after(&mut app, set::<SmokeMedium>(|m| m.sigma_t *= 1.5)), relit);
    assert_eq!(after(&mut app, set::<SmokeMedium>(|m| m.albedo.red = 0.1)), relit);
    assert_eq!(after(&mut app, set::<Transform>(|t| t.rotate_y(0.3))), relit);
    assert_eq!(after(&mut app, set::<Transform>(|t| t.scale *= 1.1)), relit);
    assert_eq!(after(&mut app, set::<Transform>(|t| t.translation.x += 0.2)), [0; 6], "distant light stays the same");
    let brighter = set::<SmokeEnvironment>(|e| {
        if let SmokeEnvironment::Coefficients { intensity, .. } = e {
            *intensity *= 2.0;
        }
    });
    assert_eq!(after(&mut app, brighter), [0; 6], "radiance is linear in the light");
    let bluer = set::<SmokeEnvironment>(|e| *e = SmokeEnvironment::constant(Vec3::Z, 1.0));
    assert_eq!(after(&mut app, bluer), relit);
}

#[test]
fn anisotropic_smoke_follows_the_eye() {
    let mut app = scene(0.5);
    assert_eq!(after(&mut app, |_| {}), [0; 6]);
    assert_eq!(after(&mut app, move_camera), [0, 0, 0, 0, 1, 1]);
}

/// Volumes that share an asset share its density; each has its own light.
#[test]
fn density_is_shared_between_volumes() {
    let mut app = app();
    let (volume, medium, environment, transform) = smoke(&mut app);
    for x in [-0.5, 0.5] {
        let transform = Transform::from_xyz(x, 0.0, 0.0) * transform;
        app.app.world_mut().spawn((volume.clone(), medium, environment.clone(), transform));
    }
    let camera = camera(&app);
    app.app.world_mut().spawn(camera);
    draw(&mut app);
    assert_eq!(dispatches(&app)[..6], [0, 1, 1, 2, 2, 2]);
}

/// A despawned volume disappears, and one that is spawned again is drawn again.
#[test]
fn volumes_come_and_go() {
    let mut app = scene(0.0);
    assert!(coverage(&app.float_pixels()) > 0.0);
    let world = app.app.world_mut();
    let volumes: Vec<Entity> = world.query_filtered::<Entity, With<SmokeVolume>>().iter(world).collect();
    for volume in volumes {
        world.despawn(volume);
    }
    app.app.update();
    app.app.update();
    assert_eq!(coverage(&app.float_pixels()), 0.0);
    let volume = smoke(&mut app);
    app.app.world_mut().spawn(volume);
    draw(&mut app);
    assert!(coverage(&app.float_pixels()) > 0.0);
}
