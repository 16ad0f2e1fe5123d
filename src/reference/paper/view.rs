//! Compensated ray marching (Zhou et al. 2008, section 5.5), with the emission of a step as printed.

use glam::{DVec3, UVec3};
use rayon::prelude::*;

use crate::{
    density::GridShape,
    rbf::Rbf,
    reference::{
        Grid, Ray, cell_size, center, density::gaussian, half_extent, outgoing::Viewer, rbf_center, volume::Volume,
    },
    sh::ShRgb,
};

/// Below this D̃ the residual is set to zero, so that smoke outside every RBF is dropped.
pub const SMALLEST_DENSITY: f64 = 1e-10;

/// Source radiance of every RBF towards the eye.
pub fn outgoing(rbfs: &[Rbf], source: &[ShRgb], viewer: Viewer) -> Vec<DVec3> {
    let look = |rbf: &Rbf| match viewer {
        Viewer::Perspective { eye } => (rbf_center(rbf) - eye).normalize_or(DVec3::Z),
        Viewer::Orthographic { forward } => forward,
    };
    rbfs.iter().zip(source).map(|(rbf, source)| source.evaluate(look(rbf))).collect()
}

/// The volume pass: D and J̃_D = (1 + R/D̃) Σ_l w_l B_l J_l (Eq. 15) at every cell, with D̃ + R = `density`.
///
/// In the place of source radiance the result holds J̃_D, which has the density in it.
pub fn volume(rbfs: &[Rbf], outgoing: &[DVec3], density: &Grid) -> Volume {
    let shape = density.shape;
    let padded = GridShape::new(shape.dims + 2);
    let (radiance, density) = (0..padded.len())
        .into_par_iter()
        .map(|index| {
            let cell = padded.cell(index);
            if (cell.cmplt(UVec3::ONE) | cell.cmpgt(shape.dims)).any() {
                return (DVec3::ZERO, 0.0);
            }
            let x = center(shape, cell - 1);
            let (mut emission, mut model) = (DVec3::ZERO, 0.0);
            for (rbf, &radiance) in rbfs.iter().zip(outgoing) {
                let weight = gaussian(rbf, x);
                emission += weight * radiance;
                model += weight;
            }
            if model < SMALLEST_DENSITY {
                return (emission, model);
            }
            let density = density.values[shape.index(cell - 1)];
            (emission * (density / model), density)
        })
        .unzip();
    Volume { shape, radiance, density }
}

/// The view pass: media radiance without background, and transmittance, along `ray`.
///
/// Steps are equal and at most half a cell. A step emits J̃_D σ Δ and lets through exp(−σ D Δ), with the values in its
/// middle.
pub fn march(volume: &Volume, ray: &Ray, sigma: f64) -> (DVec3, f64) {
    let (mut radiance, mut transmittance) = (DVec3::ZERO, 1.0);
    let Some((start, end)) = ray.clip(half_extent(volume.shape)) else {
        return (radiance, transmittance);
    };
    let steps = ((end - start) / (0.5 * cell_size(volume.shape))).ceil();
    let step = (end - start) / steps;
    for i in 0..steps as usize {
        let (emission, density) = volume.sample(ray.at(start + (i as f64 + 0.5) * step));
        radiance += transmittance * emission * (sigma * step);
        transmittance *= (-sigma * density * step).exp();
    }
    (radiance, transmittance)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference::density::density;

    fn rbfs() -> [Rbf; 2] {
        let at = |x, radius, weight| Rbf { center: [x, 0.0, 0.0], radius, weight };
        [at(-0.1, 0.09, 1.0), at(0.1, 0.07, 0.5)]
    }

    #[test]
    fn the_volume_holds_equation_15() {
        let shape = GridShape::new(UVec3::new(24, 20, 16));
        let residual = |cell: UVec3| if cell.x.is_multiple_of(2) { 0.05 } else { -0.01 };
        let density = density(&rbfs(), residual, shape);
        let j = [DVec3::new(1.0, 2.0, 3.0), DVec3::new(0.5, 0.1, 0.0)];
        let volume = volume(&rbfs(), &j, &density);
        for index in 0..shape.len() {
            let cell = shape.cell(index);
            let (emission, found) = volume.sample(center(shape, cell));
            let weights = rbfs().map(|rbf| gaussian(&rbf, center(shape, cell)));
            let model = weights[0] + weights[1];
            // In every RBF's absence there is no smoke, whatever the residual says.
            let expected = if model < 1e-10 { 0.0 } else { (model + residual(cell)).max(0.0) };
            let mean = if model < 1e-10 { DVec3::ZERO } else { (weights[0] * j[0] + weights[1] * j[1]) / model };
            assert!((found - expected).abs() < 1e-12, "{cell}: {found} {expected}");
            assert!((emission - expected * mean).length() < 1e-11);
        }
        assert!(volume.density.iter().zip(&volume.radiance).any(|(&d, &e)| d == 0.0 && e == DVec3::ZERO));
    }

    #[test]
    fn a_slab_glows_as_printed() {
        // 64 steps through J̃_D = J D: J σDΔ (1 − q⁶⁴)/(1 − q) with q = e^{−σDΔ}, above J(1 − q⁶⁴) by σDΔ/2.
        let shape = GridShape::new(UVec3::splat(32));
        let padded = GridShape::new(shape.dims + 2);
        let j = DVec3::new(3.0, 2.0, 1.0);
        let volume = Volume { shape, radiance: vec![j * 0.75; padded.len()], density: vec![0.75; padded.len()] };
        let (radiance, transmittance) = march(&volume, &Ray::new(DVec3::new(-2.0, 0.1, 0.1), DVec3::X), 8.0);
        let depth = 6.0 / 64.0f64;
        let expected = j * (depth * (1.0 - (-6f64).exp()) / (1.0 - (-depth).exp()));
        assert!((radiance - expected).length() < 1e-12, "{radiance} {expected}");
        assert!((transmittance - (-6f64).exp()).abs() < 1e-14);
        assert_eq!(march(&volume, &Ray::new(DVec3::new(-2.0, 0.7, 0.1), DVec3::X), 8.0), (DVec3::ZERO, 1.0));
    }

    #[test]
    fn outgoing_looks_from_the_eye() {
        // y2 is positive along +Z.
        let mut lobe = ShRgb::default();
        lobe.0[2] = DVec3::ONE;
        let eye = DVec3::new(-0.1, 0.0, 3.0);
        let found = outgoing(&rbfs(), &[lobe; 2], Viewer::Perspective { eye });
        let slope = 3.0 / (9.0f64 + 0.04).sqrt();
        let scale = (0.75 / core::f64::consts::PI).sqrt();
        assert!((found[0].x + scale).abs() < 1e-7 && (found[1].x + scale * slope).abs() < 1e-7, "{found:?}");
        let parallel = outgoing(&rbfs(), &[lobe; 2], Viewer::Orthographic { forward: DVec3::Z });
        assert!(parallel.iter().all(|j| (*j - DVec3::splat(scale)).length() < 1e-14));
    }
}
