//! How much is computed for a volume's picture: the parts of the model that can be had for less, and which of them to take.
//!
//! Cost and error of a model are predicted by two small formulas ([`model`]), fitted to measurements. Where
//! `RenderDiagnosticsPlugin` measures the passes, predicted times follow the GPU at hand.

mod choice;
pub(crate) mod coefficients;
pub mod model;

use bevy::prelude::*;

pub use choice::QualityChoice;
pub(crate) use choice::{Predictor, SteadyChoice};
pub(crate) use model::{Milliseconds, Setting};

/// How much is computed for a volume of smoke; beside every [`SmokeVolume`](crate::volume::SmokeVolume).
#[derive(Component, Clone, Copy, Debug, PartialEq, Reflect)]
#[reflect(Component, Default, Debug, Clone, PartialEq)]
pub enum SmokeQuality {
    /// As said.
    Model(SmokeModel),
    /// The cheapest model whose picture is predicted to be this close: relative RMS error over the smoke's pixels, 0.02 being
    /// two percent. Where none is, the cheapest of those that are next to as close as any.
    Error(f32),
    /// The most accurate model that is predicted to take at most so many milliseconds of the GPU in a frame in which all of
    /// the volume changes, all views together. Where none does, the most accurate of those that are next to as fast as any.
    Budget(f32),
}

impl SmokeQuality {
    /// The same with every value inside its range; what is not a number asks for the full model.
    pub fn clamped(&self) -> Self {
        match *self {
            Self::Model(model) => Self::Model(model.clamped()),
            Self::Error(most) | Self::Budget(most) if most.is_nan() => Self::default(),
            Self::Error(most) => Self::Error(most.clamp(0.0, 1.0)),
            Self::Budget(most) => Self::Budget(most.clamp(0.0, 1e6)),
        }
    }
}

impl Default for SmokeQuality {
    fn default() -> Self {
        Self::Model(SmokeModel::FULL)
    }
}

/// What a volume's light and picture are computed with: each value is a trade of accuracy for GPU time.
///
/// The smoke's density is always drawn in full; what is left out is left out of its light. Values outside their range
/// are drawn as the nearest inside it, and a warning names them once.
#[derive(Clone, Copy, Debug, PartialEq, Reflect)]
#[cfg_attr(feature = "bake", derive(serde::Serialize, serde::Deserialize))]
#[reflect(Default, Debug, Clone, PartialEq)]
pub struct SmokeModel {
    /// RBFs that light is computed at, at most; 1 or more. Where smoke has been baked with more, so many stand for all
    /// ([`rbf::reduced`](crate::rbf::reduced)). Time of the `incident_light` pass falls with their number, that of
    /// `pair_matrix` and `scattering` with its square.
    pub rbfs: u32,
    /// Probes of each RBF: 7, or 1, at its centre alone.
    pub probes: u32,
    /// Bands of spherical harmonics of light that has scattered more than once, 1 to 4; that has scattered once has four.
    /// Time of `scattering` rises with their square. Smoke that scatters evenly (g = 0) needs one, and is given no more.
    pub order: u32,
    /// Directions in which a probe looks for light: 16, 32 or 64.
    pub directions: u32,
    /// Sweeps of the solver of multiple scattering, at most: a multiple of 5, up to 30. It stops before where its
    /// [tolerance](crate::scattering::SmokeScattering::tolerance) is reached, and goes on in the next frame whose light
    /// changes; the sweeps that it does not need cost little.
    pub sweeps: u32,
    /// Length of a step of the march along a pixel's ray, in cells of the density: 0.25 to 4.
    pub step: f32,
    /// Whether every second pixel of every second row is marched, and the others are interpolated between those that see as
    /// deep; where meshes end, each is marched still. Views with MSAA, and smoke with transparent meshes in it or behind it,
    /// are drawn at full resolution.
    pub half_resolution: bool,
    /// Light is computed again after so many frames at the soonest, 1 to 60: 1 whenever something changed. Density and view
    /// always follow.
    pub lighting_interval: u32,
}

impl SmokeModel {
    /// The most accurate.
    pub const FULL: Self = Self {
        rbfs: u32::MAX,
        probes: 7,
        order: 4,
        directions: 64,
        sweeps: 30,
        step: 0.5,
        half_resolution: false,
        lighting_interval: 1,
    };

    /// The model with every value inside its range; what is not a number becomes the full model's value.
    pub fn clamped(&self) -> Self {
        Self {
            rbfs: self.rbfs.max(1),
            probes: if self.probes < 4 { 1 } else { 7 },
            order: self.order.clamp(1, 4),
            directions: match self.directions {
                0..24 => 16,
                24..48 => 32,
                _ => 64,
            },
            sweeps: self.sweeps.clamp(5, 30).next_multiple_of(5),
            step: if self.step.is_nan() { Self::FULL.step } else { self.step.clamp(0.25, 4.0) },
            half_resolution: self.half_resolution,
            lighting_interval: self.lighting_interval.clamp(1, 60),
        }
    }
}

impl Default for SmokeModel {
    fn default() -> Self {
        Self::FULL
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clamping_mends_every_value_and_keeps_good_ones() {
        let good = SmokeModel { rbfs: 100, probes: 1, order: 2, directions: 32, step: 1.0, ..default() };
        assert_eq!(good.clamped(), good);
        assert_eq!(SmokeModel::FULL.clamped(), SmokeModel::FULL);
        let bad = SmokeModel {
            rbfs: 0,
            probes: 5,
            order: 9,
            directions: 40,
            sweeps: 7,
            step: f32::NAN,
            half_resolution: true,
            lighting_interval: 0,
        };
        let mended = SmokeModel { rbfs: 1, directions: 32, sweeps: 10, half_resolution: true, ..SmokeModel::FULL };
        assert_eq!(bad.clamped(), mended);
        assert_eq!(SmokeModel { step: 100.0, ..default() }.clamped().step, 4.0);
    }
}
