//! The Gaussians of a sequence from frame to frame.

use super::report::{FitSeconds, FitSummary};
use super::verify::{difference, relative};
use super::{BakeError, BakeSettings};
use crate::density::DensityGrid;
use crate::rbf::RbfModel;
use crate::rbf::fit::{
    Fit, FitProgress, FitReport, FitSettings, FitTarget, FollowSettings, Followed, NumberedRbfs, fit, follow,
};

/// The least error that a limit is set to: what 32-bit sums can tell from nothing.
const LEAST_LIMIT: f32 = 1e-6;

/// All that a frame takes over from those before it.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Track {
    /// The Gaussians of the last frame.
    pub rbfs: NumberedRbfs,
    /// Error of the first frame with smoke, once there has been one.
    pub reference: Option<f32>,
}

impl Track {
    /// Fits the next frame: after the last one, or where that has no Gaussians by itself.
    pub fn advance(
        &mut self,
        grid: &DensityGrid,
        settings: &BakeSettings,
        progress: &dyn Fn(FitProgress),
    ) -> Result<FitSummary, BakeError> {
        let limit = self.limit(settings);
        let max_rbfs = settings.most_rbfs();
        let (before, next_id) = (self.rbfs.ids.len(), self.rbfs.next_id);
        let followed = match limit {
            Some(limit) if before > 0 => {
                let trim = matches!(settings.target, FitTarget::Error(_));
                follow(grid.shape, &grid.values, &self.rbfs, &FollowSettings { limit, max_rbfs, trim }, progress)?
            }
            _ => {
                // The same error as the frames before had, so that counts do not jump.
                let target = limit.map_or(settings.target, FitTarget::Error);
                let fit_settings = FitSettings { target, seed: settings.seed, max_rbfs };
                let Fit { model, report } = fit(grid.shape, &grid.values, &fit_settings, progress)?;
                let inserted = model.rbfs.len();
                Followed { rbfs: NumberedRbfs::new(model, next_id), report, inserted, deleted: before }
            }
        };
        let Followed { rbfs, report, inserted, deleted } = followed;
        self.rbfs = rbfs;
        if self.reference.is_none() && !self.rbfs.ids.is_empty() {
            self.reference = Some(report.error);
        }
        Ok(self.summary(grid, &report, inserted, deleted, max_rbfs))
    }

    /// The error above which a frame gets more Gaussians.
    fn limit(&self, settings: &BakeSettings) -> Option<f32> {
        match settings.target {
            FitTarget::Count(_) => self.reference.map(|error| (settings.threshold * error).max(LEAST_LIMIT)),
            // The first frame is fitted to a target of its own: it may be out of range.
            FitTarget::Error(error) => self.reference.map(|_| error),
        }
    }

    fn summary(
        &self,
        grid: &DensityGrid,
        fit: &FitReport,
        inserted: usize,
        deleted: usize,
        max_rbfs: usize,
    ) -> FitSummary {
        let model = &self.rbfs.model;
        let error = model_error(grid, model);
        let reference = f64::from(self.reference.unwrap_or(0.0));
        let shortfall = if fit.reached {
            None
        } else if model.rbfs.len() >= max_rbfs {
            Some("max-rbfs reached".to_string())
        } else {
            Some("no place for another RBF found".to_string())
        };
        FitSummary {
            rbfs: model.rbfs.len(),
            error,
            ratio: if error > 0.0 && reference > 0.0 { error / reference } else { 1.0 },
            reached: fit.reached,
            shortfall,
            inserted,
            deleted,
            iterations: fit.iterations,
            teleports: fit.teleports,
            evaluations: fit.evaluations,
            seconds: FitSeconds::new(&fit.seconds),
        }
    }
}

/// `sqrt(Σ (D − D̃)² / Σ D²)` over all cells.
fn model_error(grid: &DensityGrid, model: &RbfModel) -> f64 {
    let square = |values: &[f32]| values.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>();
    let residuals = difference(&grid.values, &model.rasterize(grid.shape));
    relative(square(&residuals), square(&grid.values))
}
