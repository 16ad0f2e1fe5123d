//! Options of `smoke render --method constellation`.

use anyhow::ensure;
use clap::{Args, ValueEnum};
use serde::Serialize;

use super::render::Method;
use crate::constellation::{ConstellationShading, SmokeConstellation};

/// Options of `smoke render` that only the constellation has.
#[derive(Args, Debug)]
pub struct ConstellationArgs {
    /// constellation: lights that stand for the light from all around [default: 16]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=i64::from(SmokeConstellation::MAX_LIGHTS)))]
    lights: Option<u32>,
    /// constellation: how much of the light's way is drawn [default: self-shadow]
    #[arg(long, value_enum)]
    shading: Option<Shading>,
    /// constellation: shades every pixel of the box, not only those that a mask says show smoke
    #[arg(long)]
    no_mask: bool,
    /// constellation: samples empty space too
    #[arg(long)]
    no_skip: bool,
    /// constellation: cells between samples along view rays [default: 0.5]
    #[arg(long, value_name = "CELLS", value_parser = step)]
    view_step: Option<f32>,
    /// constellation: cells between samples along shadow rays [default: 1]
    #[arg(long, value_name = "CELLS", value_parser = step)]
    shadow_step: Option<f32>,
}

#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Shading {
    /// Smoke emits the mean radiance
    Alpha,
    /// Light reaches every point
    Primary,
    /// Light is attenuated on its way
    SelfShadow,
}

fn step(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(cells) if (0.1..=8.0).contains(&cells) => Ok(cells),
        _ => Err("a step is 0.1 to 8 cells".into()),
    }
}

/// What the constellation did, for `--stats`.
#[derive(Serialize)]
pub(super) struct ConstellationStats {
    lights: u32,
    shading: Shading,
    mask: bool,
    skip_empty: bool,
    view_step: f32,
    shadow_step: f32,
}

impl ConstellationArgs {
    /// Refuses options that the method does not have.
    pub(super) fn check(&self, method: Method) -> anyhow::Result<()> {
        let Self { lights, shading, no_mask, no_skip, view_step, shadow_step } = self;
        let steps = view_step.is_some() || shadow_step.is_some();
        let given = lights.is_some() || shading.is_some() || *no_mask || *no_skip || steps;
        ensure!(
            method == Method::Constellation || !given,
            "--lights, --shading, --no-mask, --no-skip, --view-step and --shadow-step are for --method constellation"
        );
        Ok(())
    }

    /// The component that draws by a constellation, if that is the method.
    pub(super) fn component(&self, method: Method) -> Option<SmokeConstellation> {
        let default = SmokeConstellation::default();
        (method == Method::Constellation).then(|| SmokeConstellation {
            lights: self.lights.unwrap_or(default.lights),
            shading: self.shading.map_or(default.shading, Into::into),
            mask: !self.no_mask,
            skip_empty: !self.no_skip,
            view_step: self.view_step.unwrap_or(default.view_step),
            shadow_step: self.shadow_step.unwrap_or(default.shadow_step),
        })
    }
}

impl From<Shading> for ConstellationShading {
    fn from(shading: Shading) -> Self {
        match shading {
            Shading::Alpha => Self::Alpha,
            Shading::Primary => Self::Primary,
            Shading::SelfShadow => Self::SelfShadow,
        }
    }
}

impl From<ConstellationShading> for Shading {
    fn from(shading: ConstellationShading) -> Self {
        match shading {
            ConstellationShading::Alpha => Self::Alpha,
            ConstellationShading::Primary => Self::Primary,
            ConstellationShading::SelfShadow => Self::SelfShadow,
        }
    }
}

impl From<SmokeConstellation> for ConstellationStats {
    fn from(constellation: SmokeConstellation) -> Self {
        let SmokeConstellation { lights, shading, mask, skip_empty, view_step, shadow_step } = constellation;
        Self { lights, shading: shading.into(), mask, skip_empty, view_step, shadow_step }
    }
}
