//! Outgoing: source radiance towards the eye, as a mean and a gradient per RBF.

use glam::{DMat3, DVec3};

use super::{RHO, TETRAHEDRON, source_radiance::probes};
use crate::{rbf::Rbf, sh::ShRgb};

/// How the camera looks at the volume, in bundle space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Viewer {
    /// From a point.
    Perspective {
        /// Where the eye is.
        eye: DVec3,
    },
    /// Along parallel lines.
    Orthographic {
        /// Unit vector along them, away from the eye.
        forward: DVec3,
    },
}

/// Source radiance towards the eye, linear around an RBF's centre.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outgoing {
    /// Mean of the four probes: the RGB value at the centre.
    pub mean: DVec3,
    /// Change per bundle unit: `gradient * offset` is RGB.
    pub gradient: DMat3,
}

/// Evaluates the probes' source radiance along the look direction and fits a linear function to each RBF's four.
pub fn outgoing(rbfs: &[Rbf], source_radiance: &[[ShRgb; 4]], viewer: Viewer) -> Vec<Outgoing> {
    rbfs.iter()
        .zip(source_radiance)
        .map(|(rbf, source_radiance)| {
            let probes = probes(rbf);
            let values: [DVec3; 4] = core::array::from_fn(|i| {
                source_radiance[i].evaluate(match viewer {
                    Viewer::Perspective { eye } => (probes[i] - eye).normalize_or(DVec3::Z),
                    Viewer::Orthographic { forward } => forward,
                })
            });
            linear_fit(values, rbf.radius.into())
        })
        .collect()
}

/// J̄ = mean J_i and G = 3/(4ρr) Σ J_i t_iᵀ.
pub(super) fn linear_fit(values: [DVec3; 4], radius: f64) -> Outgoing {
    let mut fit = Outgoing { mean: DVec3::ZERO, gradient: DMat3::ZERO };
    for (value, t) in values.into_iter().zip(TETRAHEDRON) {
        fit.mean += value / 4.0;
        let outer = DMat3::from_cols(value * t.x, value * t.y, value * t.z);
        fit.gradient += outer * (3.0 / (4.0 * RHO * radius));
    }
    fit
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference::rbf_center;
    use crate::sh::henyey_greenstein_factors;

    const RBF: Rbf = Rbf { center: [0.1, -0.2, 0.05], radius: 0.125, weight: 1.0 };

    #[test]
    fn uniform_light_is_uniform() {
        // Under constant light the phase function does not show, whatever g and the viewer.
        let light = ShRgb::constant(DVec3::new(1.0, 0.5, 0.25)).convolve(&henyey_greenstein_factors(0.6));
        for viewer in
            [Viewer::Perspective { eye: DVec3::new(1.0, 2.0, 3.0) }, Viewer::Orthographic { forward: DVec3::X }]
        {
            let found = outgoing(&[RBF], &[[light; 4]], viewer)[0];
            assert!((found.mean - DVec3::new(1.0, 0.5, 0.25)).length() < 1e-15);
            assert!((found.gradient * DVec3::ONE).length() < 1e-13);
        }
    }

    #[test]
    fn linear_fields_are_fitted_exactly() {
        let mean = DVec3::new(2.0, 1.0, 0.5);
        let gradient =
            DMat3::from_cols(DVec3::new(1.0, 2.0, 3.0), DVec3::new(-1.0, 0.5, 0.0), DVec3::new(0.0, 4.0, -2.0));
        let field = |x: DVec3| mean + gradient * (x - rbf_center(&RBF));
        let probes = probes(&RBF).map(|p| ShRgb::constant(field(p)));
        let found = outgoing(&[RBF], &[probes], Viewer::Orthographic { forward: DVec3::Y })[0];
        assert!((found.mean - mean).length() < 1e-14);
        for axis in DVec3::AXES {
            assert!(((found.gradient - gradient) * axis).length() < 1e-12);
        }
        let x = DVec3::new(0.3, 0.3, 0.3);
        assert!((found.mean + found.gradient * (x - rbf_center(&RBF)) - field(x)).length() < 1e-12);
    }

    #[test]
    fn probes_are_seen_along_their_own_lines() {
        // A lobe linear in v: J(v) = v.z, i.e. z/y2 = √(4π/3). From far the four lines are parallel.
        let lobe = ShRgb::zonal(DVec3::Z, &[0.0, 4.0 * core::f64::consts::PI / 3.0, 0.0, 0.0], DVec3::ONE);
        let eye = DVec3::new(0.1, -0.2, 1.05);
        let near = outgoing(&[RBF], &[[lobe; 4]], Viewer::Perspective { eye })[0];
        let expected = probes(&RBF).map(|p| (p - eye).z / (p - eye).length());
        assert!((near.mean.x - expected.iter().sum::<f64>() / 4.0).abs() < 1e-14);
        let far = outgoing(&[RBF], &[[lobe; 4]], Viewer::Perspective { eye: DVec3::Z * 1e6 })[0];
        let parallel = outgoing(&[RBF], &[[lobe; 4]], Viewer::Orthographic { forward: -DVec3::Z })[0];
        assert!((parallel.mean - DVec3::splat(-1.0)).length() < 1e-14);
        assert!((far.mean - parallel.mean).length() < 1e-9);
    }

    #[test]
    fn an_eye_on_a_probe_stays_finite() {
        let light = ShRgb::constant(DVec3::ONE);
        let eye = probes(&RBF)[2];
        let found = outgoing(&[RBF], &[[light; 4]], Viewer::Perspective { eye })[0];
        assert!((found.mean - DVec3::ONE).length() < 1e-15);
    }
}
