//! The figures of a bake, as `smoke bake --report` writes them.

use serde::{Deserialize, Serialize};

use super::picture::PictureError;
use super::verify::QuantizationReport;
use crate::bundle::{BundleHeader, SectionBytes, SmokeFrame, section_bytes};
use crate::density::DensityGrid;
use crate::rbf::fit::FitStage;
use crate::residual::HashedResidual;

/// What a frame took, and how close its result is to the input.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrameReport {
    /// The input.
    pub source: SourceReport,
    /// The Gaussians.
    pub fit: FitSummary,
    /// Errors of the 8-bit residual, over all cells.
    pub quantization: QuantizationReport,
    /// The error that quantisation causes in a picture.
    pub picture: PictureError,
    /// The residual and its spatial hash.
    pub residual: ResidualReport,
    /// Where the bytes go.
    pub bytes: BytesReport,
    /// Seconds per stage.
    pub seconds: StageSeconds,
}

/// The density that was baked.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SourceReport {
    /// The grid's name; empty where the format has none.
    pub grid: String,
    /// Active voxels of the file.
    pub active_voxels: u64,
    /// Leaf nodes of the file's tree; 0 where the format has none.
    pub leaves: u64,
    /// Whether the file stores half-precision values.
    pub half: bool,
    /// Cells a side of the box.
    pub dims: [u32; 3],
    /// Side of a cell in world units.
    pub voxel_size: f64,
    /// World position of the box's centre.
    pub center: [f64; 3],
    /// The smallest density above 0; 0 if there is none.
    pub min_density: f32,
    /// The largest density.
    pub max_density: f32,
    /// The density the file gives to empty space.
    pub background: f32,
    /// Cells whose density was negative and has been set to 0.
    pub negative_voxels: u64,
}

/// The fit's result.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FitSummary {
    /// Gaussians.
    pub rbfs: usize,
    /// `sqrt(Σ R² / Σ D²)` over all cells; Zhou et al. print its square.
    pub error: f64,
    /// `error` over that of the sequence's first frame with smoke; 1 there, and where no error has been set before.
    pub ratio: f64,
    /// The number of Gaussians, or the error, that was asked for has been reached.
    pub reached: bool,
    /// Why it has not been.
    pub shortfall: Option<String>,
    /// Gaussians that the frame before did not have.
    pub inserted: usize,
    /// Gaussians that only the frame before had.
    pub deleted: usize,
    /// Iterations of the minimiser.
    pub iterations: u32,
    /// Gaussians moved to where the error is largest, those moved in vain included.
    pub teleports: u32,
    /// Evaluations of the sum of squared errors.
    pub evaluations: u32,
    /// Seconds by stage.
    pub seconds: FitSeconds,
}

/// Seconds of the fit's stages.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FitSeconds {
    /// Adding Gaussians.
    pub grow: f64,
    /// Teleportation rounds.
    pub teleport: f64,
    /// The last run on the full grid.
    pub polish: f64,
    /// Taking the Gaussians of the frame before to this one.
    pub follow: f64,
}

/// The residual and its hash tables.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ResidualReport {
    /// Cells with a residual that is not 0.
    pub count: u32,
    /// Their share of all cells.
    pub share: f64,
    /// Side of the offset table.
    pub offset_side: u32,
    /// Slots of the hash table.
    pub slots: u32,
}

/// Bytes of the file.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct BytesReport {
    /// The parts of the frame before compression.
    pub uncompressed: SectionBytes,
    /// The frame in the file.
    pub file: usize,
    /// The input as 32-bit numbers, one a cell.
    pub dense: u64,
}

/// Seconds spent.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StageSeconds {
    /// Reading the input, where it was a file.
    pub read: f64,
    /// Fitting the Gaussians.
    pub fit: f64,
    /// Quantising and hashing the residual.
    pub residual: f64,
    /// Compressing and writing to memory.
    pub compress: f64,
    /// Reading back and measuring.
    pub verify: f64,
}

impl SourceReport {
    pub(super) fn new(grid: &DensityGrid) -> Self {
        let source = &grid.source;
        let smallest = grid.values.iter().copied().filter(|&d| d > 0.0).fold(f32::INFINITY, f32::min);
        Self {
            grid: source.grid.clone(),
            active_voxels: source.active_voxels,
            leaves: source.leaves,
            half: source.half,
            dims: grid.shape.dims.to_array(),
            voxel_size: grid.placement.voxel_size,
            center: grid.placement.center.to_array(),
            min_density: if smallest.is_finite() { smallest } else { 0.0 },
            max_density: grid.max(),
            background: source.background,
            negative_voxels: source.negative_voxels,
        }
    }
}

impl FitSeconds {
    pub(super) fn new(spent: &[(FitStage, f64)]) -> Self {
        let mut seconds = Self::default();
        for &(stage, spent) in spent {
            match stage {
                FitStage::Grow => seconds.grow += spent,
                FitStage::Teleport => seconds.teleport += spent,
                FitStage::Polish => seconds.polish += spent,
                FitStage::Follow => seconds.follow += spent,
            }
        }
        seconds
    }
}

impl ResidualReport {
    pub(super) fn new(residual: &HashedResidual) -> Self {
        Self {
            count: residual.count(),
            share: f64::from(residual.count()) / residual.shape().len() as f64,
            offset_side: residual.offset_side(),
            slots: residual.slots(),
        }
    }
}

impl BytesReport {
    pub(super) fn new(frame: &SmokeFrame, file: usize) -> Self {
        let dense = 4 * frame.residual.shape().len() as u64;
        Self { uncompressed: section_bytes(frame), file, dense }
    }
}

/// A bake of a sequence: figures of the whole, then of every frame.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SequenceReport {
    /// The whole.
    pub summary: SummaryReport,
    /// The frames in order.
    pub frames: Vec<InputReport>,
}

/// A frame's figures and the file they belong to.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct InputReport {
    /// The file.
    pub input: String,
    /// Its figures.
    #[serde(flatten)]
    pub report: FrameReport,
}

/// Figures of a whole sequence.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SummaryReport {
    /// Frames.
    pub frames: usize,
    /// Cells a side of the box that all frames share.
    pub dims: [u32; 3],
    /// Gaussians in the frame with the fewest and in that with the most.
    pub rbfs: [usize; 2],
    /// The largest error of a fit.
    pub worst_error: f64,
    /// The frame that has it, from 0.
    pub worst_frame: usize,
    /// The frames, from 0, that are short of what was asked for; each says why.
    pub short: Vec<usize>,
    /// Bytes of the file.
    pub bytes: u64,
    /// Bytes a frame.
    pub bytes_per_frame: f64,
    /// Seconds that all frames took, added up by stage. Stages of different frames run at the same time.
    pub stage_seconds: StageSeconds,
    /// Seconds of this run of the command, without frames that had been finished before it.
    pub seconds: f64,
    /// Frames that had been finished before this run.
    pub resumed: usize,
    /// Threads the fit could use.
    pub threads: usize,
    /// Seed of the fit.
    pub seed: u64,
}

impl SummaryReport {
    /// The summary of at least one frame, as far as the frames tell.
    pub(super) fn new(frames: &[InputReport], header: &BundleHeader, seed: u64) -> Self {
        let fits = || frames.iter().map(|frame| &frame.report.fit);
        let worst = fits().enumerate().max_by(|(_, a), (_, b)| a.error.total_cmp(&b.error));
        let mut stage_seconds = StageSeconds::default();
        for InputReport { report: FrameReport { seconds, .. }, .. } in frames {
            stage_seconds.read += seconds.read;
            stage_seconds.fit += seconds.fit;
            stage_seconds.residual += seconds.residual;
            stage_seconds.compress += seconds.compress;
            stage_seconds.verify += seconds.verify;
        }
        let bytes = header.file_length();
        Self {
            frames: frames.len(),
            dims: header.shape.dims.to_array(),
            rbfs: [fits().map(|fit| fit.rbfs).min(), fits().map(|fit| fit.rbfs).max()].map(Option::unwrap_or_default),
            worst_error: worst.map_or(0.0, |(_, fit)| fit.error),
            worst_frame: worst.map_or(0, |(index, _)| index),
            short: fits().enumerate().filter(|(_, fit)| !fit.reached).map(|(index, _)| index).collect(),
            bytes,
            bytes_per_frame: bytes as f64 / frames.len() as f64,
            stage_seconds,
            seconds: 0.0,
            resumed: 0,
            threads: rayon::current_num_threads(),
            seed,
        }
    }
}
