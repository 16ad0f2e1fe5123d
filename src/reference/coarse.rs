//! Coarse: box averages of the density, on the grid through which probes look for light.

use glam::UVec3;
use rayon::prelude::*;

use super::Grid;
use crate::density::COARSE_CELLS;

/// The density averaged over the cells of [`GridShape::coarse`](crate::density::GridShape::coarse): cubes of
/// h = max(1, longest/[`COARSE_CELLS`]) fine cells a side, centred on the box. Density is constant within a fine cell here, and zero
/// outside the box, where outer coarse cells may stick out.
pub fn coarse(fine: &Grid) -> Grid {
    let shape = fine.shape.coarse();
    let h = (f64::from(fine.shape.longest()) / f64::from(COARSE_CELLS)).max(1.0);
    // Per axis and coarse cell: the fine cells it overlaps, and by how much.
    let overlaps: [Vec<Vec<(u32, f64)>>; 3] = core::array::from_fn(|axis| {
        let (fine_dim, coarse_dim) = (fine.shape.dims[axis], shape.dims[axis]);
        (0..coarse_dim)
            .map(|i| {
                let low = (f64::from(i) - 0.5 * f64::from(coarse_dim)) * h + 0.5 * f64::from(fine_dim);
                let overlap = |j: u32| (low + h).min(f64::from(j) + 1.0) - low.max(f64::from(j));
                (0..fine_dim).map(|j| (j, overlap(j))).filter(|&(_, overlap)| overlap > 0.0).collect()
            })
            .collect()
    });
    let values = (0..shape.len())
        .into_par_iter()
        .map(|index| {
            let cell = shape.cell(index);
            let mut mass = 0.0;
            for &(z, dz) in &overlaps[2][cell.z as usize] {
                for &(y, dy) in &overlaps[1][cell.y as usize] {
                    for &(x, dx) in &overlaps[0][cell.x as usize] {
                        mass += dx * dy * dz * fine.values[fine.shape.index(UVec3::new(x, y, z))];
                    }
                }
            }
            mass / (h * h * h)
        })
        .collect();
    Grid { shape, values }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{density::GridShape, reference::center};

    fn grid(dims: [u32; 3], f: impl Fn(UVec3) -> f64) -> Grid {
        let shape = GridShape::new(dims.into());
        Grid { shape, values: (0..shape.len()).map(|i| f(shape.cell(i))).collect() }
    }

    fn noise(cell: UVec3) -> f64 {
        (f64::from(cell.x) * 1.3 + f64::from(cell.y) * 2.7 + f64::from(cell.z) * 0.9).sin() + 1.0
    }

    #[test]
    fn mass_is_preserved() {
        for dims in [[128, 64, 64], [80, 75, 101], [65, 1, 64], [7, 12, 32]] {
            let fine = grid(dims, noise);
            let coarse = coarse(&fine);
            // In bundle units a cell's volume is 1/longest³ for both.
            let mass = |g: &Grid| g.values.iter().sum::<f64>() / f64::from(g.shape.longest()).powi(3);
            assert!((mass(&coarse) / mass(&fine) - 1.0).abs() < 1e-12, "{dims:?}");
        }
    }

    #[test]
    fn small_grids_are_copied() {
        let fine = grid([7, 12, 32], noise);
        let coarse = coarse(&fine);
        assert_eq!(coarse.shape, fine.shape);
        for (a, b) in coarse.values.iter().zip(&fine.values) {
            assert!((a - b).abs() < 1e-14);
        }
    }

    #[test]
    fn whole_factors_average_blocks() {
        let fine = grid([128, 64, 64], noise);
        let coarse = coarse(&fine);
        let cell = UVec3::new(3, 17, 31);
        let block = (0..8).map(|i| noise(cell * 2 + UVec3::new(i & 1, i >> 1 & 1, i >> 2)));
        assert!((coarse.values[coarse.shape.index(cell)] - block.sum::<f64>() / 8.0).abs() < 1e-14);
    }

    #[test]
    fn a_ramp_stays_a_ramp() {
        // x, piecewise constant, has the averages of x up to the cells cut in two: those err by at most h⁻¹ f(1−f)/2
        // with f the cut, 1/8 of a fine cell each side here (h = 1.5, cuts in the middle of a cell).
        let shape = GridShape::new(UVec3::new(96, 96, 40));
        let fine = grid([96, 96, 40], |cell| center(shape, cell).x);
        let coarse = coarse(&fine);
        assert_eq!(coarse.shape.dims, UVec3::new(64, 64, 27));
        for (index, value) in coarse.values.iter().enumerate() {
            let cell = coarse.shape.cell(index);
            let x = center(coarse.shape, cell).x;
            // In z, 27·1.5 = 40.5 cells cover 40: the outermost are full to 5/6.
            let share = if cell.z == 0 || cell.z == 26 { 5.0 / 6.0 } else { 1.0 };
            assert!((value - share * x).abs() < 0.125 / 1.5 / 96.0 + 1e-14, "{cell}: {value} for {x}");
        }
        // With a whole factor it is exact.
        let shape = GridShape::new(UVec3::new(128, 64, 64));
        let fine = grid([128, 64, 64], |cell| center(shape, cell).x);
        let coarse = super::coarse(&fine);
        for (index, value) in coarse.values.iter().enumerate() {
            assert!((value - center(coarse.shape, coarse.shape.cell(index)).x).abs() < 1e-14);
        }
    }
}
