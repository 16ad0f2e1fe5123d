//! What is computed when: nothing twice, and nothing that did not change.

use bevy::asset::RenderAssetUsages;
use bevy::prelude::*;
use bevy::render::render_resource::{Extent3d, TextureDimension, TextureFormat};
use bevy_smoke::headless::Headless;
use bevy_smoke::prelude::*;
use bevy_smoke::render::SmokeRenderStats;

use crate::scene::*;

/// The dispatches that one update makes after a change: environment, density, coarse, pair matrix, incident light,
/// scattering, outgoing, volume.
fn after(app: &mut Headless, change: impl FnOnce(&mut World)) -> [u32; 8] {
    let before = dispatches(app);
    change(app.app.world_mut());
    app.app.update();
    let now = dispatches(app);
    assert_eq!(now[8] - before[8], 1, "the view is drawn every frame");
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
    assert_eq!(dispatches(&app)[..8], [0, 1, 1, 1, 1, 1, 1, 1], "the first frame, once each");
    assert_eq!(after(&mut app, |_| {}), [0; 8], "a static scene");
    assert_eq!(after(&mut app, move_camera), [0; 8], "isotropic smoke looks the same from everywhere");
    let relit = [0, 0, 0, 0, 1, 1, 1, 1];
    let denser = [0, 0, 0, 1, 1, 1, 1, 1];
    assert_eq!(after(&mut app, set::<SmokeMedium>(|m| m.sigma_t *= 1.5)), denser);
    assert_eq!(after(&mut app, set::<SmokeMedium>(|m| m.albedo.red = 0.1)), relit);
    assert_eq!(after(&mut app, set::<Transform>(|t| t.rotate_y(0.3))), relit);
    assert_eq!(after(&mut app, set::<Transform>(|t| t.scale *= 1.1)), denser);
    assert_eq!(after(&mut app, set::<Transform>(|t| t.translation.x += 0.2)), [0; 8], "distant light stays the same");
    let brighter = set::<SmokeEnvironment>(|e| {
        if let SmokeEnvironment::Coefficients { intensity, .. } = e {
            *intensity *= 2.0;
        }
    });
    assert_eq!(after(&mut app, brighter), [0; 8], "radiance is linear in the light");
    let bluer = set::<SmokeEnvironment>(|e| *e = SmokeEnvironment::constant(Vec3::Z, 1.0));
    assert_eq!(after(&mut app, bluer), relit);
}

#[test]
fn anisotropic_smoke_follows_the_eye() {
    let mut app = scene(0.5);
    assert_eq!(after(&mut app, |_| {}), [0; 8]);
    assert_eq!(after(&mut app, move_camera), [0, 0, 0, 0, 0, 0, 1, 1]);
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
    assert_eq!(dispatches(&app)[..8], [0, 1, 1, 2, 2, 2, 2, 2]);
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

/// An environment image whose content changes lights the smoke anew.
#[test]
fn a_changed_image_is_projected_again() {
    let mut app = app();
    let image = Image::new_fill(
        Extent3d { width: 8, height: 4, depth_or_array_layers: 1 },
        TextureDimension::D2,
        bytemuck::cast_slice(&[1.0_f32, 1.0, 1.0, 1.0]),
        TextureFormat::Rgba32Float,
        RenderAssetUsages::default(),
    );
    let image = app.app.world_mut().resource_mut::<Assets<Image>>().add(image);
    let (volume, medium, _, transform) = smoke(&mut app);
    app.app.world_mut().spawn((volume, medium, SmokeEnvironment::equirect(image.clone(), 1.0), transform));
    let camera = camera(&app);
    app.app.world_mut().spawn(camera);
    let white = draw(&mut app);
    assert_eq!(dispatches(&app)[..8], [2, 1, 1, 1, 1, 1, 1, 1]);
    let changed = after(&mut app, |world| {
        let mut images = world.resource_mut::<Assets<Image>>();
        let mut image = images.get_mut(&image).unwrap();
        let red = [2.0_f32, 0.0, 0.0, 1.0];
        image.data = Some(bytemuck::cast_slice(&red).repeat(32));
    });
    assert_eq!(changed, [2, 0, 0, 0, 1, 1, 1, 1]);
    // Multiple scattering is solved to half a percent, from where it was before.
    for (red, white) in app.float_pixels().iter().zip(&white) {
        assert!((red[0] - 2.0 * white[0]).abs() <= 1e-6 + 1e-2 * white[0] && red[1] == 0.0, "{red:?} {white:?}");
    }
}

/// Showing another frame unpacks it once and lights it.
#[test]
fn frames_are_unpacked_when_they_are_shown() {
    let mut app = scene(0.0);
    let world = app.app.world_mut();
    let mut volumes = world.query::<&mut SmokeVolume>();
    let handle = volumes.single(world).unwrap().animation().unwrap().clone();
    let mut animation = world.resource::<Assets<SmokeAnimation>>().get(&handle).unwrap().clone();
    let mut frame = (**animation.frames.get(0).unwrap()).clone();
    let half = frame.ids.len() / 2;
    frame.rbfs.rbfs.truncate(half);
    frame.ids.truncate(half);
    let first = (**animation.frames.get(0).unwrap()).clone();
    animation.frames = vec![first, frame].into();
    let both = world.resource_mut::<Assets<SmokeAnimation>>().add(animation);
    *volumes.single_mut(world).unwrap() = SmokeVolume::new(both);
    world.query::<&mut SmokePlayback>().single_mut(world).unwrap().paused = true;
    let first = draw(&mut app);
    let show = |frame| set::<SmokePlayback>(move |playback| *playback = SmokePlayback::at_frame(frame));
    assert_eq!(after(&mut app, show(1)), [0, 1, 1, 1, 1, 1, 1, 1]);
    assert!(rms(&app.float_pixels(), &first) > 1e-3, "the second frame looks like the first");
    assert_eq!(after(&mut app, show(0)), [0, 1, 1, 1, 1, 1, 1, 1], "one moment is kept a volume, whatever was before");
    // Multiple scattering is solved to half a percent, from where it was before.
    assert!(rms(&app.float_pixels(), &first) < 2e-3);
    let memory = app.app.world().resource::<SmokeRenderStats>().memory();
    assert_eq!(memory.moments, memory.moments_created, "moments are rewritten in place");
    // Past the end the last frame is shown.
    after(&mut app, show(7));
    assert!(rms(&app.float_pixels(), &first) > 1e-3);
}

/// Smoke without RBFs is drawn from its residual alone: there is density, and nowhere a source of radiance.
#[test]
fn smoke_without_rbfs_is_black_but_there() {
    let mut app = app();
    let (volume, medium, environment, transform) = smoke(&mut app);
    let mut animations = app.app.world_mut().resource_mut::<Assets<SmokeAnimation>>();
    let mut animation = animations.get(volume.animation().unwrap()).unwrap().clone();
    let mut frame = (**animation.frames.get(0).unwrap()).clone();
    frame.rbfs.rbfs.clear();
    frame.ids.clear();
    animation.frames = vec![frame].into();
    let volume = SmokeVolume::new(animations.add(animation));
    app.app.world_mut().spawn((volume, medium, environment, transform));
    let camera = camera(&app);
    app.app.world_mut().spawn(camera);
    let pixels = draw(&mut app);
    assert!(coverage(&pixels) > 10.0);
    assert!(pixels.iter().all(|pixel| pixel[..3] == [0.0; 3]));
}
