//! Reading a density file of any known format.

use std::path::Path;

use glam::IVec3;

use super::{DensityError, DensityGrid, GridShape, npy, vdb};

/// The largest box a reader accepts, in cells.
pub(super) const MAX_CELLS: u64 = 1 << 31;

/// Reads a density file: OpenVDB or NumPy, told apart by content.
///
/// `grid` picks a grid of an OpenVDB file by name; `None` takes the one named `density`, else the only float grid there
/// is. NumPy files hold a single unnamed array, so a name is ignored for them.
///
/// # Errors
///
/// The file cannot be read, is of neither format or damaged, has no such grid, or the grid is not a plain density: see
/// [`read_vdb`](super::read_vdb) and [`read_npy`](super::read_npy). Every error names the file.
pub fn read(path: impl AsRef<Path>, grid: Option<&str>) -> Result<DensityGrid, DensityError> {
    let path = path.as_ref();
    let bytes = std::fs::read(path).map_err(|source| DensityError::Io { path: path.into(), source })?;
    let result = if bytes.starts_with(&vdb::MAGIC) {
        vdb::read_vdb(&bytes, grid)
    } else if bytes.starts_with(npy::MAGIC) {
        npy::read_npy(&bytes)
    } else {
        Err(DensityError::UnknownFormat)
    };
    result.map_err(|source| DensityError::File { path: path.into(), source: source.into() })
}

/// A box of `fill`ed cells, or an error where it would have more than `max_cells` or does not fit into memory.
pub(super) fn allocate(dims: [u64; 3], fill: f32, max_cells: u64) -> Result<(GridShape, Vec<f32>), DensityError> {
    let [x, y, z] = dims;
    let too_large = || DensityError::TooLarge(x, y, z);
    let cells = x.checked_mul(y).and_then(|xy| xy.checked_mul(z)).filter(|&cells| cells <= max_cells);
    let cells = cells.and_then(|cells| usize::try_from(cells).ok()).ok_or_else(too_large)?;
    let mut values = Vec::new();
    values.try_reserve_exact(cells).map_err(|_| too_large())?;
    values.resize(cells, fill);
    // Every side is at most the number of cells, which fits.
    let shape = GridShape::new(dims.map(|side| side as u32).into());
    Ok((shape, values))
}

/// Sets negative densities to 0 and counts them; an infinite density or NaN is an error that names the voxel.
pub(super) fn clamp(shape: GridShape, index_min: IVec3, values: &mut [f32]) -> Result<u64, DensityError> {
    let mut negative = 0;
    for (index, value) in values.iter_mut().enumerate() {
        if !value.is_finite() {
            let [x, y, z] = (shape.cell(index).as_i64vec3() + index_min.as_i64vec3()).to_array();
            return Err(DensityError::NotFinite(x, y, z, *value));
        }
        if *value < 0.0 {
            *value = 0.0;
            negative += 1;
        }
    }
    Ok(negative)
}
