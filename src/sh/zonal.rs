//! Functions of the angle to an axis, and convolution with them.
//!
//! A kernel h(cos θ) is four band factors λ_l = 2π ∫ h(t) P_l(t) dt over t from −1 to 1. By the Funk–Hecke theorem
//! ∫ h(ω·a) y_k(ω) dω = λ_l y_k(a): the same factors project a lobe about an axis and convolve any function.

use core::f64::consts::PI;

use glam::DVec3;

use super::{BANDS, Coefficient, Sh, band, basis, quadrature::gauss_legendre};

/// Factors of the clamped cosine max(t, 0): radiance convolved with it is irradiance by normal.
pub const CLAMPED_COSINE: [f64; BANDS] = [PI, 2.0 * PI / 3.0, PI / 4.0, 0.0];

/// Factors of the Henyey–Greenstein phase function with mean cosine `g`: g^l.
pub fn henyey_greenstein_factors(g: f64) -> [f64; BANDS] {
    [1.0, g, g * g, g * g * g]
}

/// Factors of any kernel, by 64-point Gauss–Legendre quadrature in t: exact for polynomials of degree ≤ 124.
pub fn zonal_factors(kernel: impl Fn(f64) -> f64) -> [f64; BANDS] {
    zonal_factors_between(-1.0, 1.0, kernel)
}

/// Factors of a kernel that vanishes but for t from `low` to `high`, by as many points there: for kernels with a narrow
/// peak or a kink, in pieces to be added up.
pub fn zonal_factors_between(low: f64, high: f64, kernel: impl Fn(f64) -> f64) -> [f64; BANDS] {
    let mut factors = [0.0; BANDS];
    let half = 0.5 * (high - low);
    for (t, weight) in gauss_legendre(64) {
        let (t, weight) = (low + half * (1.0 + t), half * weight);
        let legendre = [1.0, t, 0.5 * (3.0 * t * t - 1.0), 0.5 * t * (5.0 * t * t - 3.0)];
        for (factor, p) in factors.iter_mut().zip(legendre) {
            *factor += 2.0 * PI * weight * kernel(t) * p;
        }
    }
    factors
}

impl<T: Coefficient> Sh<T> {
    /// The function ω ↦ `scale` h(ω·`axis`), with the unit vector `axis` and the factors of h.
    pub fn zonal(axis: DVec3, factors: &[f64; BANDS], scale: T) -> Self {
        let y = basis(axis);
        Self(core::array::from_fn(|k| scale * (factors[band(k)] * y[k])))
    }

    /// The convolution v ↦ ∫ f(ω) h(ω·v) dω with the kernel h of these factors.
    pub fn convolve(&self, factors: &[f64; BANDS]) -> Self {
        Self(core::array::from_fn(|k| self.0[k] * factors[band(k)]))
    }
}
