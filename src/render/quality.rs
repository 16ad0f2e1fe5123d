//! Which model each volume is drawn with in this frame, and why.

use core::time::Duration;

use bevy::diagnostic::{DiagnosticPath, DiagnosticsStore};
use bevy::platform::collections::HashMap;
use bevy::prelude::*;
use bevy::render::renderer::RenderAdapterInfo;
use bevy::render::sync_world::MainEntity;

use super::SmokeRenderStats;
use super::extract::{Content, ExtractedVolume};
use super::frame::GpuSmokeFrame;
use super::placed::{Coverage, Placed};
use super::view::{self, Emission};
use crate::quality::{Milliseconds, Predictor, Setting, SmokeModel, SteadyChoice};

/// What has been measured longer ago than this says nothing of the present.
const RECENT: Duration = Duration::from_secs(1);

/// The choices so far.
#[derive(Default)]
pub(super) struct Qualities {
    choices: HashMap<MainEntity, SteadyChoice>,
    /// Lamps that have lit each volume.
    lamps: HashMap<MainEntity, u32>,
    /// What the views of this frame make of each volume, and what of its light is known.
    settings: HashMap<MainEntity, Setting>,
    /// Known from the first frame on.
    predictor: Option<Predictor>,
    /// Of the frame before.
    predicted: Milliseconds,
}

impl Qualities {
    /// Starts a frame.
    pub fn begin(&mut self) {
        self.settings.clear();
    }

    /// A volume is seen by one more view.
    pub fn see(
        &mut self,
        entity: MainEntity,
        (volume, placed, frame): (&ExtractedVolume, &Placed, &GpuSmokeFrame),
        multiple: bool,
        coverage: &Coverage,
        can_halve: bool,
    ) {
        let shape = placed.shape;
        let lamps = self.lamps.get(&entity).copied();
        let setting = self.settings.entry(entity).or_insert_with(|| {
            // Of live smoke nothing is known but its lattice.
            let optical_radius = frame.typical_depth().map_or(0.3, |depth| depth * placed.sigma(volume));
            let dims = shape.dims.as_vec3();
            Setting {
                rbfs: frame.rbf_count as f32,
                is_reducible: matches!(volume.content, Content::Baked(_)),
                can_halve: volume.emission() == Emission::Exact,
                optical_radius,
                g: volume.medium.g,
                multiple,
                // Known of the frame before.
                lamps: lamps.unwrap_or(0) as f32,
                cells: dims.element_product(),
                pixels: 0.0,
                // The mean chord of a convex body: four times its volume over its surface.
                cells_along: 2.0 * dims.element_product() / (dims.x * dims.y + dims.y * dims.z + dims.z * dims.x),
                cells_a_pixel: f32::MAX,
            }
        });
        setting.can_halve &= can_halve;
        setting.pixels += coverage.pixels;
        setting.cells_a_pixel = setting.cells_a_pixel.min(coverage.cells_a_pixel);
    }

    /// Chooses for all volumes that are seen, by what the GPU has been measured to take where there are measurements.
    pub fn choose<'a>(
        &mut self,
        volume_of: impl Fn(MainEntity) -> &'a ExtractedVolume,
        measured: Option<f32>,
        adapter: &RenderAdapterInfo,
        stats: &SmokeRenderStats,
    ) {
        let predictor = self.predictor.get_or_insert_with(|| Predictor::of(adapter.device_type));
        if let Some(measured) = measured {
            predictor.follow(measured, self.predicted);
        }
        let mut predicted = Milliseconds::default();
        for (&entity, setting) in &self.settings {
            let asked = volume_of(entity).quality;
            let choice = self
                .choices
                .entry(entity)
                .and_modify(|choice| choice.update(asked, setting, predictor))
                .or_insert_with(|| SteadyChoice::new(predictor.best(asked, setting)));
            stats.set_quality(entity, choice.current);
            let work = predictor.price_of(setting, &choice.current.model);
            predicted.light += work.light;
            predicted.view += work.view;
        }
        self.predicted = predicted;
    }

    /// So many lamps light a volume.
    pub fn lit_by(&mut self, entity: MainEntity, lamps: u32) {
        self.lamps.insert(entity, lamps);
    }

    /// What a volume is drawn with.
    pub fn model(&self, entity: MainEntity) -> SmokeModel {
        self.choices.get(&entity).map_or(SmokeModel::FULL, |choice| choice.current.model)
    }

    /// Lets go of volumes that are gone, or no longer drawn by choice.
    pub fn retain(&mut self, is_chosen: impl Fn(MainEntity) -> bool, stats: &SmokeRenderStats) {
        self.choices.retain(|entity, _| is_chosen(*entity));
        self.lamps.retain(|entity, _| is_chosen(*entity));
        stats.retain_quality(is_chosen);
    }
}

/// Milliseconds that the passes take of frames in which light is computed, where `RenderDiagnosticsPlugin` measures them;
/// None while there are no such frames.
pub(super) fn measured(diagnostics: &DiagnosticsStore) -> Option<f32> {
    let time = |name: &str| {
        let diagnostic = diagnostics.get(&DiagnosticPath::new(format!("render/{name}/elapsed_gpu")))?;
        let is_recent = diagnostic.measurement()?.time.elapsed() < RECENT;
        diagnostic.smoothed().filter(|_| is_recent).map(|ms| ms as f32)
    };
    let always = [view::LABEL, super::incident_light::LABEL, super::outgoing::LABEL, super::volume::LABEL];
    let sometimes = [super::pair_matrix::LABEL, super::scattering::LABEL, super::diffusion::LABEL];
    let always: Option<f32> = always.into_iter().map(time).sum();
    Some(always? + sometimes.into_iter().filter_map(time).sum::<f32>())
}
