//! Options of `smoke render` that trade accuracy for time.

use anyhow::ensure;
use clap::Args;
use serde::Serialize;

use super::render::Method;
use crate::quality::{QualityChoice, SmokeModel, SmokeQuality};

/// What the light and the picture of method rbf are computed with; the most accurate unless given.
#[derive(Args, Debug)]
pub struct QualityArgs {
    /// rbf: chooses all of the below, to be as cheap as it can with an error of so much (error:0.02 is 2 %), or as accurate
    /// as it can in so many milliseconds of the GPU (budget:4)
    #[arg(long, value_name = "error:E|budget:MS", value_parser = parse_quality, conflicts_with_all = [
        "rbf_limit", "probes", "sh_order", "directions", "sweeps", "step", "half_resolution", "lighting_interval",
    ])]
    quality: Option<SmokeQuality>,
    /// rbf: RBFs that light is computed at, at most: so many stand for all
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    rbf_limit: Option<u32>,
    /// rbf: probes of each RBF, 7 or 1 [default: 7]
    #[arg(long, value_parser = ["1", "7"])]
    probes: Option<String>,
    /// rbf: bands of spherical harmonics of scattered light, 1 to 4 [default: 4]
    #[arg(long, value_name = "BANDS", value_parser = clap::value_parser!(u32).range(1..=4))]
    sh_order: Option<u32>,
    /// rbf: directions in which a probe looks for light, 16, 32 or 64 [default: 64]
    #[arg(long, value_parser = ["16", "32", "64"])]
    directions: Option<String>,
    /// rbf: sweeps of the solver of multiple scattering at most, a multiple of 5 [default: 30]
    #[arg(long, value_parser = ["5", "10", "15", "20", "25", "30"])]
    sweeps: Option<String>,
    /// rbf: length of a step along a ray, in cells, 0.25 to 4 [default: 0.5]
    #[arg(long, value_name = "CELLS")]
    step: Option<f32>,
    /// rbf: marches a quarter of the pixels and interpolates the others
    #[arg(long)]
    half_resolution: bool,
    /// rbf: frames from one computation of light to the next at least, 1 to 60 [default: 1]
    #[arg(long, value_name = "FRAMES", value_parser = clap::value_parser!(u32).range(1..=60))]
    lighting_interval: Option<u32>,
}

impl QualityArgs {
    /// Refuses options that the method does not have, and values out of range.
    pub(super) fn check(&self, method: Method) -> anyhow::Result<()> {
        let quality = self.quality();
        ensure!(
            method == Method::Rbf || quality == SmokeQuality::default(),
            "--quality, --rbf-limit, --probes, --sh-order, --directions, --sweeps, --step, --half-resolution and --lighting-interval \
             are for --method rbf"
        );
        if let Some(step) = self.step {
            ensure!((0.25..=4.0).contains(&step), "--step {step}: 0.25 to 4 cells");
        }
        Ok(())
    }

    /// What is asked for.
    pub(super) fn quality(&self) -> SmokeQuality {
        if let Some(quality) = self.quality {
            return quality;
        }
        let full = SmokeModel::FULL;
        let number =
            |text: &Option<String>, default| text.as_ref().map_or(default, |text| text.parse().expect("listed"));
        SmokeQuality::Model(SmokeModel {
            rbfs: self.rbf_limit.unwrap_or(full.rbfs),
            probes: number(&self.probes, full.probes),
            order: self.sh_order.unwrap_or(full.order),
            directions: number(&self.directions, full.directions),
            sweeps: number(&self.sweeps, full.sweeps),
            step: self.step.unwrap_or(full.step),
            half_resolution: self.half_resolution,
            lighting_interval: self.lighting_interval.unwrap_or(full.lighting_interval),
        })
    }
}

fn parse_quality(text: &str) -> Result<SmokeQuality, String> {
    let parse = |number: &str| number.parse().ok().filter(|number: &f32| *number > 0.0);
    let quality = match text.split_once(':') {
        Some(("error", most)) => parse(most).filter(|most| *most <= 1.0).map(SmokeQuality::Error),
        Some(("budget", most)) => parse(most).map(SmokeQuality::Budget),
        _ => None,
    };
    quality.ok_or(
        "a quality is error:E with E above 0 and up to 1, or budget:MS in milliseconds: error:0.02, budget:4".into(),
    )
}

/// The model that was drawn with, for `--stats`.
#[derive(Serialize)]
pub(super) struct QualityStats {
    model: ModelStats,
    /// Of the picture, relative and root mean square; of a frame in which everything changes.
    predicted_error: f32,
    predicted_ms: f32,
    why: String,
}

impl From<QualityChoice> for QualityStats {
    fn from(choice: QualityChoice) -> Self {
        Self {
            model: choice.model.into(),
            predicted_error: choice.error,
            predicted_ms: choice.milliseconds,
            why: choice.to_string(),
        }
    }
}

/// A model, for `--stats`.
#[derive(Serialize)]
struct ModelStats {
    /// At most; null where there is no limit.
    rbf_limit: Option<u32>,
    probes_an_rbf: u32,
    sh_order: u32,
    directions: u32,
    sweeps: u32,
    step: f32,
    half_resolution: bool,
    lighting_interval: u32,
}

impl From<SmokeModel> for ModelStats {
    fn from(model: SmokeModel) -> Self {
        Self {
            rbf_limit: (model.rbfs != u32::MAX).then_some(model.rbfs),
            probes_an_rbf: model.probes,
            sh_order: model.order,
            directions: model.directions,
            sweeps: model.sweeps,
            step: model.step,
            half_resolution: model.half_resolution,
            lighting_interval: model.lighting_interval,
        }
    }
}
