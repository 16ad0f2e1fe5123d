//! OpenVDB files: a reader for scalar density grids.
//!
//! The format, as far as it matters here, all little-endian:
//!
//! ```text
//! magic u64 · file version u32 · library version 2 × u32 · has offsets u8 · UUID 36 bytes · metadata · grid count i32
//! per grid: name · type · parent name · offsets of the grid, its buffers and its end, 3 × i64
//!           compression u32 · metadata · transform · tree topology · leaf buffers
//! ```
//!
//! Strings are a `u32` length and that many bytes. A tree is 5-4-3: a root of any size, over nodes of 32³ children
//! (4096³ voxels), over nodes of 16³ children (128³ voxels), over leaves of 8³ voxels; where a node has no child it has
//! a *tile*, one value for the whole of the child's cube. Voxels and tiles are active or not. All topology comes first
//! (`tree`), depth first; then the voxels of all leaves in the same order. Node values are compressed node by node in
//! a way of their own (`values`). A grid whose "parent" is another grid shares that grid's tree (an *instance*).

mod cursor;
mod header;
mod transform;
mod tree;
mod values;

#[cfg(test)]
mod tests;

use glam::IVec3;

use super::read::{MAX_CELLS, allocate, clamp};
use super::{DensityError, DensityGrid, SourceInfo};
use cursor::Cursor;
use header::{Archive, Descriptor, GridHeader};
use tree::Topology;
use values::ValueReader;

/// The first bytes of an OpenVDB file.
pub(super) use header::MAGIC;

/// Reads a density grid from the bytes of an OpenVDB file.
///
/// `grid` is the grid's name (`name[1]` picks the second of several grids of one name); `None` takes the one named
/// `density`, else the only scalar float grid there is.
///
/// Understands file versions 222 and later (OpenVDB 3 and later), 32- and 64-bit float grids, also those saved with
/// half precision, every compression, active tiles, instances, and transforms that scale all axes alike and move. The
/// box is the active voxels' index bounds. Inside it every voxel has the value that the file gives it, active or not;
/// outside it the density is 0, even where the file's background is not ([`SourceInfo::background`]). Negative
/// densities are set to 0 and counted ([`SourceInfo::negative_voxels`]).
///
/// # Errors
///
/// A file that is damaged, cut short or older; no such grid, or no obvious one; a grid of other values, a level set, an
/// empty grid, or one with a rotated, stretched, mirrored or perspective transform; values that are not finite; a box
/// of more than 2³¹ cells. Besides the box, a file costs memory in proportion to its size, damaged or not (all tiles at
/// worst: about a hundred times).
pub fn read_vdb(bytes: &[u8], grid: Option<&str>) -> Result<DensityGrid, DensityError> {
    read_within(bytes, grid, MAX_CELLS)
}

/// [`read_vdb`] with a limit of its own on the box's cells.
fn read_within(bytes: &[u8], name: Option<&str>, max_cells: u64) -> Result<DensityGrid, DensityError> {
    let archive = Archive::read(bytes, skip_grid)?;
    let chosen = archive.choose(name)?;
    let grid = chosen.display_name();

    let mut at = Cursor::new(bytes);
    at.seek(chosen.position)?;
    let mut header = GridHeader::read(&mut at)?;
    if header.level_set {
        return Err(DensityError::Unsupported(format!(
            "the grid \"{grid}\" is a level set, that is distances to a surface: convert it to a fog volume"
        )));
    }
    let placement_of = header.transform;
    let mut tree_of = chosen;
    if let Some(parent) = archive.parent(chosen)? {
        tree_of = parent;
        at.seek(parent.position)?;
        header = GridHeader::read(&mut at)?;
    }

    let mut reader = ValueReader::new(tree_of, &header)?;
    let topology = Topology::read(&mut at, &mut reader)?;
    let Some((min, max)) = topology.bounds else {
        return Err(DensityError::Empty(grid));
    };
    let placement = placement_of.placement(min, max).map_err(|problem| {
        DensityError::Unsupported(format!("the transform of grid \"{grid}\" {problem}: resample the grid"))
    })?;

    let dims = (max.as_i64vec3() - min.as_i64vec3() + 1).to_array().map(|side| side as u64);
    let (shape, mut values) = allocate(dims, topology.background, max_cells)?;
    topology.draw_tiles(shape, min, &mut values);
    topology
        .read_leaves(&mut at, &mut reader, |origin, leaf| tree::draw_leaf(origin, leaf, shape, min, &mut values))?;
    let negative_voxels = clamp(shape, min, &mut values)?;
    let source = SourceInfo {
        grid,
        active_voxels: topology.active_voxels,
        leaves: topology.leaves.len() as u64,
        index_min: min,
        half: reader.half(),
        background: topology.background,
        negative_voxels,
    };
    Ok(DensityGrid { shape, values, placement, source })
}

/// Moves past a grid's data, for files that do not say where the next grid begins.
fn skip_grid(at: &mut Cursor, descriptor: &Descriptor) -> Result<(), DensityError> {
    let header = GridHeader::read(at)?;
    if descriptor.parent.is_empty() {
        let mut reader = ValueReader::new(descriptor, &header)?;
        let topology = Topology::read(at, &mut reader)?;
        topology.read_leaves(at, &mut reader, |_: IVec3, _: &[f32]| {})?;
    }
    Ok(())
}
