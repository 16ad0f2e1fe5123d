//! The pressure that keeps the flow free of divergence: conjugate gradients, preconditioned by multigrid.

use glam::UVec3;
use rayon::prelude::*;

use super::lattice::{Lattice, Velocity, unit};
use crate::density::GridShape;

/// Where the solver stops: RMS divergence after projection over RMS divergence before.
pub const TOLERANCE: f64 = 1e-4;
/// A bound on iterations; a dozen do.
const MAX_ITERATIONS: usize = 60;
/// Levels end where a side would have fewer cells than this.
const COARSEST: u32 = 3;
/// Jacobi sweeps on the coarsest level.
const COARSEST_SWEEPS: usize = 16;
/// Relaxation of these: D⁻¹A has eigenvalues below 2, so that below 1 every sweep damps them all.
const COARSEST_RELAXATION: f32 = 0.9;
/// Cells that make a task of their own worth while.
const CELLS_A_TASK: usize = 4096;
/// Relaxations of two Jacobi sweeps that together damp the eigenvalues of D⁻¹A from 1/3 to 2, which the coarser level
/// does not see, as Chebyshev's polynomial of degree 2 does: to a third.
const RELAXATION: [f32; 2] = [0.5695, 1.732];

/// The equation for pressure on a box with open and closed faces.
///
/// Σ_f w_f (p − p_f) = −Σ_f ±w_f u_f for every cell, over its six faces: w_f is the open fraction of a face (Batty et al.
/// 2007 and Ng et al. 2009), 0 for a closed one; p_f is the pressure behind it, 0 outside the box; p is in units of velocity.
#[derive(Clone, Debug)]
pub struct Pressure {
    levels: Vec<Level>,
    /// The solution, kept to start the next solve from.
    pressure: Vec<f32>,
}

impl Pressure {
    /// `open` is the open fraction of every face.
    pub fn new(open: &[Lattice; 3]) -> Self {
        let mut levels = vec![Level::finest(open)];
        while let Some(level) = levels.last()
            && level.shape.dims.min_element() >= 2 * COARSEST
        {
            levels.push(level.coarser());
        }
        let pressure = levels[0].zeros();
        Self { levels, pressure }
    }

    /// Makes the flow free of divergence, to [`TOLERANCE`]; velocities at closed faces become 0. Returns the number of
    /// iterations.
    pub fn project(&mut self, velocity: &mut Velocity) -> usize {
        let finest = &self.levels[0];
        let rhs = finest.inflow(velocity);
        let iterations = solve(&self.levels, &rhs, &mut self.pressure, TOLERANCE);
        let finest = &self.levels[0];
        for (axis, face) in velocity.faces.iter_mut().enumerate() {
            let stride = finest.strides[axis];
            face.update(|point, _, value| {
                let high = finest.index(point);
                let difference = self.pressure[high] - self.pressure[high - stride];
                if finest.open[axis][high] > 0.0 { value - difference } else { 0.0 }
            });
        }
        iterations
    }

    /// The pressure of a cell.
    #[cfg(test)]
    pub fn at(&self, cell: UVec3) -> f32 {
        self.pressure[self.levels[0].index(cell)]
    }
}

/// Preconditioned conjugate gradients from `x` on, until the residual's norm is `tolerance` of the right-hand side's.
/// Returns the number of iterations.
fn solve(levels: &[Level], rhs: &[f32], x: &mut [f32], tolerance: f64) -> usize {
    let level = &levels[0];
    let goal = tolerance * tolerance * level.dot(rhs, rhs);
    if goal == 0.0 {
        x.fill(0.0);
        return 0;
    }
    let mut residual = level.residual(x, rhs);
    let mut direction = level.zeros();
    let mut last = 0.0;
    for iteration in 0..MAX_ITERATIONS {
        if level.dot(&residual, &residual) <= goal {
            return iteration;
        }
        let preconditioned = v_cycle(levels, &residual);
        let current = level.dot(&residual, &preconditioned);
        let beta = if iteration == 0 { 0.0 } else { (current / last) as f32 };
        let previous = std::mem::replace(&mut direction, preconditioned);
        level.add(&mut direction, beta, &previous);
        let applied = level.applied(&direction);
        let alpha = (current / level.dot(&direction, &applied)) as f32;
        level.add(x, alpha, &direction);
        level.add(&mut residual, -alpha, &applied);
        last = current;
    }
    MAX_ITERATIONS
}

/// An approximate solution for a right-hand side: one V-cycle of multigrid, a symmetric operator.
fn v_cycle(levels: &[Level], rhs: &[f32]) -> Vec<f32> {
    let level = &levels[0];
    let Some(coarse) = levels.get(1) else {
        return (0..COARSEST_SWEEPS).fold(level.zeros(), |x, _| level.swept(&x, rhs, COARSEST_RELAXATION));
    };
    let [first, second] = RELAXATION;
    let x = level.swept(&level.swept(&level.zeros(), rhs, first), rhs, second);
    let correction = v_cycle(&levels[1..], &coarse.restricted(level, &level.residual(&x, rhs)));
    let x = level.corrected(x, coarse, &correction);
    level.swept(&level.swept(&x, rhs, second), rhs, first)
}

/// One grid of the hierarchy. Every array has one more cell on every side, so that no loop asks for the box's end: there,
/// values are 0.
#[derive(Clone, Debug)]
struct Level {
    /// The cells inside.
    shape: GridShape,
    /// From a cell to the next along each axis.
    strides: [usize; 3],
    /// Weight of every cell's lower face across each axis.
    open: [Vec<f32>; 3],
}

impl Level {
    fn new(dims: UVec3, weight: impl Fn(usize, UVec3) -> f32) -> Self {
        let strides = [1, dims.x as usize + 2, (dims.x as usize + 2) * (dims.y as usize + 2)];
        let mut level = Self { shape: GridShape::new(dims), strides, open: Default::default() };
        level.open = std::array::from_fn(|axis| {
            let mut open = level.zeros();
            let faces = GridShape::new(dims + unit(axis));
            for face in (0..faces.len()).map(|index| faces.cell(index)) {
                open[level.index(face)] = weight(axis, face);
            }
            open
        });
        level
    }

    fn finest(open: &[Lattice; 3]) -> Self {
        let dims = open[0].shape.dims - unit(0);
        Self::new(dims, |axis, face| open[axis].values[open[axis].shape.index(face)])
    }

    /// Cells of 2³ of this level's. A face is four times as large and pressure is taken twice as far apart: its weight is
    /// half the sum of four.
    fn coarser(&self) -> Self {
        let fine = self.shape.dims;
        Self::new(fine.map(|n| n.div_ceil(2)), |axis, face| {
            let [b, c] = [(axis + 1) % 3, (axis + 2) % 3];
            let mut first = 2 * face;
            // The face behind an odd number of cells is this level's last.
            first[axis] = first[axis].min(fine[axis]);
            let quarters = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(i, j)| first + i * unit(b) + j * unit(c));
            let inside = quarters.iter().filter(|face| face[b] < fine[b] && face[c] < fine[c]);
            0.5 * inside.map(|&face| self.open[axis][self.index(face)]).sum::<f32>()
        })
    }

    fn zeros(&self) -> Vec<f32> {
        vec![0.0; self.strides[2] * (self.shape.dims.z as usize + 2)]
    }

    fn index(&self, cell: UVec3) -> usize {
        (cell + 1).to_array().iter().zip(self.strides).map(|(&i, stride)| i as usize * stride).sum()
    }

    /// Calls `of_row` with the index of every row's first cell and the row's values.
    fn rows(&self, values: &mut [f32], of_row: impl Fn(usize, &mut [f32]) + Sync) {
        let [_, row, plane] = self.strides;
        let [nx, ny, nz] = self.shape.dims.to_array().map(|n| n as usize);
        let planes = values.par_chunks_exact_mut(plane).enumerate().skip(1).take(nz);
        planes.with_min_len(CELLS_A_TASK.div_ceil(nx * ny)).for_each(|(z, values)| {
            for y in 1..=ny {
                let start = y * row + 1;
                of_row(z * plane + start, &mut values[start..][..nx]);
            }
        });
    }

    /// `values` + `scale` · `added`.
    fn add(&self, values: &mut [f32], scale: f32, added: &[f32]) {
        self.rows(values, |start, row| {
            row.iter_mut().zip(&added[start..]).for_each(|(value, added)| *value += scale * added);
        });
    }

    /// Sum of products over the cells inside. By planes, whose sums are added in order: the same with any number of
    /// threads.
    fn dot(&self, a: &[f32], b: &[f32]) -> f64 {
        let plane = self.strides[2];
        let of_plane = |(a, b): (&[f32], &[f32])| a.iter().zip(b).map(|(&a, &b)| f64::from(a) * f64::from(b)).sum();
        let sums: Vec<f64> = a.par_chunks_exact(plane).zip(b.par_chunks_exact(plane)).map(of_plane).collect();
        sums.iter().sum()
    }

    /// `value(Σ w_f, Σ w_f x_f, x, b)` of every cell.
    #[inline]
    fn stencil(&self, x: &[f32], b: &[f32], value: impl Fn(f32, f32, f32, f32) -> f32 + Sync) -> Vec<f32> {
        let mut result = self.zeros();
        let [_, row, plane] = self.strides;
        self.rows(&mut result, |i, out| {
            // Rows of equal length let the compiler see that no index is out of bounds.
            let n = out.len();
            let [wx, wy, wz] = self.open.each_ref().map(|open| &open[i..][..n]);
            let [wx1, wy1, wz1] = [(0, 1), (1, row), (2, plane)].map(|(axis, d)| &self.open[axis][i + d..][..n]);
            let [x0, x1, y0, y1, z0, z1] = [i - 1, i + 1, i - row, i + row, i - plane, i + plane].map(|i| &x[i..][..n]);
            let (x, b) = (&x[i..][..n], &b[i..][..n]);
            for i in 0..n {
                let diagonal = (wx[i] + wx1[i]) + (wy[i] + wy1[i]) + (wz[i] + wz1[i]);
                let along_x = wx[i] * x0[i] + wx1[i] * x1[i];
                let along_y = wy[i] * y0[i] + wy1[i] * y1[i];
                let along_z = wz[i] * z0[i] + wz1[i] * z1[i];
                out[i] = value(diagonal, along_x + along_y + along_z, x[i], b[i]);
            }
        });
        result
    }

    /// A x.
    fn applied(&self, x: &[f32]) -> Vec<f32> {
        self.stencil(x, x, |diagonal, neighbours, x, _| diagonal * x - neighbours)
    }

    /// b − A x.
    fn residual(&self, x: &[f32], b: &[f32]) -> Vec<f32> {
        self.stencil(x, b, |diagonal, neighbours, x, b| b - diagonal * x + neighbours)
    }

    /// One Jacobi sweep. Cells without open faces stay 0.
    fn swept(&self, x: &[f32], b: &[f32], relaxation: f32) -> Vec<f32> {
        self.stencil(
            x,
            b,
            |diagonal, neighbours, x, b| {
                if diagonal > 0.0 { x + relaxation * ((b + neighbours) / diagonal - x) } else { 0.0 }
            },
        )
    }

    /// Sums of a finer level's values over the cells of this one.
    fn restricted(&self, fine: &Level, values: &[f32]) -> Vec<f32> {
        let mut result = self.zeros();
        let [_, row, plane] = fine.strides;
        self.rows(&mut result, |start, out| {
            let first = fine.index(2 * self.cell(start));
            for (x, out) in out.iter_mut().enumerate() {
                // An odd number of cells ends in one that is outside, and 0.
                let i = first + 2 * x;
                *out = [i, i + row, i + plane, i + row + plane].iter().map(|&i| values[i] + values[i + 1]).sum();
            }
        });
        result
    }

    /// `x` plus a coarser level's values: the transpose of [`restricted`](Self::restricted).
    fn corrected(&self, mut x: Vec<f32>, coarse: &Level, values: &[f32]) -> Vec<f32> {
        self.rows(&mut x, |start, row| {
            let first = coarse.index(self.cell(start) / 2);
            for (x, out) in row.iter_mut().enumerate() {
                *out += values[first + x / 2];
            }
        });
        x
    }

    /// The cell of an index: the inverse of [`index`](Self::index).
    fn cell(&self, index: usize) -> UVec3 {
        let [_, row, plane] = self.strides;
        UVec3::new((index % row) as u32, (index % plane / row) as u32, (index / plane) as u32) - 1
    }

    /// What flows into every cell.
    fn inflow(&self, velocity: &Velocity) -> Vec<f32> {
        let mut result = self.zeros();
        self.rows(&mut result, |start, out| {
            let first = self.cell(start);
            for (axis, face) in velocity.faces.iter().enumerate() {
                let [low, high] = [first, first + unit(axis)].map(|face_cell| face.shape.index(face_cell));
                let (low, high) = (&face.values[low..], &face.values[high..]);
                let (w, w1) = (&self.open[axis][start..], &self.open[axis][start + self.strides[axis]..]);
                for (i, out) in out.iter_mut().enumerate() {
                    *out += w[i] * low[i] - w1[i] * high[i];
                }
            }
        });
        result
    }
}
