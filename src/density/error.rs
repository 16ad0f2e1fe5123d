//! Why a density file cannot be read.

use std::path::PathBuf;

/// Why a density file cannot be read: what is wrong, where, and where it helps what to do.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DensityError {
    /// The file cannot be opened or read.
    #[error("cannot read {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// Something is wrong with a named file's content.
    #[error("{path}: {source}")]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: Box<DensityError>,
    },
    /// The bytes are neither OpenVDB nor NumPy.
    #[error("neither an OpenVDB (.vdb) nor a NumPy (.npy) file")]
    UnknownFormat,
    /// The file ends in the middle of something.
    #[error("the file ends inside {0}: it is cut short or damaged")]
    Truncated(&'static str),
    /// The file contradicts itself or its format.
    #[error("the file is damaged: {0}")]
    Damaged(String),
    /// A valid file with something in it that this reader does not handle.
    #[error("{0}")]
    Unsupported(String),
    /// No grid of the name asked for, or no single obvious one.
    #[error("{0}")]
    NoSuchGrid(String),
    /// The grid has no voxels.
    #[error("the grid \"{0}\" is empty: it has no active voxels")]
    Empty(String),
    /// The box is too large for a dense grid.
    #[error("a box of {0} × {1} × {2} cells is too large (the limit is 2^31 cells): crop or resample it")]
    TooLarge(u64, u64, u64),
    /// A density is infinite or not a number.
    #[error("the density of voxel ({0}, {1}, {2}) is {3}: densities must be finite 32-bit floats")]
    NotFinite(i64, i64, i64, f32),
}
