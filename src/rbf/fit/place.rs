//! Where one more Gaussian would help most: matching pursuit over positions and sizes.

use rayon::prelude::*;

use super::field::Field;
use super::minimize::Bounds;
use crate::rbf::{Rbf, SUPPORT};

/// Sizes tried, from the largest radius to the smallest.
const SIZES: usize = 6;

/// A Gaussian that would lower the squared error by `gain`, were it alone.
#[derive(Clone, Copy)]
struct Candidate {
    gain: f32,
    rbf: Rbf,
}

/// Proposes up to `count` Gaussians for a residual laid out as `field`'s values, best first, apart from each other by
/// about their radii.
///
/// A Gaussian of radius r with the best weight lowers the squared error by (Σ R B)² / Σ B². Both come from blurring the
/// residual, per size and for all positions at once.
pub(super) fn propose(field: &Field, residual: &[f32], bounds: &Bounds, count: usize) -> Vec<Rbf> {
    let (low, high) = bounds.radius;
    let mut candidates: Vec<Candidate> = (0..SIZES)
        .into_par_iter()
        .flat_map_iter(|size| {
            let radius = high * (low / high).powf(size as f32 / (SIZES - 1) as f32);
            maxima(field, residual, bounds, radius)
        })
        .collect();
    candidates.sort_by(|a, b| b.gain.total_cmp(&a.gain));

    let mut chosen: Vec<Rbf> = Vec::with_capacity(count);
    for Candidate { rbf, .. } in candidates {
        if chosen.len() == count {
            break;
        }
        let apart = |other: &Rbf| {
            let d2: f32 = (0..3).map(|i| (rbf.center[i] - other.center[i]).powi(2)).sum();
            d2 > (rbf.radius + other.radius).powi(2)
        };
        if chosen.iter().all(apart) {
            chosen.push(rbf);
        }
    }
    chosen
}

/// The local maxima of the gain over positions, for one radius.
fn maxima(field: &Field, residual: &[f32], bounds: &Bounds, radius: f32) -> Vec<Candidate> {
    let dims = field.shape.dims.to_array().map(|n| n as usize);
    let kernel = kernel(radius / field.block_size());
    let norm: f32 = kernel.iter().map(|k| k * k).sum::<f32>().powi(3);
    let mut blurred = residual.to_vec();
    for axis in 0..3 {
        blurred = blur(&blurred, dims, field.stride, axis, &kernel);
    }
    let at = |x: usize, y: usize, z: usize| blurred[x + field.stride * (y + dims[1] * z)];
    let mut found = Vec::new();
    for z in 0..dims[2] {
        for y in 0..dims[1] {
            for x in 0..dims[0] {
                let value = at(x, y, z);
                // Too faint for the least weight allowed.
                if value < bounds.weight.0 * norm {
                    continue;
                }
                // Compared with the 6 neighbours inside the grid; the first of equals counts.
                let greatest = (x == 0 || at(x - 1, y, z) < value)
                    && (x + 1 == dims[0] || at(x + 1, y, z) <= value)
                    && (y == 0 || at(x, y - 1, z) < value)
                    && (y + 1 == dims[1] || at(x, y + 1, z) <= value)
                    && (z == 0 || at(x, y, z - 1) < value)
                    && (z + 1 == dims[2] || at(x, y, z + 1) <= value);
                if greatest {
                    let center = [(0, x), (1, y), (2, z)].map(|(axis, i)| field.block_center(axis, i as u32));
                    let rbf = bounds.clamp(Rbf { center, radius, weight: value / norm });
                    found.push(Candidate { gain: value * value / norm, rbf });
                }
            }
        }
    }
    found
}

/// A Gaussian of `radius` blocks, sampled to its support; at least one sample.
fn kernel(radius: f32) -> Vec<f32> {
    let half = (SUPPORT * radius) as i32;
    (-half..=half).map(|i| (-(i as f32 / radius).powi(2)).exp()).collect()
}

/// Correlates along one axis; outside the grid there is nothing.
fn blur(values: &[f32], dims: [usize; 3], stride: usize, axis: usize, kernel: &[f32]) -> Vec<f32> {
    let step = [1, stride, stride * dims[1]][axis];
    let half = (kernel.len() / 2) as isize;
    let mut out = vec![0.0; values.len()];
    for z in 0..dims[2] {
        for y in 0..dims[1] {
            let row = stride * (y + dims[1] * z);
            if axis == 0 {
                for x in 0..dims[0] as isize {
                    let (first, last) = ((x - half).max(0), (x + half).min(dims[0] as isize - 1));
                    let taps = &kernel[(first - x + half) as usize..=(last - x + half) as usize];
                    let values = &values[row + first as usize..=row + last as usize];
                    out[row + x as usize] = values.iter().zip(taps).map(|(v, k)| v * k).sum();
                }
                continue;
            }
            let i = [0, y, z][axis] as isize;
            for (tap, k) in (i - half..=i + half).zip(kernel) {
                if (0..dims[axis] as isize).contains(&tap) {
                    let from = (row as isize + (tap - i) * step as isize) as usize;
                    for (out, value) in out[row..row + dims[0]].iter_mut().zip(&values[from..from + dims[0]]) {
                        *out += k * value;
                    }
                }
            }
        }
    }
    out
}
