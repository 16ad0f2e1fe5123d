//! A panel that shows and edits a scene's smoke while it runs (feature `egui`).
//!
//! [`SmokePanelPlugin`] adds a window to any app, drawn by [`bevy_egui`] into the camera that has the primary context:
//!
//! ```no_run
//! use bevy::prelude::*;
//! use bevy_smoke::panel::{SmokePanel, SmokePanelPlugin};
//! use bevy_smoke::prelude::*;
//!
//! fn main() {
//!     App::new()
//!         .add_plugins((DefaultPlugins, SmokePlugin, SmokePanelPlugin))
//!         .add_systems(Update, |keys: Res<ButtonInput<KeyCode>>, mut panel: ResMut<SmokePanel>| {
//!             panel.open ^= keys.just_pressed(KeyCode::F1);
//!         })
//!         .run();
//! }
//! ```
//!
//! It edits the components themselves, so that a game sees what the panel does and the panel what the game does: of one
//! volume [`SmokeMedium`](crate::medium::SmokeMedium), [`SmokeEnvironment`](crate::lighting::SmokeEnvironment),
//! [`SmokeScattering`](crate::scattering::SmokeScattering), [`SmokeQuality`](crate::quality::SmokeQuality) and [`SmokePlayback`](crate::playback::SmokePlayback); of the scene
//! its lights, and its cameras' environment maps and [`SmokeShadows`](crate::shadows::SmokeShadows). A component is marked as
//! changed only when a value is. Beside them are what the passes cost and what was chosen for the volume: GPU times where the
//! app has Bevy's `RenderDiagnosticsPlugin` and the adapter timestamps.
//!
//! Closed, the panel runs no system but the question whether it is open.
//!
//! What has been set up is saved as a scene that games load: see [`scene`].

mod environment;
mod lights;
mod medium;
mod playback;
mod quality;
mod scattering;
pub mod scene;
mod shadows;
mod stats;
mod widgets;

use bevy::ecs::system::SystemParam;
use bevy::prelude::*;
use bevy_egui::{EguiContexts, EguiPlugin, EguiPrimaryContextPass, egui};

use crate::volume::SmokeVolume;

/// Adds a [`SmokePanel`] to an app; [`EguiPlugin`] too, if the app has not added it before.
#[derive(Clone, Copy, Debug, Default)]
pub struct SmokePanelPlugin;

impl Plugin for SmokePanelPlugin {
    fn build(&self, app: &mut App) {
        if !app.is_plugin_added::<EguiPlugin>() {
            app.add_plugins(EguiPlugin::default());
        }
        app.init_resource::<SmokePanel>()
            .add_systems(EguiPrimaryContextPass, show.run_if(|panel: Res<SmokePanel>| panel.open));
    }
}

/// The panel: whether it is open, and what it shows.
#[derive(Resource, Clone, Debug)]
pub struct SmokePanel {
    /// Whether it is there.
    pub open: bool,
    /// The volume that is edited; the first there is while this is `None` or gone.
    pub volume: Option<Entity>,
    /// A line at the top, for what went wrong or was done; the user can close it.
    pub notice: Option<String>,
    /// A latitude-longitude image that volumes can be lit by. The panel keeps the last one that it has seen on a volume.
    pub image: Option<Handle<Image>>,
    /// How it is turned.
    pub rotation: Quat,
    /// The file that "save" writes.
    pub scene: String,
    /// Coefficients that volumes can be lit by: the last that the panel has seen on a volume.
    coefficients: crate::lighting::EnvironmentCoefficients,
}

impl Default for SmokePanel {
    fn default() -> Self {
        Self {
            open: true,
            volume: None,
            notice: None,
            image: None,
            rotation: Quat::IDENTITY,
            scene: "smoke.scn.ron".into(),
            coefficients: environment::sky(),
        }
    }
}

/// Everything that the panel shows.
#[derive(SystemParam)]
struct Shown<'w, 's> {
    volumes: Query<'w, 's, (Entity, Option<&'static Name>), With<SmokeVolume>>,
    medium: medium::Media<'w, 's>,
    environment: environment::Environments<'w, 's>,
    lights: lights::Lights<'w, 's>,
    scattering: scattering::Scattering<'w, 's>,
    quality: quality::Quality<'w, 's>,
    playback: playback::Playback<'w, 's>,
    shadows: shadows::Shadows<'w, 's>,
    stats: stats::Stats<'w>,
    commands: Commands<'w, 's>,
}

fn show(mut contexts: EguiContexts, mut panel: ResMut<SmokePanel>, mut shown: Shown) {
    // No camera, no context.
    let Ok(ctx) = contexts.ctx_mut() else { return };
    // The panel's own state is no news to systems that ask whether it has changed.
    let panel = panel.bypass_change_detection();
    let mut open = panel.open;
    // As high as there is room for.
    let size = [330.0, ctx.viewport_rect().height() - 60.0];
    let window = egui::Window::new("Smoke").default_pos([8.0, 8.0]).default_size(size).vscroll(true);
    window.open(&mut open).show(ctx, |ui| {
        notice(ui, panel);
        match select(ui, panel, &shown.volumes) {
            Some(volume) => shown.show_volume(ui, panel, volume),
            None => drop(ui.label("There is no smoke.")),
        }
        shown.show_scene(ui, panel);
    });
    panel.open = open;
}

/// The line at the top.
fn notice(ui: &mut egui::Ui, panel: &mut SmokePanel) {
    let Some(notice) = panel.notice.clone() else { return };
    ui.horizontal_wrapped(|ui| {
        ui.label(notice);
        if ui.button("close").clicked() {
            panel.notice = None;
        }
    });
    ui.separator();
}

/// Which volume: a choice where there are several.
fn select(
    ui: &mut egui::Ui,
    panel: &mut SmokePanel,
    volumes: &Query<(Entity, Option<&Name>), With<SmokeVolume>>,
) -> Option<Entity> {
    let mut all: Vec<(Entity, String)> = volumes.iter().map(|(entity, name)| (entity, title(entity, name))).collect();
    all.sort();
    let selected = panel.volume.filter(|volume| volumes.contains(*volume)).or(Some(all.first()?.0));
    panel.volume = selected;
    if all.len() > 1 {
        ui.horizontal_wrapped(|ui| {
            for (entity, title) in all {
                ui.radio_value(&mut panel.volume, Some(entity), title);
            }
        });
    }
    panel.volume
}

/// What an entity is called in the panel.
fn title(entity: Entity, name: Option<&Name>) -> String {
    name.map_or_else(|| entity.to_string(), Name::to_string)
}

impl Shown<'_, '_> {
    fn show_volume(&mut self, ui: &mut egui::Ui, panel: &mut SmokePanel, volume: Entity) {
        widgets::section(ui, "View", |ui| self.medium.show_view(ui, volume, &mut self.commands));
        widgets::section(ui, "Medium", |ui| self.medium.show(ui, volume));
        widgets::section(ui, "Environment", |ui| self.environment.show(ui, panel, volume));
        widgets::section(ui, "Scattering", |ui| self.scattering.show(ui, volume));
        widgets::section(ui, "Quality", |ui| self.quality.show(ui, volume));
        widgets::section(ui, "Playback", |ui| self.playback.show(ui, volume));
    }

    fn show_scene(&mut self, ui: &mut egui::Ui, panel: &mut SmokePanel) {
        widgets::section(ui, "Lights", |ui| self.lights.show(ui));
        widgets::section(ui, "Shadows", |ui| self.shadows.show(ui, &mut self.commands));
        widgets::section(ui, "Costs", |ui| self.stats.show(ui));
        widgets::section(ui, "Scene", |ui| {
            ui.text_edit_singleline(&mut panel.scene);
            if ui.button("save").clicked() {
                self.commands.queue(scene::save_from_panel);
            }
        });
    }
}
