//! From a density grid to a bundle: fit, residual, file, and a check of the file against the grid.
//!
//! [`bake`] ends by reading back what it wrote: every figure of [`BakeReport`] is measured on what a game will load.

mod picture;
mod process;
mod report;
#[cfg(test)]
mod tests;
mod verify;

use std::time::Instant;

use crate::bundle::{self, BundleError, SmokeAnimation, SmokeFrame};
use crate::density::DensityGrid;
use crate::rbf::fit::{Fit, FitError, FitProgress, FitSettings, FitTarget, fit};
use crate::residual::{HashedResidual, QuantizationLaw, ResidualError};

use picture::Picture;
pub use picture::{PictureError, picture_error};
pub use process::{VdbBaker, VdbBakerSettings};
pub use report::{BakeReport, BytesReport, FitSeconds, FitSummary, ResidualReport, SourceReport, StageSeconds};
pub use verify::{QuantizationReport, Worst};

/// The exponents that a bake may choose from.
pub const EXPONENTS: [f32; 4] = [1.0, 1.5, 2.0, 3.0];
/// Relative error of the picture ([`picture_error`]) that quantisation may cause before a larger exponent is taken.
pub const PICTURE_BUDGET: f64 = 0.0025;

/// What to bake for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BakeSettings {
    /// How many Gaussians, or how close a fit.
    pub target: FitTarget,
    /// Seed of the fit's random choices: the same seed gives the same bundle.
    pub seed: u64,
    /// Playback speed stored in the bundle, above 0.
    pub frames_per_second: f32,
    /// Exponent of the residual's [`QuantizationLaw`], 0.1 to 10: 1 is linear, more is finer near 0 and larger on disk.
    /// `None` takes the smallest of [`EXPONENTS`] that costs at most [`PICTURE_BUDGET`] of the picture.
    pub residual_exponent: Option<f32>,
}

impl Default for BakeSettings {
    fn default() -> Self {
        Self { target: FitTarget::Count(600), seed: 1, frames_per_second: 30.0, residual_exponent: None }
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

/// Why a grid cannot be baked.
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
}

/// A finished bake.
#[derive(Clone, Debug)]
pub struct Baked {
    /// The animation, as read back from `file`.
    pub animation: SmokeAnimation,
    /// The bytes of the `.smoke` file.
    pub file: Vec<u8>,
    /// What it took and how good it is.
    pub report: BakeReport,
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
    let fit_settings = FitSettings { target: settings.target, seed: settings.seed, ..FitSettings::default() };
    let Fit { model: rbfs, report: fit_report } =
        fit(grid.shape, &grid.values, &fit_settings, &|p| progress(BakeProgress::Fitting(p)))?;
    let fit = clock.lap();

    progress(BakeProgress::Residual);
    let residual = quantize(grid, &rbfs.rasterize(grid.shape), settings.residual_exponent)?;
    let frame = SmokeFrame::new(rbfs, residual);
    let residual = clock.lap();

    progress(BakeProgress::Compressing);
    let max_density = frame.decode().into_iter().fold(0.0, f32::max);
    let file = bundle::write(&SmokeAnimation {
        shape: grid.shape,
        placement: grid.placement,
        frames_per_second: settings.frames_per_second,
        max_density,
        frames: vec![frame].into(),
    })?;
    let compress = clock.lap();

    progress(BakeProgress::Verifying);
    let animation = bundle::read(&file)?;
    let frame = animation.frames.get(0).expect("the one that has been written");
    let quantization = QuantizationReport::measure(&grid.values, frame);
    // Half a step is exact but for the rounding of a 32-bit number.
    if quantization.worst_half_steps.error > 1.0 {
        let Worst { error: half_steps, cell } = quantization.worst_half_steps;
        return Err(BakeError::Verification { cell, half_steps });
    }
    let picture = picture_error(grid, frame);
    let seconds = StageSeconds { fit, residual, compress, verify: clock.lap() };

    let report = BakeReport {
        source: SourceReport::new(grid),
        fit: FitSummary::new(grid, frame, &fit_report),
        quantization,
        picture,
        residual: ResidualReport::new(&frame.residual),
        bytes: BytesReport::new(frame, file.len()),
        seconds,
        threads: rayon::current_num_threads(),
        seed: settings.seed,
    };
    Ok(Baked { animation, file, report })
}

/// Quantises and hashes what the model leaves out, by the law of the given exponent or by the first that is good enough.
fn quantize(grid: &DensityGrid, model: &[f32], exponent: Option<f32>) -> Result<HashedResidual, BakeError> {
    let residuals = verify::difference(&grid.values, model);
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
