//! Shadow probes: what smoke takes of the sky from surfaces around it.
//!
//! With D(ω) = L(ω)(1 − T(ω)) the radiance that is missing at a point, a surface of normal n misses
//!
//! ```text
//! ΔE(n) = ∫ D(ω) max(n·ω, 0) dω
//! ```
//!
//! Where the smoke is all above the surface's horizon, the maximum is of no account, and ΔE = n·V with V = ∫ D ω dω:
//! three numbers, exactly. In between, a smooth step from 0 to n·V, ΔE = (n·V + √((n·V)² + k²))/2, whose width k is how far
//! D is spread: k² = (D₀² − |V|²)/4, D₀ = ∫ D dω. From all around, V = 0, it gives ΔE = D₀/4, which is exact again.

use core::f64::consts::PI;

use glam::{DVec3, DVec4, UVec3};

use super::{Grid, Ray, surroundings::march};
use crate::{optics::transmittance, sh::fibonacci};

/// Probes a side of a volume's grid.
pub const SHADOW_PROBES: u32 = 24;
/// How far the grid reaches, in half sides of the box.
pub const REACH: f64 = 12.0;
/// Directions in which a probe looks.
pub const SHADOW_DIRECTIONS: usize = 64;
/// Samples of the coarse density along each.
pub const SHADOW_STEPS: usize = 16;

/// What is missing at a point: a colour each, D₀ and V.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ShadowProbe(pub [DVec4; 3]);

impl ShadowProbe {
    /// ΔE on a surface of this normal.
    pub fn missing_irradiance(&self, normal: DVec3) -> DVec3 {
        let missing = |c: DVec4| {
            let v = DVec3::new(c.y, c.z, c.w);
            let (along, spread) = (normal.dot(v), (c.x * c.x - v.length_squared()).max(0.0));
            0.5 * (along + (along * along + 0.25 * spread).sqrt())
        };
        DVec3::from(self.0.map(missing))
    }
}

/// Where a probe is, for half the sides of the box: dense near it, p = h t / (1 − |t|).
pub fn position(probe: UVec3, half_extent: DVec3) -> DVec3 {
    let t = (2.0 * probe.as_dvec3() / f64::from(SHADOW_PROBES - 1) - 1.0) * (REACH / (REACH + 1.0));
    half_extent * t / (DVec3::ONE - t.abs())
}

/// What is missing at a point of bundle space, under a sky of these radiances; `half_extent` is half the sides of the box,
/// `sigma` extinction. Directions fill the cone in which the ellipsoid about the box is seen.
pub fn probe(
    point: DVec3,
    coarse: &Grid,
    half_extent: DVec3,
    sigma: f64,
    sky: impl Fn(DVec3) -> DVec3,
    directions: usize,
    steps: usize,
) -> ShadowProbe {
    // Where the box is a cube of half side 1, the ellipsoid is a sphere of radius √3.
    let p = point / half_extent;
    let cosine = if p.length_squared() > 3.0 { (1.0 - 3.0 / p.length_squared()).sqrt() } else { -1.0 };
    let z = if cosine > -1.0 { -p.normalize() } else { DVec3::Z };
    let x = z.cross(if z.x.abs() > 0.7 { DVec3::Y } else { DVec3::X }).normalize();
    let y = z.cross(x);
    let mut missing = [DVec4::ZERO; 3];
    for even in fibonacci(directions) {
        // The lattice's height, y up, from 1 to −1, made the cone's.
        let height = 1.0 - (1.0 - cosine) * 0.5 * (1.0 - even.y);
        let side = (1.0 - height * height).max(0.0).sqrt() / even.x.hypot(even.z).max(1e-300);
        let stretched = half_extent * (x * (side * even.x) + y * (side * even.z) + z * height);
        let solid_angle =
            2.0 * PI * (1.0 - cosine) / directions as f64 * half_extent.element_product() / stretched.length().powi(3);
        let towards = stretched.normalize();
        let stopped = 1.0 - transmittance(sigma * march(&Ray::new(point, towards), coarse, steps));
        let radiance = sky(towards).max(DVec3::ZERO) * (stopped * solid_angle);
        for (c, missing) in missing.iter_mut().enumerate() {
            *missing += radiance[c] * DVec4::new(1.0, towards.x, towards.y, towards.z);
        }
    }
    ShadowProbe(missing)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::density::GridShape;

    fn black_cube() -> Grid {
        let shape = GridShape::new(UVec3::splat(64));
        Grid { shape, values: vec![1e3; shape.len()] }
    }

    #[test]
    fn a_black_cube_takes_the_sky_behind_it() {
        // Lambert's formula for the irradiance of a polygon: here the top face of a cube beneath the point, seen from a
        // distance of 1 above it along its axis, as a surface that looks down at it: F = (4/2π)·2·X/√(1+X²) atan(X/√(1+X²))
        // for each quarter, X = 0.5.
        let x: f64 = 0.5;
        let form_factor = 4.0 / PI * (x / (1.0 + x * x).sqrt() * (x / (1.0 + x * x).sqrt()).atan());
        let sky = |_| DVec3::new(1.0, 2.0, 3.0);
        let half = DVec3::splat(0.5);
        let found = probe(DVec3::new(0.0, 1.5, 0.0), &black_cube(), half, 1.0, sky, 4096, 64);
        let missing = found.missing_irradiance(DVec3::NEG_Y);
        // The trilinear cube is half a cell larger on each side: 3 % of its area.
        assert!((missing / sky(DVec3::ZERO) / (PI * form_factor) - 1.0).abs().max_element() < 0.05, "{missing}");
        // A surface that looks away misses what the smooth step leaves: 3 % here, where much is seen at a slant.
        assert!(found.missing_irradiance(DVec3::Y).x < 0.04 * missing.x);
    }

    #[test]
    fn a_surface_within_misses_the_half_it_faces() {
        let sky = |_| DVec3::ONE;
        let found = probe(DVec3::ZERO, &black_cube(), DVec3::splat(0.5), 1.0, sky, 4096, 32);
        for normal in [DVec3::X, DVec3::NEG_Y, DVec3::new(0.6, 0.0, 0.8)] {
            assert!((found.missing_irradiance(normal) - PI).abs().max_element() < 5e-3);
        }
    }

    #[test]
    fn probes_fill_their_cone_whatever_the_shape_of_the_box() {
        // The solid angle of the cone about the ellipsoid of half axes √3 h, seen from along an axis at distance d:
        // 4096 weights add up to it, and a black box takes what a finer sum over all directions takes.
        let shape = GridShape::new(UVec3::new(32, 64, 16));
        let grid = Grid { shape, values: vec![1e3; shape.len()] };
        let half = shape.half_extent().as_dvec3();
        let sky = |w: DVec3| DVec3::new(1.0 + w.x, 1.5 - w.y, 1.0);
        for point in [DVec3::new(0.1, -1.2, 0.3), DVec3::new(0.9, 0.2, -0.8), DVec3::new(0.3, 0.6, 0.2)] {
            let found = probe(point, &grid, half, 1.0, sky, 4096, 64);
            let mut exact = [DVec4::ZERO; 3];
            for w in fibonacci(1 << 18) {
                let stopped = 1.0 - transmittance(march(&Ray::new(point, w), &grid, 64));
                let d = sky(w) * (stopped * 4.0 * PI / f64::from(1 << 18));
                exact.iter_mut().enumerate().for_each(|(c, e)| *e += d[c] * DVec4::new(1.0, w.x, w.y, w.z));
            }
            for (found, exact) in found.0.iter().zip(exact) {
                // The trilinear box is half a cell larger on each side than the one in the cone, which leaves out its corners
                // where it is seen from near by; 4096 directions are off by 0.3 %.
                assert!((*found - exact).length() < 0.01 * exact.x, "{point}: {found} for {exact}");
            }
        }
    }

    #[test]
    fn probes_are_dense_near_the_box_and_end_where_it_is_far() {
        let half = DVec3::new(0.2, 0.5, 0.3);
        let end = position(UVec3::splat(SHADOW_PROBES - 1), half);
        assert!((end - half * REACH).abs().max_element() < 1e-12);
        assert!((position(UVec3::ZERO, half) + end).abs().max_element() < 1e-12);
        let step = position(UVec3::splat(12), half) - position(UVec3::splat(11), half);
        assert!((step / half).max_element() < 0.09, "{step}");
    }
}
