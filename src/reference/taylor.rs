//! The first two terms of a function of direction, as diffusion needs them, and their way to and from order-2 SH.
//!
//! Diffusion speaks of the direction ω in which light travels, L(ω) = L0 + L1·ω. Spherical harmonics here are functions
//! of the opposite direction: of where arriving light comes from, or, for source radiance, of the look direction v = −ω
//! (eye → point). The first-order term changes its sign between the two.

use core::{f64::consts::PI, ops::Add, ops::Mul};

use glam::DVec3;

use crate::sh::ShRgb;

/// √(3/4π), which y1, y2 and y3 have before −y, z and −x.
const LINEAR: f64 = 0.488_602_511_902_919_9;

/// L(ω) = `mean` + `first`·ω of one colour channel, ω the direction of travel.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Taylor {
    /// L0 = 1/4π ∫ L dω: the mean over all directions.
    pub mean: f64,
    /// L1 = 3/4π ∫ L ω dω: the flux, times 3/4π.
    pub first: DVec3,
}

impl Taylor {
    /// Bands 0 and 1 of one channel of `sh`, a function of −ω.
    pub fn of(sh: &ShRgb, channel: usize) -> Self {
        let c = |k: usize| sh.0[k][channel];
        Self { mean: c(0) / (4.0 * PI).sqrt(), first: DVec3::new(c(3), c(1), -c(2)) * LINEAR }
    }

    /// Three channels as a function of −ω; bands 2 and 3 are zero.
    pub fn sh([r, g, b]: [Self; 3]) -> ShRgb {
        let coefficients = |taylor: Self| {
            let DVec3 { x, y, z } = taylor.first / LINEAR;
            [taylor.mean * (4.0 * PI).sqrt(), y, -z, x]
        };
        let [r, g, b] = [r, g, b].map(coefficients);
        let mut sh = ShRgb::default();
        for k in 0..4 {
            sh.0[k] = DVec3::new(r[k], g[k], b[k]);
        }
        sh
    }
}

impl Add for Taylor {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self { mean: self.mean + other.mean, first: self.first + other.first }
    }
}

impl Mul<f64> for Taylor {
    type Output = Self;

    fn mul(self, factor: f64) -> Self {
        Self { mean: self.mean * factor, first: self.first * factor }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sh::{SphereRule, fibonacci};

    #[test]
    fn terms_are_the_moments_of_travelling_light() {
        let channels = [1.0, 0.7, -0.2].map(|s| Taylor { mean: 2.0 - s, first: DVec3::new(s, -0.3, 0.4 + s) });
        let sh = Taylor::sh(channels);
        for (channel, taylor) in channels.into_iter().enumerate() {
            for travel in fibonacci(10) {
                let found = sh.evaluate(-travel)[channel];
                assert!((found - taylor.mean - taylor.first.dot(travel)).abs() < 1e-14);
            }
            let back = Taylor::of(&sh, channel);
            assert!((back.mean - taylor.mean).abs() + (back.first - taylor.first).length() < 1e-14);
            // By their definition, with bands 2 and 3 there too: exact through degree 9.
            let mut bumpy = sh;
            bumpy.0[5] = DVec3::splat(0.3);
            bumpy.0[12] = DVec3::splat(-0.8);
            let rule = SphereRule::new(5);
            let mean = rule.integrate(|w| bumpy.evaluate(-w)[channel]) / (4.0 * PI);
            let first = [DVec3::X, DVec3::Y, DVec3::Z]
                .map(|axis| rule.integrate(|w| bumpy.evaluate(-w)[channel] * w.dot(axis)) * 3.0 / (4.0 * PI));
            let found = Taylor::of(&bumpy, channel);
            assert!((found.mean - mean).abs() + (found.first - DVec3::from(first)).length() < 1e-13);
        }
    }
}
