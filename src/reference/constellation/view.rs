//! Validity mask and view: a camera ray marched through the density, with a ray to every light from every sample.

use glam::DVec3;

use super::{Constellation, DistanceMap};
use crate::{
    constellation::ConstellationShading,
    optics::{henyey_greenstein, transmittance},
    reference::{Grid, Medium, Ray, half_extent, lamp::Lamps},
};

/// A volume and what lights it.
#[derive(Clone, Debug)]
pub struct Scene<'a> {
    /// Density of the box's cells.
    pub density: &'a Grid,
    /// What smoke does to light.
    pub medium: Medium,
    /// The environment, its lights' directions in bundle axes.
    pub constellation: &'a Constellation,
    /// Other lights.
    pub lamps: &'a Lamps,
    /// How much of the light's way is drawn.
    pub shading: ConstellationShading,
    /// Between samples along view rays, in bundle space.
    pub step: f64,
    /// Between samples along shadow rays, in bundle space.
    pub shadow_step: f64,
    /// What to leave out by, if anything.
    pub distances: Option<&'a DistanceMap>,
}

impl Scene<'_> {
    /// Samples to leave out after one at `x`, with its density.
    fn leave_out(&self, density: f64, x: DVec3, direction: DVec3, step: f64) -> usize {
        match self.distances {
            Some(map) if density <= 0.0 => map.empty_samples(self.density.shape, x, direction, step),
            _ => 0,
        }
    }

    /// The number of the first sample in smoke, if there is one. The i-th stands for what is between i and i + 1 steps from
    /// the ray's origin, by the density in the middle.
    pub fn first_sample(&self, ray: &Ray) -> Option<usize> {
        let (enter, leave) = ray.clip(half_extent(self.density.shape))?;
        let mut i = (enter / self.step) as usize;
        while (i as f64) < (leave / self.step).ceil() {
            let x = ray.at((i as f64 + 0.5) * self.step);
            let density = self.density.sample(x);
            if density > 0.0 {
                return Some(i);
            }
            i += 1 + self.leave_out(density, x, ray.dir, self.step);
        }
        None
    }

    /// Radiance and transmittance along a ray, from a sample on.
    pub fn march(&self, ray: &Ray, first: usize) -> (DVec3, f64) {
        let (mut radiance, mut transmittance) = (DVec3::ZERO, 1.0);
        let Some((enter, leave)) = ray.clip(half_extent(self.density.shape)) else {
            return (radiance, transmittance);
        };
        let mut i = first.max((enter / self.step) as usize);
        while (i as f64) < (leave / self.step).ceil() {
            let x = ray.at((i as f64 + 0.5) * self.step);
            let density = self.density.sample(x);
            if density > 0.0 {
                // Of the first and the last step, the part that is on the ray.
                let length = ((i + 1) as f64 * self.step).min(leave) - (i as f64 * self.step).max(enter);
                let kept = (-self.medium.sigma * density * length).exp();
                radiance += transmittance * (1.0 - kept) * self.source_radiance(x, ray.dir);
                transmittance *= kept;
            }
            i += 1 + self.leave_out(density, x, ray.dir, self.step);
        }
        (radiance, transmittance)
    }

    /// J(x) = Ω Σ p E T toward an eye that looks along `look`; Navarro et al. 2008, Eq. 3, with any phase function.
    pub fn source_radiance(&self, x: DVec3, look: DVec3) -> DVec3 {
        let through = |ray: &Ray| match self.shading {
            ConstellationShading::SelfShadow => transmittance(self.medium.sigma * self.column(ray)),
            _ => 1.0,
        };
        let phase = |towards: DVec3| henyey_greenstein(towards.dot(look), self.medium.g);
        if self.shading == ConstellationShading::Alpha {
            return self.medium.albedo * self.constellation.mean;
        }
        let lights = self.constellation.lights.iter();
        let lights = lights.map(|l| l.irradiance * (phase(l.direction) * through(&Ray::new(x, l.direction))));
        let lamps = self.lamps.lamps.iter().map(|lamp| {
            let seen = lamp.seen_from(x, self.lamps.softening);
            seen.irradiance * (phase(seen.ray.dir) * through(&seen.ray))
        });
        self.medium.albedo * lights.chain(lamps).sum::<DVec3>()
    }

    /// ∫ of the density along a ray to the box's face or the ray's end, by midpoints of steps.
    fn column(&self, ray: &Ray) -> f64 {
        let (_, end) = ray.clip(half_extent(self.density.shape)).unwrap_or_default();
        let (mut sum, mut i) = (0.0, 0);
        while (i as f64) * self.shadow_step < end {
            let begin = i as f64 * self.shadow_step;
            let x = ray.at(begin + 0.5 * self.shadow_step);
            let density = self.density.sample(x);
            sum += density * self.shadow_step.min(end - begin);
            i += 1 + self.leave_out(density, x, ray.dir, self.shadow_step);
        }
        sum
    }
}
