//! Zhou et al. 2008 as printed, in the place of the passes from incident light to volume, for the volumes that ask for
//! it. A baseline to compare with, only with the feature `reference`; [`crate::reference::paper`] is its twin.
//!
//! | step | reads | writes | once per |
//! |---|---|---|---|
//! | `single` | environment, RBFs | 16 SH coefficients of source radiance, an RBF | volume and light |
//! | `system` | those | Eq. 13, n × n | the same |
//! | `start` | L⁰ as it was before, of the RBFs at the same places in the list | where the solver starts | the same |
//! | `residual`, `transpose`, `begin`; `multiply`, `transpose`, `advance` a step | Eq. 13 | L⁰ at the RBFs | volume and light |
//! | `media` | L⁰ | source radiance, added to the above | the same |
//! | `outgoing` | source radiance | that toward the eye, an RBF | the same, × view if g ≠ 0 |
//! | `volume` | RBFs, bins, density | 3D texture of source radiance times density, and density | the same |

mod light;
mod steps;
mod tables;

use bevy::prelude::*;
use bevy::render::render_resource::PipelineCache;
use bevy::render::renderer::RenderContext;
use bevy::render::sync_world::MainEntity;

#[cfg(all(test, feature = "cli"))]
pub(super) use self::light::jobs;
pub(super) use self::light::{PaperLight, PaperSlice};
#[cfg(all(test, feature = "cli"))]
pub(super) use self::steps::{LightBindings, LookBindings};
pub(crate) use self::steps::{PaperPasses, Step};
#[cfg(all(test, feature = "cli"))]
pub(super) use self::tables::PaperUniform;
pub(super) use self::tables::Tables;
use super::lighting::LightingUniform;
use super::pass::{ComputePass, Job};
use super::{SmokePasses, SmokeRenderStats, SmokeWork};

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_paper";

/// Runs all steps of all volumes, in the order they were listed.
pub(super) fn paper(
    work: Res<SmokeWork>,
    passes: Res<SmokePasses>,
    cache: Res<PipelineCache>,
    stats: Res<SmokeRenderStats>,
    mut ctx: RenderContext,
) {
    let jobs: Vec<(&ComputePass, &Job)> = work.paper.iter().map(|(step, job)| (passes.paper.of(*step), job)).collect();
    ComputePass::run_all(LABEL, &jobs, &cache, &stats.paper, &mut ctx);
}

/// The method knows no lamps: says so once, and leaves them out. A sun in the environment stays in its coefficients.
pub(super) fn without_lamps(lighting: LightingUniform, volume: MainEntity) -> LightingUniform {
    if lighting.lamp_count > u32::from(lighting.sun_irradiance != Vec3::ZERO) {
        warn_once!("smoke volume {volume:?} has SmokePaper: lamps do not light it (said once)");
    }
    LightingUniform { lamp_count: 0, sun_irradiance: Vec3::ZERO, ..lighting }
}
