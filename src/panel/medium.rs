//! The optical properties of a volume, and what is drawn of it.

use bevy::ecs::system::SystemParam;
use bevy::prelude::*;
use bevy_egui::egui::Ui;

use super::widgets;
use crate::debug::SmokeDebugView;
use crate::medium::SmokeMedium;

#[derive(SystemParam)]
pub(super) struct Media<'w, 's> {
    media: Query<'w, 's, &'static mut SmokeMedium>,
    views: Query<'w, 's, &'static SmokeDebugView>,
}

impl Media<'_, '_> {
    pub fn show(&mut self, ui: &mut Ui, volume: Entity) {
        let Ok(mut medium) = self.media.get_mut(volume) else { return };
        let mut next = *medium;
        widgets::magnitude(ui, "sigma_t, 1/m", &mut next.sigma_t, 0.01..=1000.0);
        let mut albedo = next.albedo.to_f32_array_no_alpha();
        widgets::color(ui, "albedo", &mut albedo);
        next.albedo = LinearRgba::from_f32_array_no_alpha(albedo).with_alpha(next.albedo.alpha);
        widgets::number(ui, "g", &mut next.g, -SmokeMedium::MAX_ASYMMETRY..=SmokeMedium::MAX_ASYMMETRY);
        medium.set_if_neq(next);
    }

    /// Which view of it.
    pub fn show_view(&self, ui: &mut Ui, volume: Entity, commands: &mut Commands) {
        let before = self.views.get(volume).copied().unwrap_or_default();
        let mut next = before;
        let views = [
            (SmokeDebugView::None, "picture"),
            (SmokeDebugView::Density, "density"),
            (SmokeDebugView::Rbfs, "RBFs"),
            (SmokeDebugView::Residual, "residual"),
            (SmokeDebugView::Single, "scattered once"),
            (SmokeDebugView::Multiple, "scattered again"),
            (SmokeDebugView::Probes, "probes"),
            (SmokeDebugView::Spheres, "occluder spheres"),
        ];
        widgets::choice(ui, "view", &mut next, &views);
        if next != before {
            commands.entity(volume).insert(next);
        }
    }
}
