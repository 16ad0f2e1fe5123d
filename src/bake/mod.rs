//! From density to a bundle: fit, residual, file, and a check of the file against the density.
//!
//! [`bake`] makes a bundle of one grid in memory, [`bake_sequence`] one of a list of files, a frame after the other, with
//! what it has done kept on disk so that it can go on after it was stopped. Both read back what they wrote: every figure
//! of a [`FrameReport`] is measured on what a game will load.

mod frame;
mod join;
mod parts;
mod picture;
mod process;
mod report;
mod sequence;
mod survey;
#[cfg(test)]
mod tests;
mod track;
mod verify;

use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::time::Instant;

use crate::bundle::{self, BundleError, BundleHeader, BundleWriter, FrameError, SmokeAnimation, WriteError};
use crate::density::{DensityError, DensityGrid};
use crate::rbf::fit::{FitError, FitProgress, FitTarget};
use crate::residual::ResidualError;

use frame::{FinishedFrame, Step, finish};
pub use join::{Joined, Seam, join};
pub use picture::{PictureError, picture_error};
pub use process::{VdbBaker, VdbBakerSettings};
pub use report::{
    BytesReport, FitSeconds, FitSummary, FrameReport, InputReport, ResidualReport, SequenceReport, SourceReport,
    StageSeconds, SummaryReport,
};
pub use sequence::{Segment, Sequence, SequenceProgress, bake_sequence};
use track::Track;
pub use verify::{QuantizationReport, Worst};

/// The exponents that a bake may choose from.
pub const EXPONENTS: [f32; 4] = [1.0, 1.5, 2.0, 3.0];
/// Relative error of the picture ([`picture_error`]) that quantisation may cause before a larger exponent is taken.
pub const PICTURE_BUDGET: f64 = 0.0025;

/// What to bake for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BakeSettings {
    /// How many Gaussians the first frame gets, or how close a fit all frames.
    pub target: FitTarget,
    /// Most Gaussians a frame may get. `None` is twice those of the first frame, or 2000 where `target` is an error.
    pub max_rbfs: Option<usize>,
    /// With a number of Gaussians as `target`: later frames get more while the error of the fit is above this times the
    /// first frame's; at least 1.
    pub threshold: f32,
    /// Seed of the fit's random choices: the same seed gives the same bundle.
    pub seed: u64,
    /// Playback speed stored in the bundle, above 0.
    pub frames_per_second: f32,
    /// Exponent of the residual's [`QuantizationLaw`](crate::residual::QuantizationLaw), 0.1 to 10: 1 is linear, more is
    /// finer near 0 and larger on disk. `None` takes the smallest of [`EXPONENTS`] that costs at most [`PICTURE_BUDGET`] of
    /// the picture.
    pub residual_exponent: Option<f32>,
}

impl BakeSettings {
    /// Most Gaussians a frame may get.
    pub fn most_rbfs(&self) -> usize {
        let most = self.max_rbfs.unwrap_or(match self.target {
            FitTarget::Count(count) => 2 * count,
            FitTarget::Error(_) => 2000,
        });
        most.min(bundle::MAX_RBFS as usize)
    }
}

impl Default for BakeSettings {
    fn default() -> Self {
        Self {
            target: FitTarget::Count(600),
            max_rbfs: None,
            threshold: 1.2,
            seed: 1,
            frames_per_second: 30.0,
            residual_exponent: None,
        }
    }
}

/// How far a bake has come.
#[derive(Clone, Copy, Debug)]
pub enum BakeProgress {
    /// The Gaussians are being fitted: nearly all of the time.
    Fitting(FitProgress),
    /// The residual is being quantised and hashed.
    Residual,
    /// The bundle is being compressed.
    Compressing,
    /// The bundle is being read back and compared with the input.
    Verifying,
}

/// Why something cannot be baked.
#[derive(Debug, thiserror::Error)]
pub enum BakeError {
    /// The Gaussians cannot be fitted.
    #[error(transparent)]
    Fit(#[from] FitError),
    /// The residual cannot be stored.
    #[error("residual: {0}")]
    Residual(#[from] ResidualError),
    /// The bundle would break a limit of its format.
    #[error("the bundle cannot be written: {0}")]
    Bundle(#[from] BundleError),
    /// A frame would break a limit of the format.
    #[error("the frame cannot be stored: {0}")]
    Store(#[from] FrameError),
    /// A cell of the finished bundle is farther from the input than quantisation explains.
    #[error(
        "cell {cell:?} of the bundle is off by {half_steps} half steps of its quantisation: this is a bug, please report it"
    )]
    Verification {
        /// The cell.
        cell: [u32; 3],
        /// Its error in half quantisation steps; at most 1 if all is well.
        half_steps: f64,
    },
    /// An input cannot be read.
    #[error(transparent)]
    Density(#[from] DensityError),
    /// A frame cannot be baked.
    #[error("{path}: {source}")]
    Frame {
        /// The input.
        path: PathBuf,
        /// What is wrong.
        source: Box<BakeError>,
    },
    /// Inputs do not belong together.
    #[error("{0}")]
    Inputs(String),
    /// A file of the bake cannot be read or written.
    #[error("{path}: {source}")]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// Another process bakes to the same output.
    #[error("another process is baking {0}: wait for it, or stop it, or choose another output")]
    Busy(PathBuf),
}

/// A finished bake.
#[derive(Clone, Debug)]
pub struct Baked {
    /// The animation, as read back from its bytes.
    pub animation: SmokeAnimation,
    /// The bytes of the `.smoke` file.
    pub file: Vec<u8>,
    /// What it took and how good it is.
    pub report: FrameReport,
}

/// Bakes one frame.
///
/// # Errors
///
/// Settings or a grid that cannot be fitted, a box beyond the format's limits, or (never, unless there is a bug) a
/// bundle that does not decode to the input.
pub fn bake(grid: &DensityGrid, settings: &BakeSettings, progress: &dyn Fn(BakeProgress)) -> Result<Baked, BakeError> {
    bundle::check_shape(grid.shape)?;
    let mut clock = Clock::start();
    let mut track = Track::default();
    let summary = track.advance(grid, settings, &|p| progress(BakeProgress::Fitting(p)))?;
    let seconds = StageSeconds { fit: clock.lap(), ..StageSeconds::default() };
    let tell = |step| {
        progress(match step {
            Step::Residual => BakeProgress::Residual,
            Step::Compressing => BakeProgress::Compressing,
            Step::Verifying => BakeProgress::Verifying,
        });
    };
    let FinishedFrame { packed, frame, max_density, report } =
        finish(grid, track.rbfs.model, track.rbfs.ids, summary, settings.residual_exponent, seconds, &tell)?;

    let header = BundleHeader {
        shape: grid.shape,
        placement: grid.placement,
        frames_per_second: settings.frames_per_second,
        max_density,
        frames: Vec::new(),
    };
    let write = || {
        let mut writer = BundleWriter::new(Cursor::new(Vec::new()), header, 1)?;
        writer.push(&packed)?;
        writer.finish(max_density)
    };
    let (file, header) = write().map_err(|error| at(Path::new("memory"), error))?;
    Ok(Baked { animation: header.animation(vec![frame].into()), file: file.into_inner(), report })
}

/// What went wrong with a file.
fn at(path: &Path, error: WriteError) -> BakeError {
    match error {
        WriteError::Io(source) => BakeError::Io { path: path.into(), source },
        WriteError::Bundle(error) => BakeError::Bundle(error),
    }
}

/// Seconds since it was last asked.
struct Clock(Instant);

impl Clock {
    fn start() -> Self {
        Self(Instant::now())
    }

    fn lap(&mut self) -> f64 {
        let seconds = self.0.elapsed().as_secs_f64();
        *self = Self::start();
        seconds
    }
}
