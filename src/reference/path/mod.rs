//! Path tracing: the witness where no given reference reaches.
//!
//! Unbiased: no steps, no RBFs, no spherical harmonics; what is left is noise, which falls with the square root of the
//! samples. Distances come from delta tracking (Woodcock 1965) under a coarse grid of majorants, transmittance from
//! ratio tracking (Novák et al. 2014), directions from the phase function itself.
//!
//! Every scattering event looks for sharp lights, and for the bright parts of an image environment (next-event
//! estimation); an image is also met where a path leaves the box, and the two are combined by multiple importance
//! sampling (Veach and Guibas 1995, balance heuristic). Near a lamp, where 1/d² has no bounds, events are not waited
//! for but placed along the path as the lamp sees it (equi-angular sampling, Kulla and Fajardo 2012); light that first
//! scatters there and then again keeps a few bright specks.
//!
//! [`Surfaces`] block light and reflect it; what they look like themselves, behind the smoke, is a picture of its own
//! ([`render_surfaces`]).
//!
//! Error estimates that discount noise need two independent halves: two [`render`]s with different seeds.

mod environment;
mod light;
#[cfg(test)]
mod tests;
mod tracking;

use core::f64::consts::PI;
use std::sync::atomic::{AtomicUsize, Ordering};

use glam::DVec3;
use rayon::prelude::*;

use super::{
    Grid, Medium, Ray, half_extent,
    surface::{Hit, Surfaces},
};
use crate::optics::henyey_greenstein;
use crate::random::SplitMix64;
use tracking::Extinction;

pub use environment::{Environment, EquirectImage};
pub use light::{Light, spot_falloff};

/// Paths that carry less than this (in their brightest channel) play Russian roulette for it.
const ROULETTE: f64 = 0.1;
/// Distance from a lamp, in bundle units, within which events are placed with regard to it.
const NEAR: f64 = 0.1;
/// Rays a side of a pixel over which [`alpha`] averages.
const ALPHA_RAYS: u32 = 4;

/// Smoke under an environment and lights, ready to trace.
pub struct Scene<'a> {
    smoke: Extinction,
    half_extent: DVec3,
    albedo: DVec3,
    g: f64,
    environment: Environment<'a>,
    lights: &'a [Light],
    surfaces: Surfaces,
}

/// Where a path turns, and by what.
#[derive(Clone, Copy)]
struct Event {
    x: DVec3,
    /// Share of the light that goes on, per RGB channel.
    albedo: DVec3,
    turn: Turn,
}

/// What turns a path.
#[derive(Clone, Copy)]
enum Turn {
    /// Smoke of this mean cosine, which the path met along a direction.
    Smoke { before: DVec3, g: f64 },
    /// A Lambertian surface of this normal.
    Surface { normal: DVec3 },
}

impl Turn {
    /// Probability per steradian of going on along `w`; light from there goes on along the path in the same measure.
    fn density(self, w: DVec3) -> f64 {
        match self {
            // The angle between light's directions of travel is that between the path's, which runs against it.
            Self::Smoke { before, g } => henyey_greenstein(before.dot(w), g),
            Self::Surface { normal } => normal.dot(w).max(0.0) / PI,
        }
    }

    /// A random direction of that density.
    fn sample(self, rng: &mut Rng) -> DVec3 {
        match self {
            Self::Smoke { before, g } => scatter(before, g, rng),
            Self::Surface { normal } => turned(normal, (1.0 - rng.uniform()).sqrt(), rng.uniform()),
        }
    }
}

/// Which paths count.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Events {
    /// Those that scatter exactly once, and are not reflected.
    Single,
    /// Those that scatter at least once, or are reflected.
    All,
}

impl<'a> Scene<'a> {
    /// Smoke of this density, at least 0 everywhere, under `environment`, in bundle axes, and `lights`.
    pub fn new(density: &Grid, medium: Medium, environment: Environment<'a>, lights: &'a [Light]) -> Self {
        let smoke = Extinction::new(density, medium.sigma);
        let half_extent = half_extent(density.shape);
        Self {
            smoke,
            half_extent,
            albedo: medium.albedo,
            g: medium.g,
            environment,
            lights,
            surfaces: Surfaces::default(),
        }
    }

    /// The same with surfaces in it.
    pub fn with_surfaces(self, surfaces: Surfaces) -> Self {
        Self { surfaces, ..self }
    }

    /// `ray` up to the first surface, and that.
    fn up_to_surface(&self, ray: &Ray) -> (Ray, Option<Hit>) {
        let hit = self.surfaces.hit(ray);
        (Ray { t_max: hit.map_or(ray.t_max, |hit| hit.t), ..*ray }, hit)
    }

    /// Smoke that a path met at `x` along `before`.
    fn scattering(&self, x: DVec3, before: DVec3) -> Event {
        Event { x, albedo: self.albedo, turn: Turn::Smoke { before, g: self.g } }
    }

    /// A random number whose mean is the share of light that arrives along `ray`.
    fn passing(&self, ray: &Ray, rng: &mut Rng) -> f64 {
        if self.surfaces.block(ray) { 0.0 } else { self.smoke.transmittance(ray, rng) }
    }

    /// Light that arrives at `x` from what is looked for there, and is turned into a path; per albedo.
    fn next_event(&self, x: DVec3, turn: Turn, rng: &mut Rng) -> DVec3 {
        let mut sum = DVec3::ZERO;
        for light in self.lights {
            // Smoke there is near_lamps's.
            let near = light.lamp().is_some_and(|lamp| lamp.distance_squared(x) < NEAR * NEAR);
            if near && matches!(turn, Turn::Smoke { .. }) {
                continue;
            }
            if let Some((ray, irradiance)) = light.sample(x, rng) {
                sum += self.arriving(&ray, irradiance * turn.density(ray.dir), rng);
            }
        }
        if let Environment::Image(image) = self.environment
            && let Some((w, density)) = image.sample(rng)
        {
            let turned = turn.density(w);
            sum += self.arriving(&Ray::new(x, w), image.radiance(w) * (turned / (density + turned)), rng);
        }
        sum
    }

    /// What arrives of `light` along `ray`, on the mean.
    fn arriving(&self, ray: &Ray, light: DVec3, rng: &mut Rng) -> DVec3 {
        if light == DVec3::ZERO { DVec3::ZERO } else { light * self.passing(ray, rng) }
    }

    /// The environment's radiance from `w`, found by a turn: all of it, or the share that looking for an image's light
    /// leaves to turning.
    fn met(&self, w: DVec3, turn: Turn) -> DVec3 {
        match self.environment {
            Environment::Function(radiance) => radiance(w),
            Environment::Image(image) => {
                let turned = turn.density(w);
                image.radiance(w) * (turned / (image.density(w) + turned))
            }
        }
    }

    /// Light of lamps that is scattered into the start of `ray` from points of it within [`NEAR`] of them; per albedo.
    fn near_lamps(&self, ray: &Ray, rng: &mut Rng) -> DVec3 {
        let mut sum = DVec3::ZERO;
        for light in self.lights {
            let Some(lamp) = light.lamp() else { continue };
            let foot = (lamp - ray.origin).dot(ray.dir);
            let height = ray.at(foot).distance(lamp);
            if !(height > 0.0 && height < NEAR) {
                continue;
            }
            let reach = (NEAR * NEAR - height * height).sqrt();
            let Some((start, end)) = ray.clip(self.half_extent) else { continue };
            let (start, end) = (start.max(foot - reach), end.min(foot + reach));
            if start >= end {
                continue;
            }
            // Evenly over the angle at the lamp: dt = (height² + (t−foot)²)/height dθ, and the bracket is d².
            let [from, to] = [start, end].map(|t| ((t - foot) / height).atan());
            let t = foot + height * (from + (to - from) * rng.uniform()).tan();
            let x = ray.at(t);
            if let Some((to_lamp, irradiance)) = light.sample(x, rng) {
                let per_t = (to - from) * lamp.distance_squared(x) / height;
                let there = self.smoke.sample(x) * self.smoke.transmittance(&Ray { t_max: t, ..*ray }, rng);
                let phase = henyey_greenstein(ray.dir.dot(to_lamp.dir), self.g);
                sum += irradiance * (per_t * there * phase * self.passing(&to_lamp, rng));
            }
        }
        sum
    }
}

/// One sample of the media radiance along `ray`, without background: a path, followed from the eye.
///
/// The end of `ray` is that of sight alone: it does not shade the smoke, as [surfaces](Scene::with_surfaces) do.
pub fn trace(scene: &Scene, ray: &Ray, events: Events, rng: &mut Rng) -> DVec3 {
    let (ray, _) = scene.up_to_surface(ray);
    let near = scene.albedo * scene.near_lamps(&ray, rng);
    match scene.smoke.collide(&ray, rng) {
        Some(t) => near + follow(scene, scene.scattering(ray.at(t), ray.dir), events, rng),
        None => near,
    }
}

/// One sample of the radiance of the first surface along `ray`, through the smoke in front of it.
pub fn trace_surfaces(scene: &Scene, ray: &Ray, events: Events, rng: &mut Rng) -> DVec3 {
    let (ray, hit) = scene.up_to_surface(ray);
    match hit {
        Some(hit) if scene.smoke.collide(&ray, rng).is_none() => follow(scene, reflection(&ray, hit), events, rng),
        _ => DVec3::ZERO,
    }
}

/// The surface that a path met along `ray`.
fn reflection(ray: &Ray, hit: Hit) -> Event {
    Event { x: ray.at(hit.t), albedo: hit.albedo, turn: Turn::Surface { normal: hit.normal } }
}

/// A sample of the radiance that `event` sends back along the path.
fn follow(scene: &Scene, mut event: Event, events: Events, rng: &mut Rng) -> DVec3 {
    let mut throughput = DVec3::ONE;
    let mut radiance = DVec3::ZERO;
    loop {
        let Event { x, albedo, turn } = event;
        throughput *= albedo;
        radiance += throughput * scene.next_event(x, turn, rng);
        let ray = Ray::new(x, turn.sample(rng));
        if events == Events::Single {
            return radiance + throughput * scene.arriving(&ray, scene.met(ray.dir, turn), rng);
        }
        let most = throughput.max_element();
        if most < ROULETTE {
            if rng.uniform() * ROULETTE >= most {
                return radiance;
            }
            throughput *= ROULETTE / most;
        }
        let (ray, hit) = scene.up_to_surface(&ray);
        radiance += throughput * scene.albedo * scene.near_lamps(&ray, rng);
        event = match (scene.smoke.collide(&ray, rng), hit) {
            (Some(t), _) => scene.scattering(ray.at(t), ray.dir),
            (None, Some(hit)) => reflection(&ray, hit),
            (None, None) => return radiance + throughput * scene.met(ray.dir, turn),
        };
    }
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
    turned(dir, cos, rng.uniform())
}

/// A unit vector at the angle of cosine `cos` to `axis`, a share `turn` of the way around it.
pub(super) fn turned(axis: DVec3, cos: f64, turn: f64) -> DVec3 {
    let (y, x) = (2.0 * PI * turn).sin_cos();
    let (across, up) = axis.any_orthonormal_pair();
    (axis * cos + (across * x + up * y) * (1.0 - cos * cos).max(0.0).sqrt()).normalize()
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
    average(size, spp, seed, progress, |x, y, rng| trace(scene, &camera(x, y), events, rng))
}

/// The same of surfaces, seen through the smoke in front of them.
pub fn render_surfaces(
    scene: &Scene,
    size: [u32; 2],
    camera: impl Fn(f64, f64) -> Ray + Sync,
    events: Events,
    spp: u32,
    seed: u64,
    progress: &(dyn Fn(f64) + Sync),
) -> Vec<DVec3> {
    average(size, spp, seed, progress, |x, y, rng| trace_surfaces(scene, &camera(x, y), events, rng))
}

/// Means of `spp` samples at random places of every pixel.
fn average(
    [width, height]: [u32; 2],
    spp: u32,
    seed: u64,
    progress: &(dyn Fn(f64) + Sync),
    sample: impl Fn(f64, f64, &mut Rng) -> DVec3 + Sync,
) -> Vec<DVec3> {
    let [width, height] = [width, height].map(|side| side as usize);
    let mut image = vec![DVec3::ZERO; width * height];
    let done = AtomicUsize::new(0);
    image.par_chunks_mut(width.max(1)).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.iter_mut().enumerate() {
            let mut rng = Rng::new(seed, (y * width + x) as u64);
            let mut sample = || {
                let (x, y) = (x as f64 + rng.uniform(), y as f64 + rng.uniform());
                sample(x, y, &mut rng)
            };
            *pixel = (0..spp).map(|_| sample()).sum::<DVec3>() / f64::from(spp);
        }
        progress((done.fetch_add(1, Ordering::Relaxed) + 1) as f64 / height as f64);
    });
    image
}

/// 1 − transmittance of every pixel of the same image up to the first surface, without noise: marched, and averaged over a grid of 4 × 4 rays a
/// pixel.
pub fn alpha(scene: &Scene, size: [u32; 2], camera: impl Fn(f64, f64) -> Ray + Sync) -> Vec<f64> {
    let width = size[0] as usize;
    let sub = |i: u32| (f64::from(i) + 0.5) / f64::from(ALPHA_RAYS);
    (0..width * size[1] as usize)
        .into_par_iter()
        .map(|index| {
            let (x, y) = ((index % width) as f64, (index / width) as f64);
            let rays = (0..ALPHA_RAYS).flat_map(|j| (0..ALPHA_RAYS).map(move |i| (x + sub(i), y + sub(j))));
            let kept: f64 = rays.map(|(x, y)| scene.smoke.march(&scene.up_to_surface(&camera(x, y)).0)).sum();
            1.0 - kept / f64::from(ALPHA_RAYS * ALPHA_RAYS)
        })
        .collect()
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
