//! Lamps: suns, point and spot lights, which are too sharp for spherical harmonics.
//!
//! Only the column of smoke toward a lamp is interpolated, from the probes, as source radiance is; how bright the lamp is,
//! where it stands and what the phase function makes of that are exact at every cell. Light of a lamp that scatters again
//! is as smooth as any: the probes' share of it goes to [`transport`](super::transport).

use glam::DVec3;
use rayon::prelude::*;

use super::{
    Grid, Medium, PROBES, Ray,
    incident_light::{Incident, column, probes},
    outgoing::{Outgoing, Viewer},
    volume::{Volume, blend_cells, padded_center},
};
use crate::{
    density::GridShape,
    optics::{henyey_greenstein, transmittance},
    rbf::{Rbf, RbfBins},
    sh::ShRgb,
};

/// A sharp light, in bundle space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Lamp {
    /// Parallel light.
    Sun {
        /// Unit vector toward it.
        direction: DVec3,
        /// RGB irradiance on a surface that faces it.
        irradiance: DVec3,
    },
    /// A point that shines the same in all directions, or in a cone.
    Point {
        /// Where it is.
        position: DVec3,
        /// RGB intensity: at distance d it gives the irradiance `intensity`/d², d in bundle units.
        intensity: DVec3,
        /// Distance at which its light has faded to nothing; may be infinite.
        range: f64,
        /// Distance closer than which it grows no brighter, above 0.
        min_distance: f64,
        /// Where it shines.
        cone: Cone,
    },
}

/// Where a point light shines, as Bevy has it: a share clamp(`scale` cos + `offset`, 0, 1)² of its intensity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cone {
    /// Unit vector along which it shines, from which the angle is measured.
    pub axis: DVec3,
    /// Factor of the cosine of that angle.
    pub scale: f64,
    /// Share at a right angle.
    pub offset: f64,
}

impl Cone {
    /// All directions.
    pub const EVERYWHERE: Self = Self { axis: DVec3::Z, scale: 0.0, offset: 1.0 };
}

/// How a lamp is seen from a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sight {
    /// From the point to the lamp, where its light ends.
    pub ray: Ray,
    /// RGB irradiance on a surface that faces it, without smoke.
    pub irradiance: DVec3,
}

impl Lamp {
    /// The lamp as seen from `x`.
    pub fn seen_from(&self, x: DVec3) -> Sight {
        match *self {
            Self::Sun { direction, irradiance } => Sight { ray: Ray::new(x, direction), irradiance },
            Self::Point { position, intensity, range, min_distance, cone } => {
                let offset = position - x;
                let dir = offset.normalize_or(DVec3::Z);
                let squared = offset.length_squared().max(min_distance * min_distance);
                let fade = (1.0 - (squared / (range * range)).powi(2)).clamp(0.0, 1.0).powi(2);
                let spot = (cone.scale * -cone.axis.dot(dir) + cone.offset).clamp(0.0, 1.0).powi(2);
                let ray = Ray { t_max: offset.length(), ..Ray::new(x, dir) };
                Sight { ray, irradiance: intensity * (fade * spot / squared) }
            }
        }
    }
}

/// Columns of the coarse density toward a lamp, around every RBF; all three channels are the same.
pub fn columns(rbfs: &[Rbf], coarse: &Grid, lamp: &Lamp) -> Vec<Outgoing> {
    let fit = |rbf: &Rbf| {
        let columns = probes(rbf).map(|p| DVec3::splat(column(&lamp.seen_from(p).ray, coarse)));
        Outgoing::through(columns, rbf.radius.into())
    };
    rbfs.par_iter().map(fit).collect()
}

/// Adds to source radiance what a lamp's light adds by scattering to the eye at once, J = Ω p E e^{−σ column};
/// `sigma` is extinction per channel on the way from the lamp.
#[expect(clippy::too_many_arguments, reason = "what is lit, by what, seen from where")]
pub fn shine(
    volume: &mut Volume,
    rbfs: &[Rbf],
    bins: &RbfBins,
    coarse: &Grid,
    lamp: &Lamp,
    medium: &Medium,
    sigma: DVec3,
    viewer: Viewer,
) {
    let shape = volume.shape;
    let padded = GridShape::new(shape.dims + 2);
    let columns = blend_cells(rbfs, &columns(rbfs, coarse, lamp), bins, shape);
    volume.radiance.par_iter_mut().zip(columns).enumerate().for_each(|(index, (radiance, column))| {
        let x = padded_center(shape, padded.cell(index));
        *radiance += scattered_once(lamp, x, column, medium, sigma, viewer);
    });
}

/// Ω p E e^{−σ column} at `x`.
fn scattered_once(lamp: &Lamp, x: DVec3, column: DVec3, medium: &Medium, sigma: DVec3, viewer: Viewer) -> DVec3 {
    let Sight { ray, irradiance } = lamp.seen_from(x);
    let phase = henyey_greenstein(ray.dir.dot(viewer.look(x)), medium.g);
    medium.albedo * irradiance * (sigma * column).map(transmittance) * phase
}

/// Incident light with that of lamps: what smoke scatters again.
///
/// A lamp is a point mass, E e^{−σ column} y_k. Only [`scattered_light`](super::transport::scattered_light) may see it
/// this way.
pub fn with_lamps(
    incident: &[[Incident; PROBES]],
    rbfs: &[Rbf],
    coarse: &Grid,
    lamps: &[Lamp],
    sigma: DVec3,
) -> Vec<[Incident; PROBES]> {
    let probe = |mut incident: Incident, p| {
        incident.light = incident.light + lamp_light(p, coarse, lamps, sigma);
        incident
    };
    let rbf = |(incident, rbf): (&[Incident; PROBES], &Rbf)| {
        let points = probes(rbf);
        core::array::from_fn(|i| probe(incident[i], points[i]))
    };
    incident.par_iter().zip(rbfs).map(rbf).collect()
}

/// Attenuated light of lamps at `p` by the direction it comes from.
fn lamp_light(p: DVec3, coarse: &Grid, lamps: &[Lamp], sigma: DVec3) -> ShRgb {
    let mut light = ShRgb::default();
    for lamp in lamps {
        let Sight { ray, irradiance } = lamp.seen_from(p);
        light.accumulate(ray.dir, irradiance * (sigma * column(&ray, coarse)).map(transmittance));
    }
    light
}

#[cfg(test)]
mod tests;
