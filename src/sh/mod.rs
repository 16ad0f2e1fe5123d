//! Real spherical harmonics of order 4: bands 0 to 3, 16 coefficients.
//!
//! Functions on the sphere are kept as `f = Σ_k c_k y_k` with `k = l(l+1)+m`, in the usual graphics signs (Sloan 2008).
//! Radiance is `ShRgb`, a linear RGB triple per coefficient; single-channel functions are `Sh<f64>`.
//!
//! Products, rotations and projections all go through one idea: a Gauss quadrature of the sphere that is exact for the
//! polynomials involved ([`SphereRule`]).

mod exponential;
mod product;
mod quadrature;
#[cfg(test)]
mod tests;
mod visibility;
mod zonal;

use core::ops::{Add, Mul};

use glam::{DMat3, DVec3};

pub use exponential::{Exponential, HALVINGS, NORM_STEP, NORMS, OptimalLinear, by_quadrature, scaling_and_squaring};
pub use product::{Gaunt, gaunt};
pub use quadrature::{SphereRule, fibonacci};
pub use visibility::{VISIBILITY_ENTRIES, log_visibilities, log_visibility};
pub use zonal::{CLAMPED_COSINE, henyey_greenstein_factors, zonal_factors, zonal_factors_between};

/// Bands kept: l = 0 to 3.
pub const BANDS: usize = 4;
/// Coefficients kept, one per (l, m).
pub const COEFFICIENTS: usize = BANDS * BANDS;

/// The band l of coefficient `k`.
pub const fn band(k: usize) -> usize {
    k.isqrt()
}

/// The 16 basis functions at the unit vector `dir`.
pub fn basis(dir: DVec3) -> [f64; COEFFICIENTS] {
    let DVec3 { x, y, z } = dir;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        0.282_094_791_773_878_14,
        -0.488_602_511_902_919_9 * y,
        0.488_602_511_902_919_9 * z,
        -0.488_602_511_902_919_9 * x,
        1.092_548_430_592_079 * x * y,
        -1.092_548_430_592_079 * y * z,
        0.315_391_565_252_520_05 * (3.0 * zz - 1.0),
        -1.092_548_430_592_079 * x * z,
        0.546_274_215_296_039_5 * (xx - yy),
        -0.590_043_589_926_643_5 * y * (3.0 * xx - yy),
        2.890_611_442_640_554 * x * y * z,
        -0.457_045_799_464_465_8 * y * (5.0 * zz - 1.0),
        0.373_176_332_590_115_4 * z * (5.0 * zz - 3.0),
        -0.457_045_799_464_465_8 * x * (5.0 * zz - 1.0),
        1.445_305_721_320_277 * z * (xx - yy),
        -0.590_043_589_926_643_5 * x * (xx - 3.0 * yy),
    ]
}

/// What a coefficient can be: `f64` (one channel) or `DVec3` (linear RGB, multiplied channel by channel).
pub trait Coefficient: Copy + Default + Add<Output = Self> + Mul<Output = Self> + Mul<f64, Output = Self> {}

impl<T: Copy + Default + Add<Output = T> + Mul<Output = T> + Mul<f64, Output = T>> Coefficient for T {}

/// A function on the sphere of order 4, as its 16 coefficients.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sh<T>(pub [T; COEFFICIENTS]);

/// A linear RGB function on the sphere, usually radiance.
pub type ShRgb = Sh<DVec3>;

impl<T: Coefficient> Sh<T> {
    /// The function that is `value` everywhere.
    pub fn constant(value: T) -> Self {
        let mut sh = Self::default();
        sh.0[0] = value * (4.0 * core::f64::consts::PI).sqrt();
        sh
    }

    /// The projection of `f`: c_k = ∫ f y_k dω by `rule`, exact where `f` is a polynomial of degree ≤ `rule.degree() -
    /// 3`.
    pub fn project(rule: &SphereRule, f: impl Fn(DVec3) -> T) -> Self {
        let mut sh = Self::default();
        for &(dir, weight) in rule.nodes() {
            sh.accumulate(dir, f(dir) * weight);
        }
        sh
    }

    /// Adds the projection of a point mass: c_k += `value` y_k(`dir`). The inner step of every quadrature.
    pub fn accumulate(&mut self, dir: DVec3, value: T) {
        for (c, y) in self.0.iter_mut().zip(basis(dir)) {
            *c = *c + value * y;
        }
    }

    /// The value in the unit direction `dir`.
    pub fn evaluate(&self, dir: DVec3) -> T {
        self.0.iter().zip(basis(dir)).fold(T::default(), |sum, (&c, y)| sum + c * y)
    }

    /// The pointwise product of two functions, projected back to order 4: exact, the higher bands are cut off.
    pub fn product(&self, other: &Self) -> Self {
        let mut sh = Self::default();
        for t in gaunt() {
            sh.0[t.k] = sh.0[t.k] + self.0[t.i] * other.0[t.j] * t.value;
        }
        sh
    }

    /// The function turned by the orthogonal matrix `rotation`: g(ω) = f(Rᵀω). Exact; reflections are fine too.
    pub fn rotate(&self, rotation: DMat3) -> Self {
        let inverse = rotation.transpose();
        Self::project(SphereRule::exact(), |dir| self.evaluate(inverse * dir))
    }
}

impl<T: Coefficient> Add for Sh<T> {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self(core::array::from_fn(|k| self.0[k] + other.0[k]))
    }
}

impl<T: Coefficient> Mul<f64> for Sh<T> {
    type Output = Self;

    fn mul(self, factor: f64) -> Self {
        Self(self.0.map(|c| c * factor))
    }
}
