//! The light that reaches smoke from all around.

use bevy::prelude::*;

/// Coefficients of an environment's radiance: order-4 spherical harmonics, index `l(l+1)+m`, RGB.
pub type EnvironmentCoefficients = [Vec3; 16];

/// The environment that lights a volume of smoke. On a [`SmokeVolume`](crate::volume::SmokeVolume) it is that volume's
/// light for every camera; by default each camera's own environment map lights it.
///
/// Smoke sees the environment through four bands of spherical harmonics: skies, rooms and soft lamps are kept. A sun in an
/// uncompressed image that the main world keeps is found and lit as a ray; other small bright lights are spread to about
/// 60°. The scene's own directional, point and spot lights light smoke beside its environment.
///
/// Radiances are in cd/m² and exposed by the camera like everything else Bevy draws.
#[derive(Component, Clone, Debug, Default, PartialEq, Reflect)]
#[reflect(Component, Default, Debug, Clone, PartialEq)]
pub enum SmokeEnvironment {
    /// The [`EnvironmentMapLight`] of the camera that looks: its specular map, intensity and rotation; and its ambient light
    /// ([`AmbientLight`], else [`GlobalAmbientLight`]).
    #[default]
    Camera,
    /// A latitude-longitude image (HDR or EXR): `u = φ/2π, v = θ/π, ω = (sin φ sin θ, cos θ, −cos φ sin θ)`, so that the
    /// image's middle column looks to +Z and its first row up.
    Equirect {
        /// The image, linear radiance.
        image: Handle<Image>,
        /// Multiplies the image's values to give cd/m².
        intensity: f32,
        /// Turns the environment in the world.
        rotation: Quat,
    },
    /// Spherical-harmonic coefficients in world axes.
    Coefficients {
        /// `L(ω) = Σ_k coefficients[k] · y_k(ω)`, with the basis of [`crate::sh`].
        coefficients: EnvironmentCoefficients,
        /// Multiplies the coefficients to give cd/m².
        intensity: f32,
    },
}

impl SmokeEnvironment {
    /// The same radiance from everywhere, `radiance · intensity` cd/m².
    pub fn constant(radiance: Vec3, intensity: f32) -> Self {
        let mut coefficients = [Vec3::ZERO; 16];
        // y_0 is the constant 1 / (2 √π); a constant L has L_0 = L · 2 √π.
        coefficients[0] = radiance * (2.0 * std::f32::consts::PI.sqrt());
        Self::Coefficients { coefficients, intensity }
    }

    /// A latitude-longitude image, unrotated.
    pub fn equirect(image: Handle<Image>, intensity: f32) -> Self {
        Self::Equirect { image, intensity, rotation: Quat::IDENTITY }
    }
}

/// The largest magnitude among coefficients, or 1 where all are 0: what they are divided by where range is short.
pub(crate) fn magnitude(coefficients: &EnvironmentCoefficients) -> f32 {
    let largest = coefficients.iter().fold(0.0_f32, |largest, c| largest.max(c.abs().max_element()));
    if largest > 0.0 { largest } else { 1.0 }
}
