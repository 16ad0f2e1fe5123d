//! What is charted: methods with settings.

use super::{Method, Scattering};
use crate::cli::scene::{Environment, Scene};
use crate::prelude::*;

/// A method and how it is set.
#[derive(Clone, Debug)]
pub(super) enum Setting {
    /// RBFs baked, and what their light is computed with.
    Rbf { rbfs: usize, model: SmokeModel, name: String },
    /// The error that is asked for, of a bundle of [`AUTO`] RBFs.
    Auto { error: f32 },
    /// Cells of the lattice.
    Live { lattice: u32 },
    /// RBFs baked, and bands of the light from all around.
    Paper { rbfs: usize, order: usize },
    /// Lights.
    Constellation { lights: u32 },
    /// Steps of a ray, and whether it takes ambient light.
    Fog { steps: u32, ambient: bool },
    /// Paths a pixel.
    Path { paths: u32 },
}

/// RBFs that bundles are baked with, as far as Zhou et al. 2008 go and half of that again.
const COUNTS: [usize; 6] = [50, 100, 200, 300, 600, 1000];
/// Those of the settings that vary something else.
const COUNT: usize = 300;
/// Those that a model is chosen for.
const AUTO: usize = 600;

impl Setting {
    /// Every one.
    pub fn all() -> Vec<Self> {
        let full = SmokeModel::FULL;
        let rbf = |rbfs: usize, model: SmokeModel, name: &str| {
            let name = if name.is_empty() { rbfs.to_string() } else { format!("{rbfs} {name}") };
            Self::Rbf { rbfs, model, name }
        };
        let mut all: Vec<Self> = COUNTS.into_iter().map(|rbfs| rbf(rbfs, full, "")).collect();
        all.extend([1, 2, 3].map(|order| rbf(COUNT, SmokeModel { order, ..full }, &format!("order {order}"))));
        all.push(rbf(100, SmokeModel { directions: 16, step: 1.0, ..full }, "coarse"));
        let cheap = SmokeModel { directions: 16, step: 1.0, half_resolution: true, ..full };
        all.push(rbf(100, cheap, "coarse, half"));
        all.push(rbf(50, SmokeModel { step: 2.0, ..cheap }, "cheapest"));
        all.push(rbf(COUNT, SmokeModel { half_resolution: true, ..full }, "half"));
        all.extend([0.05, 0.02, 0.01].map(|error| Self::Auto { error }));
        all.extend([6, 8, 12, 16].map(|lattice| Self::Live { lattice }));
        all.extend(COUNTS.map(|rbfs| Self::Paper { rbfs, order: 4 }));
        all.extend([1, 2, 3].map(|order| Self::Paper { rbfs: COUNT, order }));
        all.extend([4, 8, 16, 32, 64].map(|lights| Self::Constellation { lights }));
        all.extend([16, 64, 256].map(|steps| Self::Fog { steps, ambient: false }));
        all.push(Self::Fog { steps: 64, ambient: true });
        all.extend([1, 4, 16, 64].map(|half| Self::Path { paths: 2 * half }));
        all
    }

    pub fn method(&self) -> Method {
        match self {
            Self::Rbf { .. } => Method::Rbf,
            Self::Auto { .. } => Method::Auto,
            Self::Live { .. } => Method::Live,
            Self::Paper { .. } => Method::Paper,
            Self::Constellation { .. } => Method::Constellation,
            Self::Fog { .. } => Method::Fog,
            Self::Path { .. } => Method::Path,
        }
    }

    /// As in the chart's marks.
    pub fn name(&self) -> String {
        match self {
            Self::Rbf { name, .. } => name.clone(),
            Self::Auto { error } => format!("{} %", 100.0 * error),
            Self::Live { lattice } => format!("lattice {lattice}"),
            Self::Paper { rbfs, order: 4 } => rbfs.to_string(),
            Self::Paper { rbfs, order } => format!("{rbfs} order {order}"),
            Self::Constellation { lights } => format!("{lights} lights"),
            Self::Fog { steps, ambient: false } => format!("{steps} steps"),
            Self::Fog { steps, ambient: true } => format!("{steps} steps, ambient"),
            Self::Path { paths } => format!("{paths} paths"),
        }
    }

    /// RBFs of the bundle it draws.
    pub fn baked_rbfs(&self) -> Option<usize> {
        match self {
            Self::Rbf { rbfs, .. } | Self::Paper { rbfs, .. } => Some(*rbfs),
            Self::Auto { .. } => Some(AUTO),
            _ => None,
        }
    }

    /// Bands of the light from all around: what is above is taken from the environment.
    pub fn order(&self) -> usize {
        match self {
            Self::Paper { order, .. } => *order,
            _ => 4,
        }
    }

    /// Whether it makes a point of its own in a scene's panel: the constellation and the fog scatter light once, so that
    /// against full scattering only one of each is shown; light that scatters once has all bands, and so has that which
    /// scatters evenly one; an image has no bands to be cut off.
    pub fn applies(&self, scene: &Scene, scattering: Scattering) -> bool {
        let once = scattering == Scattering::Single;
        match self {
            Self::Constellation { lights } => once || *lights == 16,
            Self::Fog { steps, .. } => once || *steps == 64,
            Self::Rbf { model, .. } if model.order < 4 => !once && scene.g != 0.0,
            Self::Paper { order, .. } if *order < 4 => matches!(scene.environment, Environment::Lobes { .. }),
            _ => true,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    #[test]
    fn names_tell_settings_apart() {
        let all = Setting::all();
        let names: HashSet<_> = all.iter().map(|setting| (setting.method(), setting.name())).collect();
        assert_eq!(names.len(), all.len());
    }
}
