//! Bevy's own volumetric fog with the smoke's density: what a game would use otherwise.
//!
//! It takes no light from all around: no environment map, no spherical harmonics. What it can take is a sun and a colour from
//! everywhere. They are given it so that together they have the environment's flux and its mean direction: a sun of the
//! irradiance that the first band has, and what is left as ambient light.

use bevy::asset::RenderAssetUsages;
use bevy::light::{FogVolume, VolumetricFog, VolumetricLight};
use bevy::math::{DVec3, Vec3};
use bevy::prelude::*;
use bevy::render::render_resource::{Extent3d, TextureDimension, TextureFormat};
use half::f16;

use crate::cli::scene::Scene;
use crate::density::DensityGrid;
use crate::sh::ShRgb;

/// The light that fog can take of an environment.
pub(super) struct FogLight {
    /// Unit vector toward the sun.
    pub toward: DVec3,
    /// On a surface that faces it.
    pub irradiance: DVec3,
    /// Radiance from everywhere.
    pub ambient: DVec3,
}

impl FogLight {
    /// Of an environment's coefficients.
    pub fn of(environment: &ShRgb) -> Self {
        // ∫ L dω and ∫ L ω dω.
        let pi = std::f64::consts::PI;
        let flux = environment.0[0] * (4.0 * pi).sqrt();
        let band = (4.0 * pi / 3.0).sqrt();
        let [x, y, z] = [-environment.0[3] * band, -environment.0[1] * band, environment.0[2] * band];
        let luminance = DVec3::new(0.2126, 0.7152, 0.0722);
        let toward = DVec3::new(x.dot(luminance), y.dot(luminance), z.dot(luminance)).normalize_or(DVec3::Y);
        let irradiance = (x * toward.x + y * toward.y + z * toward.z).max(DVec3::ZERO);
        Self { toward, irradiance, ambient: ((flux - irradiance) / (4.0 * pi)).max(DVec3::ZERO) }
    }
}

/// Spawns the fog and its sun; the camera's part is returned, to be put on it. Radiance is in units of `unit`.
pub(super) fn spawn(
    world: &mut World,
    scene: &Scene,
    grid: &DensityGrid,
    transform: Transform,
    light: &FogLight,
    unit: f32,
    (steps, ambient): (u32, bool),
) -> (Vec<Entity>, VolumetricFog) {
    let dims = grid.shape.dims;
    let data = grid.values.iter().flat_map(|&value| f16::from_f32(value).to_le_bytes()).collect();
    let image = Image::new(
        Extent3d { width: dims.x, height: dims.y, depth_or_array_layers: dims.z },
        TextureDimension::D3,
        data,
        TextureFormat::R16Float,
        RenderAssetUsages::RENDER_WORLD,
    );
    let image = world.resource_mut::<Assets<Image>>().add(image);
    let albedo = scene.albedo.as_vec3();
    // Absorption and scattering are one number each; its colour makes up for what channels differ.
    let mean = albedo.element_sum() / 3.0;
    let color = albedo / mean.max(1e-6);
    let fog = FogVolume {
        fog_color: Color::linear_rgb(color.x, color.y, color.z),
        density_factor: scene.sigma_t as f32,
        density_texture: Some(image),
        absorption: 1.0 - mean,
        scattering: mean,
        scattering_asymmetry: scene.g as f32,
        ..default()
    };
    // A unit cube, which the box of the grid fills.
    let stretch = dims.as_vec3() / grid.shape.longest() as f32;
    let volume = world.spawn((fog, Transform { scale: transform.scale * stretch, ..transform })).id();
    let irradiance = light.irradiance.as_vec3() / unit;
    let illuminance = irradiance.max_element().max(f32::MIN_POSITIVE);
    let color = irradiance / illuminance;
    let sun = DirectionalLight {
        color: Color::linear_rgb(color.x, color.y, color.z),
        illuminance,
        shadow_maps_enabled: true,
        ..default()
    };
    let toward = light.toward.as_vec3();
    let from = Transform::default().looking_to(-toward, toward.any_orthogonal_vector());
    let sun = world.spawn((sun, VolumetricLight, from)).id();
    let [r, g, b] = (if ambient { light.ambient.as_vec3() / unit } else { Vec3::ZERO }).to_array();
    let camera = VolumetricFog {
        ambient_color: Color::linear_rgb(r, g, b),
        ambient_intensity: 1.0,
        step_count: steps,
        jitter: 0.0,
    };
    (vec![volume, sun], camera)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sh::SphereRule;

    #[test]
    fn flux_and_its_direction_are_kept() {
        let toward = DVec3::new(0.6, 0.64, -0.48);
        let environment =
            ShRgb::project(&SphereRule::new(4), |w| DVec3::new(2.0, 1.0, 0.5) * (1.0 + 0.6 * w.dot(toward)));
        let light = FogLight::of(&environment);
        assert!(light.toward.distance(toward) < 1e-9);
        let pi = std::f64::consts::PI;
        // ∫ 0.6 (ω·d) ω dω = 0.6 · 4π/3 d.
        assert!(light.irradiance.distance(DVec3::new(2.0, 1.0, 0.5) * 0.8 * pi) < 1e-9);
        let flux = light.irradiance + 4.0 * pi * light.ambient;
        assert!(flux.distance(DVec3::new(2.0, 1.0, 0.5) * 4.0 * pi) < 1e-9);
    }
}
