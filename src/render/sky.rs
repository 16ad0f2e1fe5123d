//! The sky over meshes: a view's environment as the passes that shade meshes see it, the `Sky` of `casters.wgsl`.

use bevy::prelude::*;
use bevy::render::render_resource::ShaderType;

use super::light::Lit;

/// The `Sky` of `casters.wgsl`.
#[derive(ShaderType, Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct SkyUniform {
    pub environment_from_world: Mat3,
    pub ambient: Vec3,
    pub scale: f32,
    pub sun_direction: Vec3,
    pub sun_irradiance: Vec3,
    pub unit: f32,
}

impl SkyUniform {
    /// The light of an environment, in units of the stronger of it and the ambient light: textures that hold it are f16.
    pub fn new(lit: &Lit) -> Self {
        let strongest = lit.intensity.abs().max(lit.ambient.max_element());
        let unit = if strongest > 0.0 { strongest } else { 1.0 };
        let (sun_direction, sun_irradiance) =
            lit.sun.map_or((Vec3::Y, Vec3::ZERO), |sun| (sun.direction, sun.irradiance));
        Self {
            environment_from_world: lit.environment_from_world,
            ambient: lit.ambient / unit,
            scale: lit.intensity / unit,
            sun_direction,
            sun_irradiance,
            unit,
        }
    }
}
