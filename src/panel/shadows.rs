//! The shadows that cameras see.

use bevy::ecs::system::SystemParam;
use bevy::prelude::*;
use bevy_egui::egui::Ui;

use super::title;
use crate::shadows::SmokeShadows;

#[derive(SystemParam)]
pub(super) struct Shadows<'w, 's> {
    cameras: Query<'w, 's, (Entity, Option<&'static Name>, Option<&'static SmokeShadows>), With<Camera3d>>,
}

impl Shadows<'_, '_> {
    pub fn show(&self, ui: &mut Ui, commands: &mut Commands) {
        let several = self.cameras.iter().len() > 1;
        for (camera, name, shadows) in &self.cameras {
            ui.push_id(camera, |ui| {
                if several {
                    ui.strong(title(camera, name));
                }
                // A camera without the component sees what the default says.
                let before = shadows.copied().unwrap_or_default();
                let mut next = before;
                ui.checkbox(&mut next.smoke, "smoke shades meshes");
                ui.checkbox(&mut next.occluders, "spheres shade meshes");
                if next != before {
                    commands.entity(camera).insert(next);
                }
            });
        }
    }
}
