//! Lamps: suns, point and spot lights, which are too sharp for spherical harmonics.
//!
//! Only the column of smoke toward a lamp is interpolated, from the probes, as source radiance is; how bright the lamp is,
//! where it stands and what the phase function makes of that are exact at every cell, but for the softening near a lamp.
//! Light of a lamp that scatters again is as smooth as any: the probes' share of it goes to
//! [`transport`](super::transport), and what of it cells can hold and RBFs cannot is [`shine_again`]'s.

use core::f64::consts::PI;

use glam::DVec3;
use rayon::prelude::*;

use super::{
    Grid, Medium, PROBES, Ray, cell_size,
    incident_light::{Incident, column, probes, reach},
    outgoing::{Outgoing, Viewer},
    rbf_center,
    surroundings::Surroundings,
    volume::{Volume, blend_cells, padded_center},
};
use crate::{
    density::GridShape,
    optics::{dawson, henyey_greenstein, transmittance},
    rbf::{Rbf, RbfBins},
};

/// The lamps that light a volume.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Lamps {
    /// In any order.
    pub lamps: Vec<Lamp>,
    /// Added to the squared distance of points and spots where their light falls with it: the cells of a volume can hold
    /// 1/(d² + softening). What that leaves out along a ray is [`near_light`](super::view::near_light).
    pub softening: f64,
}

/// The softening of lamps in a volume of this shape: 2.5 cells, squared.
pub fn softening(shape: GridShape) -> f64 {
    (2.5 * cell_size(shape)).powi(2)
}

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

    /// The share of the intensity in the direction `dir`, a unit vector away from the lamp.
    pub fn share(&self, dir: DVec3) -> f64 {
        (self.scale * self.axis.dot(dir) + self.offset).clamp(0.0, 1.0).powi(2)
    }
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
    pub fn seen_from(&self, x: DVec3, softening: f64) -> Sight {
        match *self {
            Self::Sun { direction, irradiance } => Sight { ray: Ray::new(x, direction), irradiance },
            Self::Point { position, .. } => {
                let offset = position - x;
                let ray = Ray { t_max: offset.length(), ..Ray::new(x, offset.normalize_or(DVec3::Z)) };
                Sight { ray, irradiance: self.intensity_toward(x) / (offset.length_squared() + softening) }
            }
        }
    }

    /// The intensity of a point or spot light toward `x`, its fall-off with the range included; 0 of a sun.
    fn intensity_toward(&self, x: DVec3) -> DVec3 {
        match *self {
            Self::Sun { .. } => DVec3::ZERO,
            Self::Point { position, intensity, range, cone } => {
                let offset = x - position;
                let fade = (1.0 - (offset.length_squared() / (range * range)).powi(2)).clamp(0.0, 1.0).powi(2);
                intensity * (fade * cone.share(offset.normalize_or(DVec3::NEG_Z)))
            }
        }
    }
}

/// Columns of the coarse density toward a lamp, around every RBF; all three channels are the same. `sigma` is the grey
/// extinction that says where the probes are.
pub fn columns(rbfs: &[Rbf], coarse: &Grid, lamp: &Lamp, sigma: f64) -> Vec<Outgoing> {
    let fit = |rbf: &Rbf| {
        let reach = reach(rbf, sigma);
        let columns = probes(rbf, reach).map(|p| DVec3::splat(column(&lamp.seen_from(p, 0.0).ray, coarse)));
        Outgoing::through(columns, reach)
    };
    rbfs.par_iter().map(fit).collect()
}

/// Adds to source radiance what a lamp's light adds by scattering to the eye at once, J = Ω p E e^{−σ column}, from
/// `columns` as [`columns`] gives them; `sigma` is extinction per channel on the way from the lamp. A sphere in the way
/// leaves nothing.
#[expect(clippy::too_many_arguments, reason = "what is lit, by what, seen from where")]
pub fn shine(
    volume: &mut Volume,
    rbfs: &[Rbf],
    bins: &RbfBins,
    columns: &[Outgoing],
    lamp: &Lamp,
    softening: f64,
    medium: &Medium,
    sigma: DVec3,
    around: &Surroundings,
    viewer: Viewer,
) {
    let shape = volume.shape;
    let padded = GridShape::new(shape.dims + 2);
    let columns = blend_cells(rbfs, columns, bins, shape);
    volume.radiance.par_iter_mut().zip(columns).enumerate().for_each(|(index, (radiance, column))| {
        let x = padded_center(shape, padded.cell(index));
        let Sight { ray, irradiance } = lamp.seen_from(x, softening);
        if around.hides(&ray) {
            return;
        }
        let phase = henyey_greenstein(ray.dir.dot(viewer.look(x)), medium.g);
        *radiance += medium.albedo * irradiance * (sigma * column).map(transmittance) * phase;
    });
}

/// RBFs hold what falls as 1/d around a lamp where it is below this over their radius, by measurement.
const HELD: f64 = 0.6;

/// Adds to source radiance what the RBFs cannot hold of a lamp's light that has scattered twice.
///
/// Where smoke is even and light scatters evenly, J_1 = Ω I/(4π d²) around a lamp, and what scatters again is
///
/// ```text
/// J_2 = Ω/(4π) ∫ σ D J_1(y) / |x − y|² dy = Ω² σ D I π / (16 d)
/// ```
///
/// which rises without end toward the lamp. Solved between RBFs it rises to about 1/d = `HELD`/r; what is above that is
/// added here, with the distance softened as everywhere, D that of the cell and r the mean radius there.
pub fn shine_again(
    volume: &mut Volume,
    rbfs: &[Rbf],
    bins: &RbfBins,
    lamp: &Lamp,
    softening: f64,
    medium: &Medium,
    sigma: DVec3,
) {
    let Lamp::Point { position, .. } = *lamp else { return };
    let shape = volume.shape;
    let padded = GridShape::new(shape.dims + 2);
    let radius = |rbf: &Rbf| Outgoing::through([DVec3::splat(rbf.radius.into()); PROBES], 1.0);
    let radii = blend_cells(rbfs, &rbfs.iter().map(radius).collect::<Vec<_>>(), bins, shape);
    let Volume { radiance, density, .. } = volume;
    radiance.par_iter_mut().zip(density).zip(radii).enumerate().for_each(|(index, ((radiance, density), radius))| {
        let x = padded_center(shape, padded.cell(index));
        let near = 1.0 / (x.distance_squared(position) + softening).sqrt();
        // Without any RBF the radius is 0, and nothing is above.
        let above = (near - HELD / radius.x).max(0.0);
        *radiance += medium.albedo * medium.albedo * sigma * *density * lamp.intensity_toward(x) * (above * PI / 16.0);
    });
}

/// Incident light with that of lamps, past what stands around: what smoke scatters again.
///
/// A lamp is a point mass, E e^{−σ column} y_k. Near a lamp 1/d² changes much within an RBF: then its mean is not that of
/// the probes, but the Gaussian's own, (2/r²) Daw(u)/u at a distance of u radii. Only
/// [`scattered_light`](super::transport::scattered_light) may see lamps this way.
pub fn with_lamps(
    incident: &[[Incident; PROBES]],
    rbfs: &[Rbf],
    coarse: &Grid,
    lamps: &Lamps,
    sigma: DVec3,
    around: &Surroundings,
) -> Vec<[Incident; PROBES]> {
    let rbf = |(incident, rbf): (&[Incident; PROBES], &Rbf)| {
        let (mut incident, points) = (*incident, probes(rbf, reach(rbf, sigma.element_sum() / 3.0)));
        for lamp in &lamps.lamps {
            let scale = mean_scale(rbf, &points, lamp, lamps.softening);
            for (incident, point) in incident.iter_mut().zip(points) {
                let Sight { ray, irradiance } = lamp.seen_from(point, lamps.softening);
                if around.hides(&ray) {
                    continue;
                }
                let passing = (sigma * column(&ray, coarse) + around.other_depth(&ray)).map(transmittance);
                incident.light.accumulate(ray.dir, irradiance * passing * scale);
            }
        }
        incident
    };
    incident.par_iter().zip(rbfs).map(rbf).collect()
}

/// The mean of 1/d² over a Gaussian, over that of 1/(d² + softening) at its probes; 1 for a sun.
fn mean_scale(rbf: &Rbf, probes: &[DVec3; PROBES], lamp: &Lamp, softening: f64) -> f64 {
    let Lamp::Point { position, .. } = *lamp else { return 1.0 };
    let at_probes: f64 =
        probes.map(|p| 1.0 / (p.distance_squared(position) + softening)).iter().sum::<f64>() / PROBES as f64;
    mean_inverse_square(position.distance(rbf_center(rbf)), rbf.radius.into()) / at_probes
}

/// The mean of 1/d² over a Gaussian of radius r, weighted by its density, d from a point `distance` from its centre:
/// (2/r²) Daw(u)/u with u = distance/r.
fn mean_inverse_square(distance: f64, radius: f64) -> f64 {
    let u = distance / radius;
    2.0 / (radius * radius) * if u > 0.0 { dawson(u) / u } else { 1.0 }
}

#[cfg(test)]
mod tests;
