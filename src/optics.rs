//! Optics of smoke in closed form: the phase function, and the optical depth through a Gaussian and around it.

use core::f64::consts::PI;

use glam::DVec3;

use crate::sh::zonal_factors;

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

/// Band factors of the optical depth of a Gaussian around a point `u` ≥ 0 radii from its centre: a_l = ∫ f P_l dt / ∫ f dt
/// over the cosine t to the direction of the centre, f(t) = exp(−u²(1−t²)) (1 + erf(u t)) (see [`gaussian_column`]).
///
/// [1, 0, 0, 0] at the centre, where the Gaussian is the same all around; towards 1 from far away, where it is a point.
/// The mean of f is Daw(u)/u.
pub fn gaussian_bands(u: f64) -> [f64; 4] {
    if u < 1.0 {
        // The moments below cancel here; f is smooth, and the quadrature exact to rounding.
        let factors = zonal_factors(|t| (-u * u * (1.0 - t * t)).exp() * (1.0 + erf(u * t)));
        return factors.map(|factor| factor / factors[0]);
    }
    // Moments of f by parts, over ∫ f dt = 2 Daw(u)/u.
    let (u2, dawson) = (u * u, dawson(u));
    let slope = (-u2).exp() / PI.sqrt();
    let first = (erf(u) / u - 2.0 * slope) / (2.0 * dawson);
    let second = (u / dawson - 1.0) / (2.0 * u2);
    let third = (erf(u) / u - 2.0 / 3.0 * slope) / (2.0 * dawson) - first / u2;
    [1.0, first, 1.5 * second - 0.5, 2.5 * third - 1.5 * first]
}

/// Dawson's integral Daw(x) = exp(−x²) ∫ exp(t²) dt from 0 to `x`, within a few 1e-15 of its value.
pub fn dawson(x: f64) -> f64 {
    let z = x.abs();
    let value = if z < 7.0 {
        // exp(−z²) Σ z²ⁿ⁺¹ / (n! (2n+1)): all terms positive, so nothing cancels.
        let (mut power, mut sum, mut n) = (z, z, 0.0);
        while power > 1e-17 * sum {
            n += 1.0;
            power *= z * z / n;
            sum += power / (2.0 * n + 1.0);
        }
        (-z * z).exp() * sum
    } else {
        // 1/(2z) Σ (2n−1)!! / (2z²)ⁿ, asymptotic: its least term, e^{−z²}, is beyond rounding from z = 7 on.
        let (mut term, mut sum, mut n) = (1.0, 1.0, 1.0);
        while term > 1e-17 {
            term *= (2.0 * n - 1.0) / (2.0 * z * z);
            sum += term;
            n += 1.0;
        }
        sum / (2.0 * z)
    };
    value.copysign(x)
}

/// The scaled complementary error function exp(x²) (1 − erf(x)), within 1e-13 of its value. Infinite below −26.6.
pub fn erfcx(x: f64) -> f64 {
    if x < 2.0 {
        return (x * x).exp() * (1.0 - erf(x));
    }
    // Continued fraction, from the tail up: x + (1/2)/(x + (2/2)/(x + (3/2)/…)).
    let fraction = (1..=120).rev().fold(x, |tail, n| x + 0.5 * f64::from(n) / tail);
    1.0 / (PI.sqrt() * fraction)
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
        1.0 - (-z * z).exp() * erfcx(z)
    } else {
        // 1 − erf(6) is 2e-17, below half a unit in the last place; NaN lands here and stays NaN.
        if z.is_nan() { z } else { 1.0 }
    };
    value.copysign(x)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sh::{ShRgb, SphereRule, band, basis, henyey_greenstein_factors};
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
    fn dawson_matches_known_values() {
        // The Maclaurin series, Σ (−1)ⁿ 2ⁿ x²ⁿ⁺¹ / (2n+1)!!, summed with 60 digits, rounded.
        for (x, expected) in [
            (0.1, 0.099_335_992_397_852_86),
            (0.5, 0.424_436_383_502_022_3),
            (1.0, 0.538_079_506_912_768_4),
            (2.0, 0.301_340_388_923_791_95),
            (3.5, 0.149_621_593_080_756_48),
            (6.9, 0.073_250_120_258_635_39),
            (7.1, 0.071_142_926_911_234_72),
            (9.0, 0.055_905_046_724_350_46),
        ] {
            assert!((dawson(x) / expected - 1.0).abs() < 3e-15, "Daw({x}) = {}", dawson(x));
            assert_eq!(dawson(-x), -dawson(x));
        }
        assert_eq!(dawson(0.0), 0.0);
        // Far out it is 1/(2x) (1 + 1/(2x²) + …).
        assert!((2e8 * dawson(1e8) - 1.0).abs() < 1e-15);
        // The two expressions meet.
        assert!((dawson(7.0) / dawson(7.0 - 1e-9) - 1.0).abs() < 1e-9);
    }

    #[test]
    fn erfcx_matches_known_values() {
        // exp(x²) erfc(x) with 60 digits, rounded.
        for (x, expected) in [
            (-1.0, 5.008_980_080_762_283),
            (0.0, 1.0),
            (0.1, 0.896_456_979_969_126_7),
            (0.5, 0.615_690_344_192_925_9),
            (1.0, 0.427_583_576_155_807),
            (1.9, 0.266_509_373_661_672_65),
            (2.1, 0.245_119_123_345_172_36),
            (3.0, 0.179_001_151_181_389_96),
            (5.0, 0.110_704_637_733_068_63),
            (8.0, 0.069_985_166_200_880_92),
        ] {
            assert!((erfcx(x) / expected - 1.0).abs() < 1e-13, "erfcx({x}) = {}", erfcx(x));
        }
        // Far out it is 1/(x √π).
        assert!((1e8 * PI.sqrt() * erfcx(1e8) - 1.0).abs() < 1e-15);
    }

    #[test]
    fn gaussian_bands_are_the_optical_depths_of_a_sphere() {
        // Against the projection of the exact column. The rule has 64 nodes in z; at u = 3 the peak is 1/18 wide.
        let (center, radius) = (DVec3::new(0.3, -0.2, 0.1), 0.7);
        let rule = SphereRule::new(64);
        for u in [0.0, 0.01, 0.5, 0.999_999, 1.0, 1.7, 3.0] {
            let axis = DVec3::new(0.6, 0.48, -0.64);
            let x = center - axis * (u * radius);
            let seen = ShRgb::project(&rule, |w| DVec3::splat(gaussian_column(x, w, center, radius, 1.3)));
            let factor = if u == 0.0 { 1.0 } else { dawson(u) / u };
            let mean = 1.3 * radius * (0.5 * PI.sqrt()) * factor;
            let bands = gaussian_bands(u);
            for (k, (seen, y)) in seen.0.iter().zip(basis(axis)).enumerate() {
                let expected = mean * 4.0 * PI * bands[band(k)] * y;
                assert!((seen.x - expected).abs() < 1e-12, "u {u}, {k}: {} for {expected}", seen.x);
            }
        }
    }

    #[test]
    fn gaussian_bands_have_their_limits() {
        assert_eq!(gaussian_bands(0.0)[0], 1.0);
        // Near the centre f = 1 + 2ut/√π + O(u²): a_1 = 2u/(3√π), the others of higher order.
        let near = gaussian_bands(1e-5);
        assert!((near[1] / (2e-5 / (3.0 * PI.sqrt())) - 1.0).abs() < 1e-5);
        assert!(near[2].abs() < 1e-9 && near[3].abs() < 1e-14);
        // Far away 1 − t is distributed as exp(−2u²(1−t)): a_l = 1 − l(l+1)/2 · 1/(2u²).
        let far = gaussian_bands(1e3);
        for (l, a) in far.into_iter().enumerate() {
            let expected = 1.0 - (l * (l + 1)) as f64 / 4e6;
            assert!((a - expected).abs() < 1e-10, "{l}: {a} for {expected}");
        }
        // Between, they grow with u and fall with l.
        let mut previous = [1.0, 0.0, 0.0, 0.0];
        for i in 1..200 {
            let bands = gaussian_bands(0.05 * f64::from(i));
            for l in 1..4 {
                assert!(bands[l] > previous[l] && bands[l] < bands[l - 1]);
            }
            previous = bands;
        }
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
