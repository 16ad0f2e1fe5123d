//! Which model each volume is drawn with in this frame, and why.

use bevy::diagnostic::{Diagnostic, DiagnosticPath, DiagnosticsStore};
use bevy::platform::collections::HashMap;
use bevy::prelude::*;
use bevy::render::sync_world::MainEntity;

use super::SmokeRenderStats;
use super::extract::{Content, ExtractedVolume};
use super::frame::GpuSmokeFrame;
use super::placed::{Coverage, Placed};
use super::view::{self, Emission};
use crate::quality::{Milliseconds, Pace, QualityChoice, Setting, SmokeModel, SteadyChoice};

/// The choices so far.
#[derive(Default)]
pub(super) struct Qualities {
    choices: HashMap<MainEntity, SteadyChoice>,
    /// What the views of this frame make of each volume, and what of its light is known.
    settings: HashMap<MainEntity, Setting>,
    pace: Pace,
    /// Of the frames before, smoothed.
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
        stats: &SmokeRenderStats,
    ) {
        if let Some(measured) = measured {
            self.pace = self.pace.toward(measured, self.predicted);
        }
        let mut predicted = Milliseconds::default();
        for (&entity, setting) in &self.settings {
            let asked = volume_of(entity).quality;
            let choice = self
                .choices
                .entry(entity)
                .and_modify(|choice| choice.update(asked, setting, &self.pace))
                .or_insert_with(|| SteadyChoice::new(QualityChoice::best(asked, setting, &self.pace)));
            stats.set_quality(entity, choice.current);
            let work = setting.milliseconds(&choice.current.model);
            predicted.light += work.light;
            predicted.view += work.view;
        }
        self.predicted = predicted;
    }

    /// What a volume is drawn with.
    pub fn model(&self, entity: MainEntity) -> SmokeModel {
        self.choices.get(&entity).map_or(SmokeModel::FULL, |choice| choice.current.model)
    }

    pub fn retain(&mut self, exists: impl Fn(MainEntity) -> bool) {
        self.choices.retain(|entity, _| exists(*entity));
    }
}

/// Milliseconds that the passes have taken of late, where `RenderDiagnosticsPlugin` measures.
pub(super) fn measured(diagnostics: &DiagnosticsStore) -> Option<f32> {
    let time = |name: &str| {
        let path = DiagnosticPath::new(format!("render/{name}/elapsed_gpu"));
        diagnostics.get(&path).and_then(Diagnostic::smoothed).map(|ms| ms as f32)
    };
    let light = [
        super::pair_matrix::LABEL,
        super::incident_light::LABEL,
        super::scattering::LABEL,
        super::outgoing::LABEL,
        super::volume::LABEL,
    ];
    Some(time(view::LABEL)? + light.into_iter().filter_map(time).sum::<f32>())
}
