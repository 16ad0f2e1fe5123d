//! Lights: an environment becomes a constellation of distant lights of about the same energy, by median cut (Debevec 2005,
//! *A median cut algorithm for light probe sampling*).

use core::f64::consts::PI;

use glam::{DVec3, UVec2, UVec4};

use crate::{reference::voxel_single::DistantLight, sh::ShRgb};

/// Columns and rows of the grid that the passes resample environments to.
pub const GRID: UVec2 = UVec2::new(128, 64);

/// Energies this close to the largest, and cuts this close to the middle, are as good as those: rounding must not decide.
const CLOSE: f64 = 1e-4;
/// Threads of the pass, among which the largest is found.
const THREADS: usize = 256;

/// A latitude-longitude grid of radiance, as an equirectangular image: see [`equirect`](crate::reference::environment::equirect).
#[derive(Clone, Debug, PartialEq)]
pub struct RadianceGrid {
    /// Columns and rows.
    pub size: UVec2,
    /// The mean radiance over each texel's solid angle; rows from the top.
    pub radiance: Vec<DVec3>,
}

/// Distant lights that together are an environment.
#[derive(Clone, Debug, PartialEq)]
pub struct Constellation {
    /// Directions in the environment's axes.
    pub lights: Vec<DistantLight>,
    /// Radiance, the mean over all directions: the sum of the lights over 4π.
    pub mean: DVec3,
}

/// The direction of a point of a grid or image, u and v from 0 to 1.
fn direction(u: f64, v: f64) -> DVec3 {
    let (phi, theta) = (2.0 * PI * u, PI * v);
    DVec3::new(phi.sin() * theta.sin(), theta.cos(), -phi.cos() * theta.sin())
}

fn luminance(color: DVec3) -> f64 {
    color.dot(DVec3::new(0.2126, 0.7152, 0.0722))
}

impl RadianceGrid {
    /// An equirectangular image with rows of `width` texels, each texel of the grid the mean of what is under it, by solid
    /// angle: no light is lost.
    pub fn of_equirect(size: UVec2, width: usize, texels: &[DVec3]) -> Self {
        let image = glam::USizeVec2::new(width, texels.len() / width.max(1));
        let mean = |at: UVec2| {
            let low = at.as_dvec2() * image.as_dvec2() / size.as_dvec2();
            let high = (at + 1).as_dvec2() * image.as_dvec2() / size.as_dvec2();
            let (mut sum, mut weights) = (DVec3::ZERO, 0.0);
            for y in low.y as usize..(high.y.ceil() as usize).min(image.y) {
                let height = |row: f64| (row * PI / image.y as f64).cos();
                let band = height(low.y.max(y as f64)) - height(high.y.min(y as f64 + 1.0));
                for x in low.x as usize..(high.x.ceil() as usize).min(image.x) {
                    let weight = band * (high.x.min(x as f64 + 1.0) - low.x.max(x as f64)).max(0.0);
                    sum += texels[x + image.x * y] * weight;
                    weights += weight;
                }
            }
            sum / weights
        };
        Self::from_fn(size, mean)
    }

    /// Any radiance by unit vector, each texel the mean of `samples`² directions in it; negative radiance is none.
    pub fn of_directions(size: UVec2, samples: u32, radiance: impl Fn(DVec3) -> DVec3) -> Self {
        let mean = |at: UVec2| {
            let (mut sum, mut weights) = (DVec3::ZERO, 0.0);
            for (y, x) in (0..samples).flat_map(|y| (0..samples).map(move |x| (y, x))) {
                let within = (UVec2::new(x, y).as_dvec2() + 0.5) / f64::from(samples);
                let uv = (at.as_dvec2() + within) / size.as_dvec2();
                let weight = (PI * uv.y).sin();
                sum += radiance(direction(uv.x, uv.y)).max(DVec3::ZERO) * weight;
                weights += weight;
            }
            sum / weights
        };
        Self::from_fn(size, mean)
    }

    /// Spherical-harmonic coefficients; four bands are smooth over a texel, and two samples a side are enough.
    pub fn of_coefficients(size: UVec2, coefficients: &ShRgb) -> Self {
        Self::of_directions(size, 2, |direction| coefficients.evaluate(direction))
    }

    fn from_fn(size: UVec2, mean: impl Fn(UVec2) -> DVec3) -> Self {
        let radiance = (0..size.element_product()).map(|i| mean(UVec2::new(i % size.x, i / size.x))).collect();
        Self { size, radiance }
    }

    /// The same brighter, and with light from everywhere on top.
    pub fn scaled(&self, scale: f64, ambient: DVec3) -> Self {
        Self { size: self.size, radiance: self.radiance.iter().map(|radiance| *radiance * scale + ambient).collect() }
    }

    /// Radiance times solid angle, exact for a row.
    fn irradiance(&self, x: u32, y: u32) -> DVec3 {
        let height = |row: u32| (PI * f64::from(row) / f64::from(self.size.y)).cos();
        let solid_angle = (height(y) - height(y + 1)) * 2.0 * PI / f64::from(self.size.x);
        self.radiance[(x + self.size.x * y) as usize] * solid_angle
    }

    /// Columns x to z, rows y to w.
    fn texels(&self, region: UVec4) -> impl Iterator<Item = (DVec3, DVec3)> {
        (region.y..region.w).flat_map(move |y| (region.x..region.z).map(move |x| (x, y))).map(move |(x, y)| {
            let (u, v) = (f64::from(x) + 0.5, f64::from(y) + 0.5);
            (direction(u / f64::from(self.size.x), v / f64::from(self.size.y)), self.irradiance(x, y))
        })
    }

    fn energy(&self, region: UVec4) -> f64 {
        self.texels(region).map(|(_, irradiance)| luminance(irradiance)).sum()
    }

    /// Whether a region is cut across its columns: its longer side, where the middle row's texels are as wide as high on the
    /// equator.
    fn is_wide(&self, region: UVec4) -> bool {
        let (columns, rows) = (f64::from(region.z - region.x), f64::from(region.w - region.y));
        let width = columns * (0.5 * PI * f64::from(region.y + region.w) / f64::from(self.size.y)).sin();
        rows < 2.0 || (columns > 1.0 && width >= rows)
    }

    /// Cuts the region with the most energy in two until there are `count`, where both parts have most nearly the same; each
    /// then is a light from its centroid (weighted by energy) with all of its irradiance.
    pub fn median_cut(&self, count: usize) -> Constellation {
        let mut regions = vec![UVec4::new(0, 0, self.size.x, self.size.y)];
        let all = self.energy(regions[0]);
        while regions.len() < count {
            let energies = regions.iter().map(|region| {
                let can_be_cut = region.z - region.x > 1 || region.w - region.y > 1;
                if can_be_cut { self.energy(*region) } else { -1.0 }
            });
            let chosen = largest(energies, CLOSE * all / regions.len() as f64);
            let region = regions[chosen];
            let wide = self.is_wide(region);
            let first = |cut: u32| match wide {
                true => UVec4::new(region.x, region.y, region.x + cut, region.w),
                false => UVec4::new(region.x, region.y, region.z, region.y + cut),
            };
            let cuts = 1..if wide { region.z - region.x } else { region.w - region.y };
            let half = 0.5 * self.energy(region);
            let off = cuts.map(|cut| -(self.energy(first(cut)) - half).abs());
            let first = first(1 + largest(off, CLOSE * 2.0 * half) as u32);
            regions[chosen] = first;
            regions.push(match wide {
                true => UVec4::new(first.z, region.y, region.z, region.w),
                false => UVec4::new(region.x, first.w, region.z, region.w),
            });
        }
        let lights: Vec<_> = regions.into_iter().map(|region| self.light(region)).collect();
        let mean = lights.iter().map(|light| light.irradiance).sum::<DVec3>() / (4.0 * PI);
        Constellation { lights, mean }
    }

    fn light(&self, region: UVec4) -> DistantLight {
        let irradiance: DVec3 = self.texels(region).map(|(_, irradiance)| irradiance).sum();
        let towards: DVec3 = self.texels(region).map(|(direction, part)| direction * luminance(part)).sum();
        let middle = |low: u32, high: u32, size: u32| 0.5 * f64::from(low + high) / f64::from(size);
        // Dark regions, and light from all around, have no centroid.
        let direction = match towards.length() > 1e-4 * luminance(irradiance) {
            true => towards.normalize(),
            false => direction(middle(region.x, region.z, self.size.x), middle(region.y, region.w, self.size.y)),
        };
        DistantLight { direction, irradiance }
    }
}

/// The place of the largest value; of two that the threads of the pass compare, the one with the lower number unless the other
/// is larger by a margin.
fn largest(values: impl Iterator<Item = f64>, margin: f64) -> usize {
    let mut all: Vec<(f64, usize)> = values.zip(0..).collect();
    all.resize(THREADS, (-1e38, 0));
    let mut reach = THREADS / 2;
    while reach > 0 {
        for thread in 0..reach {
            if all[thread + reach].0 > all[thread].0 + margin {
                all[thread] = all[thread + reach];
            }
        }
        reach /= 2;
    }
    all[0].1
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sh::fibonacci;
    use glam::DMat3;

    fn sky(direction: DVec3) -> DVec3 {
        let sun = (40.0 * (direction.dot(DVec3::new(0.3, 0.8, 0.52).normalize()) - 1.0)).exp();
        DVec3::new(1.0, 0.9, 0.7) * (30.0 * sun) + DVec3::new(0.2, 0.3, 0.5) * (1.0 + direction.y)
    }

    fn integral(grid: &RadianceGrid) -> DVec3 {
        grid.texels(UVec4::new(0, 0, grid.size.x, grid.size.y)).map(|(_, irradiance)| irradiance).sum()
    }

    #[test]
    fn resampling_keeps_every_bit_of_light() {
        // Whatever the sizes: smaller, larger, no multiples.
        let noise = |i: usize| DVec3::new((i * 7 % 11) as f64, (i * 5 % 13) as f64, f64::from(i == 77) * 1e4);
        for (width, height) in [(50, 23), (128, 64), (300, 150), (3, 2)] {
            let texels: Vec<_> = (0..width * height).map(noise).collect();
            let image = RadianceGrid { size: UVec2::new(width as u32, height as u32), radiance: texels.clone() };
            let grid = RadianceGrid::of_equirect(GRID, width, &texels);
            let (found, expected) = (integral(&grid), integral(&image));
            assert!((found - expected).abs().max_element() < 1e-11 * expected.max_element(), "{found} for {expected}");
        }
    }

    #[test]
    fn lights_are_the_integral_and_point_where_light_comes_from() {
        let grid = RadianceGrid::of_directions(GRID, 2, sky);
        for count in [1, 2, 3, 16, 23, 100, 256] {
            let constellation = grid.median_cut(count);
            assert_eq!(constellation.lights.len(), count);
            let sum: DVec3 = constellation.lights.iter().map(|light| light.irradiance).sum();
            assert!((sum / integral(&grid) - 1.0).abs().max_element() < 1e-12, "{count}: {sum}");
            assert!((constellation.mean * 4.0 * PI / sum - 1.0).abs().max_element() < 1e-12);
            assert!(constellation.lights.iter().all(|light| (light.direction.length() - 1.0).abs() < 1e-12));
        }
        // Energies within a factor of 3 of each other; regions with the sun's core are the last to be even.
        let energies: Vec<f64> = grid.median_cut(64).lights.iter().map(|light| luminance(light.irradiance)).collect();
        let (low, high) = energies.iter().fold((f64::MAX, 0.0f64), |(l, h), e| (l.min(*e), h.max(*e)));
        assert!(high < 3.0 * low, "{low} {high}");
    }

    #[test]
    fn a_constant_sky_is_cut_into_even_lights() {
        let grid = RadianceGrid::of_directions(GRID, 1, |_| DVec3::ONE);
        let lights = grid.median_cut(16).lights;
        for light in &lights {
            // Cuts lie between texels: rows near the equator hold a fortieth of a half.
            assert!((light.irradiance.x / (4.0 * PI / 16.0) - 1.0).abs() < 0.1, "{}", light.irradiance.x);
        }
        // Nothing is favoured: they add up to no direction.
        let sum: DVec3 = lights.iter().map(|light| light.direction * light.irradiance.x).sum();
        assert!(sum.length() < 0.02 * 4.0 * PI, "{sum}");
    }

    #[test]
    fn one_bright_texel_is_a_light_of_its_own() {
        let mut grid = RadianceGrid::of_directions(GRID, 1, |_| DVec3::splat(0.1));
        grid.radiance[128 * 20 + 70] = DVec3::splat(1e5);
        let lights = grid.median_cut(16).lights;
        let brightest = lights.iter().max_by(|a, b| a.irradiance.x.total_cmp(&b.irradiance.x)).unwrap();
        let expected = direction(70.5 / 128.0, 20.5 / 64.0);
        assert!(brightest.direction.angle_between(expected) < 1e-3);
        assert!((brightest.irradiance.x / grid.irradiance(70, 20).x - 1.0).abs() < 1e-3);
    }

    #[test]
    fn no_light_is_no_trouble() {
        let black = RadianceGrid::of_directions(GRID, 1, |_| DVec3::ZERO).median_cut(40);
        assert!(black.lights.iter().all(|light| light.irradiance == DVec3::ZERO && light.direction.is_finite()));
        assert_eq!(black.mean, DVec3::ZERO);
    }

    #[test]
    fn negative_lobes_are_dark() {
        let lobes = ShRgb::zonal(DVec3::Y, &[0.5, 1.0, 0.0, 0.0], DVec3::ONE);
        let below = fibonacci(100).filter(|direction| lobes.evaluate(*direction).x < 0.0).count();
        assert!(below > 10);
        let grid = RadianceGrid::of_coefficients(GRID, &lobes);
        assert!(grid.radiance.iter().all(|radiance| radiance.min_element() >= 0.0));
    }

    #[test]
    fn irradiance_from_a_constellation_converges() {
        // A cosine-weighted integral over the upper half, by 4 to 256 lights: what diffuse surfaces make of the sky.
        let grid = RadianceGrid::of_directions(GRID, 2, sky);
        let normal = DMat3::from_rotation_x(0.4) * DVec3::Y;
        let whole = UVec4::new(0, 0, GRID.x, GRID.y);
        let exact: f64 = grid.texels(whole).map(|(w, e)| e.x * w.dot(normal).max(0.0)).sum();
        let error = |count| {
            let lights = grid.median_cut(count).lights;
            let sum: f64 = lights.iter().map(|l| l.irradiance.x * l.direction.dot(normal).max(0.0)).sum();
            (sum / exact - 1.0).abs()
        };
        let errors = [4, 16, 64, 256].map(error);
        println!("{errors:?}");
        assert!(errors[0] < 0.1 && errors[2] < 0.01 && errors[3] < 0.003, "{errors:?}");
    }
}
