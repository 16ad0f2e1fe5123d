//! Outgoing: source radiance towards the eye, as a quadratic function per RBF.

use glam::{DMat3, DVec3};

use super::{
    PROBES,
    incident_light::{probes, reach},
};
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

impl Viewer {
    /// The look direction at `x`: a unit vector from the eye.
    pub fn look(&self, x: DVec3) -> DVec3 {
        match *self {
            Self::Perspective { eye } => (x - eye).normalize_or(DVec3::Z),
            Self::Orthographic { forward } => forward,
        }
    }
}

/// How far from the centre of its RBF a fit is followed, in units of the probes' distance.
const BEYOND: f64 = 1.5;

/// Source radiance towards the eye around an RBF's centre: quadratic, without mixed terms.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outgoing {
    /// RGB value at the centre.
    pub center: DVec3,
    /// Change per bundle unit: `gradient * offset` is RGB.
    pub gradient: DMat3,
    /// Half the second derivatives along the axes: `curvature * (offset * offset)` is RGB.
    pub curvature: DMat3,
    /// Lower bound.
    pub low: DVec3,
    /// Upper bound.
    pub high: DVec3,
    /// Distance of the outer probes from the centre.
    pub reach: f64,
}

impl Outgoing {
    /// The function through the values at the probes of an RBF, without bounds: along each axis the parabola through
    /// three of them, the outer ones `reach` from the centre.
    pub fn through(values: [DVec3; PROBES], reach: f64) -> Self {
        let [center, outer @ ..] = values;
        let slope = |axis: usize| (outer[2 * axis] - outer[2 * axis + 1]) / (2.0 * reach);
        let bend = |axis: usize| (outer[2 * axis] + outer[2 * axis + 1] - 2.0 * center) / (2.0 * reach * reach);
        Self {
            center,
            gradient: DMat3::from_cols(slope(0), slope(1), slope(2)),
            curvature: DMat3::from_cols(bend(0), bend(1), bend(2)),
            low: DVec3::NEG_INFINITY,
            high: DVec3::INFINITY,
            reach,
        }
    }

    /// [`through`](Self::through), kept between half the least and twice the largest of the values.
    pub fn bounded(values: [DVec3; PROBES], reach: f64) -> Self {
        let low = 0.5 * values.into_iter().reduce(DVec3::min).unwrap_or_default();
        let high = 2.0 * values.into_iter().reduce(DVec3::max).unwrap_or_default();
        Self { low, high, ..Self::through(values, reach) }
    }

    /// The RGB value at `offset` from the centre. Further out than 1.5 times its probes it stays what it is there.
    pub fn value(&self, offset: DVec3) -> DVec3 {
        let delta = offset.clamp_length_max(BEYOND * self.reach);
        let value = self.center + self.gradient * delta + self.curvature * (delta * delta);
        // Where all values are negative, which ringing can make them, the bounds are out of order: the upper one holds.
        value.max(self.low).min(self.high)
    }
}

/// Evaluates the probes' source radiance along the look direction and fits a function to each RBF's seven; `sigma` is the
/// grey extinction that says where the probes are.
pub fn outgoing(rbfs: &[Rbf], source_radiance: &[[ShRgb; PROBES]], viewer: Viewer, sigma: f64) -> Vec<Outgoing> {
    rbfs.iter()
        .zip(source_radiance)
        .map(|(rbf, source_radiance)| {
            let reach = reach(rbf, sigma);
            let probes = probes(rbf, reach);
            let value = |i: usize| source_radiance[i].evaluate(viewer.look(probes[i]));
            Outgoing::bounded(core::array::from_fn(value), reach)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference::{PROBE_OFFSETS, rbf_center};
    use crate::sh::henyey_greenstein_factors;

    const RBF: Rbf = Rbf { center: [0.1, -0.2, 0.05], radius: 0.125, weight: 1.0 };

    #[test]
    fn uniform_light_is_uniform() {
        // Under constant light the phase function does not show, whatever g and the viewer.
        let light = ShRgb::constant(DVec3::new(1.0, 0.5, 0.25)).convolve(&henyey_greenstein_factors(0.6));
        for viewer in
            [Viewer::Perspective { eye: DVec3::new(1.0, 2.0, 3.0) }, Viewer::Orthographic { forward: DVec3::X }]
        {
            let found = outgoing(&[RBF], &[[light; PROBES]], viewer, 0.0)[0];
            assert!((found.center - DVec3::new(1.0, 0.5, 0.25)).length() < 1e-15);
            assert!((found.gradient * DVec3::ONE).length() < 1e-13);
        }
    }

    #[test]
    fn quadratic_fields_are_fitted_exactly() {
        let mean = DVec3::new(2.0, 1.0, 0.5);
        let gradient =
            DMat3::from_cols(DVec3::new(1.0, 2.0, 3.0), DVec3::new(-1.0, 0.5, 0.0), DVec3::new(0.0, 4.0, -2.0));
        let curvature =
            DMat3::from_cols(DVec3::new(3.0, 0.0, -5.0), DVec3::new(4.0, -6.0, 1.0), DVec3::new(-2.0, 2.0, 7.0));
        let field = |d: DVec3| mean + gradient * d + curvature * (d * d);
        let source = probes(&RBF, RBF.radius.into()).map(|p| ShRgb::constant(field(p - rbf_center(&RBF))));
        let found = outgoing(&[RBF], &[source], Viewer::Orthographic { forward: DVec3::Y }, 0.0)[0];
        assert!((found.center - mean).length() < 1e-14);
        for axis in DVec3::AXES {
            assert!(((found.gradient - gradient) * axis).length() < 1e-12);
            // Rounding of values near 2, over r²/2 = 1/128.
            assert!(((found.curvature - curvature) * axis).length() < 1e-11);
        }
        // The bounds, from 0.25 or less to 2 or more, do not act here.
        let radius = f64::from(RBF.radius);
        let offset = DVec3::new(0.06, -0.05, 0.1);
        assert!((found.value(offset) - field(offset)).length() < 1e-13);
        // 4 radii away: the offset is shortened to 1.5.
        let unbounded = Outgoing::through(source.map(|j| j.evaluate(DVec3::Y)), radius);
        let end = DVec3::new(0.6, 0.0, 0.8) * (1.5 * radius);
        assert!((unbounded.value(end * (4.0 / 1.5)) - field(end)).length() < 1e-12);
    }

    #[test]
    fn values_stay_between_half_and_twice_those_of_the_probes() {
        // Along x steeply up: 1, 2, 3 at the probes, 3.5 at their end. Along z a peak: 0 at 1.4 radii without bounds.
        let radius = f64::from(RBF.radius);
        let value = |x: f64| DVec3::splat(x);
        let found = Outgoing::bounded([2.0, 3.0, 1.0, 2.0, 2.0, 1.0, 1.0].map(value), radius);
        assert_eq!((found.low, found.high), (value(0.5), value(6.0)));
        assert!((found.value(DVec3::X * radius * 2.0) - value(3.5)).length() < 1e-13);
        assert_eq!(found.value(DVec3::Z * radius * 1.4), value(0.5));
        let valley = Outgoing::bounded([0.1, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0].map(value), radius);
        assert_eq!(valley.value(DVec3::NEG_Y * radius * 1.5), value(2.0));
    }

    #[test]
    fn probes_are_seen_along_their_own_lines() {
        // A lobe linear in v: J(v) = −v.z, i.e. −z/y2 = √(4π/3). From far the lines are parallel.
        let lobe = ShRgb::zonal(DVec3::NEG_Z, &[0.0, 4.0 * core::f64::consts::PI / 3.0, 0.0, 0.0], DVec3::ONE);
        let eye = DVec3::new(0.1, -0.2, 1.05);
        let near = outgoing(&[RBF], &[[lobe; PROBES]], Viewer::Perspective { eye }, 0.0)[0];
        let expected = probes(&RBF, RBF.radius.into()).map(|p| (eye - p).z / (p - eye).length());
        for (offset, expected) in PROBE_OFFSETS.into_iter().zip(expected) {
            let value = near.value(offset * f64::from(RBF.radius));
            assert!((value - DVec3::splat(expected)).length() < 1e-14);
        }
        let far = outgoing(&[RBF], &[[lobe; PROBES]], Viewer::Perspective { eye: DVec3::Z * 1e6 }, 0.0)[0];
        let parallel = outgoing(&[RBF], &[[lobe; PROBES]], Viewer::Orthographic { forward: -DVec3::Z }, 0.0)[0];
        assert!((parallel.center - DVec3::ONE).length() < 1e-14);
        assert!((far.center - parallel.center).length() < 1e-9);
    }

    #[test]
    fn an_eye_on_a_probe_stays_finite() {
        let light = ShRgb::constant(DVec3::ONE);
        let eye = probes(&RBF, RBF.radius.into())[2];
        let found = outgoing(&[RBF], &[[light; PROBES]], Viewer::Perspective { eye }, 0.0)[0];
        assert!((found.center - DVec3::ONE).length() < 1e-15);
    }
}
