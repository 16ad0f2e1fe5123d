//! The sum of squared errors of a set of Gaussians over a [`Field`], its gradient, and its residual.
//!
//! Both passes are parallel and their results do not depend on the number of threads: a plane of the residual sums its
//! Gaussians in their order, a Gaussian's gradient is one task, and totals are added in index order.

use std::ops::Range;

use rayon::prelude::*;

use super::field::{Field, LANES};
use crate::rbf::{Rbf, SUPPORT};

/// One Gaussian over a field: per axis the blocks within its support and, for each, the means of `e`, `u e`, `u² e`.
struct Splat {
    ranges: [Range<u32>; 3],
    /// x moments as three arrays, padded with zeros to a multiple of [`LANES`].
    x: [Vec<f32>; 3],
    y: Vec<[f32; 3]>,
    z: Vec<[f32; 3]>,
    rbf: Rbf,
}

impl Splat {
    fn new(field: &Field, rbf: Rbf) -> Self {
        let reach = SUPPORT * rbf.radius;
        let ranges: [Range<u32>; 3] = std::array::from_fn(|axis| field.blocks_within(axis, rbf.center[axis], reach));
        let moments = |axis: usize| -> Vec<[f32; 3]> {
            ranges[axis].clone().map(|i| field.moments(axis, i, rbf.center[axis], rbf.radius)).collect()
        };
        let rows = moments(0);
        let padded = rows.len().next_multiple_of(LANES);
        let x = std::array::from_fn(|k| rows.iter().map(|m| m[k]).chain(std::iter::repeat(0.0)).take(padded).collect());
        Self { x, y: moments(1), z: moments(2), ranges, rbf }
    }

    /// Calls `visit(y, chunk range of x)` for the rows of plane `z` that meet the support.
    fn rows(&self, field: &Field, z: u32, mut visit: impl FnMut(u32, Range<usize>)) {
        let rbf = self.rbf;
        let size = field.block_size();
        let dz = field.block_center(2, z) - rbf.center[2];
        let left = (SUPPORT * rbf.radius).powi(2) - dz * dz;
        let offset = (rbf.center[0] - field.block_center(0, self.ranges[0].start)) / size;
        for y in self.ranges[1].clone() {
            let dy = field.block_center(1, y) - rbf.center[1];
            let chord2 = left - dy * dy;
            if chord2 < 0.0 {
                continue;
            }
            let chord = chord2.sqrt() / size;
            // Whole chunks: what they hold beyond the chord is below e⁻⁹.
            let first = (offset - chord).max(0.0) as usize / LANES * LANES;
            let end = ((offset + chord).max(0.0) as usize + 1).next_multiple_of(LANES).min(self.x[0].len());
            if first < end {
                visit(y, first..end);
            }
        }
    }
}

/// The sum of squared errors over a field, evaluated for one set of Gaussians at a time.
pub(super) struct Objective<'a> {
    pub field: &'a Field,
    splats: Vec<Splat>,
    /// `D − D̃`, laid out as the field's values.
    pub residual: Vec<f32>,
}

impl<'a> Objective<'a> {
    pub fn new(field: &'a Field) -> Self {
        Self { field, splats: Vec::new(), residual: field.values.clone() }
    }

    /// Moves to `rbfs` and returns the sum of squared errors there; [`residual`](Self::residual) is up to date.
    pub fn evaluate(&mut self, rbfs: &[Rbf]) -> f64 {
        let field = self.field;
        rbfs.par_iter().with_min_len(16).map(|&rbf| Splat::new(field, rbf)).collect_into_vec(&mut self.splats);
        let plane = field.stride * field.shape.dims.y as usize;
        let splats = &self.splats;
        let sums: Vec<f64> = self
            .residual
            .par_chunks_exact_mut(plane)
            .zip(field.values.par_chunks_exact(plane))
            .enumerate()
            .map(|(z, (residual, values))| {
                residual.copy_from_slice(values);
                for splat in splats {
                    subtract(splat, field, z as u32, residual);
                }
                sum_of_squares(residual, field)
            })
            .collect();
        sums.iter().sum()
    }

    /// Half the gradient of the sum of squared errors at the Gaussians last evaluated: per Gaussian centre, radius,
    /// weight.
    pub fn gradient(&self) -> Vec<[f64; 5]> {
        self.splats.par_iter().with_min_len(4).map(|splat| gradient(splat, self.field, &self.residual)).collect()
    }
}

/// Subtracts one Gaussian from a plane of the residual.
fn subtract(splat: &Splat, field: &Field, z: u32, plane: &mut [f32]) {
    if !splat.ranges[2].contains(&z) {
        return;
    }
    let gz = splat.rbf.weight * splat.z[(z - splat.ranges[2].start) as usize][0];
    splat.rows(field, z, |y, chunk| {
        let scale = gz * splat.y[(y - splat.ranges[1].start) as usize][0];
        let start = field.stride * y as usize + splat.ranges[0].start as usize;
        let row = &mut plane[start + chunk.start..start + chunk.end];
        let (row, _) = row.as_chunks_mut::<LANES>();
        let (gauss, _) = splat.x[0][chunk].as_chunks::<LANES>();
        for (values, gauss) in row.iter_mut().zip(gauss) {
            for (value, g) in values.iter_mut().zip(gauss) {
                *value -= scale * g;
            }
        }
    });
}

/// The sum of squares of a plane. Chunks may have run over a row's end, where the tables are 0 and so is the padding.
fn sum_of_squares(plane: &[f32], field: &Field) -> f64 {
    let mut total = 0.0;
    for row in plane.chunks_exact(field.stride) {
        let (chunks, rest) = row.as_chunks::<LANES>();
        let mut lanes = [0.0f32; LANES];
        for chunk in chunks {
            for (lane, value) in lanes.iter_mut().zip(chunk) {
                *lane += value * value;
            }
        }
        total += lanes.iter().chain([&rest.iter().map(|v| v * v).sum()]).map(|&v| f64::from(v)).sum::<f64>();
    }
    total
}

/// One pass over the support: moments of the residual in x by row, then in y and z.
fn gradient(splat: &Splat, field: &Field, residual: &[f32]) -> [f64; 5] {
    let plane = field.stride * field.shape.dims.y as usize;
    // By block of x: Σ_y of the residual times e, u e and u² e of y.
    let mut columns = [(); 3].map(|()| vec![[0.0f32; LANES]; splat.x[0].len() / LANES]);
    // Σ R B, Σ R B u_x, u_y, u_z, and Σ R B |u|².
    let mut sums = [0.0f64; 5];
    for z in splat.ranges[2].clone() {
        columns.iter_mut().for_each(|column| column.fill([0.0; LANES]));
        let values = &residual[plane * z as usize..][..plane];
        splat.rows(field, z, |y, chunk| {
            let [m0, m1, m2] = splat.y[(y - splat.ranges[1].start) as usize];
            let start = field.stride * y as usize + splat.ranges[0].start as usize;
            let (row, _) = values[start + chunk.start..start + chunk.end].as_chunks::<LANES>();
            let blocks = chunk.start / LANES..chunk.end / LANES;
            let [a, b, c] = &mut columns;
            let rows = a[blocks.clone()].iter_mut().zip(&mut b[blocks.clone()]).zip(&mut c[blocks]).zip(row);
            for (((a, b), c), row) in rows {
                for i in 0..LANES {
                    a[i] += m0 * row[i];
                    b[i] += m1 * row[i];
                    c[i] += m2 * row[i];
                }
            }
        });
        let dot = |column: usize, moment: usize| -> f64 {
            let (x, _) = splat.x[moment].as_chunks::<LANES>();
            let mut lanes = [0.0f32; LANES];
            for (column, x) in columns[column].iter().zip(x) {
                for i in 0..LANES {
                    lanes[i] += column[i] * x[i];
                }
            }
            lanes.iter().map(|&v| f64::from(v)).sum()
        };
        let [m0, m1, m2] = splat.z[(z - splat.ranges[2].start) as usize].map(f64::from);
        let s = dot(0, 0);
        sums[0] += m0 * s;
        sums[1] += m0 * dot(0, 1);
        sums[2] += m0 * dot(1, 0);
        sums[3] += m1 * s;
        sums[4] += m0 * (dot(0, 2) + dot(2, 0)) + m2 * s;
    }
    // d/dc (w B) = 2 w B u / r, d/dr = 2 w B |u|² / r, and the error is Σ (D − w B)².
    let scale = -2.0 * f64::from(splat.rbf.weight) / f64::from(splat.rbf.radius);
    [scale * sums[1], scale * sums[2], scale * sums[3], scale * sums[4], -sums[0]]
}
