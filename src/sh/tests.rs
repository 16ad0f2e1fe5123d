//! Closed forms and quadrature. Where a quantity is a polynomial the rules are exact and the tolerance is rounding:
//! about a hundred operations on numbers below ten, so 1e-13.

use core::f64::consts::PI;

use glam::{DMat3, DQuat, DVec3};
use proptest::prelude::*;

use super::*;

const ROUNDING: f64 = 1e-13;

fn rule() -> SphereRule {
    SphereRule::new(16)
}

fn assert_close<const N: usize>(a: [f64; N], b: [f64; N], tolerance: f64) {
    for k in 0..N {
        assert!((a[k] - b[k]).abs() <= tolerance, "[{k}]: {} for {}", a[k], b[k]);
    }
}

/// Some function with every coefficient non-zero.
fn sample_sh(seed: f64) -> Sh<f64> {
    Sh(core::array::from_fn(|k| (seed + 1.7 * k as f64).sin()))
}

#[test]
fn constants_match_their_closed_forms() {
    let y = basis(DVec3::new(1.0, 1.0, 1.0)); // not a unit vector: polynomial values show the bare constants
    let root = |q: f64| (q / PI).sqrt();
    assert_close(
        y,
        [
            0.5 * root(1.0),
            -0.5 * root(3.0),
            0.5 * root(3.0),
            -0.5 * root(3.0),
            0.5 * root(15.0),
            -0.5 * root(15.0),
            0.25 * root(5.0) * 2.0,
            -0.5 * root(15.0),
            0.0,
            -0.25 * root(17.5) * 2.0,
            0.5 * root(105.0),
            -0.25 * root(10.5) * 4.0,
            0.25 * root(7.0) * 2.0,
            -0.25 * root(10.5) * 4.0,
            0.0,
            0.25 * root(17.5) * 2.0,
        ],
        1e-15,
    );
    // The two that vanish there.
    let y = basis(DVec3::new(1.0, 0.0, 1.0));
    assert_close([y[8], y[14]], [0.25 * root(15.0), 0.25 * root(105.0)], 1e-15);
    assert_eq!((0..COEFFICIENTS).map(band).collect::<Vec<_>>(), [0, 1, 1, 1, 2, 2, 2, 2, 2, 3, 3, 3, 3, 3, 3, 3]);
}

#[test]
fn basis_is_orthonormal() {
    for i in 0..COEFFICIENTS {
        let column = Sh::project(&rule(), |w| basis(w)[i]);
        assert_close(column.0, core::array::from_fn(|k| f64::from(i == k)), ROUNDING);
    }
}

#[test]
fn rules_integrate_monomials_exactly() {
    // ∫ x²ᵃ y²ᵇ z²ᶜ dω = 4π (2a−1)!! (2b−1)!! (2c−1)!! / (2(a+b+c)+1)!!; odd powers vanish.
    for n in [1, 2, 5, 16] {
        let rule = SphereRule::new(n);
        assert_eq!(rule.degree(), 2 * n - 1);
        assert!((rule.integrate(|_| 1.0) - 4.0 * PI).abs() < ROUNDING);
        if n >= 5 {
            let integral: f64 = rule.integrate(|w| w.x.powi(4) * w.y.powi(2) * w.z.powi(2));
            assert!((integral - 4.0 * PI * 3.0 / 945.0).abs() < ROUNDING);
            assert!(rule.integrate(|w| w.x.powi(4) * w.y * w.z.powi(4)).abs() < ROUNDING);
        }
    }
}

#[test]
fn projection_reproduces_polynomials() {
    // x y z = y10 / 2.890611…, z³ = 2/5 P3 + 3/5 P1, 1 = √(4π) y0.
    let f = |w: DVec3| 2.0 + w.x * w.y * w.z - 3.0 * w.z.powi(3);
    let sh = Sh::project(SphereRule::exact(), f);
    let mut expected = [0.0; 16];
    expected[0] = 2.0 * (4.0 * PI).sqrt();
    expected[10] = (4.0 * PI / 105.0).sqrt();
    expected[2] = -3.0 * 0.6 * (4.0 * PI / 3.0).sqrt();
    expected[12] = -3.0 * 0.4 * (4.0 * PI / 7.0).sqrt();
    assert_close(sh.0, expected, ROUNDING);
    for w in fibonacci(20) {
        assert!((sh.evaluate(w) - f(w)).abs() < ROUNDING);
    }
    assert_close(Sh::constant(2.0).0, Sh::project(&rule(), |_| 2.0).0, ROUNDING);
}

#[test]
fn fibonacci_directions_follow_the_definition() {
    let w: Vec<_> = fibonacci(32).collect();
    assert_eq!(w.len(), 32);
    // j = 0: y = 31/32, φ = 0. j = 1: y = 29/32, φ = π(3−√5) = 2.399963.
    assert!((w[0] - DVec3::new((1.0 - 0.96875f64 * 0.96875).sqrt(), 0.96875, 0.0)).length() < 1e-15);
    let radius = (1.0 - 0.90625f64 * 0.90625).sqrt();
    let expected =
        DVec3::new(radius * 2.399_963_229_728_653f64.cos(), 0.90625, radius * 2.399_963_229_728_653f64.sin());
    assert!((w[1] - expected).length() < 1e-14);
    assert!(w.iter().all(|w| (w.length() - 1.0).abs() < 1e-15));
    // Nearly uniform: the 16 moments of 1024 directions are those of the sphere to 1 in 1000.
    let moments = fibonacci(1024).fold(Sh::default(), |mut sh, w| {
        sh.accumulate(w, 4.0 * PI / 1024.0);
        sh
    });
    assert_close(moments.0, Sh::constant(1.0).0, 5e-3);
}

#[test]
fn gaunt_tensor_is_symmetric_and_has_known_entries() {
    let find = |i, j, k| gaunt().iter().find(|t| (t.i, t.j, t.k) == (i, j, k)).map_or(0.0, |t| t.value);
    for t in gaunt() {
        assert!((find(t.j, t.i, t.k) - t.value).abs() < 1e-15);
        assert!((find(t.k, t.j, t.i) - t.value).abs() < 1e-15);
    }
    // y0 times anything scales it by y0; ∫ y2² y6 = 1/√(5π) is the textbook l = 1, 1, 2 entry.
    for k in 0..COEFFICIENTS {
        assert!((find(0, k, k) - 0.25f64.sqrt() / PI.sqrt()).abs() < 1e-15);
    }
    assert!((find(2, 2, 6) - 1.0 / (5.0 * PI).sqrt()).abs() < 1e-15);
    let smallest = gaunt().iter().map(|t| t.value.abs()).fold(f64::INFINITY, f64::min);
    assert!(smallest > 0.02, "{smallest}");
}

#[test]
fn product_is_the_projected_pointwise_product() {
    let (a, b) = (sample_sh(0.3), sample_sh(2.1));
    let expected = Sh::project(&rule(), |w| a.evaluate(w) * b.evaluate(w));
    assert_close(a.product(&b).0, expected.0, ROUNDING);
    assert_close(a.product(&Sh::constant(1.0)).0, a.0, ROUNDING);
    // RGB multiplies channel by channel.
    let rgb = |s: f64| Sh(core::array::from_fn(|k| DVec3::new(sample_sh(s).0[k], sample_sh(s + 1.0).0[k], 0.0)));
    let product = rgb(0.3).product(&rgb(2.1));
    assert_close(product.0.map(|c| c.x), expected.0, ROUNDING);
    assert_close(product.0.map(|c| c.z), [0.0; 16], 0.0);
}

#[test]
fn convolution_is_the_integral_against_the_kernel() {
    let f = sample_sh(1.0);
    // A cubic kernel keeps the integrand polynomial, so both sides are exact.
    let kernel = |t: f64| 0.4 + t - 0.7 * t * t + 2.0 * t * t * t;
    let convolved = f.convolve(&zonal_factors(kernel));
    for v in fibonacci(20) {
        let expected = rule().integrate(|w| f.evaluate(w) * kernel(w.dot(v)));
        assert!((convolved.evaluate(v) - expected).abs() < ROUNDING);
    }
    // The clamped cosine has a kink, where the rule is of second order only: (π/200)² = 2e-4.
    let irradiance = f.convolve(&CLAMPED_COSINE);
    let fine = SphereRule::new(200);
    let expected = fine.integrate(|w| f.evaluate(w) * w.x.max(0.0));
    assert!((irradiance.evaluate(DVec3::X) - expected).abs() < 1e-3, "{}", irradiance.evaluate(DVec3::X) - expected);
}

#[test]
fn zonal_factors_match_closed_forms() {
    // Powers of t: λ_l of t² is 4π/3, 0, 8π/15, 0.
    assert_close(zonal_factors(|t| t * t), [4.0 * PI / 3.0, 0.0, 8.0 * PI / 15.0, 0.0], ROUNDING);
    // The kink of the clamped cosine costs the rule O(1/n²) = 2e-4, times 2π.
    assert_close(zonal_factors(|t| t.max(0.0)), CLAMPED_COSINE, 2e-3);
}

#[test]
fn zonal_lobe_is_its_kernel() {
    let lobe = |t: f64| (1.0 + t) * (t + 0.3) * (t + 0.3) / 3.38;
    let axis = DVec3::new(0.3, -0.8, 0.4).normalize();
    let sh = ShRgb::zonal(axis, &zonal_factors(lobe), DVec3::new(1.0, 2.0, 0.5));
    for w in fibonacci(20) {
        assert!((sh.evaluate(w) - DVec3::new(1.0, 2.0, 0.5) * lobe(w.dot(axis))).length() < ROUNDING);
    }
}

#[test]
fn sums_and_multiples_are_linear() {
    let (a, b) = (sample_sh(0.1), sample_sh(0.2));
    let w = DVec3::new(0.36, 0.48, 0.8);
    assert!(((a + b * 3.0).evaluate(w) - a.evaluate(w) - 3.0 * b.evaluate(w)).abs() < ROUNDING);
}

proptest! {
    #[test]
    fn rotation_turns_the_function(axis in prop::array::uniform3(-1.0..1.0f64), angle in -PI..PI, seed in 0.0..6.0f64) {
        let rotation = DMat3::from_quat(DQuat::from_axis_angle(DVec3::from(axis).normalize_or(DVec3::Y), angle));
        let f = sample_sh(seed);
        let g = f.rotate(rotation);
        for w in fibonacci(8) {
            prop_assert!((g.evaluate(rotation * w) - f.evaluate(w)).abs() < ROUNDING);
        }
        // Rotations keep the norm of every band, and undo.
        let norm = |sh: &Sh<f64>, l| (0..16).filter(|&k| band(k) == l).map(|k| sh.0[k] * sh.0[k]).sum::<f64>();
        for l in 0..BANDS {
            prop_assert!((norm(&f, l) - norm(&g, l)).abs() < ROUNDING);
        }
        assert_close(g.rotate(rotation.transpose()).0, f.0, ROUNDING);
    }
}

#[test]
fn reflection_is_exact_too() {
    let flip = DMat3::from_diagonal(DVec3::new(1.0, 1.0, -1.0));
    let f = sample_sh(0.7);
    let g = f.rotate(flip);
    for w in fibonacci(8) {
        assert!((g.evaluate(w) - f.evaluate(flip * w)).abs() < ROUNDING);
    }
}
