//! The linear system of the diffusion equation, enforced at the RBF centres (Zhou et al. 2008, Eq. 13), as printed.
//!
//! Printed are a source of σ_t/Ω D J⁰ − σ_t/σ_tr ∇·J¹, where the moments of the transport equation give
//! σ_t D J⁰ − σ_t/(3σ_tr) ∇·J¹, and no boundary condition.

use core::ops::Add;

use glam::DVec3;

use super::Matrix;
use crate::{
    rbf::{Rbf, SUPPORT},
    reference::{rbf_center, taylor::Taylor},
};

/// A L = b for L⁰(c_l), the mean media radiance at the centres, in one colour channel.
#[derive(Clone, Debug, PartialEq)]
pub struct System {
    /// n × n, dense.
    pub matrix: Matrix,
    /// n values.
    pub rhs: Vec<f64>,
}

/// The medium of one colour channel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Optics {
    /// σ_t: extinction per bundle unit.
    pub extinction: f64,
    /// Ω.
    pub albedo: f64,
    /// Mean cosine of the phase function.
    pub g: f64,
}

impl Optics {
    /// σ_tr = (1 − Ω μ̄/3) σ_t with the paper's μ̄ = 3g.
    pub fn transport(&self) -> f64 {
        (1.0 - self.albedo * self.g) * self.extinction
    }

    /// σ_a = σ_t − σ_s.
    pub fn absorption(&self) -> f64 {
        (1.0 - self.albedo) * self.extinction
    }
}

/// A function and its first derivatives in a point.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Jet {
    /// The value.
    pub value: f64,
    /// ∇.
    pub gradient: DVec3,
    /// ∇².
    pub laplacian: f64,
}

impl Add for Jet {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            value: self.value + other.value,
            gradient: self.gradient + other.gradient,
            laplacian: self.laplacian + other.laplacian,
        }
    }
}

/// w B at `x`, zero from three radii on.
pub fn jet(rbf: &Rbf, x: DVec3) -> Jet {
    let (offset, radius_squared) = (x - rbf_center(rbf), f64::from(rbf.radius).powi(2));
    let u_squared = offset.length_squared() / radius_squared;
    if u_squared >= f64::from(SUPPORT * SUPPORT) {
        return Jet::default();
    }
    let value = f64::from(rbf.weight) * (-u_squared).exp();
    Jet {
        value,
        gradient: offset * (-2.0 * value / radius_squared),
        laplacian: value * (4.0 * u_squared - 6.0) / radius_squared,
    }
}

/// Eq. 13 at every centre. `source` holds J⁰_ss and J¹_ss of every RBF.
pub fn system(rbfs: &[Rbf], source: &[Taylor], optics: Optics) -> System {
    let (transport, absorption) = (optics.transport(), optics.absorption());
    let mut matrix = Vec::with_capacity(rbfs.len() * rbfs.len());
    let rows = rbfs.iter().map(|row| {
        let jets: Vec<Jet> = rbfs.iter().map(|rbf| jet(rbf, rbf_center(row))).collect();
        let d = jets.iter().fold(Jet::default(), |sum, &jet| sum + jet);
        let density_squared = d.value * d.value;
        let mut rhs = 0.0;
        for (b, source) in jets.iter().zip(source) {
            let diffusion = density_squared * b.laplacian - 3.0 * d.value * d.gradient.dot(b.gradient)
                + (3.0 * d.gradient.length_squared() - d.value * d.laplacian) * b.value;
            matrix.push(diffusion / (3.0 * transport * density_squared * density_squared) - absorption * b.value);
            let divergence = (b.gradient * d.value - d.gradient * b.value) / density_squared;
            rhs += optics.extinction / transport * divergence.dot(source.first)
                - optics.extinction / optics.albedo * b.value * source.mean;
        }
        rhs
    });
    let rhs = rows.collect();
    System { matrix: Matrix { size: rbfs.len(), values: matrix }, rhs }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rbfs() -> Vec<Rbf> {
        let at = |x, y, z, radius, weight| Rbf { center: [x, y, z], radius, weight };
        vec![
            at(0.0, 0.0, 0.0, 0.09, 1.0),
            at(0.06, 0.02, -0.03, 0.07, 0.6),
            at(-0.05, 0.05, 0.0, 0.08, 1.3),
            at(0.01, -0.07, 0.04, 0.06, 0.9),
        ]
    }

    const OPTICS: Optics = Optics { extinction: 7.0, albedo: 0.8, g: 0.4 };
    /// Step of the central differences: their error is (STEP/r)² = 3e-8 of a derivative, their rounding 1e-16/STEP².
    const STEP: f64 = 1e-5;

    fn density(rbfs: &[Rbf], x: DVec3) -> f64 {
        rbfs.iter().map(|rbf| jet(rbf, x).value).sum()
    }

    fn gradient(f: &dyn Fn(DVec3) -> f64, x: DVec3) -> DVec3 {
        DVec3::from(DVec3::AXES.map(|axis| (f(x + axis * STEP) - f(x - axis * STEP)) / (2.0 * STEP)))
    }

    #[test]
    fn jets_match_finite_differences() {
        let rbf = rbfs()[1];
        let x = DVec3::new(0.02, -0.04, 0.01);
        let found = jet(&rbf, x);
        let value = |x: DVec3| jet(&rbf, x).value;
        assert!((value(x) - f64::from(rbf.weight * rbf.basis(x.as_vec3()))).abs() < 1e-6);
        assert!((found.gradient - gradient(&value, x)).length() < 1e-6 * found.gradient.length());
        let laplacian: f64 =
            DVec3::AXES.map(|axis| gradient(&|x| jet(&rbf, x).gradient.dot(axis), x).dot(axis)).iter().sum();
        assert!((found.laplacian - laplacian).abs() < 1e-6 * laplacian.abs(), "{} {laplacian}", found.laplacian);
        assert_eq!(jet(&rbf, rbf_center(&rbf) + DVec3::X * 0.2101), Jet::default());
    }

    #[test]
    fn rows_are_the_diffusion_equation() {
        // ∇κ·∇L⁰ + κ∇²L⁰ − αL⁰ + S = 0 (Eq. 5), every derivative by finite differences of Eq. 12.
        let rbfs = rbfs();
        let radiance = [0.7, 1.1, 0.4, 0.9];
        let source: Vec<Taylor> =
            [0.5, 0.8, 0.3, 0.6].map(|mean| Taylor { mean, first: DVec3::new(0.3 * mean, -0.1, 0.2 - mean) }).to_vec();
        let interpolate = |values: &dyn Fn(usize) -> f64, x: DVec3| -> f64 {
            (0..4).map(|l| jet(&rbfs[l], x).value * values(l)).sum::<f64>() / density(&rbfs, x)
        };
        let system = system(&rbfs, &source, OPTICS);
        let product = system.matrix.multiply(&radiance);
        for (row, rbf) in rbfs.iter().enumerate() {
            let x = rbf_center(rbf);
            let kappa = |x: DVec3| 1.0 / (3.0 * OPTICS.transport() * density(&rbfs, x));
            let mean = |x: DVec3| interpolate(&|l| radiance[l], x);
            // ∇·(κ∇L⁰) with an outer step 10 times as long, as the inner one is rounded to 1e-11.
            let flux = |x: DVec3| kappa(x) * gradient(&mean, x);
            let outer = 10.0 * STEP;
            let divergence: f64 = DVec3::AXES
                .map(|axis| (flux(x + axis * outer) - flux(x - axis * outer)).dot(axis) / (2.0 * outer))
                .iter()
                .sum();
            let divergence_of_source: f64 =
                (0..3).map(|axis| gradient(&|x| interpolate(&|l| source[l].first[axis], x), x)[axis]).sum();
            let (sigma_t, sigma_tr) = (OPTICS.extinction, OPTICS.transport());
            let d = density(&rbfs, x);
            let s = sigma_t / OPTICS.albedo * d * interpolate(&|l| source[l].mean, x)
                - sigma_t / sigma_tr * divergence_of_source;
            let left = divergence - OPTICS.absorption() * d * mean(x);
            // Differences of differences.
            assert!((product[row] - left).abs() < 1e-4 * left.abs(), "{} {left}", product[row]);
            assert!((system.rhs[row] + s).abs() < 1e-6 * s.abs(), "{} {s}", system.rhs[row]);
        }
    }

    #[test]
    fn one_rbf_is_absorption_alone() {
        // L⁰ is constant in the only interpolation there is, and so is the source.
        let rbf = Rbf { center: [0.0; 3], radius: 0.05, weight: 2.0 };
        let system = system(&[rbf], &[Taylor { mean: 0.5, first: DVec3::X }], OPTICS);
        assert!((system.matrix.values[0] + 2.0 * 7.0 * 0.2).abs() < 1e-12);
        assert!((system.rhs[0] + 2.0 * 7.0 * 0.5 / 0.8).abs() < 1e-12);
    }
}
