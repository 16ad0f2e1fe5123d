//! Incident light: the environment's light that reaches each probe through the smoke.

use core::f64::consts::PI;

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::{
    DIRECTIONS, Grid, MARCH_STEPS, PROBE_OFFSETS, PROBES, Ray, rbf_center,
    surroundings::{Surroundings, march},
};
use crate::{
    optics::transmittance,
    rbf::Rbf,
    sh::{Sh, ShRgb, fibonacci},
};

/// The environment as the volume sees it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lighting {
    /// Radiance arriving from each direction of the environment's own axes.
    pub environment: ShRgb,
    /// Rotation from bundle axes to the environment's.
    pub env_from_local: DMat3,
}

/// Light that reaches a point through the smoke, from outside it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Incident {
    /// L_d: attenuated radiance by the direction it comes from.
    pub light: ShRgb,
    /// τ̄: the mean transmittance from the point to infinity over all directions, 0 to 1 per channel.
    pub escape: DVec3,
    /// T: the transmittance itself by direction, 0 to 1, at the mean extinction of the channels.
    pub passing: Sh<f64>,
}

/// L_d, τ̄ and T at the probes of every RBF, of smoke that is alone; `sigma` is extinction per channel.
pub fn incident_light(rbfs: &[Rbf], coarse: &Grid, lighting: &Lighting, sigma: DVec3) -> Vec<[Incident; PROBES]> {
    incident_light_among(rbfs, coarse, lighting, sigma, &Surroundings::default())
}

/// The same where something stands around the smoke.
pub fn incident_light_among(
    rbfs: &[Rbf],
    coarse: &Grid,
    lighting: &Lighting,
    sigma: DVec3,
    around: &Surroundings,
) -> Vec<[Incident; PROBES]> {
    let at = |rbf: &Rbf| probes(rbf, reach(rbf, sigma.element_sum() / 3.0));
    rbfs.par_iter().map(|rbf| at(rbf).map(|p| incident(p, coarse, lighting, sigma, around, DIRECTIONS))).collect()
}

/// Where the probes of an RBF are.
pub fn probes(rbf: &Rbf, reach: f64) -> [DVec3; PROBES] {
    PROBE_OFFSETS.map(|offset| rbf_center(rbf) + offset * reach)
}

/// Distance of an RBF's outer probes from its centre: a radius, but farther where the RBF is so thick that light ends
/// before, for the grey extinction `sigma`.
///
/// r √(ln(3 σ w r)) is about where what is left of the Gaussian outside, √π/2 · w r e^{−u²} in its tail, has an optical
/// depth of a third: there is light still, and it is there that smoke is seen. No farther than r √6.
pub fn reach(rbf: &Rbf, sigma: f64) -> f64 {
    let (radius, weight) = (f64::from(rbf.radius), f64::from(rbf.weight));
    radius * (3.0 * sigma * weight * radius).max(1e-30).ln().clamp(1.0, 6.0).sqrt()
}

/// L_d, τ̄ and T at `p`, from `directions` fixed directions; `sigma` is extinction per channel. What stands around dims the
/// light alone: τ̄ and T are of the smoke itself.
pub fn incident(
    p: DVec3,
    coarse: &Grid,
    lighting: &Lighting,
    sigma: DVec3,
    around: &Surroundings,
    directions: usize,
) -> Incident {
    let solid_angle = 4.0 * PI / directions as f64;
    let mean_sigma = sigma.element_sum() / 3.0;
    let mut incident = Incident::default();
    for dir in fibonacci(directions) {
        let radiance = lighting.environment.evaluate(lighting.env_from_local * dir);
        let ray = Ray::new(p, dir);
        let column = column(&ray, coarse);
        let passing = (sigma * column).map(transmittance);
        let seen = around.unhidden(p, dir) * transmittance(around.other_depth(&ray));
        incident.light.accumulate(dir, radiance * passing * (seen * solid_angle));
        incident.escape += passing / directions as f64;
        incident.passing.accumulate(dir, transmittance(mean_sigma * column) * solid_angle);
    }
    incident
}

/// ∫ of the coarse density along `ray` to its end, or to where the density ends, half a cell outside its box.
pub fn column(ray: &Ray, coarse: &Grid) -> f64 {
    march(ray, coarse, MARCH_STEPS)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        density::GridShape,
        optics::gaussian_column,
        reference::{coarse::coarse, density::density},
        sh::SphereRule,
    };
    use glam::UVec3;

    fn sky() -> ShRgb {
        ShRgb::constant(DVec3::new(0.4, 0.5, 0.7))
            + ShRgb::zonal(DVec3::new(0.6, 0.0, 0.8), &[1.0, 0.8, 0.5, 0.2], DVec3::new(3.0, 2.0, 1.0))
    }

    fn lighting() -> Lighting {
        Lighting { environment: sky(), env_from_local: DMat3::IDENTITY }
    }

    fn assert_close(a: &ShRgb, b: &ShRgb, tolerance: f64) {
        for (k, (a, b)) in a.0.iter().zip(&b.0).enumerate() {
            assert!((*a - *b).abs().max_element() < tolerance, "{k}: {a} for {b}");
        }
    }

    fn direct_light(p: DVec3, coarse: &Grid, lighting: &Lighting, sigma: f64, directions: usize) -> ShRgb {
        incident(p, coarse, lighting, DVec3::splat(sigma), &Surroundings::default(), directions).light
    }

    fn uniform(dims: UVec3, value: f64) -> Grid {
        let shape = GridShape::new(dims);
        Grid { shape, values: vec![value; shape.len()] }
    }

    #[test]
    fn clear_air_returns_the_environment() {
        let empty = uniform(UVec3::splat(32), 0.0);
        // 4096 Fibonacci directions integrate degree 6 to a few 1e-4; 32 to a few percent (of coefficients near 4).
        let exact = sky();
        assert_close(&direct_light(DVec3::ZERO, &empty, &lighting(), 5.0, 4096), &exact, 5e-3);
        assert_close(&direct_light(DVec3::ZERO, &empty, &lighting(), 5.0, DIRECTIONS), &exact, 0.3);
        // A turned volume sees the environment turned back.
        let turn = DMat3::from_axis_angle(DVec3::new(0.0, 0.6, 0.8), 1.1);
        let turned = Lighting { env_from_local: turn, ..lighting() };
        let expected = exact.rotate(turn.transpose());
        assert_close(&direct_light(DVec3::ZERO, &empty, &turned, 5.0, 4096), &expected, 5e-3);
    }

    #[test]
    fn columns_of_a_uniform_box() {
        let grid = uniform(UVec3::new(32, 16, 32), 1.3);
        // Along x from the centre: 15.5 cells of full density, then a ramp to zero over one cell, in 20 steps of
        // 16.5/20 = 0.825 cells: 19 find the full density, the last one 0.4125 of it. (16.015 cells for 16.)
        let cells = 0.825 * (19.0 + 0.4125);
        assert!((column(&Ray::new(DVec3::ZERO, DVec3::X), &grid) - 1.3 * cells / 32.0).abs() < 1e-14);
        // From outside, 33 cells from end to end: 20 steps of 1.65, of which the outer two find 0.825. (32.4 cells for
        // 32.)
        let cells = 1.65 * (18.0 + 2.0 * 0.825);
        assert!((column(&Ray::new(DVec3::X * -3.0, DVec3::X), &grid) - 1.3 * cells / 32.0).abs() < 1e-14);
        // From beyond the box, or past it, nothing.
        assert_eq!(column(&Ray::new(DVec3::X * 3.0, DVec3::X), &grid), 0.0);
        assert_eq!(column(&Ray::new(DVec3::new(-3.0, 0.3, 0.0), DVec3::X), &grid), 0.0);
    }

    #[test]
    fn a_homogeneous_cube_dims_the_light_along_its_diagonals() {
        // Against an independent quadrature: exact SphereRule directions, chords of the box in closed form.
        let grid = uniform(UVec3::splat(32), 1.0);
        let p = DVec3::new(0.1, -0.2, 0.05);
        let sigma = 3.0;
        let chord = |w: DVec3| (w.signum() * 0.5 - p) / w;
        let expected =
            ShRgb::project(&SphereRule::new(64), |w| sky().evaluate(w) * (-sigma * chord(w).min_element()).exp());
        // Rounded corners (trilinear) and 20 steps: 1 % of the largest coefficient.
        let found = direct_light(p, &grid, &lighting(), sigma, 4096);
        assert_close(&found, &expected, 0.01 * expected.0[0].max_element());
    }

    #[test]
    fn one_gaussian_matches_the_exact_optical_depth() {
        let rbf = Rbf { center: [0.0, 0.05, 0.0], radius: 0.14, weight: 2.0 };
        let grid = coarse(&density(&[rbf], |_| 0.0, GridShape::new(UVec3::splat(64))));
        let center = rbf_center(&rbf);
        for p in
            probes(&rbf, rbf.radius.into()).into_iter().chain([DVec3::new(-0.3, 0.2, 0.1), DVec3::new(0.45, 0.4, -0.4)])
        {
            for dir in fibonacci(DIRECTIONS) {
                // The coarse grid blurs: in coarse cells, averaging pairs adds 1/16 to the variance per axis and
                // trilinear interpolation 1/6, to r²/2 = 10.04. The two axes across the ray lose 0.229/10.04 = 2.3 % of
                // the largest column w r √π; the march adds little, with steps of at most 2.8 cells across 9.
                let exact = gaussian_column(p, dir, center, rbf.radius.into(), rbf.weight.into());
                let largest = 2.0 * 0.14 * PI.sqrt();
                let found = column(&Ray::new(p, dir), &grid);
                assert!((found - exact).abs() < 0.03 * largest, "{found} for {exact}");
            }
        }
    }

    #[test]
    fn constant_light_is_what_passes() {
        // Under light of radiance 1, L_d is T, and its mean τ̄: the same sums.
        let grid = uniform(UVec3::splat(8), 1.0);
        let constant = Lighting { environment: ShRgb::constant(DVec3::ONE), ..lighting() };
        let p = DVec3::new(0.3, -0.2, 0.1);
        let alone = Surroundings::default();
        let found = incident(p, &grid, &constant, DVec3::splat(4.0), &alone, DIRECTIONS);
        for (light, passing) in found.light.0.iter().zip(found.passing.0) {
            assert!((*light - passing).abs().max_element() < 1e-14);
        }
        assert!((found.escape - found.passing.0[0] / (4.0 * PI).sqrt()).abs().max_element() < 1e-14);
        // With extinctions that differ, T has their mean.
        let coloured = incident(p, &grid, &constant, DVec3::new(2.0, 4.0, 6.0), &alone, DIRECTIONS);
        assert_eq!(coloured.passing, found.passing);
        assert!(coloured.escape.x > coloured.escape.y && coloured.escape.y > coloured.escape.z);
    }

    #[test]
    fn columns_end_where_the_ray_does() {
        let grid = uniform(UVec3::splat(8), 1.5);
        let ray = Ray { t_max: 0.25, ..Ray::new(DVec3::new(-0.2, 0.1, 0.0), DVec3::X) };
        assert!((column(&ray, &grid) - 1.5 * 0.25).abs() < 1e-14);
    }
}
