//! Lights that are sharp: from one point, or one direction.

use glam::DVec3;

use super::{Rng, turned};
use crate::reference::Ray;

/// A sharp light, in bundle space. Smoke sees it through next-event estimation alone; the eye does not see it at all.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Light {
    /// A distant disc of constant radiance.
    Sun {
        /// Unit vector toward it.
        direction: DVec3,
        /// RGB irradiance on a surface that faces it.
        irradiance: DVec3,
        /// Its diameter, as an angle in radians from 0 to π; 0 is a direction alone.
        angle: f64,
    },
    /// A point that shines the same in all directions. It may be inside the smoke.
    Point {
        /// Where it is.
        position: DVec3,
        /// RGB intensity: at distance d it gives the irradiance `intensity`/d², d in bundle units.
        intensity: DVec3,
    },
    /// A point that shines in a cone, as Bevy's spot lights do. It may be inside the smoke.
    Spot {
        /// Where it is.
        position: DVec3,
        /// Unit vector along which it shines.
        direction: DVec3,
        /// RGB intensity within the inner cone, as of a point.
        intensity: DVec3,
        /// Half-angle of the cone of full intensity, in radians.
        inner: f64,
        /// Half-angle beyond which there is no light, in radians, at least `inner`.
        outer: f64,
    },
}

impl Light {
    /// Where the light is, if it is a point.
    pub(super) fn lamp(&self) -> Option<DVec3> {
        match *self {
            Self::Sun { .. } => None,
            Self::Point { position, .. } | Self::Spot { position, .. } => Some(position),
        }
    }

    /// A random ray from `x` to the light, which it ends at, and the light's irradiance at `x` without smoke, on a
    /// surface that faces the ray: the mean over rays weights the light's parts as they shine. `None` in the dark.
    pub fn sample(&self, x: DVec3, rng: &mut Rng) -> Option<(Ray, DVec3)> {
        self.ray(x, [rng.uniform(), rng.uniform()])
    }

    /// The same ray for a place on the light, two numbers from 0 to 1: how far out on a sun's disc, and how far around.
    pub fn ray(&self, x: DVec3, place: [f64; 2]) -> Option<(Ray, DVec3)> {
        match *self {
            Self::Sun { direction, irradiance, angle } => {
                if angle == 0.0 {
                    return Some((Ray::new(x, direction), irradiance));
                }
                // Uniform over the cap of solid angle 2π(1−cos). A facing surface gets radiance · π sin² of it, so
                // that radiance times solid angle is irradiance · 2(1−cos)/sin² = irradiance · 2/(1+cos).
                let cos_edge = (0.5 * angle).cos();
                let cos = 1.0 - place[0] * (1.0 - cos_edge);
                Some((Ray::new(x, turned(direction, cos, place[1])), irradiance * (2.0 / (1.0 + cos_edge))))
            }
            Self::Point { position, intensity } => {
                let (dir, distance) = toward(position, x)?;
                Some((Ray { t_max: distance, ..Ray::new(x, dir) }, intensity / (distance * distance)))
            }
            Self::Spot { position, direction, intensity, inner, outer } => {
                let (ray, irradiance) = Self::Point { position, intensity }.ray(x, place)?;
                let share = spot_falloff(-direction.dot(ray.dir), inner, outer);
                (share > 0.0).then_some((ray, irradiance * share))
            }
        }
    }
}

/// The share of a spot light's intensity at the cosine `cos` to its axis: Bevy's formula, which is Filament's, down to
/// the bound that keeps a hard edge finite.
pub fn spot_falloff(cos: f64, inner: f64, outer: f64) -> f64 {
    let t = (cos - outer.cos()) / (inner.cos() - outer.cos()).max(1e-4);
    t.clamp(0.0, 1.0).powi(2)
}

/// Direction and distance to `position`; `None` on it.
fn toward(position: DVec3, x: DVec3) -> Option<(DVec3, f64)> {
    let (dir, distance) = (position - x).normalize_and_length();
    (distance > 0.0).then_some((dir, distance))
}
