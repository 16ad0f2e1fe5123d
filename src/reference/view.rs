//! View: a camera ray marched through the volume.

use glam::DVec3;

use super::{Ray, cell_size, half_extent, volume::Volume};
use crate::density::GridShape;

/// Media radiance without background, and transmittance, along `ray`.
pub fn march(volume: &Volume, ray: &Ray, sigma: f64) -> (DVec3, f64) {
    march_with(volume.shape, ray, sigma, |x| volume.sample(x))
}

/// [`march`] through any source radiance and density, given as a function of the point, within the box of `shape`.
///
/// Steps are equal and at most half a cell; each emits J(1−e^{−σDΔ}) of the values in its middle.
pub fn march_with(shape: GridShape, ray: &Ray, sigma: f64, sample: impl Fn(DVec3) -> (DVec3, f64)) -> (DVec3, f64) {
    let (mut radiance, mut transmittance) = (DVec3::ZERO, 1.0);
    let Some((start, end)) = ray.clip(half_extent(shape)) else {
        return (radiance, transmittance);
    };
    let steps = ((end - start) / (0.5 * cell_size(shape))).ceil();
    let step = (end - start) / steps;
    for i in 0..steps as usize {
        let (source, density) = sample(ray.at(start + (i as f64 + 0.5) * step));
        let absorbed = 1.0 - (-sigma * density * step).exp();
        radiance += transmittance * absorbed * source;
        transmittance *= 1.0 - absorbed;
    }
    (radiance, transmittance)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::UVec3;

    const SHAPE: GridShape = GridShape::new(UVec3::new(32, 20, 24));
    const J: DVec3 = DVec3::new(3.0, 2.0, 1.0);

    fn slab(ray: &Ray) -> (DVec3, f64) {
        march_with(SHAPE, ray, 4.0, |_| (J, 0.75))
    }

    fn assert_slab(ray: Ray, length: f64) {
        // However it is stepped, a homogeneous medium gives the closed form: J(1 − e^{−σDl}).
        let (radiance, transmittance) = slab(&ray);
        assert!((transmittance - (-3.0 * length).exp()).abs() < 1e-13, "{transmittance}");
        assert!((radiance - J * (1.0 - (-3.0 * length).exp())).length() < 1e-13);
    }

    #[test]
    fn homogeneous_slab() {
        let ray = Ray::new(DVec3::new(-2.0, 0.1, 0.1), DVec3::X);
        assert_slab(ray, 1.0);
        // Slanted through the y faces, 20/32 apart, 0.8 of the way per unit.
        assert_slab(Ray::new(DVec3::new(-0.75, -1.0, 0.0), DVec3::new(0.6, 0.8, 0.0)), 0.625 / 0.8);
        // From inside, and past the box.
        assert_slab(Ray::new(DVec3::new(0.2, 0.0, 0.0), DVec3::X), 0.3);
        assert_slab(Ray::new(DVec3::new(0.6, 0.0, 0.0), DVec3::X), 0.0);
        assert_slab(Ray::new(DVec3::new(-2.0, 0.4, 0.1), DVec3::X), 0.0);
        // Up to an opaque surface within, before and behind.
        assert_slab(Ray { t_max: 1.9, ..ray }, 0.4);
        assert_slab(Ray { t_max: 1.0, ..ray }, 0.0);
        assert_slab(Ray { t_max: 9.0, ..ray }, 1.0);
    }

    #[test]
    fn steps_are_half_a_cell_at_most() {
        let count = core::cell::Cell::new(0);
        let ray = Ray::new(DVec3::new(0.2, 0.0, 0.0), DVec3::X);
        march_with(SHAPE, &ray, 1.0, |x| {
            // 0.3 / (1/64) = 19.2: twenty steps of 0.015.
            let expected = 0.2 + (f64::from(count.get()) + 0.5) * 0.015;
            assert!((x.x - expected).abs() < 1e-12);
            count.set(count.get() + 1);
            (DVec3::ZERO, 0.0)
        });
        assert_eq!(count.get(), 20);
    }

    #[test]
    fn a_ramp_of_radiance_converges_to_its_integral() {
        // ∫ σ D e^{−σDt} t dt over 0..1 with σD = 3: 1/3 − e⁻³(1 + 1/3). 64 steps: second order, (1/64)² / 12 · 3.
        let ray = Ray::new(DVec3::X * -2.0, DVec3::X);
        let (radiance, _) = march_with(SHAPE, &ray, 3.0, |x| (DVec3::splat(x.x + 0.5), 1.0));
        let expected = 1.0 / 3.0 - (-3f64).exp() * (4.0 / 3.0);
        assert!((radiance.x - expected).abs() < 1e-4, "{radiance} {expected}");
    }

    #[test]
    fn a_grid_fades_out_over_its_last_half_cell() {
        let padded = GridShape::new(SHAPE.dims + 2);
        let density = (0..padded.len())
            .map(|i| {
                let cell = padded.cell(i);
                f64::from(cell.cmpge(UVec3::ONE).all() && cell.cmple(SHAPE.dims).all())
            })
            .collect();
        let volume = Volume { shape: SHAPE, radiance: vec![J; padded.len()], density };
        // Through cell centres along x: 31 cells between the outermost centres, and at each end half a cell falling
        // from 1 to 1/2: 31.75 of 32. Along y 19.75 of 20, in units of 1/32.
        for (ray, cells) in [
            (Ray::new(DVec3::new(-2.0, 1.0 / 64.0, 1.0 / 64.0), DVec3::X), 31.75),
            (Ray::new(DVec3::new(1.0 / 64.0, 3.0, 1.0 / 64.0), -DVec3::Y), 19.75),
        ] {
            let (radiance, transmittance) = march(&volume, &ray, 2.0);
            let expected = (-2.0 * cells / 32.0f64).exp();
            // Midpoints are exact on straight pieces, if the steps meet the kinks: 64 or 65 steps (rounding) leave
            // 1e-4.
            assert!((transmittance - expected).abs() < 1e-4, "{transmittance} {expected}");
            assert!((radiance - J * (1.0 - transmittance)).length() < 1e-13);
        }
    }
}
