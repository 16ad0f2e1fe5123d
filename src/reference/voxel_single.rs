//! Single scattering without noise, fast enough for every frame of an animation: source radiance once a voxel.
//!
//! [`single`](super::single) looks for light at every step of every view ray. Here each voxel with smoke does so, by the
//! same marches along the same directions, and view rays interpolate what the voxels send to the eye. Interpolating is all
//! that sets the two apart.

use core::f64::consts::PI;

use glam::{DVec3, DVec4, UVec3};
use rayon::prelude::*;

use super::{Grid, Medium, Ray, cell_size, center, view::march_with};
use crate::{
    density::GridShape,
    optics::{henyey_greenstein, transmittance},
    sh::fibonacci,
};

/// Light from infinitely far away, from one direction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DistantLight {
    /// Unit vector toward the light, in bundle axes.
    pub direction: DVec3,
    /// RGB irradiance on a surface that faces it: radiance times steradians.
    pub irradiance: DVec3,
}

/// A smooth environment as `count` Fibonacci directions, each with the radiance there; `radiance` is by unit vector.
pub fn distant_lights(count: usize, radiance: impl Fn(DVec3) -> DVec3) -> Vec<DistantLight> {
    let solid_angle = 4.0 * PI / count as f64;
    fibonacci(count)
        .map(|direction| DistantLight { direction, irradiance: radiance(direction) * solid_angle })
        .collect()
}

/// An environment that may change within the steradians of a direction, such as an image: `radiance` in the middle of each
/// of `columns` × `rows` texels of an equirectangular image, times the texel's solid angle, goes to the nearest of `count`
/// Fibonacci directions. No light is lost or missed.
pub fn gathered_lights(
    count: usize,
    [columns, rows]: [usize; 2],
    radiance: impl Fn(DVec3) -> DVec3,
) -> Vec<DistantLight> {
    let mut lights = distant_lights(count, |_| DVec3::ZERO);
    for row in 0..rows {
        let polar = |row: f64| PI * row / rows as f64;
        let (top, bottom) = (polar(row as f64), polar(row as f64 + 1.0));
        let solid_angle = (top.cos() - bottom.cos()) * 2.0 * PI / columns as f64;
        let (sin, cos) = polar(row as f64 + 0.5).sin_cos();
        for column in 0..columns {
            let azimuth = 2.0 * PI * (column as f64 + 0.5) / columns as f64;
            let w = DVec3::new(azimuth.sin() * sin, cos, -azimuth.cos() * sin);
            let nearest = lights.iter_mut().max_by(|a, b| a.direction.dot(w).total_cmp(&b.direction.dot(w)));
            if let Some(light) = nearest {
                light.irradiance += radiance(w) * solid_angle;
            }
        }
    }
    lights
}

/// Smoke, and the light that each of its voxels scatters toward one eye.
#[derive(Clone, Debug, PartialEq)]
pub struct LitVoxels {
    shape: GridShape,
    sigma: f64,
    /// J·D and D of the box's cells and one more cell on every side, where both are 0.
    texels: Vec<DVec4>,
}

impl LitVoxels {
    /// Single scattering of `lights` toward an eye at `eye`, at the centre of every voxel with smoke: Ω Σ p E T, with T
    /// from midpoints of half-cell steps to the end of the smoke.
    pub fn new(density: &Grid, medium: &Medium, eye: DVec3, lights: &[DistantLight]) -> Self {
        let shape = density.shape;
        let padded = GridShape::new(shape.dims + 2);
        let smoke = Smoke::new(density, padded);
        let cell = cell_size(shape);
        let source = |at: UVec3| {
            // v runs from the eye; light from ω turns from −ω to −v.
            let view = (center(shape, at) - eye).normalize_or_zero();
            let scattered = |light: &DistantLight| {
                let phase = henyey_greenstein(light.direction.dot(view), medium.g);
                let depth = medium.sigma * cell * smoke.column((at + 1).as_dvec3(), light.direction);
                light.irradiance * (phase * transmittance(depth))
            };
            medium.albedo * lights.iter().map(scattered).sum::<DVec3>()
        };
        let texel = |index| {
            let density: f64 = smoke.values[index];
            let emitted = if density > 0.0 { density * source(padded.cell(index) - 1) } else { DVec3::ZERO };
            emitted.extend(density)
        };
        let texels = (0..padded.len()).into_par_iter().map(texel).collect();
        Self { shape, sigma: medium.sigma, texels }
    }

    /// Media radiance without background, and transmittance, along `ray` from the eye: half-cell steps, each emitting
    /// J(1−e^{−σDΔ}) of the values in its middle.
    pub fn march(&self, ray: &Ray) -> (DVec3, f64) {
        march_with(self.shape, ray, self.sigma, |x| {
            let texel = self.sample(x);
            if texel.w > 0.0 { (texel.truncate() / texel.w, texel.w) } else { (DVec3::ZERO, 0.0) }
        })
    }

    /// J·D and D at a point of the box, trilinear between cell centres. Where some of the voxels around it are empty, J is
    /// that of the others.
    fn sample(&self, x: DVec3) -> DVec4 {
        let position = x / cell_size(self.shape) + 0.5 * self.shape.dims.as_dvec3() + 0.5;
        trilinear(&self.texels, self.shape.dims + 2, position)
    }
}

/// Density with a margin of one empty cell, and where there is any. Positions are in cells, the centre of the margin's first
/// cell at 0.
struct Smoke {
    dims: UVec3,
    values: Vec<f64>,
    /// Outside these corners density is 0.
    low: DVec3,
    high: DVec3,
}

impl Smoke {
    fn new(density: &Grid, padded: GridShape) -> Self {
        let mut values = vec![0.0; padded.len()];
        let (mut low, mut high) = (UVec3::MAX, UVec3::ZERO);
        for (index, &value) in density.values.iter().enumerate().filter(|(_, value)| **value > 0.0) {
            let cell = density.shape.cell(index) + 1;
            values[padded.index(cell)] = value;
            (low, high) = (low.min(cell), high.max(cell));
        }
        // Trilinear density reaches one cell beyond the outermost voxels, but not out of the box.
        let low = (low.as_dvec3() - 1.0).max(DVec3::splat(0.5));
        let high = (high.as_dvec3() + 1.0).min(density.shape.dims.as_dvec3() + 0.5);
        Self { dims: padded.dims, values, low, high }
    }

    /// ∫ of the density, in cells, from a position within the smoke along the unit vector `dir` to its end, by midpoints of
    /// half-cell steps.
    fn column(&self, from: DVec3, dir: DVec3) -> f64 {
        let exit = |axis: usize| {
            let face = if dir[axis] > 0.0 { self.high[axis] } else { self.low[axis] };
            if dir[axis] == 0.0 { f64::INFINITY } else { (face - from[axis]) / dir[axis] }
        };
        let length = exit(0).min(exit(1)).min(exit(2));
        let steps = (2.0 * length).ceil();
        let step = dir * (length / steps);
        let sample = |i: usize| trilinear(&self.values, self.dims, from + step * (i as f64 + 0.5));
        (0..steps as usize).map(sample).sum::<f64>() * (length / steps)
    }
}

/// The value at a position in cells, between the centres of the first cell and the last.
fn trilinear<T>(values: &[T], dims: UVec3, position: DVec3) -> T
where
    T: Copy + core::ops::Add<Output = T> + core::ops::Mul<f64, Output = T>,
{
    let base = position.as_uvec3();
    let f = position - base.as_dvec3();
    let [row, slice] = [dims.x as usize, dims.x as usize * dims.y as usize];
    let first = base.x as usize + row * base.y as usize + slice * base.z as usize;
    let along_x = |at: usize| {
        let pair = &values[at..at + 2];
        pair[0] * (1.0 - f.x) + pair[1] * f.x
    };
    let along_y = |at: usize| along_x(at) * (1.0 - f.y) + along_x(at + row) * f.y;
    along_y(first) * (1.0 - f.z) + along_y(first + slice) * f.z
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference::single::single_scattering;

    const EYE: DVec3 = DVec3::new(0.4, 0.3, 2.5);

    /// Two blobs and a ripple in a corner of a box of 24 × 20 × 22 cells; empty cells around them and between.
    fn smoke() -> Grid {
        let shape = GridShape::new(UVec3::new(24, 20, 22));
        let value = |index| {
            let x = center(shape, shape.cell(index));
            let blob = |at: DVec3, r: f64| (-x.distance_squared(at) / (r * r)).exp();
            let value = blob(DVec3::new(-0.1, -0.1, 0.05), 0.12) + 0.7 * blob(DVec3::new(0.15, 0.12, -0.1), 0.1);
            let value = value * (1.0 + 0.4 * (25.0 * x.x).sin() * (21.0 * x.y).cos());
            if value > 0.02 { value } else { 0.0 }
        };
        Grid { shape, values: (0..shape.len()).map(value).collect() }
    }

    fn sky(w: DVec3) -> DVec3 {
        let t = w.dot(DVec3::new(0.6, 0.75, 0.28));
        DVec3::new(0.12, 0.15, 0.2) + DVec3::new(3.0, 2.7, 2.2) * ((1.0 + t) * (t + 0.3).powi(2) / 3.38)
    }

    #[test]
    fn pictures_agree_with_light_looked_for_at_every_step() {
        let density = smoke();
        let medium = Medium { sigma: 12.0, albedo: DVec3::new(0.9, 0.6, 0.3), g: 0.4 };
        let lit = LitVoxels::new(&density, &medium, EYE, &distant_lights(24, sky));
        let (mut difference, mut power, mut darkest) = (0.0, 0.0, 1.0f64);
        for i in 0..100 {
            let target = DVec3::new(f64::from(i % 10) - 4.5, f64::from(i / 10) - 4.5, 0.0) / 12.0;
            let ray = Ray::new(EYE, (target - EYE).normalize());
            let (expected, transmittance) = single_scattering(&density, &medium, &ray, 24, sky);
            let (found, found_transmittance) = lit.march(&ray);
            assert!((found_transmittance - transmittance).abs() < 1e-12, "the same density in the same steps");
            difference += (found - expected).length_squared();
            power += expected.length_squared();
            darkest = darkest.min(transmittance);
        }
        let error = (difference / power).sqrt();
        println!("relative difference {error:.5}, least transmittance {darkest:.3}");
        assert!(darkest < 0.3);
        // Cells of 0.36 mean free paths where it is densest, and blobs of 2.5 cells: interpolation's second order.
        assert!(error < 0.01, "{error}");
    }

    #[test]
    fn source_radiance_is_that_of_the_voxel_itself() {
        // A ray of single steps: at the voxel's centre, the source of `single_scattering` is what the march emits.
        let density = smoke();
        let medium = Medium { sigma: 5.0, albedo: DVec3::ONE, g: -0.3 };
        let lit = LitVoxels::new(&density, &medium, EYE, &distant_lights(16, sky));
        let cell = UVec3::new(9, 8, 12);
        let x = center(density.shape, cell);
        let ray = Ray::new(EYE, (x - EYE).normalize());
        let cell_ray = Ray { origin: x - ray.dir * 1e-5, t_max: 2e-5, ..ray };
        let (expected, transmittance) = single_scattering(&density, &medium, &cell_ray, 16, sky);
        let texel = lit.sample(x);
        let found = texel.truncate() / texel.w;
        let expected = expected / (1.0 - transmittance);
        // The same midpoints but for where the last step ends: here at the smoke's end, there at the box's face.
        assert!(((found - expected) / expected).abs().max_element() < 2e-3, "{found} for {expected}");
    }

    #[test]
    fn smoke_at_the_faces_ends_there() {
        // A full box: ½ · (1 + ½)/2 of a cell's density between the outermost centres and the faces on either side.
        let shape = GridShape::new(UVec3::new(6, 4, 5));
        let smoke = Smoke::new(&Grid { shape, values: vec![2.0; shape.len()] }, GridShape::new(shape.dims + 2));
        let from = DVec3::new(1.0, 2.0, 3.0);
        assert!((smoke.column(from, DVec3::X) - 2.0 * (5.0 + 0.375)).abs() < 1e-12);
        assert!((smoke.column(from, DVec3::NEG_Y) - 2.0 * (1.0 + 0.375)).abs() < 1e-12);
        // A single voxel in an empty box reaches a cell each way: ∫ (1 − t) dt.
        let values = (0..shape.len()).map(|index| f64::from(shape.cell(index) == UVec3::new(2, 1, 2))).collect();
        let smoke = Smoke::new(&Grid { shape, values }, GridShape::new(shape.dims + 2));
        assert!((smoke.column(DVec3::new(3.0, 2.0, 3.0), DVec3::Z) - 0.5).abs() < 1e-12);
    }

    #[test]
    fn all_light_is_gathered() {
        let total = |lights: &[DistantLight]| lights.iter().map(|light| light.irradiance).sum::<DVec3>();
        let lights = gathered_lights(20, [32, 16], |w| DVec3::new(1.0, 1.0 + w.y, 0.0));
        assert!((total(&lights) / (4.0 * PI) - DVec3::new(1.0, 1.0, 0.0)).abs().max_element() < 1e-12);
        // Light from one texel goes to the direction nearest to it.
        let sun = DVec3::new(0.6, 0.48, 0.64);
        let lights = gathered_lights(20, [64, 32], |w| DVec3::splat(f64::from(w.dot(sun) > 0.996)));
        let lit: Vec<_> = lights.iter().filter(|light| light.irradiance.x > 0.0).collect();
        let nearest = fibonacci(20).max_by(|a, b| a.dot(sun).total_cmp(&b.dot(sun))).unwrap();
        assert!(lit.iter().any(|light| light.direction == nearest) && lit.len() < 4, "{lit:?}");
    }
}
