//! A camera that turns about a point.

use bevy::input::mouse::{AccumulatedMouseMotion, AccumulatedMouseScroll, MouseScrollUnit};
use bevy::prelude::*;
use bevy_egui::input::EguiWantsInput;

/// Where a camera looks from.
#[derive(Component, Clone, Copy, Debug)]
#[require(Transform)]
pub struct Orbit {
    /// What it looks at.
    pub center: Vec3,
    /// Metres from there.
    pub distance: f32,
    /// Radians about the vertical.
    pub turn: f32,
    /// Radians above the horizon, negative: it looks down.
    pub tilt: f32,
}

impl Orbit {
    fn transform(&self) -> Transform {
        let rotation = Quat::from_euler(EulerRot::YXZ, self.turn, self.tilt, 0.0);
        Transform::from_translation(self.center + rotation * (self.distance * Vec3::Z)).with_rotation(rotation)
    }
}

pub struct OrbitPlugin;

impl Plugin for OrbitPlugin {
    fn build(&self, app: &mut App) {
        app.add_systems(Update, (steer, follow).chain());
    }
}

fn steer(
    buttons: Res<ButtonInput<MouseButton>>,
    motion: Res<AccumulatedMouseMotion>,
    scroll: Res<AccumulatedMouseScroll>,
    panel: Res<EguiWantsInput>,
    mut cameras: Query<&mut Orbit>,
) {
    if panel.wants_any_pointer_input() {
        return;
    }
    for mut orbit in &mut cameras {
        if buttons.pressed(MouseButton::Left) && motion.delta != Vec2::ZERO {
            orbit.turn -= 0.005 * motion.delta.x;
            orbit.tilt = (orbit.tilt - 0.005 * motion.delta.y).clamp(-1.5, 0.3);
        }
        let lines = scroll.delta.y * if scroll.unit == MouseScrollUnit::Pixel { 0.01 } else { 1.0 };
        if lines != 0.0 {
            orbit.distance = (orbit.distance * (-0.1 * lines).exp()).clamp(0.3, 60.0);
        }
    }
}

fn follow(mut cameras: Query<(&Orbit, &mut Transform), Changed<Orbit>>) {
    for (orbit, mut transform) in &mut cameras {
        *transform = orbit.transform();
    }
}
