//! What surfaces receive of sky and lamps through smoke: the truth that shadows of smoke are measured against.
//!
//! Direct light alone: straight from its source, not scattered on its way. Deterministic: no stepping through the density,
//! whose trilinear interpolation is integrated exactly, and directions where there is smoke to look through. Transmittance
//! T needs to be known only within the cone in which the box is seen, and what is missing there is smooth:
//!
//! E(x, n) = ∫ L V max(n·ω, 0) dω − ∫ L V (1−T) max(n·ω, 0) dω, the second integral over that cone.

use core::{f64::consts::PI, iter::Sum, ops::Add};

use glam::{DVec3, IVec3, UVec3};

use super::{
    Grid, Ray, cell_size, half_extent,
    path::{Environment, Light, turned},
    surface::Surfaces,
};
use crate::{density::GridShape, optics::transmittance};

/// Directions over the cone in which the box is seen. On a floor under a plume, on a wall beside it and within it, a quarter
/// as many are within 0.1 % of the irradiance, and these within 0.02 %.
const CONE: usize = 4096;
/// Directions over the hemisphere, without smoke.
const HEMISPHERE: usize = 65_536;
/// Directions over the disc of a sun.
const DISC: usize = 64;

/// Smoke and surfaces under an environment and lights, in bundle space.
pub struct Receiving<'a> {
    /// The smoke's density.
    pub columns: Columns,
    /// Extinction per bundle unit and unit of density.
    pub sigma: f64,
    /// Light from infinitely far away; one that is a function is to be smooth.
    pub environment: Environment<'a>,
    /// Sharp lights.
    pub lights: &'a [Light],
    /// What blocks light beside the smoke.
    pub surfaces: &'a Surfaces,
}

/// What a surface receives, RGB.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Irradiance {
    /// As if there were no smoke.
    pub clear: DVec3,
    /// Through the smoke.
    pub shaded: DVec3,
}

impl Receiving<'_> {
    /// The light of sky and lights at `x`, on a surface with the unit normal `n` there.
    pub fn irradiance(&self, x: DVec3, n: DVec3) -> Irradiance {
        self.sky(x, n) + self.lights(x, n)
    }

    /// The environment's part.
    pub fn sky(&self, x: DVec3, n: DVec3) -> Irradiance {
        match self.environment {
            Environment::Function(radiance) => self.smooth_sky(x, n, radiance, CONE),
            Environment::Image(image) => image
                .texels()
                .filter(|(w, light)| n.dot(*w) > 0.0 && *light != DVec3::ZERO)
                .map(|(w, light)| self.arriving(&Ray::new(x, w), light * n.dot(w)))
                .sum(),
        }
    }

    /// That of a smooth environment, with so many directions over the cone of the box.
    fn smooth_sky(&self, x: DVec3, n: DVec3, radiance: &dyn Fn(DVec3) -> DVec3, cone: usize) -> Irradiance {
        // Evenly by the cosine's weight: cos² from 1 down to 0.
        let hemisphere = spiral(n, HEMISPHERE, |u| (1.0 - u).sqrt());
        let seen = |w: &DVec3| !self.surfaces.block(&Ray::new(x, *w));
        let clear = hemisphere.filter(seen).map(radiance).sum::<DVec3>() * (PI / HEMISPHERE as f64);

        let (away, distance) = (-x).normalize_and_length();
        let reach = half_extent(self.columns.shape).length();
        let edge = if distance > reach { (1.0 - (reach / distance).powi(2)).sqrt() } else { -1.0 };
        let axis = if distance > 0.0 { away } else { n };
        let missing = |w: DVec3| {
            let cos = n.dot(w);
            let ray = Ray::new(x, w);
            if cos <= 0.0 || self.surfaces.block(&ray) {
                return DVec3::ZERO;
            }
            radiance(w) * (cos * (1.0 - self.transmittance(&ray)))
        };
        let solid_angle = 2.0 * PI * (1.0 - edge) / cone as f64;
        let missing = spiral(axis, cone, |u| 1.0 - u * (1.0 - edge)).map(missing).sum::<DVec3>() * solid_angle;
        Irradiance { clear, shaded: clear - missing }
    }

    /// The lights' part.
    pub fn lights(&self, x: DVec3, n: DVec3) -> Irradiance {
        let rays = spread(DISC).flat_map(|place| self.lights.iter().filter_map(move |light| light.ray(x, place)));
        rays.map(|(ray, light)| self.arriving(&ray, light * (n.dot(ray.dir).max(0.0) / DISC as f64))).sum()
    }

    /// What is left of `light` along `ray`.
    fn arriving(&self, ray: &Ray, light: DVec3) -> Irradiance {
        if light == DVec3::ZERO || self.surfaces.block(ray) {
            return Irradiance::default();
        }
        Irradiance { clear: light, shaded: light * self.transmittance(ray) }
    }

    /// The share of light that passes the smoke along `ray`.
    pub fn transmittance(&self, ray: &Ray) -> f64 {
        transmittance(self.sigma * self.columns.column(ray))
    }
}

impl Add for Irradiance {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self { clear: self.clear + other.clear, shaded: self.shaded + other.shaded }
    }
}

impl Sum for Irradiance {
    fn sum<I: Iterator<Item = Self>>(parts: I) -> Self {
        parts.fold(Self::default(), Add::add)
    }
}

/// Exact integrals of a trilinear density along rays, within its box.
pub struct Columns {
    shape: GridShape,
    /// Density at the cells of the box and one more, empty, on every side.
    padded: Vec<f64>,
    /// Whether there is any density in the cube between eight of these cells, by the lowest of them.
    occupied: Vec<bool>,
}

impl Columns {
    /// Of a density that is at least 0 everywhere.
    pub fn new(density: &Grid) -> Self {
        let shape = density.shape;
        let around = GridShape::new(shape.dims + 2);
        let mut padded = vec![0.0; around.len()];
        for (index, &value) in density.values.iter().enumerate() {
            padded[around.index(shape.cell(index) + 1)] = value;
        }
        let mut occupied = vec![false; around.len()];
        for index in (0..around.len()).filter(|&index| padded[index] > 0.0) {
            // A cell with density is never on the padding's own face.
            let cell = around.cell(index);
            for corner in 0..8 {
                occupied[around.index(cell - UVec3::new(corner & 1, corner >> 1 & 1, corner >> 2))] = true;
            }
        }
        Self { shape, padded, occupied }
    }

    /// ∫ of the density along `ray`. Between cells it is a cubic polynomial along the ray, whose integral two points give.
    pub fn column(&self, ray: &Ray) -> f64 {
        let Some((mut t, end)) = ray.clip(half_extent(self.shape)) else {
            return 0.0;
        };
        // In cells, from the centre of the padding's first.
        let origin = ray.origin / cell_size(self.shape) + 0.5 * self.shape.dims.as_dvec3() + 0.5;
        let dir = ray.dir / cell_size(self.shape);
        // Rounding may put the start into a neighbouring cube: the first stretch is then empty.
        let mut cube = (origin + dir * t).floor().as_ivec3().clamp(IVec3::ZERO, self.shape.dims.as_ivec3());
        let step = dir.map(|d| if d > 0.0 { 1.0 } else { -1.0 }).as_ivec3();
        let between = (1.0 / dir).abs();
        let mut exits = ((cube + step.max(IVec3::ZERO)).as_dvec3() - origin) / dir;
        for axis in 0..3 {
            if dir[axis] == 0.0 {
                exits[axis] = f64::INFINITY;
            }
        }
        let mut sum = 0.0;
        while t < end {
            let axis = if exits.x < exits.y { 0 } else { 1 };
            let axis = if exits.z < exits[axis] { 2 } else { axis };
            let exit = exits[axis].min(end);
            if exit > t {
                let half = 0.5 * (exit - t);
                let inside = origin + dir * (t + half) - cube.as_dvec3();
                sum += half * self.sum_at(cube.as_uvec3(), inside, dir * (half / 3f64.sqrt()));
                t = exit;
            }
            exits[axis] += between[axis];
            cube[axis] += step[axis];
        }
        sum
    }

    /// The sum of the densities at p − `offset` and p + `offset`, p measured in cells from the lowest of a cube's eight.
    fn sum_at(&self, cube: UVec3, p: DVec3, offset: DVec3) -> f64 {
        let (row, layer) =
            ((self.shape.dims.x + 2) as usize, ((self.shape.dims.x + 2) * (self.shape.dims.y + 2)) as usize);
        let first = cube.x as usize + row * cube.y as usize + layer * cube.z as usize;
        if !self.occupied[first] {
            return 0.0;
        }
        let corners: [f64; 8] =
            core::array::from_fn(|i| self.padded[first + (i & 1) + row * (i >> 1 & 1) + layer * (i >> 2)]);
        let at = |p: DVec3| {
            let x: [f64; 4] = core::array::from_fn(|i| corners[2 * i] + p.x * (corners[2 * i + 1] - corners[2 * i]));
            let [near, far] = [x[0] + p.y * (x[1] - x[0]), x[2] + p.y * (x[3] - x[2])];
            near + p.z * (far - near)
        };
        at(p - offset) + at(p + offset)
    }
}

/// `count` directions on a Fibonacci spiral about `axis`, a unit vector; `cosine` is that to the axis of a number that runs
/// evenly from 0 to 1.
fn spiral(axis: DVec3, count: usize, cosine: impl Fn(f64) -> f64) -> impl Iterator<Item = DVec3> {
    spread(count).map(move |[u, turn]| turned(axis, cosine(u), turn))
}

/// Pairs of numbers from 0 to 1 that cover the square evenly, the second as the turns of a Fibonacci spiral.
fn spread(count: usize) -> impl Iterator<Item = [f64; 2]> {
    const GOLDEN_RATIO: f64 = 0.618_033_988_749_894_9;
    (0..count).map(move |j| [(j as f64 + 0.5) / count as f64, (j as f64 * GOLDEN_RATIO).fract()])
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::reference::{
        center,
        path::EquirectImage,
        surface::{Plane, Sphere},
    };
    use crate::{optics::gaussian_column, sh::fibonacci};

    fn grid(dims: [u32; 3], density: impl Fn(DVec3) -> f64) -> Grid {
        let shape = GridShape::new(UVec3::from(dims));
        Grid { shape, values: (0..shape.len()).map(|i| density(center(shape, shape.cell(i)))).collect() }
    }

    fn receiving<'a>(density: &Grid, environment: Environment<'a>, surfaces: &'a Surfaces) -> Receiving<'a> {
        Receiving { columns: Columns::new(density), sigma: 6.0, environment, lights: &[], surfaces }
    }

    fn one(_: DVec3) -> DVec3 {
        DVec3::ONE
    }

    #[test]
    fn columns_are_exact() {
        let noise = |x: DVec3| ((13.0 * x.x).sin() * (27.0 * x.y).cos() + (9.0 * x.z).sin()).max(0.0);
        let density = grid([20, 16, 12], noise);
        let columns = Columns::new(&density);
        for (i, dir) in fibonacci(60).enumerate() {
            let toward = DVec3::new(0.1, -0.15, 0.02) * (i % 3) as f64;
            // From outside, and from within.
            for ray in [Ray::new(toward - dir * 2.0, dir), Ray::new(toward, dir)] {
                // Midpoints of 40 000 steps: second order, and 1e-8 of a column of some 0.3.
                let (start, end) = ray.clip(half_extent(density.shape)).unwrap();
                let step = (end - start) / 4e4;
                let sum: f64 = (0..40_000).map(|i| density.sample(ray.at(start + (f64::from(i) + 0.5) * step))).sum();
                let column = columns.column(&ray);
                assert!((column - sum * step).abs() < 1e-7, "{column} for {}", sum * step);
            }
        }
        // Along an axis, through cells' centres and on the box's face.
        let row = |y: f64| columns.column(&Ray::new(DVec3::new(-2.0, y, 0.025), DVec3::X));
        let middle = density.values[20 * (4 + 16 * 6)..][..20].iter().sum::<f64>() / 20.0;
        // The ramps at the ends are cut off at the box's faces, where three quarters of each half cell's worth is left.
        let ends = [0, 19].map(|x| density.values[density.shape.index(UVec3::new(x, 4, 6))]).iter().sum::<f64>();
        assert!((row(-0.175) - (middle - 0.125 * ends / 20.0)).abs() < 1e-14);
        assert_eq!(columns.column(&Ray::new(DVec3::new(-2.0, 0.6, 0.0), DVec3::X)), 0.0);
    }

    #[test]
    fn a_ball_takes_its_form_factor() {
        // Of a constant sky a ball wholly above the horizon hides π (r/d)² cos θ.
        let empty = grid([8, 8, 8], |_| 0.0);
        let (ball, n) = (Sphere { center: DVec3::Y, radius: 0.4, albedo: DVec3::ZERO }, DVec3::Y);
        let surfaces = Surfaces { plane: Some(Plane { y: 0.0, albedo: DVec3::ONE }), spheres: vec![ball] };
        let scene = receiving(&empty, Environment::Function(&one), &surfaces);
        let image = EquirectImage::new(512, vec![Vec3::ONE; 512 * 256]);
        let pictured = receiving(&empty, Environment::Image(&image), &surfaces);
        for x in [0.0, 0.5, 1.5] {
            let x = DVec3::X * x;
            let d = ball.center - x;
            let expected = PI * (1.0 - (0.4 / d.length()).powi(2) * d.y / d.length());
            let [a, b] = [&scene, &pictured].map(|scene| scene.irradiance(x, n).shaded.x / expected);
            // Directions at the ball's edge are counted or not: few of 65 536; of texels of 0.7°, straight under the ball,
            // half a row, which is 3 % of the 16 % that it hides.
            assert!((a - 1.0).abs() < 1e-3 && (b - 1.0).abs() < 6e-3, "{a} {b}");
        }
    }

    #[test]
    fn a_gaussian_shades_as_its_exact_columns_do() {
        // Against directions all around and the closed form of the column; 24 cells to a radius.
        let (c, r) = (DVec3::new(0.05, 0.02, -0.03), 0.12);
        let density = grid([96, 96, 96], |x| (-(x - c).length_squared() / (r * r)).exp());
        let none = Surfaces::default();
        let sky = |w: DVec3| DVec3::new(1.0 + w.y, 1.0, 1.0 - w.x);
        let scene = receiving(&density, Environment::Function(&sky), &none);
        let rule = crate::sh::SphereRule::new(160);
        for (x, n) in [
            (DVec3::new(0.3, -0.7, 0.1), DVec3::Y),
            (DVec3::new(-0.9, 0.1, 0.1), DVec3::new(0.6, 0.8, 0.0)),
            (DVec3::new(0.1, 0.0, -0.1), DVec3::Y),
        ] {
            let seen = |w: DVec3| sky(w) * (n.dot(w).max(0.0) * (-6.0 * gaussian_column(x, w, c, r, 1.0)).exp());
            let expected = rule.integrate(seen);
            let found = scene.irradiance(x, n);
            // Trilinear interpolation widens the Gaussian: 1/6 of a cell's square to r²/2 = 66 of them, of a shadow that
            // is up to half the light.
            let error = (found.shaded / expected - 1.0).abs().max_element();
            assert!(error < 1.5e-3 && found.shaded.cmplt(found.clear).all(), "{error}");
        }
    }

    #[test]
    fn the_cone_has_directions_enough() {
        // Smoke of a few cells' size, seen from a fifth of the box below it, from its side and from within.
        let noise = |x: DVec3| ((23.0 * x.x).sin() * (37.0 * x.y).cos() + (19.0 * x.z).sin()).max(0.0);
        let density = grid([20, 40, 20], noise);
        let none = Surfaces::default();
        let sky = |w: DVec3| DVec3::splat(1.0 + w.y);
        let scene = receiving(&density, Environment::Function(&sky), &none);
        for (x, n) in [
            (DVec3::new(0.1, -0.7, 0.2), DVec3::Y),
            (DVec3::new(0.4, 0.2, 0.0), DVec3::new(-0.6, 0.8, 0.0)),
            (DVec3::new(0.1, 0.0, 0.05), DVec3::Y),
        ] {
            let [few, many] = [CONE / 4, 4 * CONE].map(|cone| scene.smooth_sky(x, n, &sky, cone).shaded.x);
            // The error falls at least with the directions: a quarter as many are 16 times as far off as those used are
            // at most, and 0.3 % of them would be too much.
            assert!((few / many - 1.0).abs() < 1e-3, "{few} {many}");
        }
    }

    #[test]
    fn lights_are_dimmed_along_their_rays() {
        let density = grid([16, 16, 16], |_| 1.0);
        let none = Surfaces::default();
        let position = DVec3::new(0.0, 1.0, 0.0);
        let lights = [
            Light::Sun { direction: DVec3::new(0.0, 0.8, 0.6), irradiance: DVec3::ONE, angle: 0.0 },
            Light::Point { position, intensity: DVec3::splat(2.0) },
        ];
        let night = |_: DVec3| DVec3::ZERO;
        let at = |lights: &[Light], x: DVec3| {
            let scene = Receiving { lights, ..receiving(&density, Environment::Function(&night), &none) };
            scene.irradiance(x, DVec3::Y)
        };
        let below = DVec3::NEG_Y;
        // 15 cells of 16, and what is left of the outer halves.
        let depth: f64 = 6.0 * (15.0 + 0.75) / 16.0;
        let lamp = at(&lights[1..], below);
        assert!((lamp.clear.x - 0.5).abs() < 1e-14 && (lamp.shaded.x / (0.5 * (-depth).exp()) - 1.0).abs() < 1e-12);
        let sun = at(&lights[..1], DVec3::new(0.0, -1.0, 3.0));
        assert!((sun.clear - 0.8).length() < 1e-14 && sun.shaded == sun.clear);
        // From within the smoke, and the lamp within it: 0.25 of the box between them.
        let lamp = [Light::Point { position: DVec3::Y * 0.2, intensity: DVec3::ONE }];
        let found = at(&lamp, DVec3::NEG_Y * 0.05);
        assert!((found.shaded.x / found.clear.x / (-6.0 * 0.25f64).exp() - 1.0).abs() < 1e-12);
    }
}
