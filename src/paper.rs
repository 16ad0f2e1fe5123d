//! The choice of Zhou et al. 2008 as printed for a volume: a baseline to compare with.

use bevy::prelude::*;

/// Draws a volume by Zhou et al. 2008, *Real-Time Smoke Rendering Using Compensated Ray Marching*, as printed: source
/// radiance at the RBFs' centres only, optical depth in spherical harmonics, and multiple scattering by their diffusion
/// equation and their solver. A baseline kept for comparison, at the faults it has: see [`reference::paper`](crate::reference::paper).
///
/// Of the light only what comes from all around is taken, no lamps.
#[derive(Component, Clone, Copy, Debug, PartialEq, Eq, Hash, Reflect)]
#[reflect(Component, Default, Debug, Clone, PartialEq, Hash)]
pub struct SmokePaper {
    /// Steps of conjugate gradients whenever the light changed, from the solution before. The paper takes 20 to 40.
    pub steps: u32,
    /// How optical depth in spherical harmonics becomes transmittance.
    pub exponential: PaperExponential,
}

/// How spherical harmonics are exponentiated (Ren et al. 2006).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Reflect)]
#[reflect(Default, Debug, Clone, PartialEq, Hash)]
pub enum PaperExponential {
    /// By two tables: cheap, 2 % off in thin smoke and 20 % in thick.
    #[default]
    OptimalLinear,
    /// By scaling and squaring ("HYB"): below 1 % and 8 %.
    Hybrid,
}

impl Default for SmokePaper {
    /// 40 steps, optimal linear.
    fn default() -> Self {
        Self { steps: 40, exponential: PaperExponential::default() }
    }
}
