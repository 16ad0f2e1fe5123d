//! Path tracing: the witness where no given reference reaches.
//!
//! Unbiased: no steps, no RBFs, no spherical harmonics; what is left is noise, which falls with the square root of the
//! samples. Distances come from delta tracking (Woodcock 1965) under a coarse grid of majorants, transmittance from
//! ratio tracking (Novák et al. 2014), directions from the phase function itself. Light comes from the environment
//! alone, where a path leaves the box.
//!
//! Error estimates that discount noise need two independent halves: two [`render`]s with different seeds.

use core::{f64::consts::PI, ops::ControlFlow};
use std::sync::atomic::{AtomicUsize, Ordering};

use glam::{DVec3, IVec3, UVec3};
use rayon::prelude::*;

use super::{Grid, Medium, Ray, cell_size, half_extent};
use crate::density::GridShape;
use crate::random::SplitMix64;

/// Cells a side of a block that shares one majorant.
const BLOCK: u32 = 8;
/// Paths that carry less than this (in their brightest channel) play Russian roulette for it.
const ROULETTE: f64 = 0.1;

/// Smoke under an environment, ready to trace.
pub struct Scene<'a> {
    density: &'a Grid,
    medium: Medium,
    environment: &'a (dyn Fn(DVec3) -> DVec3 + Sync),
    /// Blocks of [`BLOCK`]³ cells from the box's lowest corner on; the last ones may stick out.
    blocks: GridShape,
    /// The largest extinction in each block.
    majorants: Vec<f64>,
}

/// Which paths count.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Events {
    /// Those that scatter exactly once.
    Single,
    /// Those that scatter at least once.
    All,
}

impl<'a> Scene<'a> {
    /// Smoke of this density, at least 0 everywhere, under `environment`: radiance by the direction it comes from (a
    /// unit vector), in bundle axes.
    pub fn new(density: &'a Grid, medium: Medium, environment: &'a (dyn Fn(DVec3) -> DVec3 + Sync)) -> Self {
        let dims = density.shape.dims;
        let blocks = GridShape::new(dims.map(|cells| cells.div_ceil(BLOCK)));
        let majorant = |index| {
            // Points of the block reach the cells around it too, for half a cell.
            let low = blocks.cell(index) * BLOCK;
            let [from, to] = [low.saturating_sub(UVec3::ONE), dims.min(low + BLOCK + 1)];
            let cells = |axis: usize| from[axis]..to[axis];
            let rows = cells(2).flat_map(|z| cells(1).map(move |y| (y, z)));
            let values = rows.flat_map(|(y, z)| cells(0).map(move |x| density.shape.index(UVec3::new(x, y, z))));
            medium.sigma * values.map(|i| density.values[i]).fold(0.0, f64::max)
        };
        Self { density, medium, environment, blocks, majorants: (0..blocks.len()).map(majorant).collect() }
    }

    /// Walks along `ray` through tentative collisions, as dense as the majorants; `visit` hears for each the share of
    /// it that is real (0 to 1), and may end the walk there. Returns the distance where it did, `None` past the smoke.
    fn walk(&self, ray: &Ray, rng: &mut Rng, mut visit: impl FnMut(f64, &mut Rng) -> ControlFlow<()>) -> Option<f64> {
        let half = half_extent(self.density.shape);
        let (mut t, end) = ray.clip(half)?;
        let side = f64::from(BLOCK) * cell_size(self.density.shape);
        let last = self.blocks.dims.as_ivec3() - 1;
        // Rounding may put the start into a neighbouring block: the first stretch is then empty.
        let mut block = ((ray.at(t) + half) / side).floor().as_ivec3().clamp(IVec3::ZERO, last);
        let mut remaining = rng.exponential();
        loop {
            let exits = [0, 1, 2].map(|axis| {
                let face = f64::from(block[axis] + i32::from(ray.dir[axis] > 0.0)) * side - half[axis];
                if ray.dir[axis] == 0.0 { f64::INFINITY } else { (face - ray.origin[axis]) / ray.dir[axis] }
            });
            let axis = if exits[0] < exits[1] { 0 } else { 1 };
            let axis = if exits[2] < exits[axis] { 2 } else { axis };
            let exit = exits[axis].min(end);
            let majorant = self.majorants[self.blocks.index(block.as_uvec3())];
            while majorant * (exit - t) > remaining {
                t += remaining / majorant;
                remaining = rng.exponential();
                let extinction = self.medium.sigma * self.density.sample(ray.at(t));
                if visit(extinction / majorant, rng).is_break() {
                    return Some(t);
                }
            }
            // Exponential distances have no memory: what is left of one carries over, measured in optical depth.
            remaining -= majorant * (exit - t).max(0.0);
            t = t.max(exit);
            block[axis] += if ray.dir[axis] > 0.0 { 1 } else { -1 };
            if t >= end || block[axis] < 0 || block[axis] > last[axis] {
                return None;
            }
        }
    }

    /// A random distance to the next collision along `ray`; `None` where it leaves the smoke or meets a surface first.
    fn collide(&self, ray: &Ray, rng: &mut Rng) -> Option<f64> {
        self.walk(ray, rng, |share, rng| match rng.uniform() < share {
            true => ControlFlow::Break(()),
            false => ControlFlow::Continue(()),
        })
    }

    /// A random number whose mean is the transmittance along `ray`.
    fn transmittance(&self, ray: &Ray, rng: &mut Rng) -> f64 {
        let mut transmittance = 1.0;
        self.walk(ray, rng, |share, _| {
            transmittance *= 1.0 - share;
            ControlFlow::Continue(())
        });
        transmittance
    }
}

/// One sample of the media radiance along `ray`, without background: a path, followed from the eye.
///
/// An opaque surface ends `ray` itself, and does not shade the smoke.
pub fn trace(scene: &Scene, ray: &Ray, events: Events, rng: &mut Rng) -> DVec3 {
    let mut ray = *ray;
    let mut throughput = DVec3::ONE;
    let mut scattered = false;
    while let Some(t) = scene.collide(&ray, rng) {
        throughput *= scene.medium.albedo;
        // The angle between light's directions of travel is that between the path's, which runs against it.
        ray = Ray::new(ray.at(t), scatter(ray.dir, scene.medium.g, rng));
        if events == Events::Single {
            return throughput * (scene.environment)(ray.dir) * scene.transmittance(&ray, rng);
        }
        scattered = true;
        let most = throughput.max_element();
        if most < ROULETTE {
            if rng.uniform() * ROULETTE >= most {
                return DVec3::ZERO;
            }
            throughput *= ROULETTE / most;
        }
    }
    if scattered { throughput * (scene.environment)(ray.dir) } else { DVec3::ZERO }
}

/// A random direction after scattering, distributed like the Henyey–Greenstein phase function about `dir`.
pub(super) fn scatter(dir: DVec3, g: f64, rng: &mut Rng) -> DVec3 {
    let u = rng.uniform();
    // Its distribution function, inverted; near g = 0 the quotient loses all digits, and its limit is as good.
    let cos = if g.abs() < 1e-4 {
        let t = 2.0 * u - 1.0;
        t + 1.5 * g * (1.0 - t * t)
    } else {
        let s = (1.0 - g * g) / (1.0 - g + 2.0 * g * u);
        (1.0 + g * g - s * s) / (2.0 * g)
    }
    .clamp(-1.0, 1.0);
    let (y, x) = (2.0 * PI * rng.uniform()).sin_cos();
    let (across, up) = dir.any_orthonormal_pair();
    (dir * cos + (across * x + up * y) * (1.0 - cos * cos).sqrt()).normalize()
}

/// The media radiance of an image of `size` (width, height), rows from the top: in every pixel the mean of `spp`
/// samples spread evenly over it.
///
/// `camera` gives the ray through a point of the picture, in pixels from its top left corner. The result depends on
/// `seed`, not on the number of threads; images of different seeds are independent. `progress` hears, from any
/// thread, the share of the rows that is done.
pub fn render(
    scene: &Scene,
    size: [u32; 2],
    camera: impl Fn(f64, f64) -> Ray + Sync,
    events: Events,
    spp: u32,
    seed: u64,
    progress: &(dyn Fn(f64) + Sync),
) -> Vec<DVec3> {
    let [width, height] = size.map(|side| side as usize);
    let mut image = vec![DVec3::ZERO; width * height];
    let done = AtomicUsize::new(0);
    image.par_chunks_mut(width.max(1)).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.iter_mut().enumerate() {
            let mut rng = Rng::new(seed, (y * width + x) as u64);
            let mut sample = || {
                let ray = camera(x as f64 + rng.uniform(), y as f64 + rng.uniform());
                trace(scene, &ray, events, &mut rng)
            };
            *pixel = (0..spp).map(|_| sample()).sum::<DVec3>() / f64::from(spp);
        }
        progress((done.fetch_add(1, Ordering::Relaxed) + 1) as f64 / height as f64);
    });
    image
}

/// The random numbers of one pixel.
#[derive(Clone, Debug)]
pub struct Rng(SplitMix64);

impl Rng {
    /// A stream of its own for every pair of numbers: streams start at random places of a cycle of 2⁶⁴.
    pub fn new(seed: u64, stream: u64) -> Self {
        let offset = SplitMix64(seed).bits();
        Self(SplitMix64(SplitMix64(offset ^ stream).bits()))
    }

    /// Uniform in [0, 1).
    pub fn uniform(&mut self) -> f64 {
        self.0.unit()
    }

    /// Exponential with mean 1.
    pub(super) fn exponential(&mut self) -> f64 {
        -(-self.uniform()).ln_1p()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference::{center, single::single_scattering};

    const MEDIUM: Medium = Medium { sigma: 6.0, albedo: DVec3::new(0.9, 0.6, 0.3), g: 0.5 };

    fn grid(dims: [u32; 3], density: impl Fn(DVec3) -> f64) -> Grid {
        let shape = GridShape::new(UVec3::from(dims));
        Grid { shape, values: (0..shape.len()).map(|i| density(center(shape, shape.cell(i)))).collect() }
    }

    /// A lopsided blob, well within the box of 20 × 16 × 12 cells: all blocks but some are cut off.
    fn blob() -> Grid {
        grid([20, 16, 12], |x| 1.5 * (-(x - DVec3::new(0.1, -0.05, 0.0)).length_squared() / 0.03).exp())
    }

    fn environment(w: DVec3) -> DVec3 {
        DVec3::new(1.0 + w.y, 1.0, 1.0 - w.x) * (0.7 + 0.5 * w.z)
    }

    /// Mean and standard error of `n` samples.
    fn mean(n: usize, mut sample: impl FnMut(&mut Rng) -> DVec3) -> (DVec3, DVec3) {
        let mut rng = Rng::new(n as u64, 0);
        let (mut sum, mut squares) = (DVec3::ZERO, DVec3::ZERO);
        for _ in 0..n {
            let x = sample(&mut rng);
            sum += x;
            squares += x * x;
        }
        let mean = sum / n as f64;
        (mean, ((squares / n as f64 - mean * mean) / n as f64).map(|v| v.max(0.0).sqrt()))
    }

    /// Within three standard errors (the seeds are fixed: a pass stays a pass), and a relative `bias` of the expectation.
    fn assert_mean(estimate: (DVec3, DVec3), expected: DVec3, bias: f64) {
        let off = (estimate.0 - expected).abs();
        assert!(off.cmple(3.0 * estimate.1 + bias * expected + 1e-12).all(), "{estimate:?} for {expected}");
    }

    /// By midpoints of 4096 steps through the box: 100 a cell or more, where already 2 are within 1 %, and second order.
    fn exact_transmittance(grid: &Grid, sigma: f64, ray: &Ray) -> f64 {
        let Some((start, end)) = ray.clip(half_extent(grid.shape)) else { return 1.0 };
        let step = (end - start) / 4096.0;
        (-sigma * step * (0..4096).map(|i| grid.sample(ray.at(start + (f64::from(i) + 0.5) * step))).sum::<f64>()).exp()
    }

    fn rays() -> [Ray; 4] {
        [
            Ray::new(DVec3::new(-2.0, 0.01, 0.02), DVec3::X),
            Ray::new(DVec3::new(0.1, -0.05, 2.0), -DVec3::Z),
            Ray::new(DVec3::new(-1.0, -1.2, 0.8), DVec3::new(1.08, 1.1, -0.85).normalize()),
            Ray::new(DVec3::new(0.15, 0.0, 0.05), DVec3::new(-0.6, 0.64, -0.48)),
        ]
    }

    #[test]
    fn majorants_bound_the_density() {
        let mut rng = Rng::new(1, 1);
        let noise: Vec<f64> = (0..20 * 9 * 17).map(|_| rng.uniform().powi(4)).collect();
        let grid = Grid { shape: GridShape::new(UVec3::new(20, 9, 17)), values: noise };
        let scene = Scene::new(&grid, MEDIUM, &environment);
        assert_eq!(scene.blocks.dims, UVec3::new(3, 2, 3));
        for _ in 0..20_000 {
            let cell = DVec3::from([(); 3].map(|()| rng.uniform())) * grid.shape.dims.as_dvec3();
            let block = (cell / 8.0).as_uvec3();
            let x = cell * cell_size(grid.shape) - half_extent(grid.shape);
            assert!(MEDIUM.sigma * grid.sample(x) <= scene.majorants[scene.blocks.index(block)] * (1.0 + 1e-12));
        }
    }

    #[test]
    fn tracking_gives_transmittance() {
        for grid in [blob(), grid([9, 8, 17], |_| 0.5)] {
            let scene = Scene::new(&grid, MEDIUM, &environment);
            for ray in rays() {
                let expected = DVec3::splat(exact_transmittance(&grid, MEDIUM.sigma, &ray));
                let survives = |rng: &mut Rng| DVec3::splat(f64::from(scene.collide(&ray, rng).is_none()));
                assert_mean(mean(20_000, survives), expected, 1e-5);
                assert_mean(mean(20_000, |rng| DVec3::splat(scene.transmittance(&ray, rng))), expected, 1e-5);
            }
        }
    }

    #[test]
    fn scattering_has_mean_cosine_g() {
        let dir = DVec3::new(0.48, -0.6, 0.64);
        for g in [-0.7, 0.0, 5e-5, 0.42, 0.9] {
            let (mean, error) = mean(20_000, |rng| {
                let out = scatter(dir, g, rng);
                assert!((out.length() - 1.0).abs() < 1e-14);
                out
            });
            assert!((mean - dir * g).abs().cmple(3.0 * error).all(), "{mean} for g {g}");
        }
    }

    #[test]
    fn forward_scattering_has_closed_forms() {
        // With g = 1 − 1e-7 light goes straight on (99 % within 1e-5): n events have the Poisson probability of the
        // optical depth. From behind, and not from the front: E(+Z) = 2, E(−Z) = 0.
        let grid = grid([16, 16, 16], |_| 1.0);
        let medium = Medium { g: 1.0 - 1e-7, ..MEDIUM };
        let light = |w: DVec3| DVec3::splat(1.0 + w.z);
        let scene = Scene::new(&grid, medium, &light);
        let ray = Ray::new(DVec3::new(0.05, 0.02, -2.0), DVec3::Z);
        let depth = -exact_transmittance(&grid, medium.sigma, &ray).ln();
        let once = 2.0 * medium.albedo * depth * (-depth).exp();
        let any = 2.0 * ((medium.albedo * depth).exp() - 1.0) * (-depth).exp();
        assert_mean(mean(40_000, |rng| trace(&scene, &ray, Events::Single, rng)), once, 1e-5);
        assert_mean(mean(40_000, |rng| trace(&scene, &ray, Events::All, rng)), any, 1e-5);
        // The darkest channel alone: here roulette decides from the second event on.
        let scene = Scene::new(&grid, Medium { albedo: DVec3::splat(0.3), ..medium }, &light);
        assert_mean(mean(40_000, |rng| trace(&scene, &ray, Events::All, rng)), DVec3::splat(any.z), 1e-5);
        // A surface half way leaves half the depth to the first event, and does not shade what follows.
        let half = Ray { t_max: 2.0, ..ray };
        let once = 2.0 * medium.albedo * 0.5 * depth * (-depth).exp();
        let scene = Scene::new(&grid, medium, &light);
        assert_mean(mean(40_000, |rng| trace(&scene, &half, Events::Single, rng)), once, 1e-5);
    }

    #[test]
    fn thin_smoke_scatters_albedo_times_optical_depth() {
        // L = Ω τ under unit light, less what is lost on the way in and out: some 4 % where the cube's side is 0.04.
        let grid = grid([16, 16, 16], |_| 1.0);
        let medium = Medium { sigma: 0.04, g: 0.0, ..MEDIUM };
        let scene = Scene::new(&grid, medium, &|_| DVec3::ONE);
        let ray = Ray::new(DVec3::new(0.05, 0.02, -2.0), DVec3::Z);
        let (radiance, error) = mean(200_000, |rng| trace(&scene, &ray, Events::Single, rng));
        let thin = medium.albedo * -exact_transmittance(&grid, medium.sigma, &ray).ln();
        let (ratio, error) = (radiance / thin, error / thin);
        assert!((ratio.cmpgt(0.94 - 3.0 * error) & ratio.cmplt(1.0 + 3.0 * error)).all(), "{ratio} {error}");
    }

    #[test]
    fn white_furnace() {
        // Where nothing is absorbed and light is the same from everywhere, smoke cannot be seen.
        let grid = blob();
        let scene = Scene::new(&grid, Medium { sigma: 20.0, albedo: DVec3::ONE, g: 0.5 }, &|_| DVec3::ONE);
        for ray in rays() {
            let seen = DVec3::splat(1.0 - exact_transmittance(&grid, 20.0, &ray));
            assert_mean(mean(10_000, |rng| trace(&scene, &ray, Events::All, rng)), seen, 1e-5);
        }
    }

    #[test]
    fn single_scattering_agrees_with_the_march() {
        let grid = blob();
        let scene = Scene::new(&grid, MEDIUM, &environment);
        for ray in rays() {
            let (expected, _) = single_scattering(&grid, &MEDIUM, &ray, 512, environment);
            // The march takes half-cell steps, and the blob is 3.5 cells wide: 3e-3.
            assert_mean(mean(40_000, |rng| trace(&scene, &ray, Events::Single, rng)), expected, 3e-3);
        }
    }

    #[test]
    fn images_depend_on_the_seed_not_on_the_threads() {
        let grid = blob();
        let scene = Scene::new(&grid, MEDIUM, &environment);
        let camera = |x: f64, y: f64| Ray::new(DVec3::new(x / 10.0 - 0.5, 0.4 - y / 10.0, 2.0), -DVec3::Z);
        let image = |threads, seed, progress: &(dyn Fn(f64) + Sync)| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| render(&scene, [10, 8], camera, Events::All, 16, seed, progress))
        };
        let rows = AtomicUsize::new(0);
        let first = image(1, 7, &|share| {
            assert_eq!(share * 8.0, (rows.fetch_add(1, Ordering::Relaxed) + 1) as f64);
        });
        assert_eq!(rows.into_inner(), 8);
        assert_eq!(first, image(3, 7, &|_| ()));
        assert_ne!(first, image(3, 8, &|_| ()));
        // Up is up, and every pixel is its own: the blob is below the middle, to the right.
        let brightest = (0..80).max_by(|&a, &b| first[a].y.total_cmp(&first[b].y)).unwrap();
        assert!((4..=7).contains(&(brightest % 10)) && (3..=6).contains(&(brightest / 10)), "{brightest}");
        assert_eq!(first[0], DVec3::ZERO);
    }
}
