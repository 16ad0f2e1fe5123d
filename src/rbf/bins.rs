//! Which Gaussians matter where: uniform bins over the density grid.

use glam::{UVec3, Vec3};

use super::{Rbf, SUPPORT};
use crate::density::GridShape;

/// Side of a bin in density cells.
pub const BIN_CELLS: u32 = 8;

/// How many of the nearest Gaussians an uncovered bin lists.
const NEAREST: usize = 4;

/// Lists of Gaussians per bin of [`BIN_CELLS`]³ density cells, in compressed rows: bin `b` lists
/// `indices[offsets[b]..offsets[b + 1]]`, ascending.
///
/// Bin (0,0,0) starts at cell (0,0,0); bins are numbered `x + dims.x (y + dims.y z)`. A bin lists every Gaussian whose
/// support meets the bin's box grown by one cell on every side, so trilinear interpolation between cells of neighbouring
/// bins sees the same Gaussians. A bin that no support meets lists its 4 nearest (by distance over radius from the
/// bin's centre, ties by index), so that wisps outside every support still have a source radiance. Only an empty model
/// has empty lists.
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
        let dims = shape.dims.map(|n| n.div_ceil(BIN_CELLS));
        let bins = GridShape::new(dims);
        let mut lists: Vec<Vec<u32>> = vec![Vec::new(); bins.len()];
        for (index, rbf) in (0..).zip(rbfs) {
            let (first, last) = reach(rbf, shape, dims);
            for z in first.z..=last.z {
                for y in first.y..=last.y {
                    for x in first.x..=last.x {
                        let bin = UVec3::new(x, y, z);
                        if meets(rbf, grown_box(bin, shape)) {
                            lists[bins.index(bin)].push(index);
                        }
                    }
                }
            }
        }
        for (bin, list) in lists.iter_mut().enumerate().filter(|(_, list)| list.is_empty()) {
            let (low, high) = grown_box(bins.cell(bin), shape);
            *list = nearest(rbfs, 0.5 * (low + high));
        }

        let mut offsets = vec![0];
        let mut indices = Vec::with_capacity(lists.iter().map(Vec::len).sum());
        for list in &lists {
            indices.extend(list);
            offsets.push(indices.len() as u32);
        }
        Self { dims, offsets, indices }
    }

    /// An upper bound on the number of entries that [`new`](Self::new) would list, found without listing them.
    pub fn entry_bound(rbfs: &[Rbf], shape: GridShape) -> u64 {
        let dims = shape.dims.map(|n| n.div_ceil(BIN_CELLS));
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

/// Whether the support of `rbf` meets a box.
fn meets(rbf: &Rbf, (low, high): (Vec3, Vec3)) -> bool {
    let center = Vec3::from(rbf.center);
    center.clamp(low, high).distance_squared(center) < (SUPPORT * rbf.radius).powi(2)
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

/// The [`NEAREST`] Gaussians to `point` by distance over radius, ties by index; ascending.
fn nearest(rbfs: &[Rbf], point: Vec3) -> Vec<u32> {
    let mut best: Vec<(f32, u32)> = Vec::with_capacity(NEAREST + 1);
    for (index, rbf) in (0..).zip(rbfs) {
        let distance = point.distance(Vec3::from(rbf.center)) / rbf.radius;
        let rank = best.partition_point(|&(other, _)| other <= distance);
        if rank < NEAREST {
            best.insert(rank, (distance, index));
            best.truncate(NEAREST);
        }
    }
    let mut list: Vec<u32> = best.into_iter().map(|(_, index)| index).collect();
    list.sort_unstable();
    list
}
