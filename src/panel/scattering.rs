//! How often light scatters in a volume, how that is solved for, and what was chosen.

use bevy::ecs::system::SystemParam;
use bevy::prelude::*;
use bevy_egui::egui::Ui;

use super::widgets;
use crate::render::SmokeRenderStats;
use crate::scattering::{ScatteringEvents, ScatteringSolver, SmokeScattering};

#[derive(SystemParam)]
pub(super) struct Scattering<'w, 's> {
    scattering: Query<'w, 's, &'static mut SmokeScattering>,
    stats: Option<Res<'w, SmokeRenderStats>>,
}

impl Scattering<'_, '_> {
    pub fn show(&mut self, ui: &mut Ui, volume: Entity) {
        let Ok(mut scattering) = self.scattering.get_mut(volume) else { return };
        let mut next = *scattering;
        let events = [
            (ScatteringEvents::Auto, "auto"),
            (ScatteringEvents::Single, "single"),
            (ScatteringEvents::Multiple, "multiple"),
        ];
        widgets::choice(ui, "events", &mut next.events, &events);
        let solvers = [(ScatteringSolver::Transport, "transport"), (ScatteringSolver::Diffusion, "diffusion")];
        widgets::choice(ui, "solver", &mut next.solver, &solvers);
        widgets::magnitude(ui, "tolerance", &mut next.tolerance, 1e-5..=1.0);
        scattering.set_if_neq(next);
        if let Some(choice) = self.stats.as_ref().and_then(|stats| stats.scattering(volume)) {
            let what = if choice.multiple { "multiple" } else { "single" };
            ui.label(format!("Drawn: {what}, {choice}."));
        }
    }
}
