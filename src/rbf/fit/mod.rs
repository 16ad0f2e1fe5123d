//! Finding the Gaussians: the density field approximation of Zhou et al. 2008, section 5.1.
//!
//! [`fit`] minimises `Σ (D − D̃)²` over the cells of a frame with L-BFGS-B, centres kept inside the box, radii within
//! [`RADIUS`] and weights within [`WEIGHT`] times the largest density. It starts from nothing: Gaussians are added in
//! batches where they help most, on a coarse copy of the frame, with a few iterations of the minimiser between batches.
//! Then come teleportation rounds on finer copies: the least significant Gaussians move to where the error is largest,
//! or, when that has stopped helping, to random smoke; a round that does not lower the error is undone, and the fit ends
//! when both ways fail. A last run on the full grid settles what coarser copies cannot see.
//!
//! Squares are not weighted. In rendered single scattering (a plume and smoke.vdb, 300 Gaussians) weighting them by the
//! root of the density lowers the error by 2 to 7 % and raises that of the fit by 4 %; favouring thin smoke or empty
//! space makes both worse.
//!
//! A fit depends on its input and seed alone: not on the number of threads, nor on how fast they are.

mod field;
mod follow;
mod minimize;
mod objective;
mod place;
mod search;
#[cfg(test)]
mod tests;

use crate::density::GridShape;
use crate::rbf::{Rbf, RbfModel};
pub use follow::{FollowSettings, Followed, NumberedRbfs, follow};
use search::Search;

/// Smallest and largest radius of a fitted Gaussian, in bundle units.
pub const RADIUS: (f32, f32) = (0.015, 0.09);

/// Smallest and largest weight of a fitted Gaussian, in multiples of the frame's largest density.
pub const WEIGHT: (f32, f32) = (0.01, 1.0);

/// What a fit aims at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FitTarget {
    /// This many Gaussians. A frame with less structure than that gets fewer: see [`FitReport::reached`].
    Count(usize),
    /// A relative error [`relative_error`] of at most this much, with as few Gaussians as it takes (to about 2 %).
    /// Within 0 to 1; 1 is an empty model.
    Error(f32),
}

/// How to fit a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FitSettings {
    /// What to aim at.
    pub target: FitTarget,
    /// Seed of the random teleportations.
    pub seed: u64,
    /// Most Gaussians that [`FitTarget::Error`] may spend.
    pub max_rbfs: usize,
}

impl Default for FitSettings {
    fn default() -> Self {
        Self { target: FitTarget::Count(600), seed: 1, max_rbfs: 2000 }
    }
}

/// The parts of a fit: [`fit`] grows, teleports and polishes, again and again under [`FitTarget::Error`]; [`follow`]
/// follows, grows and polishes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum FitStage {
    /// Gaussians are added in batches.
    Grow,
    /// Teleportation rounds.
    Teleport,
    /// The last run on the full grid.
    Polish,
    /// Taking the Gaussians of the frame before to the next one: what [`follow`] begins with.
    Follow,
}

/// How far a fit has come.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FitProgress {
    /// What it is doing.
    pub stage: FitStage,
    /// Share of the work done, 0 to 1; never falls. An estimate: a fit may end early.
    pub fraction: f32,
    /// Gaussians at the moment.
    pub rbfs: usize,
    /// Relative error at the moment, as far as the current copy of the frame shows it.
    pub error: f32,
}

/// What a fit did.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FitReport {
    /// Relative error of the model: see [`relative_error`].
    pub error: f32,
    /// The model has the number of Gaussians, or at most the error, that was asked for. Otherwise it is the best found:
    /// with [`FitTarget::Count`] every Gaussian more would have weighed less than [`WEIGHT`] allows; with
    /// [`FitTarget::Error`] the most Gaussians allowed were not enough.
    pub reached: bool,
    /// Iterations of the minimiser.
    pub iterations: u32,
    /// Gaussians teleported, those moved in vain included.
    pub teleports: u32,
    /// Evaluations of the sum of squared errors, with or without its gradient.
    pub evaluations: u32,
    /// Wall-clock seconds by stage.
    pub seconds: Vec<(FitStage, f64)>,
}

/// A fitted frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Fit {
    /// The Gaussians; empty for a frame without smoke.
    pub model: RbfModel,
    /// How they came about.
    pub report: FitReport,
}

/// Why a frame cannot be fitted.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FitError {
    /// There is not one value per cell.
    #[error("{found} densities for a grid of {expected} cells")]
    Length {
        /// Cells in the grid.
        expected: usize,
        /// Values given.
        found: usize,
    },
    /// A density is infinite or not a number.
    #[error("the density of cell {0} is not a finite number")]
    NotFinite(glam::UVec3),
    /// The target error is not within 0 to 1.
    #[error("a target error of {0}: it must lie above 0, and 1 is already an empty model")]
    Target(f32),
}

/// Fits Gaussians to one frame, `values` in flat order over `shape`.
///
/// `progress` is called from the calling thread, many times a second.
///
/// # Errors
///
/// Only for input that makes no sense: see [`FitError`]. A target out of reach is no error: see
/// [`FitReport::reached`].
pub fn fit(
    shape: GridShape,
    values: &[f32],
    settings: &FitSettings,
    progress: &dyn Fn(FitProgress),
) -> Result<Fit, FitError> {
    check(shape, values)?;
    if let FitTarget::Error(error) = settings.target
        && !(error > 0.0 && error.is_finite())
    {
        return Err(FitError::Target(error));
    }
    let max = values.iter().copied().fold(0.0, f32::max);
    if max < f32::MIN_POSITIVE {
        let reached = matches!(settings.target, FitTarget::Error(_) | FitTarget::Count(0));
        return Ok(Fit { model: RbfModel::default(), report: FitReport { reached, ..FitReport::default() } });
    }
    Ok(Search::new(shape, values, max, settings.seed, progress).run(settings))
}

/// The relative error of a model, `√(Σ (D − D̃)² / Σ D²)`; 0 where there is no density.
///
/// Zhou et al. print its square.
pub fn relative_error(shape: GridShape, values: &[f32], model: &RbfModel) -> f32 {
    let (mut error, mut energy) = (0.0f64, 0.0f64);
    for (&value, fitted) in values.iter().zip(model.rasterize(shape)) {
        error += (f64::from(value) - f64::from(fitted)).powi(2);
        energy += f64::from(value).powi(2);
    }
    if energy > 0.0 { (error / energy).sqrt() as f32 } else { 0.0 }
}

fn check(shape: GridShape, values: &[f32]) -> Result<(), FitError> {
    if values.len() != shape.len() {
        return Err(FitError::Length { expected: shape.len(), found: values.len() });
    }
    match values.iter().position(|value| !value.is_finite()) {
        Some(index) => Err(FitError::NotFinite(shape.cell(index))),
        None => Ok(()),
    }
}

/// How much a Gaussian matters: its integral, but for a constant factor.
fn significance(rbf: &Rbf) -> f32 {
    rbf.weight * rbf.radius.powi(3)
}
