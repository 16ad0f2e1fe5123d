//! Single scattering from first principles: no RBFs, no probes, no spherical harmonics, no coarse grid.
//!
//! Deterministic, and slow: directions times two marches. What it still approximates goes away with more directions.

use core::f64::consts::PI;

use glam::DVec3;

use super::{Grid, Medium, Ray, cell_size, half_extent, view::march_with};
use crate::{
    optics::{henyey_greenstein, transmittance},
    sh::fibonacci,
};

/// Radiance and transmittance along `ray`: at every half-cell step, light from `directions` Fibonacci directions, each
/// attenuated along half-cell steps through the full grid, weighted by the exact phase function.
///
/// `environment` is radiance by the direction it comes from, in bundle axes.
pub fn single_scattering(
    density: &Grid,
    medium: &Medium,
    ray: &Ray,
    directions: usize,
    environment: impl Fn(DVec3) -> DVec3,
) -> (DVec3, f64) {
    // Scattering from ω to the eye turns light from −ω to −v, with v along the ray.
    let lights: Vec<(DVec3, DVec3)> = fibonacci(directions)
        .map(|dir| {
            let phase = henyey_greenstein(dir.dot(ray.dir), medium.g);
            (dir, environment(dir) * medium.albedo * (phase * 4.0 * PI / directions as f64))
        })
        .collect();
    march_with(density.shape, ray, medium.sigma, |x| {
        let here = density.sample(x);
        if here == 0.0 {
            return (DVec3::ZERO, 0.0);
        }
        let arriving = |&(dir, light): &(DVec3, DVec3)| light * transmittance(medium.sigma * column(density, x, dir));
        (lights.iter().map(arriving).sum(), here)
    })
}

/// ∫ of the density from `x` along `dir` to the box's face, by midpoints of half-cell steps.
fn column(density: &Grid, x: DVec3, dir: DVec3) -> f64 {
    let ray = Ray::new(x, dir);
    let Some((start, end)) = ray.clip(half_extent(density.shape)) else {
        return 0.0;
    };
    let steps = ((end - start) / (0.5 * cell_size(density.shape))).ceil();
    let step = (end - start) / steps;
    (0..steps as usize).map(|i| density.sample(ray.at(start + (i as f64 + 0.5) * step))).sum::<f64>() * step
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        density::GridShape,
        optics::{erf, gaussian_column},
        rbf::Rbf,
        reference::density::density,
    };
    use glam::UVec3;

    const MEDIUM: Medium = Medium { sigma: 6.0, albedo: DVec3::new(0.9, 0.6, 0.3), g: 0.5 };

    #[test]
    fn thin_smoke_scatters_albedo_times_optical_depth() {
        // Nothing is attenuated: L = Ω τ under unit light, phase integrating to 1 over 512 directions within 1e-3.
        let shape = GridShape::new(UVec3::splat(16));
        let grid = Grid { shape, values: vec![1.0; shape.len()] };
        let medium = Medium { sigma: 1e-5, ..MEDIUM };
        let ray = Ray::new(DVec3::new(0.01, 0.02, 3.0), -DVec3::Z);
        let (radiance, transmittance) = single_scattering(&grid, &medium, &ray, 512, |_| DVec3::ONE);
        let ratio = radiance / (medium.albedo * (1.0 - transmittance));
        assert!((ratio - DVec3::ONE).abs().max_element() < 1e-3, "{ratio}");
    }

    #[test]
    fn a_gaussian_matches_its_exact_optical_depths() {
        // The same integral with closed-form optical depths and a finer march.
        let rbf = Rbf { center: [0.0, 0.0, 0.0], radius: 0.15, weight: 1.0 };
        let grid = density(&[rbf], |_| 0.0, GridShape::new(UVec3::splat(32)));
        let environment = |w: DVec3| DVec3::new(1.0 + w.y, 1.0, 1.0 - w.x) * (0.5 + 0.5 * w.z);
        let ray = Ray::new(DVec3::new(0.05, 0.03, -3.0), DVec3::Z);
        let radius = f64::from(rbf.radius);
        let depth = |x, dir| MEDIUM.sigma * gaussian_column(x, dir, DVec3::ZERO, radius, 1.0);
        let mut expected = DVec3::ZERO;
        let step = 1.0 / 200.0;
        for i in 0..200 {
            let x = ray.at(2.5 + (f64::from(i) + 0.5) * step);
            let extinction = MEDIUM.sigma * (-x.length_squared() / (radius * radius)).exp();
            for dir in fibonacci(128) {
                let phase = henyey_greenstein(dir.dot(ray.dir), MEDIUM.g) * 4.0 * PI / 128.0;
                let survives = transmittance(depth(x, dir) + depth(x, -ray.dir));
                expected += environment(dir) * MEDIUM.albedo * (phase * survives * extinction * step);
            }
        }
        let (radiance, alpha) = single_scattering(&grid, &MEDIUM, &ray, 128, environment);
        // Trilinear interpolation of a Gaussian of 4.8 cells: curvature · h²/8 per axis, within 1 %.
        assert!(((radiance - expected) / expected).abs().max_element() < 0.01, "{radiance} {expected}");
        let exact = transmittance(depth(ray.at(0.0), ray.dir));
        assert!((alpha - exact).abs() < 0.005, "{alpha} {exact}");
        assert!(erf(0.5 / radius) > 0.999_99, "the box holds the Gaussian");
    }

    #[test]
    fn a_slab_lit_from_one_side() {
        // One direction only (n = 1 is +X, weight 4π) across a cube: e^{−σ(0.5−x)} in, e^{−σ(z+0.5)} out.
        let dir = fibonacci(1).next().unwrap();
        assert!((dir - DVec3::X).length() < 1e-15);
        let shape = GridShape::new(UVec3::splat(64));
        let grid = Grid { shape, values: vec![1.0; shape.len()] };
        let medium = Medium { sigma: 2.0, albedo: DVec3::ONE, g: 0.0 };
        let ray = Ray::new(DVec3::new(0.1, 0.0, -2.0), DVec3::Z);
        let (radiance, _) = single_scattering(&grid, &medium, &ray, 1, |_| DVec3::ONE);
        let expected = (-2.0 * 0.4f64).exp() * (1.0 - (-2f64).exp());
        // Density fades over half a cell at each face: 1/8 cell less each, 1/512 · σ.
        assert!((radiance.x / expected - 1.0).abs() < 0.01, "{radiance} {expected}");
    }
}
