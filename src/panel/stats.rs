//! What the passes did and cost.

use bevy::diagnostic::{Diagnostic, DiagnosticPath, DiagnosticsStore};
use bevy::ecs::system::SystemParam;
use bevy::prelude::*;
use bevy_egui::egui::Ui;

use super::widgets;
use crate::render::SmokeRenderStats;

#[derive(SystemParam)]
pub(super) struct Stats<'w> {
    stats: Option<Res<'w, SmokeRenderStats>>,
    diagnostics: Option<Res<'w, DiagnosticsStore>>,
}

impl Stats<'_> {
    pub fn show(&self, ui: &mut Ui) {
        let Some(stats) = &self.stats else {
            ui.label("The app has no renderer.");
            return;
        };
        let rows = rows(stats, self.diagnostics.as_deref());
        let timed = rows.iter().any(|row| row.gpu_ms.is_some());
        let total: f64 = rows.iter().filter_map(|row| row.gpu_ms).sum();
        let cells = rows.into_iter().map(|row| row.cells());
        widgets::table(ui, "passes", ["pass", "dispatches", "GPU ms"], cells);
        ui.label(match timed {
            true => format!("{total:.2} ms in all: medians of the last frames in which each pass ran."),
            false => "No GPU times: add Bevy's RenderDiagnosticsPlugin, on an adapter with timestamps.".into(),
        });
        let memory = stats.memory();
        let megabytes = memory.bytes as f64 / 1e6;
        ui.label(format!("{} moments of smoke on the GPU, {megabytes:.1} MB.", memory.moments));
    }
}

/// A pass in the table.
#[derive(Clone, Debug, PartialEq)]
struct Row {
    pass: &'static str,
    dispatches: u32,
    gpu_ms: Option<f64>,
}

impl Row {
    fn cells(&self) -> [String; 3] {
        let time = self.gpu_ms.map_or("-".into(), |ms| format!("{ms:.3}"));
        [self.pass.into(), self.dispatches.to_string(), time]
    }
}

/// The passes in the order in which they run.
fn rows(stats: &SmokeRenderStats, diagnostics: Option<&DiagnosticsStore>) -> Vec<Row> {
    let gpu_ms = |pass: &str| {
        let diagnostic = diagnostics?.get(&DiagnosticPath::new(format!("render/{pass}/elapsed_gpu")))?;
        median(Diagnostic::values(diagnostic).copied())
    };
    let passes = SmokeRenderStats::PASSES.into_iter().zip(stats.dispatches());
    passes.map(|(pass, dispatches)| Row { pass, dispatches, gpu_ms: gpu_ms(pass) }).collect()
}

/// The middle value, the upper one of two; None of nothing.
fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use bevy::diagnostic::DiagnosticMeasurement;

    use super::*;

    #[test]
    fn medians() {
        assert_eq!(median([].into_iter()), None);
        assert_eq!(median([3.0, 1.0, 2.0].into_iter()), Some(2.0));
        assert_eq!(median([4.0, 1.0, 3.0, 2.0].into_iter()), Some(3.0));
    }

    #[test]
    fn rows_have_the_times_that_bevy_measured() {
        let path = DiagnosticPath::new("render/smoke_view/elapsed_gpu");
        let mut diagnostic = Diagnostic::new(path);
        for value in [2.0, 9.0, 1.0] {
            diagnostic.add_measurement(DiagnosticMeasurement { time: Instant::now(), value });
        }
        let mut diagnostics = DiagnosticsStore::default();
        diagnostics.add(diagnostic);
        let rows = rows(&SmokeRenderStats::default(), Some(&diagnostics));
        let times: Vec<_> = rows.iter().filter_map(|row| row.gpu_ms.map(|ms| (row.pass, ms))).collect();
        assert_eq!(times, [("smoke_view", 2.0)]);
        assert_eq!(rows.len(), SmokeRenderStats::PASSES.len());
        assert_eq!(rows.last().unwrap().cells(), ["smoke_view", "0", "2.000"]);
    }
}
