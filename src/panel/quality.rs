//! How much is computed for a volume.

use bevy::ecs::system::SystemParam;
use bevy::prelude::*;
use bevy_egui::egui::{Slider, SliderClamping, Ui};

use super::widgets;
use crate::quality::{SmokeModel, SmokeQuality};
use crate::render::SmokeRenderStats;

/// What a quality is given by.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum By {
    Model,
    Error,
    Budget,
}

impl By {
    fn of(quality: SmokeQuality) -> Self {
        match quality {
            SmokeQuality::Model(_) => Self::Model,
            SmokeQuality::Error(_) => Self::Error,
            SmokeQuality::Budget(_) => Self::Budget,
        }
    }

    /// Where it starts: what was drawn so far, 2 percent, 2 milliseconds.
    fn first(self, drawn: SmokeModel) -> SmokeQuality {
        match self {
            Self::Model => SmokeQuality::Model(drawn),
            Self::Error => SmokeQuality::Error(0.02),
            Self::Budget => SmokeQuality::Budget(2.0),
        }
    }
}

#[derive(SystemParam)]
pub(super) struct Quality<'w, 's> {
    qualities: Query<'w, 's, &'static mut SmokeQuality>,
    stats: Option<Res<'w, SmokeRenderStats>>,
}

impl Quality<'_, '_> {
    pub fn show(&mut self, ui: &mut Ui, volume: Entity) {
        let Ok(mut quality) = self.qualities.get_mut(volume) else { return };
        let choice = self.stats.as_ref().and_then(|stats| stats.quality(volume));
        let mut next = *quality;
        let before = By::of(next);
        let mut by = before;
        widgets::choice(ui, "by", &mut by, &[(By::Model, "model"), (By::Error, "error"), (By::Budget, "budget")]);
        if by != before {
            next = by.first(choice.map_or(SmokeModel::FULL, |choice| choice.model));
        }
        match &mut next {
            SmokeQuality::Model(model) => edit(ui, model),
            SmokeQuality::Error(most) => {
                let mut percent = 100.0 * *most;
                widgets::magnitude(ui, "error, %", &mut percent, 0.1..=100.0);
                if percent != 100.0 * *most {
                    *most = percent / 100.0;
                }
            }
            SmokeQuality::Budget(most) => widgets::magnitude(ui, "budget, ms", most, 0.01..=100.0),
        }
        quality.set_if_neq(next);
        if let Some(choice) = choice {
            ui.label(format!("Drawn: {choice}."));
        }
    }
}

fn edit(ui: &mut Ui, model: &mut SmokeModel) {
    /// More than any bundle holds: all.
    const ALL: u32 = 2000;
    let mut rbfs = model.rbfs.min(ALL);
    if ui.add(Slider::new(&mut rbfs, 1..=ALL).text("RBFs at most").logarithmic(true)).changed() {
        model.rbfs = if rbfs == ALL { u32::MAX } else { rbfs };
    }
    widgets::choice(ui, "probes", &mut model.probes, &[(1, "1 probe"), (7, "7 probes")]);
    let orders = [(1, "order 1"), (2, "order 2"), (3, "order 3"), (4, "order 4")];
    widgets::choice(ui, "light", &mut model.order, &orders);
    let directions = [(16, "16 directions"), (32, "32 directions"), (64, "64 directions")];
    widgets::choice(ui, "look", &mut model.directions, &directions);
    let mut sweeps = model.sweeps;
    ui.add(Slider::new(&mut sweeps, 5..=30).step_by(5.0).text("sweeps").clamping(SliderClamping::Edits));
    model.sweeps = sweeps;
    widgets::number(ui, "step, cells", &mut model.step, 0.25..=4.0);
    ui.checkbox(&mut model.half_resolution, "half resolution");
    let interval = Slider::new(&mut model.lighting_interval, 1..=60).text("lighting interval, frames");
    ui.add(interval.clamping(SliderClamping::Edits));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_chosen_first_is_of_its_kind() {
        let drawn = SmokeModel { order: 2, ..SmokeModel::FULL };
        for by in [By::Model, By::Error, By::Budget] {
            assert_eq!(By::of(by.first(drawn)), by);
        }
        assert_eq!(By::Model.first(drawn), SmokeQuality::Model(drawn));
    }
}
