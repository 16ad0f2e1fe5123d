//! Shadows of smoke on meshes.

use bevy::prelude::*;
use bevy::render::render_resource::TextureFormat;
use bevy_smoke::headless::Headless;
use bevy_smoke::prelude::*;

use crate::scene::*;

/// Smoke that stands on a white floor under a sky and a sun; the camera looks down on it from the side.
pub fn stage(size: UVec2) -> Headless {
    let mut app = Headless::new(size, TextureFormat::Rgba16Float).unwrap();
    let (volume, medium, _, transform) = smoke(&mut app);
    let world = app.app.world_mut();
    world.spawn((volume, medium, transform.with_translation(Vec3::new(0.0, 1.7, 0.0))));
    let floor = world.resource_mut::<Assets<Mesh>>().add(Plane3d::default().mesh().size(20.0, 20.0));
    let material = StandardMaterial { perceptual_roughness: 1.0, reflectance: 0.0, ..Color::WHITE.into() };
    let material = world.resource_mut::<Assets<StandardMaterial>>().add(material);
    world.spawn((Mesh3d(floor), MeshMaterial3d(material)));
    let sun = DirectionalLight { illuminance: 2.0, ..default() };
    world.spawn((sun, Transform::default().looking_to(Vec3::new(1.0, -1.0, 0.3), Vec3::Y)));
    world.insert_resource(GlobalAmbientLight { brightness: 0.5, ..default() });
    app
}

#[test]
fn smoke_darkens_the_floor() {
    let size = UVec2::new(256, 192);
    let mut app = stage(size);
    let eye = Transform::from_xyz(0.0, 3.0, 9.0).looking_at(Vec3::new(0.0, 1.2, 0.0), Vec3::Y);
    let camera = camera(&app);
    app.app.world_mut().spawn(camera).insert(eye);
    let pixels = draw(&mut app);
    save_radiance("floor", size, &pixels);
}
