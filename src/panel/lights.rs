//! The scene's sun and lamps.

use bevy::ecs::system::SystemParam;
use bevy::prelude::*;
use bevy_egui::egui::Ui;

use super::{title, widgets};

type AnyLight = AnyOf<(&'static mut DirectionalLight, &'static mut PointLight, &'static mut SpotLight)>;

#[derive(SystemParam)]
pub(super) struct Lights<'w, 's> {
    lights: Query<'w, 's, (Entity, Option<&'static Name>, &'static mut Transform, AnyLight)>,
}

/// What is edited of a light.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Light {
    color: [f32; 3],
    /// Lux of a sun, lumens of a lamp.
    strength: f32,
}

impl Light {
    /// As Bevy has it.
    fn new(color: Color, strength: f32) -> Self {
        Self { color: color.to_linear().to_f32_array_no_alpha(), strength }
    }

    /// Edits it; whether it is another now.
    fn edit(&mut self, ui: &mut Ui, what: &str, unit: &str, range: std::ops::RangeInclusive<f32>) -> bool {
        let before = *self;
        widgets::color(ui, &format!("{what} colour"), &mut self.color);
        widgets::magnitude(ui, &format!("{what}, {unit}"), &mut self.strength, range);
        *self != before
    }

    fn color(&self) -> Color {
        let [red, green, blue] = self.color;
        Color::linear_rgb(red, green, blue)
    }
}

impl Lights<'_, '_> {
    pub fn show(&mut self, ui: &mut Ui) {
        if self.lights.is_empty() {
            ui.label("The scene has no lights.");
        }
        for (entity, name, transform, light) in &mut self.lights {
            ui.push_id(entity, |ui| match light {
                (Some(sun), ..) => {
                    ui.strong(title(entity, name));
                    show_sun(ui, sun);
                    show_heading(ui, "sun", transform);
                }
                (_, Some(lamp), _) => {
                    ui.strong(title(entity, name));
                    show_lamp(ui, lamp);
                    show_position(ui, "lamp", transform);
                }
                (.., Some(spot)) => {
                    ui.strong(title(entity, name));
                    show_spot(ui, spot);
                    let transform = show_position(ui, "spot light", transform);
                    show_heading(ui, "spot light", transform);
                }
                _ => {}
            });
        }
    }
}

fn show_sun(ui: &mut Ui, mut sun: Mut<DirectionalLight>) {
    let mut light = Light::new(sun.color, sun.illuminance);
    if light.edit(ui, "sun", "lux", 0.1..=200_000.0) {
        (sun.color, sun.illuminance) = (light.color(), light.strength);
    }
}

fn show_lamp(ui: &mut Ui, mut lamp: Mut<PointLight>) {
    let mut light = Light::new(lamp.color, lamp.intensity);
    if light.edit(ui, "lamp", "lumens", 1.0..=1e8) {
        (lamp.color, lamp.intensity) = (light.color(), light.strength);
    }
}

fn show_spot(ui: &mut Ui, mut spot: Mut<SpotLight>) {
    let mut light = Light::new(spot.color, spot.intensity);
    if light.edit(ui, "spot light", "lumens", 1.0..=1e8) {
        (spot.color, spot.intensity) = (light.color(), light.strength);
    }
    let mut outer = spot.outer_angle;
    widgets::angle(ui, "spot light half angle, °", &mut outer, 0.0..=89.0);
    if outer != spot.outer_angle {
        spot.outer_angle = outer;
        spot.inner_angle = spot.inner_angle.min(spot.outer_angle);
    }
}

fn show_position<'a>(ui: &mut Ui, what: &str, mut transform: Mut<'a, Transform>) -> Mut<'a, Transform> {
    let mut at = transform.translation.to_array();
    widgets::position(ui, &format!("{what} at"), &mut at);
    if at != transform.translation.to_array() {
        transform.translation = at.into();
    }
    transform
}

fn show_heading(ui: &mut Ui, what: &str, mut transform: Mut<Transform>) {
    let before = heading(transform.rotation);
    let (mut yaw, mut pitch) = before;
    widgets::angle(ui, &format!("{what} turn, °"), &mut yaw, -180.0..=180.0);
    widgets::angle(ui, &format!("{what} tilt, °"), &mut pitch, -90.0..=90.0);
    if (yaw, pitch) != before {
        transform.rotation = turned(transform.rotation, yaw, pitch);
    }
}

/// Which way a rotation looks (−Z): the angle about the vertical, and that above the horizon; radians.
pub(super) fn heading(rotation: Quat) -> (f32, f32) {
    let (yaw, pitch, _) = rotation.to_euler(EulerRot::YXZ);
    (yaw, pitch)
}

/// A rotation that looks elsewhere, with the roll that it had.
pub(super) fn turned(rotation: Quat, yaw: f32, pitch: f32) -> Quat {
    let (.., roll) = rotation.to_euler(EulerRot::YXZ);
    Quat::from_euler(EulerRot::YXZ, yaw, pitch, roll)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn headings_come_back() {
        // Where the sky's poles are not looked at, one heading is one direction.
        for (yaw, pitch) in [(0.0, 0.0), (1.0, -0.5), (-3.0, 1.4), (2.5, -1.4)] {
            let rotation = turned(Quat::from_rotation_z(0.3), yaw, pitch);
            let (yaw_back, pitch_back) = heading(rotation);
            assert!((yaw - yaw_back).abs() < 1e-5 && (pitch - pitch_back).abs() < 1e-5, "{yaw} {pitch}");
            let look = rotation * Vec3::NEG_Z;
            let (sin, cos) = pitch.sin_cos();
            let expected = Vec3::new(-yaw.sin() * cos, sin, -yaw.cos() * cos);
            assert!(look.distance(expected) < 1e-5, "{look} is not {expected}");
        }
        let (.., roll) = turned(Quat::from_rotation_z(0.3), 1.0, 0.5).to_euler(EulerRot::YXZ);
        assert!((roll - 0.3).abs() < 1e-5);
    }
}
