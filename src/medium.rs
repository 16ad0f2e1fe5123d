//! The optical properties of smoke.

use bevy::color::LinearRgba;
use bevy::prelude::*;

/// What a volume's smoke does to light: how much it takes out, how much of that it scatters, and where to.
///
/// Values outside their range are clamped to it when the smoke is drawn, and a warning names them once.
#[derive(Component, Clone, Copy, Debug, PartialEq, Reflect)]
#[reflect(Component, Default, Debug, Clone, PartialEq)]
pub struct SmokeMedium {
    /// Extinction cross-section σ_t: extinction per world metre and unit of density, 0 to 1e9. A ray that crosses a
    /// length `l` of density `D` keeps `exp(-sigma_t * D * l)` of its light. Scaling a volume by 2 doubles its
    /// optical depth.
    pub sigma_t: f32,
    /// Single-scattering albedo Ω: the share of the light taken out that is scattered and not absorbed, per channel,
    /// linear, 0..=1. Alpha is ignored.
    pub albedo: LinearRgba,
    /// Henyey–Greenstein asymmetry g in -0.95..=0.95: 0 scatters evenly, above 0 forward, below 0 back.
    ///
    /// Light from all around meets the phase function in four bands of spherical harmonics, its factors g, g² and g³, after
    /// its forward peak has been cut off where light scatters more than once (delta-M): the nearer |g| is to 1 the blunter
    /// it gets. The last scattering of light from a sun or lamp is exact.
    pub g: f32,
}

impl SmokeMedium {
    /// Largest |g| that is drawn.
    pub const MAX_ASYMMETRY: f32 = 0.95;

    /// Largest σ_t that is drawn.
    pub const MAX_EXTINCTION: f32 = 1e9;

    /// The medium with every value inside its range; what is not a number becomes the default's value.
    pub fn clamped(&self) -> Self {
        let default = Self::default();
        let fix = |value: f32, low: f32, high: f32, default: f32| {
            if value.is_nan() { default } else { value.clamp(low, high) }
        };
        Self {
            sigma_t: fix(self.sigma_t, 0.0, Self::MAX_EXTINCTION, default.sigma_t),
            albedo: LinearRgba::rgb(
                fix(self.albedo.red, 0.0, 1.0, default.albedo.red),
                fix(self.albedo.green, 0.0, 1.0, default.albedo.green),
                fix(self.albedo.blue, 0.0, 1.0, default.albedo.blue),
            ),
            g: fix(self.g, -Self::MAX_ASYMMETRY, Self::MAX_ASYMMETRY, default.g),
        }
    }
}

impl Default for SmokeMedium {
    /// Light grey smoke: σ_t 4 per metre, albedo 0.8, isotropic.
    fn default() -> Self {
        Self { sigma_t: 4.0, albedo: LinearRgba::rgb(0.8, 0.8, 0.8), g: 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clamping_mends_every_value_and_keeps_good_ones() {
        let good = SmokeMedium { sigma_t: 2.0, albedo: LinearRgba::rgb(0.1, 0.5, 1.0), g: -0.3 };
        assert_eq!(good.clamped(), good);
        let bad = SmokeMedium { sigma_t: f32::NAN, albedo: LinearRgba::rgb(-1.0, 2.0, f32::NAN), g: 3.0 };
        let mended = bad.clamped();
        assert_eq!(mended.sigma_t, SmokeMedium::default().sigma_t);
        assert_eq!(mended.albedo, LinearRgba::rgb(0.0, 1.0, 0.8));
        assert_eq!(mended.g, SmokeMedium::MAX_ASYMMETRY);
        assert_eq!(SmokeMedium { sigma_t: -1.0, ..good }.clamped().sigma_t, 0.0);
        assert_eq!(SmokeMedium { sigma_t: f32::INFINITY, ..good }.clamped().sigma_t, SmokeMedium::MAX_EXTINCTION);
    }
}
