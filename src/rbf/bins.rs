//! Which Gaussians matter where: uniform bins over the density grid.

use bevy::platform::collections::HashMap;
use glam::{UVec3, Vec3};

use super::{Rbf, SUPPORT};
use crate::density::GridShape;

/// Side of a bin in density cells.
pub const BIN_CELLS: u32 = 8;

/// Bins over the cells of a grid.
pub(crate) fn bin_shape(shape: GridShape) -> GridShape {
    GridShape::new(shape.dims.map(|n| n.div_ceil(BIN_CELLS)))
}

/// How many of the nearest Gaussians an uncovered bin lists.
const NEAREST: usize = 4;

/// Lists of Gaussians per bin of [`BIN_CELLS`]³ density cells, in compressed rows: bin `b` lists
/// `indices[offsets[b]..offsets[b + 1]]`, ascending.
///
/// Bin (0,0,0) starts at cell (0,0,0); bins are numbered `x + dims.x (y + dims.y z)`. A bin lists every Gaussian whose
/// support meets the bin's box grown by one cell on every side, so trilinear interpolation between cells of neighbouring
/// bins sees the same Gaussians. A bin that no support meets lists its 4 nearest (by distance over radius from the
/// bin's centre, ties by index), so that wisps outside every support still have a source radiance; one that only Gaussians
/// meet which come or go as time goes on lists those beside the 4 nearest that stay. Only an empty model has empty lists.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RbfBins {
    /// Bins a side: the grid's dimensions over [`BIN_CELLS`], rounded up.
    pub dims: UVec3,
    /// Start of each bin's list in `indices`; one more than there are bins.
    pub offsets: Vec<u32>,
    /// Indices into the list of Gaussians.
    pub indices: Vec<u32>,
}

impl RbfBins {
    /// Sorts `rbfs` into bins over `shape`.
    pub fn new(rbfs: &[Rbf], shape: GridShape) -> Self {
        Self::of_moment(rbfs, &vec![true; rbfs.len()], shape)
    }

    /// The same of a moment between two frames, where some stay and others come or go.
    pub fn of_moment(rbfs: &[Rbf], stays: &[bool], shape: GridShape) -> Self {
        let bins = bin_shape(shape);
        let dims = bins.dims;
        // The bins that every Gaussian meets, Gaussian by Gaussian, and how many Gaussians every bin has.
        let mut met = Vec::new();
        let mut counts = vec![0_u32; bins.len()];
        let mut is_covered = vec![false; bins.len()];
        let ends: Vec<usize> = rbfs
            .iter()
            .zip(stays)
            .map(|(rbf, stays)| {
                met_bins(rbf, shape, bins, |bin| {
                    met.push(bin as u32);
                    counts[bin] += 1;
                    is_covered[bin] |= stays;
                });
                met.len()
            })
            .collect();
        let mut candidates = Nearest::new(rbfs, stays, shape, bins);
        let uncovered: Vec<(usize, Vec<u32>)> =
            (0..bins.len()).filter(|&bin| !is_covered[bin]).map(|bin| (bin, candidates.to(bin))).collect();
        for (bin, list) in &uncovered {
            counts[*bin] += list.len() as u32;
        }

        let mut offsets = Vec::with_capacity(bins.len() + 1);
        offsets.push(0);
        let mut end = 0;
        for count in counts {
            end += count;
            offsets.push(end);
        }
        let mut indices = vec![0; end as usize];
        // Where each bin's next entry goes; Gaussians come in order, so that lists ascend.
        let mut next = offsets.clone();
        let mut start = 0;
        for (index, end) in (0..).zip(ends) {
            for &bin in &met[start..end] {
                let at = &mut next[bin as usize];
                indices[*at as usize] = index;
                *at += 1;
            }
            start = end;
        }
        for (bin, list) in uncovered {
            let end = offsets[bin + 1] as usize;
            indices[end - list.len()..end].copy_from_slice(&list);
            indices[offsets[bin] as usize..end].sort_unstable();
        }
        Self { dims, offsets, indices }
    }

    /// An upper bound on the number of entries that would be listed, found without listing them.
    pub fn entry_bound(rbfs: &[Rbf], shape: GridShape) -> u64 {
        let dims = bin_shape(shape).dims;
        let reached = |rbf: &Rbf| {
            let (first, last) = reach(rbf, shape, dims);
            (last.saturating_sub(first) + 1).to_array().map(u64::from).iter().product::<u64>()
        };
        let uncovered = GridShape::new(dims).len() as u64 * NEAREST as u64;
        rbfs.iter().map(reached).sum::<u64>() + uncovered
    }

    /// The list of the bin that holds `cell`; cells outside the grid use the nearest bin.
    pub fn at(&self, cell: UVec3) -> &[u32] {
        let bin = GridShape::new(self.dims).index((cell / BIN_CELLS).min(self.dims - 1));
        &self.indices[self.offsets[bin] as usize..self.offsets[bin + 1] as usize]
    }
}

/// The corners of a bin's box grown by one cell on every side.
fn grown_box(bin: UVec3, shape: GridShape) -> (Vec3, Vec3) {
    let first = bin * BIN_CELLS;
    let last = (first + BIN_CELLS).min(shape.dims) - 1;
    // Half a cell from a cell's centre to its face, and one more cell.
    let margin = 1.5 * shape.cell_size();
    (shape.center(first) - margin, shape.center(last) + margin)
}

/// Calls `found` with every bin whose grown box the support of `rbf` meets.
fn met_bins(rbf: &Rbf, shape: GridShape, bins: GridShape, mut found: impl FnMut(usize)) {
    let (first, last) = reach(rbf, shape, bins.dims);
    // Squared distances to the bins' boxes, axis by axis.
    let apart: [Vec<f32>; 3] = std::array::from_fn(|axis| {
        (first[axis]..=last[axis])
            .map(|bin| {
                let (low, high) = grown_box(UVec3::splat(bin).min(bins.dims - 1), shape);
                let center = rbf.center[axis];
                (center.clamp(low[axis], high[axis]) - center).powi(2)
            })
            .collect()
    });
    let reach2 = (SUPPORT * rbf.radius).powi(2);
    for (z, dz2) in (first.z..).zip(&apart[2]) {
        for (y, dy2) in (first.y..).zip(&apart[1]) {
            let row = bins.index(UVec3::new(0, y, z));
            for (x, dx2) in (first.x..).zip(&apart[0]) {
                if dx2 + dy2 + dz2 < reach2 {
                    found(row + x as usize);
                }
            }
        }
    }
}

/// The first and last bin that `rbf` may reach, a cell generous: [`meets`] decides.
fn reach(rbf: &Rbf, shape: GridShape, dims: UVec3) -> (UVec3, UVec3) {
    let longest = shape.longest() as f32;
    let bin = |x: Vec3| {
        let cell = (x + shape.half_extent()) * longest;
        // The cast clamps what lies below the box to 0.
        (cell / BIN_CELLS as f32).as_uvec3().min(dims - 1)
    };
    let (center, margin) = (Vec3::from(rbf.center), SUPPORT * rbf.radius + 2.0 / longest);
    (bin(center - margin), bin(center + margin))
}

/// Side in bins of the blocks whose bins look for their nearest Gaussians among the same few.
const BLOCK: u32 = 2;

/// Finds the nearest Gaussians of bins that no support meets: few of them can be, for all bins of a block.
struct Nearest {
    all: Vec<Candidate>,
    shape: GridShape,
    bins: GridShape,
    blocks: HashMap<UVec3, Vec<Candidate>>,
}

#[derive(Clone, Copy)]
struct Candidate {
    index: u32,
    center: Vec3,
    /// One over the radius.
    scale: f32,
}

impl Nearest {
    /// Among those that stay.
    fn new(rbfs: &[Rbf], stays: &[bool], shape: GridShape, bins: GridShape) -> Self {
        let all = (0..).zip(rbfs).zip(stays).filter(|(_, stays)| **stays).map(|((index, rbf), _)| Candidate {
            index,
            center: rbf.center.into(),
            scale: 1.0 / rbf.radius,
        });
        Self { all: all.collect(), shape, bins, blocks: HashMap::default() }
    }

    /// The [`NEAREST`] Gaussians to a bin's centre by distance over radius, ties by index; ascending.
    fn to(&mut self, bin: usize) -> Vec<u32> {
        let (shape, bins) = (self.shape, self.bins);
        let center = |bin: UVec3| {
            let (low, high) = grown_box(bin, shape);
            0.5 * (low + high)
        };
        let bin = bins.cell(bin);
        let block = bin / BLOCK;
        let candidates = self.blocks.entry(block).or_insert_with(|| {
            let (first, last) = (center(block * BLOCK), center((block * BLOCK + BLOCK - 1).min(bins.dims - 1)));
            of_block(&self.all, 0.5 * (first + last), 0.5 * first.distance(last))
        });
        nearest(candidates, center(bin))
    }
}

/// Those that may be among the [`NEAREST`] of some point within `reach` of `center`; ascending.
fn of_block(all: &[Candidate], center: Vec3, reach: f32) -> Vec<Candidate> {
    let distances: Vec<f32> = all.iter().map(|candidate| center.distance(candidate.center)).collect();
    // So many are at most this far from any of the points.
    let mut farthest = [f32::INFINITY; NEAREST];
    for (candidate, distance) in all.iter().zip(&distances) {
        let mut far = (distance + reach) * candidate.scale;
        if far < farthest[NEAREST - 1] {
            for kept in &mut farthest {
                if far < *kept {
                    std::mem::swap(&mut far, kept);
                }
            }
        }
    }
    // A little more, for rounding.
    let enough = farthest[NEAREST - 1] * 1.0001 + 1e-4;
    let near = |(candidate, distance): &(&Candidate, &f32)| (**distance - reach) * candidate.scale <= enough;
    all.iter().zip(&distances).filter(near).map(|(candidate, _)| *candidate).collect()
}

/// The [`NEAREST`] of some Gaussians to `point` by distance over radius, ties by index; ascending.
fn nearest(among: &[Candidate], point: Vec3) -> Vec<u32> {
    let mut best: Vec<(f32, u32)> = Vec::with_capacity(NEAREST + 1);
    let mut farthest = f32::INFINITY;
    for candidate in among {
        let square = point.distance_squared(candidate.center) * (candidate.scale * candidate.scale);
        if square < farthest {
            let rank = best.partition_point(|&(other, _)| other <= square);
            best.insert(rank, (square, candidate.index));
            best.truncate(NEAREST);
            if best.len() == NEAREST {
                farthest = best[NEAREST - 1].0;
            }
        }
    }
    let mut list: Vec<u32> = best.into_iter().map(|(_, index)| index).collect();
    list.sort_unstable();
    list
}
