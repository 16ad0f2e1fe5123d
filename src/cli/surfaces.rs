//! A scene's plane and spheres as Bevy's meshes, and the light from all around that they are seen in.

use std::path::Path;

use bevy::asset::RenderAssetUsages;
use bevy::light::EnvironmentMapLight;
use bevy::math::DVec3;
use bevy::prelude::*;
use bevy::render::render_resource::{
    Extent3d, TextureDimension, TextureFormat, TextureViewDescriptor, TextureViewDimension,
};
use half::f16;

use super::render::read_equirect;
use super::scene::{Environment, Scene};
use crate::prelude::*;
use crate::reference::environment::{cubemap_direction, equirect};
use crate::reference::path::EquirectImage;
use crate::sh::{CLAMPED_COSINE, ShRgb};

/// Sides of the plane, in sides of the smoke's box.
const PLANE: f32 = 50.0;
/// Texels a side of a face of the environment.
const FACE: usize = 64;
/// The same of what is left of it on diffuse surfaces.
const DIFFUSE_FACE: usize = 16;

/// Spawns the plane and the spheres, Lambertian where they are to be seen, else black; spheres stand in the smoke's light.
/// `side` is that of the smoke's box, in metres.
pub(super) fn spawn_surfaces(world: &mut World, scene: &Scene, side: f32, seen: bool) {
    let mut material = |albedo: DVec3| {
        let [r, g, b] = albedo.as_vec3().to_array();
        let lit = StandardMaterial {
            base_color: Color::linear_rgb(r, g, b),
            perceptual_roughness: 1.0,
            reflectance: 0.0,
            double_sided: true,
            cull_mode: None,
            ..default()
        };
        let material = if seen { lit } else { StandardMaterial { base_color: Color::BLACK, unlit: true, ..lit } };
        MeshMaterial3d(world.resource_mut::<Assets<StandardMaterial>>().add(material))
    };
    let plane = scene.plane.map(|plane| (material(plane.albedo), plane.y as f32));
    let spheres: Vec<_> = scene.spheres.iter().map(|sphere| (material(sphere.albedo), sphere)).collect();
    if let Some((material, y)) = plane {
        let mesh = Plane3d::default().mesh().size(PLANE * side, PLANE * side);
        let mesh = world.resource_mut::<Assets<Mesh>>().add(mesh);
        world.spawn((Mesh3d(mesh), material, Transform::from_xyz(0.0, y, 0.0)));
    }
    for (material, sphere) in spheres {
        let radius = sphere.radius as f32;
        // Within a thousandth of the radius of the ball that it stands for.
        let mesh = Sphere::new(radius).mesh().uv(128, 64);
        let mesh = world.resource_mut::<Assets<Mesh>>().add(mesh);
        let at = Transform::from_translation(sphere.center.as_vec3());
        world.spawn((Mesh3d(mesh), material, SmokeOccluder::new([(Vec3::ZERO, radius)]), at));
    }
}

/// Lets meshes shade each other from the world's lights.
pub(super) fn cast_shadows(world: &mut World) {
    world.query::<&mut DirectionalLight>().iter_mut(world).for_each(|mut light| light.shadow_maps_enabled = true);
    world.query::<&mut PointLight>().iter_mut(world).for_each(|mut light| light.shadow_maps_enabled = true);
    world.query::<&mut SpotLight>().iter_mut(world).for_each(|mut light| light.shadow_maps_enabled = true);
}

/// The scene's light from all around as Bevy's own, for a camera, in units of `unit`; without Bevy's ambient light.
pub(super) fn environment_map(world: &mut World, scene: &Scene, unit: f32) -> anyhow::Result<EnvironmentMapLight> {
    let (specular, sh) = match &scene.environment {
        Environment::Equirect(path) => of_image(path)?,
        lobes => {
            let radiance = |w| lobes.radiance(w).unwrap_or_default();
            (cubemap(FACE, 1.0 / f64::from(unit), radiance), lobes.coefficients().unwrap_or_default())
        }
    };
    // Bevy wants irradiance over π by normal.
    let irradiance = sh.convolve(&CLAMPED_COSINE.map(|factor| factor / std::f64::consts::PI));
    let diffuse = cubemap(DIFFUSE_FACE, 1.0 / f64::from(unit), |n| irradiance.evaluate(n).max(DVec3::ZERO));
    world.insert_resource(GlobalAmbientLight::NONE);
    let mut images = world.resource_mut::<Assets<Image>>();
    Ok(EnvironmentMapLight {
        diffuse_map: images.add(diffuse),
        specular_map: images.add(specular),
        intensity: 1.0,
        ..default()
    })
}

/// A cubemap of a latitude-longitude image, and its coefficients.
fn of_image(path: &Path) -> anyhow::Result<(Image, ShRgb)> {
    let ([width, _], texels) = read_equirect(path)?;
    let texels: Vec<Vec3> = texels.into_iter().map(Vec3::from).collect();
    let sh = equirect(width as usize, &texels.iter().map(|rgb| rgb.as_dvec3()).collect::<Vec<_>>());
    let image = EquirectImage::new(width as usize, texels);
    Ok((cubemap(FACE, 1.0, |w| image.radiance(w)), sh))
}

/// A cubemap of `scale` times a radiance by direction.
fn cubemap(size: usize, scale: f64, radiance: impl Fn(DVec3) -> DVec3) -> Image {
    let texels = (0..6).flat_map(|face| (0..size * size).map(move |i| (face, i % size, i / size)));
    let data = texels.flat_map(|(face, column, row)| {
        let rgb = radiance(cubemap_direction(size, face, column, row).0) * scale;
        let rgba = rgb.as_vec3().min(Vec3::splat(f16::MAX.to_f32())).extend(1.0).to_array();
        rgba.into_iter().flat_map(|value| f16::from_f32(value).to_le_bytes())
    });
    let extent = Extent3d { width: size as u32, height: size as u32, depth_or_array_layers: 6 };
    let format = TextureFormat::Rgba16Float;
    let data = data.collect();
    let mut image = Image::new(extent, TextureDimension::D2, data, format, RenderAssetUsages::RENDER_WORLD);
    image.texture_view_descriptor =
        Some(TextureViewDescriptor { dimension: Some(TextureViewDimension::Cube), ..default() });
    image
}
