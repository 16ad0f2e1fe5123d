//! Density grids, and the files they come from.
//!
//! A [`DensityGrid`] is a box of cells with a density at every cell centre, placed in the world. `read` (feature
//! `bake`) makes one from an OpenVDB file (`.vdb`: what Houdini, Blender, EmberGen and most others export) or from a
//! NumPy array (`.npy`); `write_npy` makes such an array.

#[cfg(feature = "bake")]
mod error;
mod grid;
#[cfg(feature = "bake")]
mod npy;
#[cfg(feature = "bake")]
mod read;
#[cfg(feature = "bake")]
mod vdb;

#[cfg(feature = "bake")]
pub use error::DensityError;
pub use grid::{COARSE_CELLS, DensityGrid, GridShape, Placement, SourceInfo};
#[cfg(feature = "bake")]
pub use npy::{read_npy, write_npy};
#[cfg(feature = "bake")]
pub use read::read;
#[cfg(feature = "bake")]
pub use vdb::read_vdb;
