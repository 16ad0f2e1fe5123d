//! The density to fit, in full or box-averaged for the coarse stages, and the tables of one Gaussian over it.

use glam::UVec3;

use crate::density::GridShape;

/// Cells that the inner loops take at a time. Rows are padded by this much, so that a chunk may run over a row's end.
pub(super) const LANES: usize = 8;

/// A density field averaged over blocks of `factor`³ cells, normalised to a largest fine density of 1.
///
/// The mean of a Gaussian over a block is the product of three one-dimensional means, so fitting block means of the sum
/// of Gaussians to block means of the density is the full problem but for what varies inside a block. Blocks at the far
/// faces may hold fewer cells; values and tables carry the square roots of the fill per axis, so that the plain sum of
/// squares counts every cell once.
pub(super) struct Field {
    /// The grid at full resolution.
    fine: GridShape,
    /// Cells a side of a block.
    pub factor: u32,
    /// Blocks a side.
    pub shape: GridShape,
    /// Values of a row of blocks, padded to allow chunks of [`LANES`] from any block of the row.
    pub stride: usize,
    /// Block means times the square root of the block's fill; padding is 0.
    pub values: Vec<f32>,
    /// Sum of the squares of the fine values over `factor`³: what relative errors are relative to.
    pub energy: f64,
    /// The part of `energy` that varies inside blocks, which no coarse fit sees.
    pub hidden: f64,
    /// Bundle coordinates of the fine cells' centres per axis.
    centers: [Vec<f32>; 3],
}

impl Field {
    /// Averages `values` (flat order, multiplied by `scale`) over blocks of `factor`³ cells.
    pub fn new(fine: GridShape, values: &[f32], scale: f32, factor: u32) -> Self {
        let shape = GridShape::new(fine.dims.map(|n| n.div_ceil(factor)));
        let stride = shape.dims.x as usize + LANES;
        let mut sums = vec![0.0f64; shape.len()];
        let [nx, ny] = [fine.dims.x as usize, fine.dims.y as usize];
        let mut squares = 0.0;
        for (row, line) in values.chunks_exact(nx).enumerate() {
            let (y, z) = ((row % ny) as u32, (row / ny) as u32);
            let start = shape.index(UVec3::new(0, y / factor, z / factor));
            for (x, value) in line.iter().enumerate() {
                let value = f64::from(value * scale);
                sums[start + x / factor as usize] += value;
                squares += value * value;
            }
        }
        let cells = f64::from(factor).powi(3);
        let mut padded = vec![0.0; stride * (shape.dims.y * shape.dims.z) as usize];
        let mut visible = 0.0;
        for (index, sum) in sums.iter().enumerate() {
            let block = shape.cell(index);
            let filled = (fine.dims - block * factor).min(UVec3::splat(factor)).as_dvec3().element_product();
            // mean · √fill = sum / filled · √(filled / cells)
            let value = sum / (filled * cells).sqrt();
            padded[block.x as usize + stride * (block.y + shape.dims.y * block.z) as usize] = value as f32;
            visible += value * value;
        }
        let energy = squares / cells;
        let centers =
            std::array::from_fn(|axis| (0..fine.dims[axis]).map(|i| fine.center(UVec3::splat(i))[axis]).collect());
        Self { fine, factor, shape, stride, values: padded, energy, hidden: (energy - visible).max(0.0), centers }
    }

    /// Bundle length of a block's side.
    pub fn block_size(&self) -> f32 {
        self.factor as f32 * self.fine.cell_size()
    }

    /// Blocks per unit of bundle volume.
    pub fn blocks_per_volume(&self) -> f32 {
        self.block_size().powi(-3)
    }

    /// Bundle coordinate of the middle of block `i` (as if it were full).
    pub fn block_center(&self, axis: usize, i: u32) -> f32 {
        self.centers[axis][0] + (i as f32 * self.factor as f32 + 0.5 * (self.factor - 1) as f32) * self.fine.cell_size()
    }

    /// The middles and densities of the blocks that hold smoke, in flat order.
    pub fn blocks_with_smoke(&self) -> Vec<([f32; 3], f32)> {
        (0..self.shape.len())
            .filter_map(|index| {
                let block = self.shape.cell(index);
                let value =
                    self.values[block.x as usize + self.stride * (block.y + self.shape.dims.y * block.z) as usize];
                (value > 0.0).then(|| ([0, 1, 2].map(|axis| self.block_center(axis, block[axis])), value))
            })
            .collect()
    }

    /// The blocks of an axis whose middles lie within `reach` of `center`.
    pub fn blocks_within(&self, axis: usize, center: f32, reach: f32) -> std::ops::Range<u32> {
        let size = self.block_size();
        let at = (center - self.block_center(axis, 0)) / size;
        let (first, last) = ((at - reach / size).ceil(), (at + reach / size).floor());
        let first = first.max(0.0) as u32;
        let end = (last + 1.0).max(0.0) as u32;
        first..end.min(self.shape.dims[axis]).max(first)
    }

    /// Means over a block of an axis of `e = exp(−u²)`, `u e` and `u² e`, `u = (x − center) / radius`, times the root
    /// of the block's fill.
    pub fn moments(&self, axis: usize, block: u32, center: f32, radius: f32) -> [f32; 3] {
        let first = (block * self.factor) as usize;
        let cells = &self.centers[axis][first..(first + self.factor as usize).min(self.centers[axis].len())];
        let mut sums = [0.0; 3];
        for x in cells {
            let u = (x - center) / radius;
            let e = (-u * u).exp();
            sums[0] += e;
            sums[1] += u * e;
            sums[2] += u * u * e;
        }
        if self.factor == 1 {
            return sums;
        }
        let scale = 1.0 / (cells.len() as f32 * self.factor as f32).sqrt();
        sums.map(|sum| sum * scale)
    }
}
