//! Light from all around that spheres take from a surface: the soft shadows of meshes on meshes (Ren et al. 2006).
//!
//! The logarithms of the spheres' visibilities add up as spherical harmonics, and are exponentiated direction by direction:
//!
//! ```text
//! E = Σ_j w_j L(ω_j) max(n·ω_j, 0) exp(Σ_s Σ_k λ_s,l y_k(ω_s) y_k(ω_j))
//! ```
//!
//! over E without spheres, summed alike.

use glam::{DVec3, DVec4};

use crate::sh::{BANDS, Sh, SphereRule, VISIBILITY_ENTRIES, log_visibilities};

/// Gauss–Legendre nodes of the rule of directions: 2 · 4² of them.
pub const RULE: usize = 4;
/// Spheres that look smaller than this, r/d, are left out.
pub const SMALLEST: f64 = 0.02;

/// The share of a sky's irradiance that spheres (centres and radii) leave to a surface at `point`.
///
/// A sphere counts for as much of its radius as is above the surface: a mesh's own spheres, beneath it, do not shade it.
pub fn unoccluded(point: DVec3, normal: DVec3, spheres: &[DVec4], sky: impl Fn(DVec3) -> DVec3) -> DVec3 {
    let table = log_visibilities();
    let mut depth = Sh::<f64>::default();
    for sphere in spheres {
        let offset = sphere.truncate() - point;
        let (distance, height) = (offset.length(), offset.dot(normal));
        let sine = (sphere.w / distance).min(1.0);
        let above = ((height + sphere.w) / sphere.w).clamp(0.0, 1.0);
        if sine > SMALLEST && above > 0.0 {
            let position = sine * (VISIBILITY_ENTRIES - 1) as f64;
            let below = (position as usize).min(VISIBILITY_ENTRIES - 2);
            let t = position - below as f64;
            let factors: [f64; BANDS] =
                core::array::from_fn(|l| table[below][l] + t * (table[below + 1][l] - table[below][l]));
            depth = depth + Sh::zonal(offset / distance, &factors, above);
        }
    }
    let (mut lit, mut clear) = (DVec3::ZERO, DVec3::ZERO);
    for &(w, weight) in SphereRule::new(RULE).nodes() {
        let arriving = sky(w) * (weight * normal.dot(w).max(0.0));
        clear += arriving;
        lit += arriving * depth.evaluate(w).exp();
    }
    (lit / clear).clamp(DVec3::ZERO, DVec3::ONE)
}

#[cfg(test)]
mod tests {
    use core::f64::consts::PI;

    use super::*;
    use crate::reference::{Ray, surroundings::hides};
    use crate::sh::fibonacci;

    fn exact(point: DVec3, normal: DVec3, spheres: &[DVec4], sky: impl Fn(DVec3) -> DVec3) -> DVec3 {
        let (mut lit, mut clear) = (DVec3::ZERO, DVec3::ZERO);
        for w in fibonacci(1 << 14) {
            let arriving = sky(w) * normal.dot(w).max(0.0);
            clear += arriving;
            if !spheres.iter().any(|sphere| hides(*sphere, &Ray::new(point, w))) {
                lit += arriving;
            }
        }
        lit / clear
    }

    fn floor() -> impl Iterator<Item = DVec3> {
        (0..49).map(|i| DVec3::new(f64::from(i % 7) * 0.4 - 1.2, 0.0, f64::from(i / 7) * 0.4 - 1.2))
    }

    #[test]
    fn a_ball_above_a_floor() {
        let ball = [DVec4::new(0.0, 1.0, 0.0, 0.5)];
        let constant = |_| DVec3::ONE;
        // π r²/d² cos θ of π: in closed form, the quadrature that follows in check.
        let closed = |p: DVec3| 1.0 - 0.25 / (1.0 + p.length_squared()).powf(1.5);
        let (mut error, mut shadow) = (0.0, 0.0);
        for p in floor() {
            let exact = exact(p, DVec3::Y, &ball, constant).x;
            assert!((exact - closed(p)).abs() < 2e-3);
            error += (unoccluded(p, DVec3::Y, &ball, constant).x - exact).powi(2);
            shadow += (1.0 - exact).powi(2);
        }
        // Measured 5 % of the shadow: what four bands and 32 directions hold of it.
        assert!((error / shadow).sqrt() < 0.07, "{}", (error / shadow).sqrt());
    }

    #[test]
    fn a_standing_figure_under_a_bright_side() {
        let body: [[f64; 4]; 9] = [
            [0.0, 1.65, 0.0, 0.13],
            [0.0, 1.35, 0.0, 0.17],
            [0.0, 1.1, 0.0, 0.16],
            [0.0, 0.92, 0.0, 0.16],
            [0.12, 0.7, 0.0, 0.1],
            [0.12, 0.4, 0.0, 0.09],
            [-0.12, 0.7, 0.1, 0.1],
            [-0.12, 0.4, 0.15, 0.09],
            [0.3, 1.2, 0.0, 0.07],
        ];
        let body = body.map(DVec4::from_array);
        let sky = |w: DVec3| DVec3::splat(0.2 + w.dot(DVec3::new(0.6, 0.8, 0.0)).max(0.0).powi(2));
        let (mut error, mut light) = (0.0, 0.0);
        for p in floor() {
            let exact = exact(p, DVec3::Y, &body, sky).x;
            error += (unoccluded(p, DVec3::Y, &body, sky).x - exact).powi(2);
            light += exact.powi(2);
        }
        // Overlapping spheres count more than once where they are blurred: a fifth of the shadow, 2 % of the light.
        assert!((error / light).sqrt() < 0.03, "{}", (error / light).sqrt());
    }

    #[test]
    fn what_is_beneath_a_surface_does_not_shade_it() {
        let sky = |_| DVec3::splat(PI);
        let beneath = [DVec4::new(0.0, -1.0, 0.0, 1.0), DVec4::new(0.5, -3.0, 0.0, 1.0)];
        assert_eq!(unoccluded(DVec3::ZERO, DVec3::Y, &beneath, sky), DVec3::ONE);
        // Within a sphere that ends a tenth of its radius above it, nearly so.
        let around = [DVec4::new(0.0, -0.9, 0.0, 1.0)];
        assert!(unoccluded(DVec3::ZERO, DVec3::Y, &around, sky).x > 0.85);
    }
}
