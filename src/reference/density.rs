//! Density: the sum of the Gaussians and the residual, at every cell.

use glam::{DVec3, UVec3};
use rayon::prelude::*;

use super::{Grid, center, rbf_center};
use crate::{
    density::GridShape,
    rbf::{Rbf, SUPPORT},
};

/// D(cell) = max(0, Σ w_l B_l(x) + R(cell)) at the cell's centre x.
pub fn density(rbfs: &[Rbf], residual: impl Fn(UVec3) -> f64 + Sync, shape: GridShape) -> Grid {
    let values = (0..shape.len())
        .into_par_iter()
        .map(|index| {
            let cell = shape.cell(index);
            let x = center(shape, cell);
            let sum: f64 = rbfs.iter().map(|rbf| gaussian(rbf, x)).sum();
            (sum + residual(cell)).max(0.0)
        })
        .collect();
    Grid { shape, values }
}

/// w exp(−|x−c|²/r²), zero at three radii and beyond.
pub(super) fn gaussian(rbf: &Rbf, x: DVec3) -> f64 {
    let radius = f64::from(rbf.radius);
    let u_squared = (x - rbf_center(rbf)).length_squared() / (radius * radius);
    if u_squared < f64::from(SUPPORT * SUPPORT) { f64::from(rbf.weight) * (-u_squared).exp() } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use core::f64::consts::PI;

    use super::*;

    #[test]
    fn one_gaussian() {
        let shape = GridShape::new(UVec3::new(48, 64, 40));
        let rbf = Rbf { center: [0.03, -0.07, 0.02], radius: 0.09, weight: 1.7 };
        let grid = density(&[rbf], |_| 0.0, shape);
        let cell = UVec3::new(20, 25, 22);
        // By hand: x = (cell + 0.5 − dims/2)/64 = (−7, −13, 5)/128.
        let d2 = (-7.0 / 128.0 - 0.03f64).powi(2) + (-13.0 / 128.0 + 0.07f64).powi(2) + (5.0 / 128.0 - 0.02f64).powi(2);
        // The RBF is stored in f32.
        assert!((grid.values[shape.index(cell)] - 1.7 * (-d2 / 0.0081).exp()).abs() < 1e-6);
        // ∫ over a ball of 3 radii: w r³ (π^1.5 erf 3 − 2π 3 e⁻⁹). Sums over a grid of 5.8 cells a radius are exact to
        // e^{−π²5.8²}; what remains is the cut, e⁻⁹ on the sphere's few boundary cells.
        let integral: f64 = grid.values.iter().sum::<f64>() / 64f64.powi(3);
        let expected = 1.7 * 0.09f64.powi(3) * (PI.powf(1.5) * crate::optics::erf(3.0) - 6.0 * PI * (-9f64).exp());
        assert!((integral / expected - 1.0).abs() < 1e-4, "{integral} {expected}");
    }

    #[test]
    fn gaussians_and_residual_add_and_never_go_below_zero() {
        let shape = GridShape::new(UVec3::new(8, 8, 8));
        let rbf = |x, weight| Rbf { center: [x, 0.0, 0.0], radius: 0.1, weight };
        let grid = density(&[rbf(0.1, 1.0), rbf(-0.2, 0.5)], |cell| f64::from(cell.x) - 3.0, shape);
        for (index, &value) in grid.values.iter().enumerate() {
            let cell = shape.cell(index);
            let x = center(shape, cell);
            let sum = gaussian(&rbf(0.1, 1.0), x) + gaussian(&rbf(-0.2, 0.5), x) + f64::from(cell.x) - 3.0;
            // Summed in another order.
            assert!((value - sum.max(0.0)).abs() < 1e-14);
        }
        assert!(grid.values.contains(&0.0));
        // Nothing beyond three radii, e⁻⁹ just within.
        assert_eq!(gaussian(&rbf(0.0, 1.0), DVec3::X * 0.3001), 0.0);
        assert!((gaussian(&rbf(0.0, 1.0), DVec3::X * 0.2999) / (-9f64).exp() - 1.0).abs() < 1e-2);
    }
}
