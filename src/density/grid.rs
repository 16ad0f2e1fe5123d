//! A dense block of density values and where it lies in the world.

use glam::{DVec3, I64Vec3, IVec3, UVec3, Vec3};

/// Cells a side of the grid on which light travels: see [`GridShape::coarse`].
pub const COARSE_CELLS: u32 = 64;

/// The cells of a box, and the bundle space that goes with them.
///
/// **Bundle space** is the box centred on the origin with its longest side 1. Values belong to cell centres; cell
/// `(i, j, k)` has its centre at `((i, j, k) + 0.5 - dims / 2) / longest`. The flat index of a cell is
/// `x + nx * (y + ny * z)`: x varies fastest.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GridShape {
    /// Cells a side, each at least 1.
    pub dims: UVec3,
}

impl GridShape {
    /// A box of `dims` cells, each at least 1.
    pub const fn new(dims: UVec3) -> Self {
        debug_assert!(dims.x > 0 && dims.y > 0 && dims.z > 0);
        Self { dims }
    }

    /// The number of cells.
    #[expect(clippy::len_without_is_empty, reason = "a box has at least one cell")]
    pub const fn len(&self) -> usize {
        self.dims.x as usize * self.dims.y as usize * self.dims.z as usize
    }

    /// The cells along the longest side.
    pub fn longest(&self) -> u32 {
        self.dims.max_element()
    }

    /// The side of a cell in bundle space: 1 / longest.
    pub fn cell_size(&self) -> f32 {
        1.0 / self.longest() as f32
    }

    /// Half the box's sides in bundle space; the largest component is 0.5.
    pub fn half_extent(&self) -> Vec3 {
        self.dims.as_vec3() * (0.5 / self.longest() as f32)
    }

    /// The centre of a cell in bundle space.
    pub fn center(&self, cell: UVec3) -> Vec3 {
        (cell.as_vec3() + 0.5 - 0.5 * self.dims.as_vec3()) / self.longest() as f32
    }

    /// The flat index of a cell inside the box.
    pub fn index(&self, cell: UVec3) -> usize {
        debug_assert!(cell.cmplt(self.dims).all());
        let [nx, ny] = [self.dims.x as usize, self.dims.y as usize];
        cell.x as usize + nx * (cell.y as usize + ny * cell.z as usize)
    }

    /// The cell of a flat index: the inverse of [`index`](Self::index).
    pub fn cell(&self, index: usize) -> UVec3 {
        let [nx, ny] = [self.dims.x as usize, self.dims.y as usize];
        UVec3::new((index % nx) as u32, (index / nx % ny) as u32, (index / (nx * ny)) as u32)
    }

    /// The coarse grid on which optical depth is marched: [`COARSE_CELLS`] cells along the longest side.
    pub fn coarse(&self) -> GridShape {
        self.coarsened(COARSE_CELLS)
    }

    /// A grid of at most `cells` cells a side: cubes of `h = max(1, longest / cells)` cells of this one a side (`h` is
    /// real), `ceil(dims / h)` of them, centred on this box. It covers the box and may stick out by less than one of its
    /// own cells in all.
    pub fn coarsened(&self, cells: u32) -> GridShape {
        let longest = self.longest();
        if longest <= cells {
            return *self;
        }
        // ceil(d / (longest / cells)) in whole numbers, so that rounding cannot add a cell.
        let cells = |d: u32| (u64::from(d) * u64::from(cells)).div_ceil(u64::from(longest)) as u32;
        GridShape::new(UVec3::new(cells(self.dims.x), cells(self.dims.y), cells(self.dims.z)))
    }
}

/// Where a box of cells lies in the world: axis-aligned, cubic cells.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    /// World position of the box's centre.
    pub center: DVec3,
    /// World length of a cell's side, above 0.
    pub voxel_size: f64,
}

/// Density on every cell of a box: what the readers return and the bake starts from.
#[derive(Clone, Debug, PartialEq)]
pub struct DensityGrid {
    /// The cells of the box.
    pub shape: GridShape,
    /// One density per cell in flat index order; finite and at least 0. Between cell centres density is trilinear,
    /// outside the box it is 0.
    pub values: Vec<f32>,
    /// Where the file places the box in the world.
    pub placement: Placement,
    /// What the file said.
    pub source: SourceInfo,
}

impl DensityGrid {
    /// The density of a cell inside the box.
    pub fn get(&self, cell: UVec3) -> f32 {
        self.values[self.shape.index(cell)]
    }

    /// The largest density, at least 0.
    pub fn max(&self) -> f32 {
        self.values.iter().copied().fold(0.0, f32::max)
    }

    /// The same density in another box of the file's index space: `shape` cells from index `min` on. Cells of the new
    /// box outside this one are empty, cells of this one outside the new box are cut off. Frames of an animation get
    /// one box for all by this, since every frame's own box ends where its smoke ends.
    pub fn reframed(&self, min: IVec3, shape: GridShape) -> DensityGrid {
        // Wide enough for the difference of any two indices.
        let offset = min.as_i64vec3() - self.source.index_min.as_i64vec3();
        let values = (0..shape.len())
            .map(|index| {
                let cell = shape.cell(index).as_i64vec3() + offset;
                let inside = cell.cmpge(I64Vec3::ZERO).all() && cell.cmplt(self.shape.dims.as_i64vec3()).all();
                if inside { self.get(cell.as_uvec3()) } else { 0.0 }
            })
            .collect();
        let moved = offset.as_dvec3() + 0.5 * (shape.dims.as_dvec3() - self.shape.dims.as_dvec3());
        let center = self.placement.center + self.placement.voxel_size * moved;
        let placement = Placement { center, ..self.placement };
        DensityGrid { shape, values, placement, source: SourceInfo { index_min: min, ..self.source.clone() } }
    }

    /// World length of the box's longest side.
    pub fn world_size(&self) -> f64 {
        f64::from(self.shape.longest()) * self.placement.voxel_size
    }
}

/// What a density file holds, for reports and warnings.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SourceInfo {
    /// The grid's name; empty where the format has none.
    pub grid: String,
    /// Active voxels, those in active tiles included; all cells where the format has no such notion.
    pub active_voxels: u64,
    /// Leaf nodes (8³ voxels) of the tree; 0 where the format has none.
    pub leaves: u64,
    /// The file's index of the box's first cell; zero where the format has none.
    pub index_min: IVec3,
    /// The file stores half-precision values.
    pub half: bool,
    /// The density the file gives to empty space. Here space outside the box has density 0, so a value other than 0
    /// means that smoke was cut off there.
    pub background: f32,
    /// Cells of the box whose density was below 0 and has been set to 0.
    pub negative_voxels: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_and_indices_agree() {
        let shape = GridShape::new(UVec3::new(3, 5, 2));
        assert_eq!(shape.len(), 30);
        assert_eq!(shape.index(UVec3::new(1, 0, 0)), 1);
        assert_eq!(shape.index(UVec3::new(0, 1, 0)), 3);
        assert_eq!(shape.index(UVec3::new(0, 0, 1)), 15);
        for index in 0..shape.len() {
            assert_eq!(shape.index(shape.cell(index)), index);
        }
    }

    #[test]
    fn the_longest_side_is_one() {
        let shape = GridShape::new(UVec3::new(4, 8, 2));
        assert_eq!(shape.half_extent(), Vec3::new(0.25, 0.5, 0.125));
        assert_eq!(shape.center(UVec3::ZERO), -shape.half_extent() + 0.5 * shape.cell_size());
        assert_eq!(shape.center(UVec3::new(3, 7, 1)), shape.half_extent() - 0.5 * shape.cell_size());
    }

    #[test]
    fn reframing_moves_no_smoke() {
        let shape = GridShape::new(UVec3::new(2, 3, 1));
        let grid = DensityGrid {
            shape,
            values: (1..7).map(|v| v as f32).collect(),
            placement: Placement { center: DVec3::new(1.0, 2.0, 3.0), voxel_size: 0.5 },
            source: SourceInfo { index_min: IVec3::new(-1, 10, 5), ..Default::default() },
        };
        let larger = grid.reframed(IVec3::new(-3, 9, 5), GridShape::new(UVec3::new(8, 5, 2)));
        assert_eq!(larger.values.iter().sum::<f32>(), 21.0);
        assert_eq!(larger.get(UVec3::new(2, 1, 0)), 1.0, "index (-1, 10, 5)");
        // The world position of that voxel, from either box: half a voxel is 0.25.
        let corner = |g: &DensityGrid| g.placement.center - 0.5 * g.placement.voxel_size * g.shape.dims.as_dvec3();
        assert_eq!(corner(&larger) + DVec3::new(1.0, 0.5, 0.0), corner(&grid));
        assert_eq!(larger.reframed(grid.source.index_min, shape), grid, "and back");
        let part = grid.reframed(IVec3::new(0, 11, 5), GridShape::new(UVec3::ONE));
        assert_eq!(part.values, [4.0]);
    }

    #[test]
    fn coarse_grid() {
        let coarse = |x, y, z| GridShape::new(UVec3::new(x, y, z)).coarse().dims;
        assert_eq!(coarse(128, 128, 128), UVec3::splat(64));
        assert_eq!(coarse(111, 222, 112), UVec3::new(32, 64, 33));
        assert_eq!(coarse(20, 32, 1), UVec3::new(20, 32, 1), "no finer than the grid itself");
        assert_eq!(coarse(65, 1, 64), UVec3::new(64, 1, 64));
    }
}
