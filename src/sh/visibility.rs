//! The logarithm of a sphere's visibility (Ren et al. 2006, section 4), which adds up where spheres do.
//!
//! A sphere at a distance d hides the cap of half angle α, sin α = r/d: its visibility V is 0 there and 1 elsewhere, or
//! what four bands keep of that. The logarithm is taken of the product with it: as ln M_V · 1, with M_V the matrix of the
//! linear map f ↦ V f, whose eigenvalues are clipped from below.

use core::f64::consts::PI;

use super::{BANDS, quadrature::gauss_legendre, zonal_factors_between};

/// Visibilities below this count as this: fully hidden has no logarithm.
const DARKEST: f64 = 0.02;

/// Entries of [`log_visibilities`].
pub const VISIBILITY_ENTRIES: usize = 64;

/// Factors λ_l of ln V of a sphere for r/d = `sine`, 0 to 1: ln V = Σ λ_l y_k(ω) y_k(toward the sphere).
pub fn log_visibility(sine: f64) -> [f64; BANDS] {
    let cosine = (1.0 - sine * sine).max(0.0).sqrt();
    // V as m = 0 coefficients with the axis along z: λ_l √((2l + 1)/4π).
    let root = |l: usize| ((2 * l + 1) as f64 / (4.0 * PI)).sqrt();
    let hidden = zonal_factors_between(cosine, 1.0, |_| 1.0);
    let visible: [f64; BANDS] =
        core::array::from_fn(|l| if l == 0 { (4.0 * PI).sqrt() } else { 0.0 } - hidden[l] * root(l));
    // Where products are with a function of the height alone, m = 0 stays by itself.
    let y = |t: f64| {
        let legendre = [1.0, t, 0.5 * (3.0 * t * t - 1.0), 0.5 * t * (5.0 * t * t - 3.0)];
        core::array::from_fn::<f64, BANDS, _>(|l| root(l) * legendre[l])
    };
    let mut matrix = [[0.0; BANDS]; BANDS];
    for (t, weight) in gauss_legendre(8) {
        let y = y(t);
        let v: f64 = y.iter().zip(&visible).map(|(y, v)| y * v).sum();
        for i in 0..BANDS {
            for j in 0..BANDS {
                matrix[i][j] += 2.0 * PI * weight * v * y[i] * y[j];
            }
        }
    }
    let (values, vectors) = eigen(matrix);
    let logarithm = |l: usize| -> f64 {
        let term = |e: usize| vectors[l][e] * values[e].max(DARKEST).ln() * vectors[0][e];
        (0..BANDS).map(term).sum::<f64>() * (4.0 * PI).sqrt()
    };
    core::array::from_fn(|l| logarithm(l) / root(l))
}

/// [`log_visibility`] at evenly spaced r/d from 0 to 1.
pub fn log_visibilities() -> [[f64; BANDS]; VISIBILITY_ENTRIES] {
    core::array::from_fn(|i| log_visibility(i as f64 / (VISIBILITY_ENTRIES - 1) as f64))
}

/// Eigenvalues of a symmetric matrix, and in columns its eigenvectors: Jacobi's rotations.
fn eigen(mut a: [[f64; BANDS]; BANDS]) -> ([f64; BANDS], [[f64; BANDS]; BANDS]) {
    let mut vectors: [[f64; BANDS]; BANDS] =
        core::array::from_fn(|i| core::array::from_fn(|j| f64::from(u8::from(i == j))));
    // Quadratic convergence: a handful of sweeps leaves rounding.
    for _ in 0..12 {
        for p in 0..BANDS {
            for q in p + 1..BANDS {
                if a[p][q].abs() < 1e-300 {
                    continue;
                }
                let theta = 0.5 * (a[q][q] - a[p][p]) / a[p][q];
                let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
                let c = 1.0 / (t * t + 1.0).sqrt();
                let s = t * c;
                for row in &mut a {
                    (row[p], row[q]) = (c * row[p] - s * row[q], s * row[p] + c * row[q]);
                }
                (a[p], a[q]) = (
                    core::array::from_fn(|k| c * a[p][k] - s * a[q][k]),
                    core::array::from_fn(|k| s * a[p][k] + c * a[q][k]),
                );
                for row in &mut vectors {
                    (row[p], row[q]) = (c * row[p] - s * row[q], s * row[p] + c * row[q]);
                }
            }
        }
    }
    (core::array::from_fn(|i| a[i][i]), vectors)
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::sh::{Sh, scaling_and_squaring};

    #[test]
    fn eigenvectors_diagonalise() {
        let a = [[2.0, 0.5, -0.3, 0.1], [0.5, 1.0, 0.7, 0.0], [-0.3, 0.7, -1.0, 0.4], [0.1, 0.0, 0.4, 3.0]];
        let (values, v) = eigen(a);
        for i in 0..4 {
            for j in 0..4 {
                let product: f64 = (0..4).map(|e| v[i][e] * values[e] * v[j][e]).sum();
                assert!((product - a[i][j]).abs() < 1e-13);
            }
        }
    }

    #[test]
    fn exponentiated_it_is_the_visibility_again() {
        for sine in [0.1, 0.3, 0.6, 0.8_f64] {
            let axis = DVec3::new(0.6, 0.0, 0.8);
            let hidden = zonal_factors_between((1.0 - sine * sine).sqrt(), 1.0, |_| 1.0);
            let visible = Sh::constant(1.0) + Sh::zonal(axis, &hidden, -1.0);
            let found = scaling_and_squaring(&Sh::zonal(axis, &log_visibility(sine), 1.0), BANDS);
            // Eigenvalues that are clipped, and the series, each take a percent of the mean, √4π.
            for (found, exact) in found.0.iter().zip(visible.0) {
                assert!((found - exact).abs() < 0.05, "{sine}: {found} for {exact}");
            }
        }
        assert!(log_visibility(0.0).iter().all(|factor| factor.abs() < 1e-12));
    }
}
