//! From a fitted frame to its bytes: residual, compression, and a check of the bytes against the grid.

use super::report::{BytesReport, FrameReport, ResidualReport, SourceReport};
use super::verify::{QuantizationReport, Worst, difference};
use super::{BakeError, Clock, EXPONENTS, FitSummary, PICTURE_BUDGET, StageSeconds, picture::Picture, picture_error};
use crate::bundle::{PackedFrame, SmokeFrame};
use crate::density::DensityGrid;
use crate::rbf::RbfModel;
use crate::residual::{HashedResidual, QuantizationLaw};

/// A frame that is ready for a file.
pub(super) struct FinishedFrame {
    pub packed: PackedFrame,
    /// The frame as read back from its bytes.
    pub frame: SmokeFrame,
    /// The largest density of any of its cells.
    pub max_density: f32,
    pub report: FrameReport,
}

/// What finishing is about to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Step {
    Residual,
    Compressing,
    Verifying,
}

/// Finishes a frame of which the Gaussians are known. `seconds` holds what it has taken so far.
pub(super) fn finish(
    grid: &DensityGrid,
    rbfs: RbfModel,
    ids: Vec<u32>,
    fit: FitSummary,
    exponent: Option<f32>,
    mut seconds: StageSeconds,
    tell: &dyn Fn(Step),
) -> Result<FinishedFrame, BakeError> {
    let mut clock = Clock::start();
    tell(Step::Residual);
    let residual = quantize(grid, &rbfs.rasterize(grid.shape), exponent)?;
    let frame = SmokeFrame { rbfs, ids, residual };
    seconds.residual = clock.lap();

    tell(Step::Compressing);
    let packed = PackedFrame::new(&frame)?;
    seconds.compress = clock.lap();

    tell(Step::Verifying);
    let frame = packed.unpack(grid.shape)?;
    let quantization = QuantizationReport::measure(&grid.values, &frame);
    // Half a step is exact but for the rounding of a 32-bit number.
    if quantization.worst_half_steps.error > 1.0 {
        let Worst { error: half_steps, cell } = quantization.worst_half_steps;
        return Err(BakeError::Verification { cell, half_steps });
    }
    let picture = picture_error(grid, &frame);
    let max_density = frame.decode().into_iter().fold(0.0, f32::max);
    seconds.verify = clock.lap();

    let report = FrameReport {
        source: SourceReport::new(grid),
        fit,
        quantization,
        picture,
        residual: ResidualReport::new(&frame.residual),
        bytes: BytesReport::new(&frame, packed.bytes.len()),
        seconds,
    };
    Ok(FinishedFrame { packed, frame, max_density, report })
}

/// Quantises and hashes what the model leaves out, by the law of the given exponent or by the first that is good enough.
fn quantize(grid: &DensityGrid, model: &[f32], exponent: Option<f32>) -> Result<HashedResidual, BakeError> {
    let residuals = difference(&grid.values, model);
    let max = residuals.iter().fold(0f32, |max, r| max.max(r.abs()));
    let encode = |exponent: f32| {
        let law = QuantizationLaw { max, exponent };
        (law, residuals.iter().map(|&r| law.encode(r)).collect::<Vec<i8>>())
    };
    let picture = Picture::new(grid);
    let is_good = |(law, codes): &(QuantizationLaw, Vec<i8>)| {
        let decoded: Vec<f32> = model.iter().zip(codes).map(|(m, &q)| (m + law.decode(q)).max(0.0)).collect();
        picture.error(&decoded).0 <= PICTURE_BUDGET
    };
    let [rising @ .., largest] = EXPONENTS;
    let (law, codes) = match exponent {
        Some(exponent) => encode(exponent),
        None => rising.into_iter().map(encode).find(is_good).unwrap_or_else(|| encode(largest)),
    };
    Ok(HashedResidual::build(grid.shape, &codes, law)?)
}
