//! The figures of a bake, as `smoke bake --report` writes them.

use serde::Serialize;

use super::picture::PictureError;
use super::verify::{QuantizationReport, difference, relative};
use crate::bundle::{SectionBytes, SmokeFrame, section_bytes};
use crate::density::DensityGrid;
use crate::rbf::fit::{FitReport, FitStage};
use crate::residual::HashedResidual;

/// What a bake took, and how close its result is to the input.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BakeReport {
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
    /// Threads the fit could use.
    pub threads: usize,
    /// Seed of the fit.
    pub seed: u64,
}

/// The density that was baked.
#[derive(Clone, Debug, PartialEq, Serialize)]
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
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FitSummary {
    /// Gaussians.
    pub rbfs: usize,
    /// `sqrt(Σ R² / Σ D²)` over all cells; Zhou et al. print its square.
    pub error: f64,
    /// The number of Gaussians, or the error, that was asked for has been reached.
    pub reached: bool,
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
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct FitSeconds {
    /// Adding Gaussians.
    pub grow: f64,
    /// Teleportation rounds.
    pub teleport: f64,
    /// The last run on the full grid.
    pub polish: f64,
}

/// The residual and its hash tables.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
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
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct BytesReport {
    /// The parts of the frame before compression.
    pub uncompressed: SectionBytes,
    /// The whole file.
    pub file: usize,
    /// The input as 32-bit numbers, one a cell.
    pub dense: u64,
}

/// Seconds spent.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct StageSeconds {
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

impl FitSummary {
    pub(super) fn new(grid: &DensityGrid, frame: &SmokeFrame, fit: &FitReport) -> Self {
        let mut seconds = FitSeconds::default();
        for &(stage, spent) in &fit.seconds {
            match stage {
                FitStage::Grow => seconds.grow += spent,
                FitStage::Teleport => seconds.teleport += spent,
                FitStage::Polish => seconds.polish += spent,
            }
        }
        let square = |values: &[f32]| values.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>();
        let residuals = difference(&grid.values, &frame.rbfs.rasterize(grid.shape));
        Self {
            rbfs: frame.rbfs.rbfs.len(),
            error: relative(square(&residuals), square(&grid.values)),
            reached: fit.reached,
            iterations: fit.iterations,
            teleports: fit.teleports,
            evaluations: fit.evaluations,
            seconds,
        }
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
