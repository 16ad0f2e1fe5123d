//! A volume's medium and light as the lighting passes see them: the `Lighting` of `lighting.wgsl`.

use bevy::prelude::*;
use bevy::render::render_resource::ShaderType;

use super::incident_light::PROBES;
use crate::medium::SmokeMedium;
use crate::quality::SmokeModel;

/// Lamps that light one volume, at most; as in `lighting.wgsl`.
pub(super) const MAX_LAMPS: usize = 8;

/// The `Lamp` of `lighting.wgsl`.
#[derive(ShaderType, Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct LampUniform {
    pub position: Vec3,
    pub inverse_range_squared: f32,
    pub color: Vec3,
    pub is_sun: u32,
    pub axis: Vec3,
    pub spot_scale: f32,
    pub spot_offset: f32,
}

/// The `Lighting` of `lighting.wgsl`.
#[derive(ShaderType, Clone, Debug, Default, PartialEq)]
pub(super) struct LightingUniform {
    pub environment_from_bundle: Mat3,
    pub ambient: Vec3,
    pub environment_scale: f32,
    pub sun_direction: Vec3,
    pub sun_irradiance: Vec3,
    pub sigma: Vec3,
    pub g: f32,
    pub scatter: [Vec4; 4],
    pub inner: [Vec4; 4],
    pub sigma_mean: f32,
    pub coefficients: u32,
    pub lamp_count: u32,
    pub softening: f32,
    pub probes: u32,
    pub light_coefficients: u32,
    pub lamps: [LampUniform; MAX_LAMPS],
}

impl LightingUniform {
    /// The part that the medium decides; `sigma` is its extinction per bundle unit where the scaled density is 1.
    ///
    /// Where light scatters more than once into a forward peak, delta-M scaling (Wiscombe 1977) takes the part f = g⁴
    /// of scattering, which four bands of spherical harmonics cannot hold, for no scattering at all: σ' = σ(1 − Ωf),
    /// Ω' = Ω(1 − f)/(1 − Ωf), g'^l = (g^l − f)/(1 − f). The last event before the eye keeps Ω and g^l.
    pub fn of_medium(medium: &SmokeMedium, sigma: f32, multiple: bool) -> Self {
        let albedo = Vec3::new(medium.albedo.red, medium.albedo.green, medium.albedo.blue);
        let bands = [1.0, medium.g, medium.g.powi(2), medium.g.powi(3)];
        let peak = if multiple { medium.g.max(0.0).powi(4) } else { 0.0 };
        let kept = Vec3::ONE - albedo * peak;
        let sigma = sigma * kept;
        Self {
            sigma,
            g: medium.g,
            scatter: bands.map(|band| (albedo * band).extend(0.0)),
            inner: bands.map(|band| (albedo / kept * (band - peak)).extend(0.0)),
            sigma_mean: sigma.element_sum() / 3.0,
            coefficients: match (multiple, medium.g == 0.0) {
                (false, _) => 0,
                (true, true) => 1,
                (true, false) => 16,
            },
            probes: PROBES,
            light_coefficients: 16,
            ..default()
        }
    }

    /// Leaves out the probes that a model does without, and its bands of light that scatters more than once, which cost by
    /// their square; and the bands that the medium does not scatter, of which `diffusion`, as a solver, needs two.
    pub fn reduced(self, model: &SmokeModel, diffusion: bool) -> Self {
        Self {
            probes: model.probes,
            coefficients: self.coefficients.min(model.order * model.order),
            light_coefficients: match (self.g == 0.0, diffusion) {
                (false, _) => 16,
                (true, true) => 4,
                (true, false) => 1,
            },
            ..self
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn medium(albedo: [f32; 3], g: f32) -> SmokeMedium {
        SmokeMedium { sigma_t: 1.0, albedo: LinearRgba::from_f32_array_no_alpha(albedo), g }
    }

    #[test]
    fn delta_m_keeps_absorption_and_transport() {
        let (albedo, g, sigma) = ([0.9, 0.6, 1.0], 0.7_f32, 5.0);
        let lighting = LightingUniform::of_medium(&medium(albedo, g), sigma, true);
        for (c, albedo) in albedo.into_iter().enumerate() {
            let inner = lighting.inner[0][c];
            // Absorption: σ'(1 − Ω') = σ(1 − Ω). Transport: σ'(1 − Ω'g') = σ(1 − Ωg).
            let absorbed = lighting.sigma[c] * (1.0 - inner);
            assert!((absorbed - sigma * (1.0 - albedo)).abs() < 1e-5);
            let transport = lighting.sigma[c] * (1.0 - lighting.inner[1][c]);
            assert!((transport - sigma * (1.0 - albedo * g)).abs() < 1e-5);
            assert!((lighting.scatter[3][c] - albedo * g.powi(3)).abs() < 1e-6);
        }
    }

    #[test]
    fn what_is_not_scattered_is_not_kept() {
        let kept = |g, order, diffusion: bool| {
            let model = SmokeModel { order, ..SmokeModel::FULL };
            let lighting = LightingUniform::of_medium(&medium([0.8; 3], g), 2.0, !diffusion).reduced(&model, diffusion);
            (lighting.coefficients, lighting.light_coefficients)
        };
        assert_eq!(kept(0.4, 4, false), (16, 16));
        assert_eq!(kept(0.4, 2, false), (4, 16));
        assert_eq!(kept(0.0, 4, false), (1, 1));
        assert_eq!(kept(0.0, 4, true), (0, 4));
    }

    #[test]
    fn only_a_forward_peak_is_cut() {
        for (g, multiple) in [(0.7, false), (0.0, true), (-0.6, true)] {
            let lighting = LightingUniform::of_medium(&medium([0.8; 3], g), 2.0, multiple);
            assert_eq!(lighting.sigma, Vec3::splat(2.0));
            assert_eq!(lighting.inner, lighting.scatter);
        }
    }
}
