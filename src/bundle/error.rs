//! What can be wrong with a `.smoke` file.

use crate::residual::ResidualError;

/// Why a `.smoke` file cannot be read or written.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum BundleError {
    /// The file does not start with the magic bytes.
    #[error("not a .smoke file")]
    NotABundle,
    /// A version this library does not know.
    #[error("version {0} of the .smoke format; this library reads version 2: update it, or bake the smoke again")]
    Version(u32),
    /// The file ends too early.
    #[error("the file ends inside the {part}: it has {found} bytes and needs {expected}")]
    Truncated {
        /// Where it ends.
        part: &'static str,
        /// Bytes needed from the file's start.
        expected: u64,
        /// Bytes there are.
        found: u64,
    },
    /// The file goes on after its last frame.
    #[error("{0} bytes too many after the last frame")]
    TrailingBytes(u64),
    /// The header has been damaged.
    #[error("the header's checksum does not match: the file is damaged")]
    HeaderChecksum,
    /// A header field has a value the format does not allow.
    #[error("header field {field}: {problem}")]
    Header {
        /// The field, as `docs/format.md` names it.
        field: &'static str,
        /// What is wrong with its value.
        problem: String,
    },
    /// An animation to be written is itself read from a file, as it plays.
    #[error("the animation's frames are in a file, not in memory: read it whole to write it")]
    NotInMemory,
    /// A frame cannot be read.
    #[error("frame {index}: {error}")]
    Frame {
        /// Its number, from 0.
        index: usize,
        /// What is wrong with it.
        error: FrameError,
    },
}

/// What is wrong with one frame.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FrameError {
    /// There is no such frame.
    #[error("there is no such frame, the bundle has {0}")]
    Missing(usize),
    /// The frame's bytes have been damaged.
    #[error("its checksum does not match: the file is damaged")]
    Checksum,
    /// The Zstandard data cannot be decompressed, or not to the length the frame table gives.
    #[error("its compressed data is not valid: {0}")]
    Compression(String),
    /// The frame is shorter or longer than its counts say.
    #[error("it has {found} bytes where its counts need {expected}")]
    Length {
        /// Bytes that the counts in the frame add up to.
        expected: u64,
        /// Bytes in the frame.
        found: u64,
    },
    /// A field has a value the format does not allow.
    #[error("{field}: {problem}")]
    Field {
        /// The field, as `docs/format.md` names it.
        field: &'static str,
        /// What is wrong with its value.
        problem: String,
    },
    /// The parts of the residual do not fit together.
    #[error("residual: {0}")]
    Residual(#[from] ResidualError),
}

impl BundleError {
    pub(super) fn header(field: &'static str, problem: impl Into<String>) -> Self {
        Self::Header { field, problem: problem.into() }
    }
}

impl FrameError {
    pub(super) fn field(field: &'static str, problem: impl Into<String>) -> Self {
        Self::Field { field, problem: problem.into() }
    }

    pub(super) fn at(self, index: usize) -> BundleError {
        BundleError::Frame { index, error: self }
    }
}
