//! Surfaces that stand in smoke's light and receive it: a horizontal plane and spheres, opaque and Lambertian.

use glam::DVec3;

use super::Ray;

/// Distance, in bundle units, within which a ray does not meet the surface it starts on. Rounding puts such a start up to
/// 1e-16 into a sphere, which a ray along its face then leaves after 1e-8.
const SKIN: f64 = 1e-7;

/// What there is beside the smoke.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Surfaces {
    /// Ground, or a ceiling.
    pub plane: Option<Plane>,
    /// Balls, which may overlap.
    pub spheres: Vec<Sphere>,
}

/// The horizontal plane of one height, opaque from either side.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plane {
    /// Its height in bundle space.
    pub y: f64,
    /// Share of the light that it reflects, per RGB channel, 0 to 1.
    pub albedo: DVec3,
}

/// A ball.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sphere {
    /// Its centre in bundle space.
    pub center: DVec3,
    /// Its radius in bundle units, above 0.
    pub radius: f64,
    /// Share of the light that it reflects, per RGB channel, 0 to 1.
    pub albedo: DVec3,
}

/// Where a ray meets a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Distance along the ray.
    pub t: f64,
    /// Unit vector out of the surface, on the side the ray comes from.
    pub normal: DVec3,
    /// Share of the light that the surface reflects.
    pub albedo: DVec3,
}

impl Surfaces {
    /// The first surface that `ray` meets before its end.
    pub fn hit(&self, ray: &Ray) -> Option<Hit> {
        let spheres = self.spheres.iter().filter_map(|sphere| sphere.hit(ray));
        let hits = self.plane.iter().filter_map(|plane| plane.hit(ray)).chain(spheres);
        hits.min_by(|a, b| a.t.total_cmp(&b.t))
    }

    /// Whether `ray` meets a surface before its end.
    pub fn block(&self, ray: &Ray) -> bool {
        self.plane.iter().any(|plane| plane.hit(ray).is_some()) || self.spheres.iter().any(|s| s.hit(ray).is_some())
    }
}

impl Plane {
    fn hit(&self, ray: &Ray) -> Option<Hit> {
        let t = (self.y - ray.origin.y) / ray.dir.y;
        // Along the plane t is infinite or NaN.
        let normal = DVec3::Y * -ray.dir.y.signum();
        (t > SKIN && t < ray.t_max && t.is_finite()).then_some(Hit { t, normal, albedo: self.albedo })
    }
}

impl Sphere {
    fn hit(&self, ray: &Ray) -> Option<Hit> {
        let to_center = self.center - ray.origin;
        let along = to_center.dot(ray.dir);
        let across_squared = (to_center - along * ray.dir).length_squared();
        let half_chord = (self.radius * self.radius - across_squared).max(0.0).sqrt();
        if half_chord == 0.0 {
            return None;
        }
        let t = [along - half_chord, along + half_chord].into_iter().find(|&t| t > SKIN && t < ray.t_max)?;
        let outward = (ray.at(t) - self.center) / self.radius;
        // From within, the other side.
        let normal = if outward.dot(ray.dir) > 0.0 { -outward } else { outward };
        Some(Hit { t, normal: normal.normalize(), albedo: self.albedo })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_meet_the_first_surface() {
        let ball = |x: f64| Sphere { center: DVec3::new(x, 1.0, 0.0), radius: 0.5, albedo: DVec3::splat(x) };
        let plane = Plane { y: -1.0, albedo: DVec3::ONE };
        let surfaces = Surfaces { plane: Some(plane), spheres: vec![ball(4.0), ball(2.0)] };
        let along = Ray::new(DVec3::Y, DVec3::X);
        assert_eq!(surfaces.hit(&along), Some(Hit { t: 1.5, normal: DVec3::NEG_X, albedo: DVec3::splat(2.0) }));
        assert!(surfaces.block(&along) && !surfaces.block(&Ray { t_max: 1.5, ..along }));
        assert!(!surfaces.block(&Ray::new(DVec3::Y, DVec3::NEG_X)), "both are behind, and the plane is parallel");
        let down = Ray::new(DVec3::new(2.0, 3.0, 0.0), DVec3::NEG_Y);
        assert_eq!(surfaces.hit(&down).map(|hit| (hit.t, hit.normal)), Some((1.5, DVec3::Y)));
        let beside = Ray::new(DVec3::new(1.0, 3.0, 0.0), DVec3::NEG_Y);
        assert_eq!(surfaces.hit(&beside), Some(Hit { t: 4.0, normal: DVec3::Y, albedo: DVec3::ONE }));
        let below = Ray::new(DVec3::NEG_Y * 2.0, DVec3::Y);
        assert_eq!(surfaces.hit(&below), Some(Hit { t: 1.0, normal: DVec3::NEG_Y, albedo: DVec3::ONE }));
    }

    #[test]
    fn rays_leave_the_surface_they_start_on() {
        let ball = Sphere { center: DVec3::new(0.3, -0.2, 0.1), radius: 0.7, albedo: DVec3::ONE };
        let surfaces = Surfaces { plane: Some(Plane { y: -0.9, albedo: DVec3::ONE }), spheres: vec![ball] };
        for normal in crate::sh::fibonacci(200).filter(|n| n.y > -0.99) {
            let start = ball.center + normal * ball.radius;
            let (across, up) = normal.any_orthonormal_pair();
            for dir in [across, up, normal, (across + normal * 1e-9).normalize()] {
                assert!(ball.hit(&Ray::new(start, dir)).is_none(), "{normal} {dir}");
            }
            // Into it, the far side.
            assert!((ball.hit(&Ray::new(start, -normal)).unwrap().t - 1.4).abs() < 1e-12);
        }
        let on_plane = DVec3::new(3.0, -0.9, 0.2);
        assert!(!surfaces.block(&Ray::new(on_plane, DVec3::new(0.6, 0.8, 0.0))));
    }
}
