//! The light from all around a volume, and around cameras.

use std::f32::consts::PI;

use bevy::ecs::system::SystemParam;
use bevy::prelude::*;
use bevy_egui::egui::Ui;

use super::lights::{heading, turned};
use super::{SmokePanel, title, widgets};
use crate::lighting::{EnvironmentCoefficients, SmokeEnvironment};

/// What an environment is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Source {
    Camera,
    Constant,
    Coefficients,
    Image,
}

impl Source {
    fn of(environment: &SmokeEnvironment) -> Self {
        match environment {
            SmokeEnvironment::Camera => Self::Camera,
            SmokeEnvironment::Equirect { .. } => Self::Image,
            SmokeEnvironment::Coefficients { coefficients, .. } if coefficients[1..] == [Vec3::ZERO; 15] => {
                Self::Constant
            }
            SmokeEnvironment::Coefficients { .. } => Self::Coefficients,
        }
    }
}

/// cd/m² of an environment that takes the place of one whose intensity is not known: Bevy's default exposure shows it as a
/// bright, overcast day.
const INTENSITY: f32 = 1000.0;

/// A sky that is brighter above than below by a factor of 9, as coefficients: L = 1 + 0.8 y.
pub(super) fn sky() -> EnvironmentCoefficients {
    let mut coefficients = [Vec3::ZERO; 16];
    coefficients[0] = Vec3::splat(2.0 * PI.sqrt());
    // y_1 = -sqrt(3 / 4π) y
    coefficients[1] = Vec3::splat(-0.8 / (3.0 / (4.0 * PI)).sqrt());
    coefficients
}

/// Mean radiance of coefficients.
fn mean(coefficients: &EnvironmentCoefficients) -> Vec3 {
    coefficients[0] / (2.0 * PI.sqrt())
}

/// An environment of another source whose radiance has the same mean over directions and channels, an image's being taken
/// for 1; None where there is no image.
fn switched(
    from: &SmokeEnvironment,
    to: Source,
    coefficients: &EnvironmentCoefficients,
    image: Option<(&Handle<Image>, Quat)>,
) -> Option<SmokeEnvironment> {
    let (radiance, intensity) = match from {
        SmokeEnvironment::Camera => (Vec3::ONE, INTENSITY),
        SmokeEnvironment::Equirect { intensity, .. } => (Vec3::ONE, *intensity),
        SmokeEnvironment::Coefficients { coefficients, intensity } => (mean(coefficients), *intensity),
    };
    let grey = |radiance: Vec3| radiance.element_sum() / 3.0;
    let as_bright = |own: f32| if own > 0.0 { intensity * grey(radiance) / own } else { intensity };
    Some(match to {
        Source::Camera => SmokeEnvironment::Camera,
        Source::Constant => SmokeEnvironment::constant(radiance, intensity),
        Source::Coefficients => SmokeEnvironment::Coefficients {
            coefficients: *coefficients,
            intensity: as_bright(grey(mean(coefficients))),
        },
        Source::Image => {
            let (image, rotation) = image?;
            SmokeEnvironment::Equirect { image: image.clone(), intensity: as_bright(1.0), rotation }
        }
    })
}

#[derive(SystemParam)]
pub(super) struct Environments<'w, 's> {
    environments: Query<'w, 's, &'static mut SmokeEnvironment>,
    cameras: Query<'w, 's, (Entity, Option<&'static Name>, &'static mut EnvironmentMapLight), With<Camera3d>>,
    ambient: Option<ResMut<'w, GlobalAmbientLight>>,
}

impl Environments<'_, '_> {
    pub fn show(&mut self, ui: &mut Ui, panel: &mut SmokePanel, volume: Entity) {
        let Ok(mut environment) = self.environments.get_mut(volume) else { return };
        let source = Source::of(&environment);
        match &*environment {
            SmokeEnvironment::Equirect { image, rotation, .. } => {
                (panel.image, panel.rotation) = (Some(image.clone()), *rotation);
            }
            SmokeEnvironment::Coefficients { coefficients, .. } if source == Source::Coefficients => {
                panel.coefficients = *coefficients;
            }
            _ => {}
        }
        let mut next = environment.clone();
        let mut to = source;
        let all = [
            (Source::Camera, "camera's"),
            (Source::Constant, "constant"),
            (Source::Coefficients, "coefficients"),
            (Source::Image, "image"),
        ];
        let there = if panel.image.is_some() { &all[..] } else { &all[..3] };
        widgets::choice(ui, "light", &mut to, there);
        if to != source {
            let image = panel.image.as_ref().map(|image| (image, panel.rotation));
            next = switched(&next, to, &panel.coefficients, image).unwrap_or(next);
        }
        edit(ui, &mut next);
        let from_camera = next == SmokeEnvironment::Camera;
        environment.set_if_neq(next);
        if from_camera {
            self.show_cameras(ui);
        }
    }

    /// What a volume takes of cameras and their scene.
    fn show_cameras(&mut self, ui: &mut Ui) {
        for (camera, name, mut light) in &mut self.cameras {
            ui.push_id(camera, |ui| {
                ui.strong(title(camera, name));
                let (mut intensity, mut rotation) = (light.intensity, light.rotation);
                widgets::magnitude(ui, "map, cd/m²", &mut intensity, 0.1..=1e6);
                turn(ui, &mut rotation);
                if (intensity, rotation) != (light.intensity, light.rotation) {
                    (light.intensity, light.rotation) = (intensity, rotation);
                }
            });
        }
        if let Some(ambient) = &mut self.ambient {
            let mut brightness = ambient.brightness;
            widgets::magnitude(ui, "ambient, cd/m²", &mut brightness, 0.1..=1e6);
            if brightness != ambient.brightness {
                ambient.brightness = brightness;
            }
        }
    }
}

/// The values of an environment that are its own.
fn edit(ui: &mut Ui, environment: &mut SmokeEnvironment) {
    let constant = Source::of(environment) == Source::Constant;
    match environment {
        SmokeEnvironment::Camera => {}
        SmokeEnvironment::Equirect { intensity, rotation, .. } => {
            widgets::magnitude(ui, "intensity, cd/m²", intensity, 0.1..=1e6);
            turn(ui, rotation);
        }
        SmokeEnvironment::Coefficients { coefficients, intensity } => {
            widgets::magnitude(ui, "intensity, cd/m²", intensity, 0.1..=1e6);
            if constant {
                let mut radiance = mean(coefficients).to_array();
                let before = radiance;
                widgets::color(ui, "radiance", &mut radiance);
                if radiance != before {
                    coefficients[0] = Vec3::from(radiance) * (2.0 * PI.sqrt());
                }
            }
        }
    }
}

/// Turns an environment about the vertical.
fn turn(ui: &mut Ui, rotation: &mut Quat) {
    let (yaw, pitch) = heading(*rotation);
    let mut next = yaw;
    widgets::angle(ui, "rotation, °", &mut next, -180.0..=180.0);
    if next != yaw {
        *rotation = turned(*rotation, next, pitch);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sources_are_told_apart() {
        let constant = SmokeEnvironment::constant(Vec3::new(1.0, 2.0, 3.0), 5.0);
        let sky = SmokeEnvironment::Coefficients { coefficients: sky(), intensity: 5.0 };
        let image = SmokeEnvironment::equirect(Handle::default(), 2.0);
        let all = [SmokeEnvironment::Camera, constant, sky, image];
        let sources = [Source::Camera, Source::Constant, Source::Coefficients, Source::Image];
        assert_eq!(all.each_ref().map(Source::of), sources);
        for from in &all {
            for to in sources {
                let next = switched(from, to, &super::sky(), Some((&Handle::default(), Quat::IDENTITY))).unwrap();
                assert_eq!(Source::of(&next), to);
            }
            assert_eq!(switched(from, Source::Image, &super::sky(), None), None);
        }
    }

    #[test]
    fn switching_keeps_brightness() {
        let brightness = |environment: &SmokeEnvironment| match environment {
            SmokeEnvironment::Coefficients { coefficients, intensity } => mean(coefficients) * *intensity,
            SmokeEnvironment::Equirect { intensity, .. } => Vec3::splat(*intensity),
            SmokeEnvironment::Camera => panic!("nobody knows"),
        };
        let mut bright = sky();
        bright.iter_mut().for_each(|c| *c *= 4.0);
        let turned = Quat::from_rotation_y(0.7);
        let (constant, image) = (SmokeEnvironment::constant(Vec3::splat(0.5), 3.0), Handle::default());
        for to in [Source::Coefficients, Source::Constant, Source::Image] {
            let next = switched(&constant, to, &bright, Some((&image, turned))).unwrap();
            assert!((brightness(&next) - 1.5).abs().max_element() < 1e-5, "{next:?}");
            let back = switched(&next, Source::Constant, &bright, None).unwrap();
            assert!((brightness(&back) - 1.5).abs().max_element() < 1e-5, "{back:?}");
            if let SmokeEnvironment::Equirect { rotation, .. } = next {
                assert_eq!(rotation, turned);
            }
        }
        let dark = switched(&constant, Source::Coefficients, &[Vec3::ZERO; 16], None).unwrap();
        assert_eq!(brightness(&dark), Vec3::ZERO);
    }

    #[test]
    fn the_sky_is_nine_times_brighter_above() {
        let radiance = |y: f32| {
            let sky = sky();
            sky[0].x / (2.0 * PI.sqrt()) - sky[1].x * (3.0 / (4.0 * PI)).sqrt() * y
        };
        assert!((radiance(1.0) - 1.8).abs() < 1e-6 && (radiance(-1.0) - 0.2).abs() < 1e-6);
    }
}
