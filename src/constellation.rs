//! Smoke lit by a constellation of lights: single scattering without RBFs.
//!
//! After Navarro et al. 2008, *Interactive HDR lighting of dynamic participating media*: the environment becomes a few
//! distant lights by median cut (Debevec 2005), and every sample along every view ray sends a ray to each of them through
//! the density. Nothing is computed ahead of time; what a frame costs goes with the pixels that show smoke, times lights. A
//! map of distances to smoke and a mask of the pixels that show any leave out empty space, without changing the picture.

use bevy::prelude::*;

/// Draws the [`SmokeVolume`](crate::volume::SmokeVolume) beside it by single scattering from a light constellation:
///
/// J(x) = Ω Σ p(ω·v) E T(x, ω)
///
/// for lights in the directions ω that together are the volume's [`SmokeEnvironment`](crate::lighting::SmokeEnvironment),
/// and for Bevy's own lights; v is the view ray's direction, E a light's irradiance (radiance times solid angle) and T what
/// smoke and the spheres of occluders let through to x. This is Eq. 3 of Navarro et al. 2008 with any phase function; their
/// Program 1 multiplies by 1/16π², which contradicts it. Light scatters once, whatever
/// [`SmokeScattering`](crate::scattering::SmokeScattering) says.
///
/// The constellation is found in the environment's own axes and turned with it, so that it does not flicker as an image
/// turns.
#[derive(Component, Clone, Copy, Debug, PartialEq, Reflect)]
#[reflect(Component, Default, Debug, Clone, PartialEq)]
pub struct SmokeConstellation {
    /// Lights that stand for the environment, 1 to 256. Shadows and time go with their number.
    pub lights: u32,
    /// How much of the light's way is drawn.
    pub shading: ConstellationShading,
    /// Whether a pass of its own finds the pixels that show smoke, and where it begins; the others are not shaded.
    pub mask: bool,
    /// Whether rays leave out samples that a map of distances to smoke says are empty.
    pub skip_empty: bool,
    /// Between samples along view rays, in cells of the density grid: 0.1 to 8.
    pub view_step: f32,
    /// Between samples along shadow rays, likewise.
    pub shadow_step: f32,
}

/// How much of the light's way a [`SmokeConstellation`] draws; the three of Navarro et al. 2008, Fig. 3.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Reflect)]
#[reflect(Default, Debug, Clone, PartialEq, Hash)]
pub enum ConstellationShading {
    /// No lights: smoke emits Ω times the environment's mean radiance, J = Ω L̄, whatever the phase function.
    Alpha,
    /// Every light reaches every point: T = 1.
    Primary,
    /// Light is attenuated on its way to the point.
    #[default]
    SelfShadow,
}

impl SmokeConstellation {
    /// The most lights there can be.
    pub const MAX_LIGHTS: u32 = 256;

    /// Every value inside its range; what is not a number becomes the default.
    pub fn clamped(&self) -> Self {
        let step = |value: f32, default: f32| if value.is_nan() { default } else { value.clamp(0.1, 8.0) };
        let default = Self::default();
        Self {
            lights: self.lights.clamp(1, Self::MAX_LIGHTS),
            view_step: step(self.view_step, default.view_step),
            shadow_step: step(self.shadow_step, default.shadow_step),
            ..*self
        }
    }
}

impl Default for SmokeConstellation {
    /// 16 lights with shadows; view rays in half cells, shadow rays in whole ones.
    fn default() -> Self {
        Self {
            lights: 16,
            shading: ConstellationShading::SelfShadow,
            mask: true,
            skip_empty: true,
            view_step: 0.5,
            shadow_step: 1.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clamping_mends_every_value_and_keeps_good_ones() {
        let good = SmokeConstellation { lights: 20, mask: false, view_step: 1.5, ..default() };
        assert_eq!(good.clamped(), good);
        let bad = SmokeConstellation { lights: 0, view_step: f32::NAN, shadow_step: -1.0, ..good };
        let mended = bad.clamped();
        assert_eq!((mended.lights, mended.view_step, mended.shadow_step), (1, 0.5, 0.1));
        assert_eq!(SmokeConstellation { lights: 1000, ..good }.clamped().lights, 256);
    }
}
