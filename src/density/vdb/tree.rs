//! The tree: which leaves and tiles there are, and drawing them into a dense box.

use std::ops::Range;

use glam::{IVec3, UVec3};

use super::super::GridShape;
use super::DensityError;
use super::cursor::Cursor;
use super::values::{ValueReader, count_set, is_set};

const WHAT: &str = "the tree's topology";

/// Voxels along a side of the nodes below the root, of those below them, and of leaves.
const UPPER: i32 = 4096;
const LOWER: i32 = 128;
const LEAF: i32 = 8;
/// Bytes of a leaf's mask: a bit per voxel.
const LEAF_MASK: usize = 64;

/// Everything of a tree but its leaves' values.
pub(super) struct Topology<'a> {
    /// The value of empty space.
    pub background: f32,
    /// The leaves, in file order.
    pub leaves: Vec<Leaf<'a>>,
    /// Tiles that are active or differ from the background.
    tiles: Vec<Tile>,
    /// Active voxels of leaves and active tiles.
    pub active_voxels: u64,
    /// Least and greatest index of an active voxel.
    pub bounds: Option<(IVec3, IVec3)>,
}

/// A cube of 8³ voxels.
pub(super) struct Leaf<'a> {
    origin: IVec3,
    /// Active voxels. Here as in all nodes z varies fastest: byte 8 x + y, bit z.
    mask: &'a [u8],
}

/// A cube of one value.
struct Tile {
    origin: IVec3,
    side: i32,
    value: f32,
}

impl<'a> Topology<'a> {
    /// Reads the root and, depth first, all below it; leaves `at` before the first leaf's values.
    pub fn read(at: &mut Cursor<'a>, reader: &mut ValueReader) -> Result<Self, DensityError> {
        let buffers = at.i32(WHAT)?;
        if buffers != 1 {
            return Err(DensityError::Unsupported(format!("trees with {buffers} buffers are not supported")));
        }
        let background = reader.scalar(at)?;
        reader.background = background;
        let mut topology = Topology { background, leaves: vec![], tiles: vec![], active_voxels: 0, bounds: None };
        let (tiles, children) = (at.u32(WHAT)?, at.u32(WHAT)?);
        for _ in 0..tiles {
            let origin = read_origin(at)?;
            let value = reader.scalar(at)?;
            let active = at.u8(WHAT)? != 0;
            topology.add_tile(Tile { origin, side: UPPER, value }, active);
        }
        for _ in 0..children {
            let origin = read_origin(at)?;
            topology.read_node(at, reader, origin, UPPER)?;
        }
        Ok(topology)
    }

    /// Reads the node of `side` voxels at `origin` and its children.
    fn read_node(
        &mut self,
        at: &mut Cursor<'a>,
        reader: &mut ValueReader,
        origin: IVec3,
        side: i32,
    ) -> Result<(), DensityError> {
        let (child_side, per_side) = if side == UPPER { (LOWER, 32) } else { (LEAF, 16) };
        let mask_bytes = per_side * per_side * per_side / 8;
        let has_child = at.take(mask_bytes, WHAT)?;
        let active = at.take(mask_bytes, WHAT)?;
        let child_origin = |index: usize| {
            let cell = [index / (per_side * per_side), index / per_side % per_side, index % per_side];
            origin + child_side * IVec3::from_array(cell.map(|c| c as i32))
        };
        for (index, &value) in reader.node(at, active)?.iter().enumerate() {
            if !is_set(has_child, index) {
                self.add_tile(Tile { origin: child_origin(index), side: child_side, value }, is_set(active, index));
            }
        }
        for index in (0..8 * mask_bytes).filter(|&index| is_set(has_child, index)) {
            if child_side == LEAF {
                self.add_leaf(Leaf { origin: child_origin(index), mask: at.take(LEAF_MASK, WHAT)? });
            } else {
                self.read_node(at, reader, child_origin(index), child_side)?;
            }
        }
        Ok(())
    }

    fn add_tile(&mut self, tile: Tile, active: bool) {
        if active {
            let voxels = (tile.side as u64).pow(3);
            self.active_voxels = self.active_voxels.saturating_add(voxels);
            self.extend_bounds(tile.origin, tile.origin + (tile.side - 1));
        }
        if active || tile.value != self.background {
            self.tiles.push(tile);
        }
    }

    fn add_leaf(&mut self, leaf: Leaf<'a>) {
        self.active_voxels = self.active_voxels.saturating_add(count_set(leaf.mask) as u64);
        let (mut min, mut max) = (IVec3::MAX, IVec3::MIN);
        for (row, &bits) in leaf.mask.iter().enumerate().filter(|&(_, &bits)| bits != 0) {
            let [x, y] = [row as i32 / LEAF, row as i32 % LEAF];
            min = min.min(IVec3::new(x, y, bits.trailing_zeros() as i32));
            max = max.max(IVec3::new(x, y, 7 - bits.leading_zeros() as i32));
        }
        if min.x <= max.x {
            self.extend_bounds(leaf.origin + min, leaf.origin + max);
        }
        self.leaves.push(leaf);
    }

    fn extend_bounds(&mut self, min: IVec3, max: IVec3) {
        let (lowest, highest) = self.bounds.unwrap_or((min, max));
        self.bounds = Some((lowest.min(min), highest.max(max)));
    }

    /// Reads every leaf's 512 values, z fastest; `draw` gets the leaf's origin with them.
    pub fn read_leaves(
        &self,
        at: &mut Cursor<'a>,
        reader: &mut ValueReader,
        mut draw: impl FnMut(IVec3, &[f32]),
    ) -> Result<(), DensityError> {
        for leaf in &self.leaves {
            if at.take(LEAF_MASK, "a leaf")? != leaf.mask {
                return Err(DensityError::Damaged(format!("the leaf at {} has two different masks", leaf.origin)));
            }
            draw(leaf.origin, reader.node(at, leaf.mask)?);
        }
        Ok(())
    }

    /// Draws the tiles into the box of `shape` whose first cell has index `min`.
    pub fn draw_tiles(&self, shape: GridShape, min: IVec3, values: &mut [f32]) {
        for tile in &self.tiles {
            let [xs, ys, zs] = overlap(tile.origin, tile.side, shape, min);
            for z in zs {
                for y in ys.clone() {
                    let row = shape.index(UVec3::new(0, y, z));
                    values[row + xs.start as usize..row + xs.end as usize].fill(tile.value);
                }
            }
        }
    }
}

/// Draws a leaf's values into the box of `shape` whose first cell has index `min`.
pub(super) fn draw_leaf(origin: IVec3, leaf: &[f32], shape: GridShape, min: IVec3, values: &mut [f32]) {
    let [xs, ys, zs] = overlap(origin, LEAF, shape, min);
    // The leaf's cell of a box's cell; origin and min differ by less than the box where there is an overlap.
    let local = |cell: u32, axis: usize| (i64::from(cell) + i64::from(min[axis]) - i64::from(origin[axis])) as usize;
    for z in zs {
        for y in ys.clone() {
            for x in xs.clone() {
                let index = 64 * local(x, 0) + 8 * local(y, 1) + local(z, 2);
                values[shape.index(UVec3::new(x, y, z))] = leaf[index];
            }
        }
    }
}

/// The box's cells that a cube covers, per axis; empty ranges where it lies outside.
fn overlap(origin: IVec3, side: i32, shape: GridShape, min: IVec3) -> [Range<u32>; 3] {
    let mut ranges = [0, 1, 2].map(|axis| {
        let start = i64::from(origin[axis]) - i64::from(min[axis]);
        let cells = i64::from(shape.dims[axis]);
        start.clamp(0, cells) as u32..(start + i64::from(side)).clamp(0, cells) as u32
    });
    if ranges.iter().any(Range::is_empty) {
        ranges = [0..0, 0..0, 0..0];
    }
    ranges
}

/// The origin of a child of the root: a multiple of its side, so no voxel's index leaves the range of `i32`.
fn read_origin(at: &mut Cursor) -> Result<IVec3, DensityError> {
    let origin = IVec3::new(at.i32(WHAT)?, at.i32(WHAT)?, at.i32(WHAT)?);
    if origin.to_array().iter().any(|&c| c % UPPER != 0) {
        return Err(DensityError::Damaged(format!("{origin} is no place for a node of {UPPER}³ voxels")));
    }
    Ok(origin)
}
