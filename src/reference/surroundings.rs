//! What stands between a volume's smoke and its light: other smoke, and the spheres of occluders.

use glam::{DAffine3, DVec3, DVec4};

use super::{Grid, Ray, cell_size, half_extent};

/// Samples of an other volume's coarse density along a ray.
pub const OTHER_STEPS: usize = 16;
/// From the middle of a direction's cone, one of [`DIRECTIONS`](super::DIRECTIONS), to that of a quarter of it.
const QUARTER: f64 = 0.13;

/// What is around a volume, in its bundle space.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Surroundings {
    /// Other smoke.
    pub others: Vec<Other>,
    /// Centres, and radii in w.
    pub spheres: Vec<DVec4>,
}

/// Another volume's smoke.
#[derive(Clone, Debug, PartialEq)]
pub struct Other {
    /// Its coarse density, in its own bundle space.
    pub coarse: Grid,
    /// From this bundle space to its own.
    pub from_here: DAffine3,
    /// Its extinction per unit of its bundle space and of density.
    pub sigma: f64,
}

impl Other {
    /// Optical depth along a ray of this bundle space.
    pub fn depth(&self, ray: &Ray) -> f64 {
        let along = self.from_here.transform_vector3(ray.dir);
        let ray = Ray {
            t_max: ray.t_max * along.length(),
            ..Ray::new(self.from_here.transform_point3(ray.origin), along.normalize())
        };
        self.sigma * march(&ray, &self.coarse, OTHER_STEPS)
    }
}

/// ∫ of a coarse density along a ray, in so many steps between where the density begins and ends, half a cell outside its
/// box.
pub fn march(ray: &Ray, coarse: &Grid, steps: usize) -> f64 {
    let Some((start, end)) = ray.clip(half_extent(coarse.shape) + 0.5 * cell_size(coarse.shape)) else {
        return 0.0;
    };
    let step = (end - start) / steps as f64;
    (0..steps).map(|i| coarse.sample(ray.at(start + (i as f64 + 0.5) * step))).sum::<f64>() * step
}

impl Surroundings {
    /// Optical depth of other smoke along a ray.
    pub fn other_depth(&self, ray: &Ray) -> f64 {
        self.others.iter().map(|other| other.depth(ray)).sum()
    }

    /// Whether a sphere hides what is at the end of a ray.
    pub fn hides(&self, ray: &Ray) -> bool {
        self.spheres.iter().any(|sphere| hides(*sphere, ray))
    }

    /// The share of the cone about a direction that no sphere hides, in quarters.
    pub fn unhidden(&self, point: DVec3, towards: DVec3) -> f64 {
        let axis = if towards.x.abs() > 0.7 { DVec3::Y } else { DVec3::X };
        let x = towards.cross(axis).normalize();
        let y = towards.cross(x);
        let seen = |side: &DVec3| !self.hides(&Ray::new(point, (towards + QUARTER * *side).normalize()));
        [x, y, -x, -y].iter().filter(|side| seen(side)).count() as f64 / 4.0
    }
}

/// Whether a sphere hides from the start of a ray what is at its end. A point within a sphere counts as one on its surface,
/// which hides half of all directions; a sphere that holds what is looked at hides nothing of it.
pub fn hides(sphere: DVec4, ray: &Ray) -> bool {
    let offset = sphere.truncate() - ray.origin;
    let along = offset.dot(ray.dir);
    let beside = offset.length_squared() - along * along;
    let half_chord = (sphere.w * sphere.w - beside).max(0.0).sqrt();
    along > 0.0 && half_chord > 0.0 && along + half_chord < ray.t_max
}

#[cfg(test)]
mod tests {
    use glam::UVec3;

    use super::*;
    use crate::{density::GridShape, reference::DIRECTIONS, sh::fibonacci};

    #[test]
    fn spheres_hide_their_solid_angle() {
        // 2π(1 − √(1 − r²/d²)) of 4π, from near and far; 256 rays hit or miss, at random as it were: an error of
        // √(p(1 − p)/256), at most 3 %, and half of that for a lattice.
        for distance in [1.05, 1.5, 2.5, 6.0_f64] {
            let around = Surroundings { spheres: vec![DVec4::new(0.3, distance, 0.1, 1.0)], ..Default::default() };
            let distance = DVec3::new(0.3, distance, 0.1).length();
            let hidden: f64 = fibonacci(DIRECTIONS).map(|w| 1.0 - around.unhidden(DVec3::ZERO, w)).sum();
            let exact = 0.5 * (1.0 - (1.0 - 1.0 / (distance * distance)).sqrt());
            let found = hidden / DIRECTIONS as f64;
            assert!((found - exact).abs() < 0.015, "{distance}: {found} for {exact}");
        }
        // A point within sees the half of its sky that is away from the middle.
        let around = Surroundings { spheres: vec![DVec4::new(0.0, 0.5, 0.0, 1.0)], ..Default::default() };
        let hidden: f64 = fibonacci(DIRECTIONS).map(|w| 1.0 - around.unhidden(DVec3::ZERO, w)).sum();
        assert!((hidden / DIRECTIONS as f64 - 0.5).abs() < 0.02);
        assert!(around.hides(&Ray::new(DVec3::ZERO, DVec3::Y)) && !around.hides(&Ray::new(DVec3::ZERO, DVec3::NEG_Y)));
    }

    #[test]
    fn what_is_beyond_the_end_of_a_ray_hides_nothing() {
        let sphere = DVec4::new(3.0, 0.0, 0.0, 1.0);
        let to = |t_max| Ray { t_max, ..Ray::new(DVec3::ZERO, DVec3::X) };
        assert!(hides(sphere, &to(4.1)) && !hides(sphere, &to(3.5)) && !hides(sphere, &to(1.5)));
        assert!(!hides(sphere, &Ray::new(DVec3::ZERO, DVec3::NEG_X)));
        // Two overlapping spheres hide no more than their union.
        let around = Surroundings { spheres: vec![sphere; 2], ..Default::default() };
        let twice: f64 = fibonacci(DIRECTIONS).map(|w| around.unhidden(DVec3::ZERO, w)).sum();
        let once = Surroundings { spheres: vec![sphere], ..Default::default() };
        assert_eq!(twice, fibonacci(DIRECTIONS).map(|w| once.unhidden(DVec3::ZERO, w)).sum::<f64>());
    }

    #[test]
    fn other_smoke_is_met_where_it_stands() {
        // A cube of density 2, half as large, 3 to the right.
        let shape = GridShape::new(UVec3::splat(8));
        let coarse = Grid { shape, values: vec![2.0; shape.len()] };
        let from_here = DAffine3::from_scale(DVec3::splat(2.0)) * DAffine3::from_translation(DVec3::X * -3.0);
        let other = Other { coarse, from_here, sigma: 1.5 };
        // Half a cell of full density less at each end, half of which the ramp outside gives back; 16 steps of 9/16 cell.
        let exact = 1.5 * 2.0;
        let found = other.depth(&Ray::new(DVec3::ZERO, DVec3::X));
        assert!((found - exact).abs() < 0.02 * exact, "{found} for {exact}");
        let half = other.depth(&Ray { t_max: 3.0, ..Ray::new(DVec3::ZERO, DVec3::X) });
        assert!((half - 0.5 * exact).abs() < 0.02 * exact, "{half}");
        assert_eq!(other.depth(&Ray::new(DVec3::ZERO, DVec3::Y)), 0.0);
        let around = Surroundings { others: vec![other.clone(), other], ..Default::default() };
        assert_eq!(around.other_depth(&Ray::new(DVec3::ZERO, DVec3::X)), 2.0 * found);
    }
}
