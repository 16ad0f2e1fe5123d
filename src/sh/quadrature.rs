//! Directions to integrate over: an exact product rule, and the Fibonacci directions of the incident light pass.

use core::f64::consts::PI;
use std::sync::OnceLock;

use glam::DVec3;

use super::Coefficient;

/// Directions and weights (steradians, summing to 4π) that integrate polynomials on the sphere exactly.
#[derive(Clone, Debug)]
pub struct SphereRule {
    nodes: Vec<(DVec3, f64)>,
    degree: usize,
}

impl SphereRule {
    /// `n` ≥ 1 Gauss–Legendre nodes in z times 2n equally spaced longitudes: 2n² directions, exact through degree 2n −
    /// 1.
    pub fn new(n: usize) -> Self {
        let n = n.max(1);
        let longitude = PI / n as f64;
        let mut nodes = Vec::with_capacity(2 * n * n);
        for (z, weight) in gauss_legendre(n) {
            let radius = (1.0 - z * z).sqrt();
            for i in 0..2 * n {
                let (sin, cos) = ((i as f64 + 0.5) * longitude).sin_cos();
                nodes.push((DVec3::new(radius * cos, radius * sin, z), weight * longitude));
            }
        }
        Self { nodes, degree: 2 * n - 1 }
    }

    /// The 50 directions exact through degree 9: enough for the product of three functions of order 4.
    pub(super) fn exact() -> &'static Self {
        static RULE: OnceLock<SphereRule> = OnceLock::new();
        RULE.get_or_init(|| Self::new(5))
    }

    /// The highest polynomial degree integrated exactly.
    pub fn degree(&self) -> usize {
        self.degree
    }

    /// Unit directions, each with its weight in steradians.
    pub fn nodes(&self) -> &[(DVec3, f64)] {
        &self.nodes
    }

    /// ∫ f dω over the sphere.
    pub fn integrate<T: Coefficient>(&self, f: impl Fn(DVec3) -> T) -> T {
        self.nodes.iter().fold(T::default(), |sum, &(dir, weight)| sum + f(dir) * weight)
    }
}

/// Nodes and weights of the `n`-point Gauss–Legendre rule on [−1, 1], by Newton's method on P_n.
pub(super) fn gauss_legendre(n: usize) -> impl Iterator<Item = (f64, f64)> {
    (0..n).map(move |i| {
        let mut x = (PI * (i as f64 + 0.75) / (n as f64 + 0.5)).cos();
        let mut slope = 1.0;
        // The start is within O(1/n²) of the root and Newton doubles the digits: six steps are one or two to spare.
        for _ in 0..6 {
            let (mut previous, mut p) = (1.0, x);
            for l in 1..n {
                let l = l as f64;
                (previous, p) = (p, ((2.0 * l + 1.0) * x * p - l * previous) / (l + 1.0));
            }
            slope = n as f64 * (previous - x * p) / (1.0 - x * x);
            x -= p / slope;
        }
        (x, 2.0 / ((1.0 - x * x) * slope * slope))
    })
}

/// `n` nearly uniform fixed directions on a Fibonacci spiral about +Y, each standing for 4π/n steradians.
pub fn fibonacci(n: usize) -> impl Iterator<Item = DVec3> {
    (0..n).map(move |j| {
        let y = 1.0 - (2 * j + 1) as f64 / n as f64;
        let (sin, cos) = (j as f64 * PI * (3.0 - 5f64.sqrt())).sin_cos();
        let radius = (1.0 - y * y).sqrt();
        DVec3::new(radius * cos, y, radius * sin)
    })
}
