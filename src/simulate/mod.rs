//! A small plume solver, to have something to bake: hot smoke rises from a source on the floor, billows, flows around a
//! sphere if there is one, and leaves through the sides and the top.
//!
//! The incompressible Euler equations on a staggered grid (Harlow and Welch 1965), split as Stam 1999, *Stable Fluids*,
//! splits them; a [`Plume`]'s step is
//!
//! 1. **advection** of velocity, density and temperature, semi-Lagrangian with limited cubic interpolation;
//! 2. **emission** at the source, cooling and dissipation;
//! 3. **forces**: heat lifts, smoke weighs, vorticity confinement returns the eddies that the grid blurs;
//! 4. **projection**: the pressure that leaves no divergence, by conjugate gradients with multigrid.
//!
//! Lengths are in bundle space (the box's longest side is 1), times in seconds, so that a finer grid shows the same plume
//! in more detail. The floor is solid; behind the other five faces is still, clean air at pressure 0. Everything is in
//! single precision and the same for the same settings, whatever the number of threads.

mod advect;
mod forces;
mod lattice;
mod obstacle;
mod pressure;
mod source;
#[cfg(test)]
mod tests;

use glam::{DVec3, UVec3, Vec3};
use thiserror::Error;

use crate::density::{DensityGrid, GridShape, Placement, SourceInfo};
use lattice::{Lattice, Velocity};
pub use obstacle::Sphere;
use obstacle::{Extension, open_faces};
use pressure::Pressure;
use source::Source;

/// The fewest cells a side.
pub const MIN_SIDE: u32 = 8;
/// The most cells of a box.
pub const MAX_CELLS: u64 = 1 << 24;

/// The most cells that anything crosses in a step.
const MAX_COURANT: f32 = 2.5;
/// The longest step in seconds, for smoke that is still to gather speed.
const LONGEST_STEP: f32 = 1.0 / 24.0;
/// The shortest step in seconds: faster flow, which no setting in its range makes last, is followed less accurately.
const SHORTEST_STEP: f32 = 1.0 / 2000.0;
/// Smoke's weight over the lift of the hottest smoke, both at density and temperature 1.
const WEIGHT: f32 = 0.15;
/// Rate at which smoke cools, per second.
const COOLING: f32 = 0.4;
/// Rate at which smoke vanishes, per second.
const DISSIPATION: f32 = 0.15;
/// The source's random acceleration over the lift of the hottest smoke.
const RESTLESSNESS: f32 = 1.5;
/// Thickness of the layer before the open faces in which smoke fades, so that it is not cut off at a plane, in lengths of
/// the box's longest side.
const FADE_LAYER: f32 = 0.05;
/// Rate at which smoke vanishes at an open face, per second, more and more toward it.
const FADE: f32 = 60.0;
/// Densities below this are written as 0, so that bundles stay small.
const VISIBLE: f32 = 1e-3;

/// What to simulate.
#[derive(Clone, Debug, PartialEq)]
pub struct PlumeSettings {
    /// The cells of the box: each side at least [`MIN_SIDE`], at most [`MAX_CELLS`] in all.
    pub shape: GridShape,
    /// Seed of the source's random puffs.
    pub seed: u64,
    /// Acceleration of the hottest smoke, in lengths of the box's longest side a second², 0 to [`MAX_BUOYANCY`](Self::MAX_BUOYANCY).
    pub buoyancy: f32,
    /// Strength of vorticity confinement, per second, 0 (none) to [`MAX_VORTICITY`](Self::MAX_VORTICITY).
    pub vorticity: f32,
    /// A solid sphere that the smoke flows around.
    pub obstacle: Option<Sphere>,
}

impl PlumeSettings {
    /// The default buoyancy.
    pub const BUOYANCY: f32 = 3.0;
    /// The default strength of vorticity confinement.
    pub const VORTICITY: f32 = 3.0;
    /// The most buoyancy.
    pub const MAX_BUOYANCY: f32 = 100.0;
    /// The strongest vorticity confinement: much more would feed the eddies faster than they fade.
    pub const MAX_VORTICITY: f32 = 20.0;

    /// A lively plume in a box of the given cells, with nothing in it.
    pub const fn new(shape: GridShape) -> Self {
        Self { shape, seed: 1, buoyancy: Self::BUOYANCY, vorticity: Self::VORTICITY, obstacle: None }
    }
}

/// Why a plume cannot be simulated.
#[derive(Debug, Error, PartialEq)]
pub enum PlumeError {
    /// A side is too short.
    #[error("a box of {0} cells is too small: each side takes at least {MIN_SIDE}")]
    TooSmall(UVec3),
    /// Too many cells.
    #[error("a box of {0} cells is too large: {MAX_CELLS} cells (256³) are the most")]
    TooLarge(UVec3),
    /// A setting is out of its range.
    #[error("{0} is {1}: it takes 0 to {2}")]
    OutOfRange(&'static str, f32, f32),
    /// The obstacle is no sphere.
    #[error("an obstacle's position has to be finite, and its radius above 0")]
    NoSphere,
    /// The obstacle covers the source's centre, or comes close to it.
    #[error("the obstacle is too close to the source at {0}: leave the smoke room to rise")]
    CoversSource(Vec3),
}

/// A plume at some time.
#[derive(Clone, Debug)]
pub struct Plume {
    settings: PlumeSettings,
    source: Source,
    seconds: f64,
    velocity: Velocity,
    density: Lattice,
    temperature: Lattice,
    pressure: Pressure,
    /// Extensions of the velocity's components and of what cells hold into the obstacle.
    extensions: [Extension; 3],
    cell_extension: Extension,
}

impl Plume {
    /// Still, clean air.
    ///
    /// # Errors
    ///
    /// Settings out of their range, or an obstacle at the source.
    pub fn new(settings: PlumeSettings) -> Result<Self, PlumeError> {
        let shape = settings.shape;
        let dims = shape.dims;
        if dims.min_element() < MIN_SIDE {
            return Err(PlumeError::TooSmall(dims));
        }
        if dims.to_array().iter().try_fold(1u64, |n, &side| n.checked_mul(side.into())).is_none_or(|n| n > MAX_CELLS) {
            return Err(PlumeError::TooLarge(dims));
        }
        for (name, value, most) in [
            ("buoyancy", settings.buoyancy, PlumeSettings::MAX_BUOYANCY),
            ("vorticity", settings.vorticity, PlumeSettings::MAX_VORTICITY),
        ] {
            if !(0.0..=most).contains(&value) {
                return Err(PlumeError::OutOfRange(name, value, most));
            }
        }
        let source = Source::new(shape, settings.seed);
        if let Some(sphere) = settings.obstacle {
            if !(sphere.center.is_finite() && sphere.radius > 0.0 && sphere.radius.is_finite()) {
                return Err(PlumeError::NoSphere);
            }
            if sphere.distance(source.center) < source.radius {
                return Err(PlumeError::CoversSource(source.center));
            }
        }
        let sphere = settings.obstacle.map(|sphere| sphere.in_cells(shape));
        let open = open_faces(dims, sphere);
        let density = Lattice::centers(dims);
        let (extensions, cell_extension) = match sphere {
            // The floor is no place to extend to: nothing is looked up below it.
            Some(sphere) => (
                open.each_ref().map(|face| {
                    Extension::new(face.shape, |point, i| {
                        face.values[i] == 0.0 && sphere.distance(face.position(point)) < 1.0
                    })
                }),
                Extension::new(shape, |cell, _| sphere.distance(density.position(cell)) < 0.0),
            ),
            None => Default::default(),
        };
        Ok(Self {
            source,
            seconds: 0.0,
            velocity: Velocity::new(dims),
            temperature: density.clone(),
            density,
            pressure: Pressure::new(&open),
            extensions,
            cell_extension,
            settings,
        })
    }

    /// Goes on by some time (above 0), in as many steps as accuracy needs.
    pub fn advance(&mut self, seconds: f32) {
        let mut left = seconds;
        loop {
            let cells_per_second = self.velocity.max() * self.settings.shape.longest() as f32;
            let longest = (MAX_COURANT / cells_per_second).clamp(SHORTEST_STEP, LONGEST_STEP);
            // Equal steps, as far as can be told now: no sliver at the end.
            let steps = (left / longest).ceil().max(1.0);
            self.step(left / steps);
            if steps == 1.0 {
                return;
            }
            left -= left / steps;
        }
    }

    /// One step of the splitting in the module's documentation.
    fn step(&mut self, seconds: f32) {
        let step = seconds * self.settings.shape.longest() as f32;
        let carrier = self.velocity.clone();
        advect::advect([&mut self.density, &mut self.temperature], &carrier, step);
        self.velocity.faces.iter_mut().for_each(|face| advect::advect([face], &carrier, step));
        self.seconds += f64::from(seconds);
        self.emit(seconds);

        let PlumeSettings { shape, buoyancy, vorticity, .. } = self.settings;
        let weight = WEIGHT * buoyancy;
        let mut acceleration =
            forces::acceleration(&self.velocity, &self.density, &self.temperature, buoyancy, weight, vorticity);
        let restlessness = RESTLESSNESS * buoyancy;
        lattice::fill_planes(shape, &mut acceleration, |cell, _, acceleration| {
            if let Some(emission) = self.source.emission(shape.center(cell), self.seconds as f32) {
                *acceleration += restlessness * emission.force;
            }
        });
        forces::accelerate(&mut self.velocity, shape, seconds, &acceleration);

        self.pressure.project(&mut self.velocity);
        for (face, extension) in self.velocity.faces.iter_mut().zip(&self.extensions) {
            extension.apply(&mut face.values);
        }
    }

    /// The source's smoke and heat, and what time takes of them.
    fn emit(&mut self, seconds: f32) {
        let (shape, now) = (self.settings.shape, self.seconds as f32);
        let (source, center) = (&self.source, |cell| shape.center(cell));
        let half = shape.half_extent();
        self.density.update(|cell, _, density| {
            let from_faces = (half - center(cell).abs()).with_y(half.y - center(cell).y).min_element();
            let depth = (1.0 - from_faces / FADE_LAYER).max(0.0);
            let kept = (-seconds * (DISSIPATION + FADE * depth * depth)).exp();
            let emitted = source.emission(center(cell), now).map_or(0.0, |emission| emission.density);
            (kept * density).max(emitted)
        });
        let kept = (-COOLING * seconds).exp();
        self.temperature.update(|cell, _, temperature| {
            let emitted = source.emission(center(cell), now).map_or(0.0, |emission| emission.temperature);
            (kept * temperature).max(emitted)
        });
        self.cell_extension.apply(&mut self.density.values);
        self.cell_extension.apply(&mut self.temperature.values);
    }

    /// The smoke as a density file holds it: 0..1, 0 inside the obstacle and where it would not be seen.
    pub fn density(&self) -> DensityGrid {
        let shape = self.settings.shape;
        let solid = |cell| self.settings.obstacle.is_some_and(|sphere| sphere.distance(shape.center(cell)) < 0.0);
        let visible = |cell, i: usize| {
            let density = self.density.values[i];
            if density < VISIBLE || solid(cell) { 0.0 } else { density }
        };
        DensityGrid {
            shape,
            values: self.density.map(visible).values,
            placement: Placement { center: DVec3::ZERO, voxel_size: 1.0 / f64::from(shape.longest()) },
            source: SourceInfo { active_voxels: shape.len() as u64, ..SourceInfo::default() },
        }
    }
}
