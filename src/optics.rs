//! Optics of smoke in closed form: the phase function and the optical depth through a Gaussian.

use core::f64::consts::PI;

use glam::DVec3;

/// Henyey–Greenstein phase function (per steradian, integrating to 1), for the cosine between the direction light
/// travels before and after scattering and the mean cosine −1 < `g` < 1: `g` > 0 scatters forward.
pub fn henyey_greenstein(cos_theta: f64, g: f64) -> f64 {
    (1.0 - g * g) / (4.0 * PI * (1.0 + g * g - 2.0 * g * cos_theta).powf(1.5))
}

/// The fraction of light that survives `optical_depth`: Beer–Lambert.
pub fn transmittance(optical_depth: f64) -> f64 {
    (-optical_depth).exp()
}

/// ∫ of the Gaussian density `weight` exp(−|y−`center`|²/`radius`²) from `x` along the unit vector `dir` to infinity.
/// Times the extinction per unit length and density, it is the exact optical depth. `radius` > 0.
///
/// The Gaussian is whole, without the cut at three radii.
pub fn gaussian_column(x: DVec3, dir: DVec3, center: DVec3, radius: f64, weight: f64) -> f64 {
    let to_center = (center - x) / radius;
    let along = to_center.dot(dir);
    let across_squared = (to_center - along * dir).length_squared();
    weight * radius * (0.5 * PI.sqrt()) * (-across_squared).exp() * (1.0 + erf(along))
}

/// The error function 2/√π ∫ exp(−t²) dt from 0 to `x`, within 1e-15.
pub fn erf(x: f64) -> f64 {
    let z = x.abs();
    let value = if z < 3.0 {
        // exp(−z²) Σ 2ⁿ z²ⁿ⁺¹ / (2n+1)!!: all terms positive, so nothing cancels.
        let (mut term, mut sum, mut n) = (z, z, 0.0);
        while term > 1e-17 * sum {
            n += 1.0;
            term *= 2.0 * z * z / (2.0 * n + 1.0);
            sum += term;
        }
        2.0 / PI.sqrt() * (-z * z).exp() * sum
    } else if z < 6.0 {
        // Continued fraction of erfc, from the tail up: z + (1/2)/(z + (2/2)/(z + (3/2)/…)).
        let fraction = (1..=40).rev().fold(z, |tail, n| z + 0.5 * n as f64 / tail);
        1.0 - (-z * z).exp() / (PI.sqrt() * fraction)
    } else {
        // 1 − erf(6) is 2e-17, below half a unit in the last place; NaN lands here and stays NaN.
        if z.is_nan() { z } else { 1.0 }
    };
    value.copysign(x)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sh::{SphereRule, henyey_greenstein_factors, zonal_factors};
    use proptest::prelude::*;

    #[test]
    fn erf_matches_known_values() {
        // The Maclaurin series summed with 50 digits, rounded.
        for (x, expected) in [
            (0.0, 0.0),
            (0.1, 0.112_462_916_018_284_9),
            (0.5, 0.520_499_877_813_046_5),
            (1.0, 0.842_700_792_949_714_9),
            (2.0, 0.995_322_265_018_952_7),
            (2.9, 0.999_958_902_121_900_5),
            (3.1, 0.999_988_351_342_632_8),
            (5.0, 0.999_999_999_998_462_5),
            (40.0, 1.0),
        ] {
            // A few roundings of numbers near 1.
            assert!((erf(x) - expected).abs() < 1e-15, "erf({x}) = {}", erf(x));
            assert_eq!(erf(-x), -erf(x));
        }
        assert!(erf(f64::NAN).is_nan());
        assert_eq!(erf(f64::INFINITY), 1.0);
    }

    #[test]
    fn phase_integrates_to_one_with_mean_cosine_g() {
        for g in [-0.6, 0.0, 0.42, 0.6, 0.9] {
            // Smooth in cos θ; the singularity at t = (1+g²)/2g = 1.0056 for g = .9 limits 64 nodes to about 1e-5.
            let factors = zonal_factors(|t| henyey_greenstein(t, g));
            for (a, b) in factors.iter().zip(henyey_greenstein_factors(g)) {
                assert!((a - b).abs() < 1e-4, "g {g}: {a} for {b}");
            }
        }
        let axis = DVec3::new(2.0, -1.0, 0.5).normalize();
        let total: f64 = SphereRule::new(64).integrate(|w| henyey_greenstein(w.dot(axis), 0.6));
        assert!((total - 1.0).abs() < 1e-12, "{total}");
        // Forward: (1−g²)/(4π(1−g)³).
        assert!((henyey_greenstein(1.0, 0.5) - 0.75 / (4.0 * PI * 0.125)).abs() < 1e-14);
    }

    proptest! {
        #[test]
        fn gaussian_column_matches_quadrature(
            p in prop::array::uniform3(-1.0..1.0f64),
            d in prop::array::uniform3(-1.0..1.0f64),
            c in prop::array::uniform3(-1.0..1.0f64),
            radius in 0.05..0.8f64,
            weight in 0.1..3.0f64,
        ) {
            let (x, dir, center) = (DVec3::from(p), DVec3::from(d).normalize_or(DVec3::Y), DVec3::from(c));
            // Simpson's rule with steps of r/100 to 8 radii past the centre: error r (1/100)⁴ ~ 1e-8 relative to w r.
            let step = radius / 100.0;
            let intervals = 2 * ((4.0 + 8.0 * radius) / step / 2.0).ceil() as usize;
            let density = |i: usize| {
                weight * (-(x + dir * (i as f64 * step) - center).length_squared() / (radius * radius)).exp()
            };
            let inner: f64 = (1..intervals).map(|i| if i % 2 == 1 { 4.0 } else { 2.0 } * density(i)).sum();
            let expected = step / 3.0 * (density(0) + inner + density(intervals));
            let column = gaussian_column(x, dir, center, radius, weight);
            prop_assert!((column - expected).abs() < 2e-9 * weight * radius, "{column} for {expected}");
            // Both ways together: the whole line, w r √π exp(−b²).
            let line = column + gaussian_column(x, -dir, center, radius, weight);
            let across = (center - x).cross(dir).length_squared() / (radius * radius);
            prop_assert!((line - weight * radius * PI.sqrt() * (-across).exp()).abs() < 1e-14);
        }
    }

    #[test]
    fn transmittance_is_exponential() {
        assert_eq!(transmittance(0.0), 1.0);
        assert!((transmittance(2f64.ln()) - 0.5).abs() < 1e-16);
    }
}
