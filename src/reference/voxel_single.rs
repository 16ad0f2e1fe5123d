//! Single scattering without noise, fast enough for every frame of an animation: source radiance once a voxel.
//!
//! [`single`](super::single) looks for light at every step of every view ray. Here each voxel does so, along the same
//! directions, and view rays interpolate what the voxels send to the eye. On a plume of 128 cells the pictures of the two
//! differ by a tenth of a per cent, root mean square.

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
    /// J and D of the box's cells and one more cell on every side; J only where reads that meet smoke touch it.
    texels: Vec<DVec4>,
}

impl LitVoxels {
    /// Single scattering of `lights` toward an eye at `eye`, Ω Σ p E T, at the centre of every voxel that has smoke in it
    /// or in one beside it; T from midpoints of steps of a cell to the end of the smoke.
    pub fn new(density: &Grid, medium: &Medium, eye: DVec3, lights: &[DistantLight]) -> Self {
        let smoke = Smoke::new(density);
        let per_cell = medium.sigma * cell_size(density.shape);
        let source = |cell: UVec3| {
            let view = (smoke.center(cell) - eye).normalize_or_zero();
            // Scattering from ω to the eye turns light from −ω to −v, with v from the eye.
            let scattered = |light: &DistantLight| {
                let phase = henyey_greenstein(light.direction.dot(view), medium.g);
                light.irradiance * (phase * transmittance(per_cell * smoke.column(cell.as_dvec3(), light.direction)))
            };
            medium.albedo * lights.iter().map(scattered).sum::<DVec3>()
        };
        let texel = |index| {
            let cell = smoke.padded.cell(index);
            let source = if smoke.is_near(cell) { source(cell) } else { DVec3::ZERO };
            source.extend(smoke.values[index])
        };
        let texels = (0..smoke.padded.len()).into_par_iter().map(texel).collect();
        Self { shape: density.shape, sigma: medium.sigma, texels }
    }

    /// Media radiance without background, and transmittance, along `ray` from the eye: half-cell steps, each emitting
    /// J(1−e^{−σDΔ}) of the values in its middle.
    pub fn march(&self, ray: &Ray) -> (DVec3, f64) {
        march_with(self.shape, ray, self.sigma, |x| {
            let texel = self.sample(x);
            (texel.truncate(), texel.w)
        })
    }

    /// J and D at a point of the box, trilinear between cell centres.
    fn sample(&self, x: DVec3) -> DVec4 {
        let position = x / cell_size(self.shape) + 0.5 * self.shape.dims.as_dvec3() + 0.5;
        trilinear(&self.texels, self.shape.dims + 2, position)
    }
}

/// Density with a margin of one empty cell, and where there is any. Positions are in cells, the centre of the margin's first
/// cell at 0.
struct Smoke {
    shape: GridShape,
    padded: GridShape,
    values: Vec<f64>,
    /// Outside these corners density is 0.
    low: DVec3,
    high: DVec3,
}

impl Smoke {
    fn new(density: &Grid) -> Self {
        let shape = density.shape;
        let padded = GridShape::new(shape.dims + 2);
        let mut values = vec![0.0; padded.len()];
        let (mut low, mut high) = (UVec3::MAX, UVec3::ZERO);
        for (index, &value) in density.values.iter().enumerate().filter(|(_, value)| **value > 0.0) {
            let cell = shape.cell(index) + 1;
            values[padded.index(cell)] = value;
            (low, high) = (low.min(cell), high.max(cell));
        }
        // Trilinear density reaches one cell beyond the outermost voxels, but not out of the box.
        let low = (low.as_dvec3() - 1.0).max(DVec3::splat(0.5));
        let high = (high.as_dvec3() + 1.0).min(shape.dims.as_dvec3() + 0.5);
        Self { shape, padded, values, low, high }
    }

    /// The centre of a cell in bundle space.
    fn center(&self, cell: UVec3) -> DVec3 {
        center(self.shape, cell) - cell_size(self.shape)
    }

    /// Whether a trilinear read that touches this cell may meet smoke.
    fn is_near(&self, cell: UVec3) -> bool {
        let (low, high) = (cell.saturating_sub(UVec3::ONE), (cell + 1).min(self.padded.dims - 1));
        (low.z..=high.z).any(|z| {
            (low.y..=high.y).any(|y| {
                let row = self.padded.index(UVec3::new(0, y, z));
                self.values[row + low.x as usize..=row + high.x as usize].iter().any(|value| *value > 0.0)
            })
        })
    }

    /// ∫ of the density, in cells, along the unit vector `dir` to the smoke's end, by midpoints of steps of a cell. From a
    /// position of the smoke; what is farther out, in the margin, is taken as on its face.
    fn column(&self, from: DVec3, dir: DVec3) -> f64 {
        let from = from.clamp(self.low, self.high);
        let exit = |axis: usize| {
            let face = if dir[axis] > 0.0 { self.high[axis] } else { self.low[axis] };
            if dir[axis] == 0.0 { f64::INFINITY } else { (face - from[axis]) / dir[axis] }
        };
        let length = exit(0).min(exit(1)).min(exit(2));
        let steps = length.ceil().max(1.0);
        let step = length / steps;
        let sample = |i: usize| trilinear(&self.values, self.padded.dims, from + dir * ((i as f64 + 0.5) * step));
        (0..steps as usize).map(sample).sum::<f64>() * step
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

    /// Two blobs and a ripple in a box of 24 × 20 × 22 cells; empty cells around them and between.
    fn smoke() -> Grid {
        let shape = GridShape::new(UVec3::new(24, 20, 22));
        let value = |index| {
            let x = center(shape, shape.cell(index));
            let blob = |at: DVec3, r: f64| (-x.distance_squared(at) / (r * r)).exp();
            let value = blob(DVec3::new(-0.1, -0.1, 0.05), 0.12) + 0.7 * blob(DVec3::new(0.15, 0.12, -0.1), 0.1);
            let value = value * (1.0 + 0.3 * (15.0 * x.x).sin() * (13.0 * x.y).cos());
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
        let medium = Medium { sigma: 6.0, albedo: DVec3::new(0.9, 0.6, 0.3), g: 0.4 };
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
        assert!(darkest < 0.4);
        // A third of a mean free path a cell where it is densest, and blobs of 2.5 cells: interpolation's second order.
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
        let found = lit.sample(x).truncate();
        let expected = expected / (1.0 - transmittance);
        // Steps of a cell for steps of half a cell.
        assert!(((found - expected) / expected).abs().max_element() < 5e-3, "{found} for {expected}");
    }

    #[test]
    fn smoke_at_the_faces_ends_there() {
        // A full box: between the outermost centres and the faces three quarters of half a cell's density are left. Steps of
        // a cell miss up to an eighth of a cell where density bends.
        let shape = GridShape::new(UVec3::new(6, 4, 5));
        let smoke = Smoke::new(&Grid { shape, values: vec![2.0; shape.len()] });
        let from = DVec3::new(1.0, 2.0, 3.0);
        for (dir, cells) in [(DVec3::X, 5.375), (DVec3::NEG_Y, 1.375), (DVec3::NEG_X, 0.375)] {
            let column = smoke.column(from, dir);
            assert!((column - 2.0 * cells).abs() < 2.0 * 0.125, "{column} for {}", 2.0 * cells);
        }
        // A single voxel in an empty box reaches a cell each way: ∫ (1 − t) dt.
        let values = (0..shape.len()).map(|index| f64::from(shape.cell(index) == UVec3::new(2, 1, 2))).collect();
        let smoke = Smoke::new(&Grid { shape, values });
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
