//! The course of a fit: grow, teleport, polish, and for a target error find how many Gaussians it takes.

use std::time::Instant;

use super::field::Field;
use super::minimize::{Bounds, minimize};
use super::objective::Objective;
use super::place::propose;
use super::{
    Fit, FitProgress, FitReport, FitSettings, FitStage, FitTarget, RADIUS, WEIGHT, relative_error, significance,
};
use crate::density::GridShape;
use crate::random::SplitMix64;
use crate::rbf::{Rbf, RbfModel};

/// Cells along the longest side of the copies on which Gaussians are placed, and on which they are teleported.
const COARSE: u32 = 64;
pub(super) const MIDDLE: u32 = 128;

/// A batch grows the model by this factor; at most this many batches, should they find little.
const GROWTH: f64 = 1.4;
const BATCHES: u32 = 40;
/// Iterations of the minimiser after a batch, in a teleportation round, and on the full grid.
const GROW_ITERATIONS: u32 = 10;
const ROUND_ITERATIONS: u32 = 20;
const POLISH_ITERATIONS: u32 = 40;
/// Teleportation rounds on the coarse and the middle copy.
const COARSE_ROUNDS: u32 = 5;
const ROUNDS: u32 = 16;
/// Rounds after trimming: the model is settled but for what was taken away.
const TRIM_ROUNDS: u32 = 4;
/// Share of the Gaussians that the first round teleports; halved whenever a round fails.
const TELEPORTED: f64 = 0.1;
/// The minimiser stops when a few iterations gain less than this share of the squared error.
const TOLERANCE: f64 = 2e-5;

/// A fit under way. Densities and weights are in units of the frame's largest density.
pub(super) struct Search<'a> {
    pub shape: GridShape,
    values: &'a [f32],
    pub max: f32,
    pub bounds: Bounds,
    /// The copy on which Gaussians are placed.
    coarse: Field,
    pub rbfs: Vec<Rbf>,
    random: SplitMix64,
    pub report: FitReport,
    progress: &'a dyn Fn(FitProgress),
    /// Share of the work that is done, and that the current stage will have done by its end.
    pub done: f32,
    until: f32,
}

impl<'a> Search<'a> {
    pub fn new(shape: GridShape, values: &'a [f32], max: f32, seed: u64, progress: &'a dyn Fn(FitProgress)) -> Self {
        let bounds = Bounds { half_extent: shape.half_extent(), radius: RADIUS, weight: WEIGHT };
        let coarse = Field::new(shape, values, 1.0 / max, shape.longest().div_ceil(COARSE));
        Self {
            shape,
            values,
            max,
            bounds,
            coarse,
            rbfs: Vec::new(),
            random: SplitMix64(seed),
            report: FitReport::default(),
            progress,
            done: 0.0,
            until: 0.0,
        }
    }

    pub fn run(mut self, settings: &FitSettings) -> Fit {
        self.report.reached = match settings.target {
            FitTarget::Count(count) => {
                self.until = 0.15;
                self.grow(count, self.coarse.factor);
                if self.rbfs.len() < count {
                    self.grow(count, self.shape.longest().div_ceil(MIDDLE));
                }
                self.refine(ROUNDS, 0.95);
                self.rbfs.len() == count
            }
            FitTarget::Error(target) => self.spend_as_few(target, settings.max_rbfs),
        };
        self.report.error = self.error();
        self.done = 1.0;
        self.tell(FitStage::Polish, self.report.error);
        Fit { model: self.model(), report: self.report }
    }

    /// Adds Gaussians in batches until there are `count`, or nothing is left worth one, with a few iterations of the
    /// minimiser between batches on a copy of `factor`³ cells a block.
    fn grow(&mut self, count: usize, factor: u32) {
        let started = Instant::now();
        let field = self.field(factor);
        let mut objective = Objective::new(&field);
        let begin = self.done;
        for _ in 0..BATCHES {
            if self.rbfs.len() >= count {
                break;
            }
            // A first batch of a twentieth, so that even small models are placed in several steps.
            let batch = (self.rbfs.len() as f64 * GROWTH).max(count as f64 / 20.0).ceil() as usize;
            let mut added = self.propose(batch.min(count) - self.rbfs.len());
            if added.is_empty() {
                // What is left is too small for the coarse copy.
                objective.evaluate(&self.rbfs);
                added = propose(&field, &objective.residual, &self.bounds, batch.min(count) - self.rbfs.len());
            }
            if added.is_empty() {
                break;
            }
            self.rbfs.extend(added);
            self.done = begin + (self.until - begin) * (self.rbfs.len() as f32 / count as f32);
            self.minimize(&mut objective, GROW_ITERATIONS, FitStage::Grow);
        }
        self.done = self.until;
        self.add_seconds(FitStage::Grow, started);
    }

    /// Teleportation rounds on coarser copies, then a run on the full grid. Uses the work up to the share `until`.
    fn refine(&mut self, rounds: u32, until: f32) {
        if self.rbfs.is_empty() {
            return;
        }
        let middle = self.shape.longest().div_ceil(MIDDLE);
        let begin = self.done;
        if self.coarse.factor > middle {
            self.until = begin + 0.1 * (until - begin);
            self.teleport(self.coarse.factor, rounds.min(COARSE_ROUNDS));
        }
        self.until = begin + 0.8 * (until - begin);
        self.teleport(middle, rounds);
        self.until = until;
        if middle > 1 {
            let started = Instant::now();
            let field = self.field(1);
            self.minimize(&mut Objective::new(&field), POLISH_ITERATIONS, FitStage::Polish);
            self.add_seconds(FitStage::Polish, started);
        }
        self.done = until;
    }

    /// Minimises, then moves the least significant Gaussians and minimises again, up to `rounds` times in all: to the
    /// largest error, and when that fails to random smoke. Fewer move after each failure; ends when both fail with the
    /// fewest.
    fn teleport(&mut self, factor: u32, rounds: u32) {
        let started = Instant::now();
        let field = self.field(factor);
        let mut objective = Objective::new(&field);
        let begin = self.done;
        let mut best = f64::INFINITY;
        let mut share = TELEPORTED;
        let mut at_random = false;
        for round in 0..rounds {
            let before = self.rbfs.clone();
            let moved = ((before.len() as f64 * share) as usize).max(1);
            if round > 0 {
                self.move_least_significant(moved, at_random);
            }
            self.done = begin + (self.until - begin) * (round as f32 / rounds as f32);
            let cost = self.minimize(&mut objective, ROUND_ITERATIONS, FitStage::Teleport);
            if cost < best * (1.0 - TOLERANCE) {
                best = cost;
                at_random = false;
                continue;
            }
            if cost >= best {
                self.rbfs = before;
            }
            if at_random {
                if moved == 1 {
                    break;
                }
                share *= 0.25;
            }
            at_random = !at_random;
        }
        self.done = self.until;
        self.add_seconds(FitStage::Teleport, started);
    }

    /// Takes `count` Gaussians away and puts as many where the error is largest, or in random smoke.
    fn move_least_significant(&mut self, count: usize, at_random: bool) {
        let before = self.rbfs.len();
        self.remove_least_significant(count);
        if !at_random {
            let added = self.propose(count);
            self.rbfs.extend(added);
        }
        // What found no place goes to random smoke, of middling size and half as dense.
        let smoke = self.coarse.blocks_with_smoke();
        let radius = (RADIUS.0 * RADIUS.1).sqrt();
        while self.rbfs.len() < before {
            let (center, density) = smoke[self.random.below(smoke.len())];
            self.rbfs.push(self.bounds.clamp(Rbf { center, radius, weight: 0.5 * density }));
        }
        self.report.teleports += count as u32;
    }

    /// Takes `count` Gaussians away and returns which are left, by their indices before.
    pub fn remove_least_significant(&mut self, count: usize) -> Vec<usize> {
        let mut order: Vec<usize> = (0..self.rbfs.len()).collect();
        order.sort_by(|&a, &b| significance(&self.rbfs[b]).total_cmp(&significance(&self.rbfs[a])));
        order.truncate(self.rbfs.len().saturating_sub(count));
        order.sort_unstable();
        self.rbfs = order.iter().map(|&index| self.rbfs[index]).collect();
        order
    }

    /// The Gaussians that help most beside those there are, as the coarse copy shows it.
    pub fn propose(&self, count: usize) -> Vec<Rbf> {
        let mut objective = Objective::new(&self.coarse);
        objective.evaluate(&self.rbfs);
        propose(&self.coarse, &objective.residual, &self.bounds, count)
    }

    /// Runs the minimiser and returns the sum of squared errors in units of the field's energy.
    pub fn minimize(&mut self, objective: &mut Objective, iterations: u32, stage: FitStage) -> f64 {
        let (energy, hidden) = (objective.field.energy, objective.field.hidden);
        let (fraction, rbfs) = (self.done, self.rbfs.len());
        let progress = self.progress;
        let mut observe = |cost: f64| {
            progress(FitProgress { stage, fraction, rbfs, error: ((cost + hidden) / energy).sqrt() as f32 });
        };
        let outcome = minimize(objective, &mut self.rbfs, &self.bounds, iterations, TOLERANCE, &mut observe);
        self.report.iterations += outcome.iterations;
        self.report.evaluations += outcome.evaluations;
        outcome.cost / energy
    }

    pub fn field(&self, factor: u32) -> Field {
        Field::new(self.shape, self.values, 1.0 / self.max, factor)
    }

    /// The model in units of density.
    pub fn model(&self) -> RbfModel {
        RbfModel { rbfs: self.rbfs.iter().map(|rbf| Rbf { weight: rbf.weight * self.max, ..*rbf }).collect() }
    }

    fn error(&self) -> f32 {
        relative_error(self.shape, self.values, &self.model())
    }

    fn tell(&self, stage: FitStage, error: f32) {
        (self.progress)(FitProgress { stage, fraction: self.done, rbfs: self.rbfs.len(), error });
    }

    pub fn add_seconds(&mut self, stage: FitStage, started: Instant) {
        let seconds = started.elapsed().as_secs_f64();
        match self.report.seconds.iter_mut().find(|entry| entry.0 == stage) {
            Some(entry) => entry.1 += seconds,
            None => self.report.seconds.push((stage, seconds)),
        }
    }
}

/// The search for the fewest Gaussians that reach an error.
impl Search<'_> {
    /// Grows until the error is near, refines until it is reached, then takes away what the target does not need.
    /// Returns whether it was reached with at most `most` Gaussians.
    fn spend_as_few(&mut self, target: f32, most: usize) -> bool {
        if target >= 1.0 || most == 0 {
            return target >= 1.0;
        }
        let factor = self.shape.longest().div_ceil(MIDDLE);
        // Errors fall about with a power of the count; the power is measured on the way.
        let mut power = 0.35;
        let (mut count, mut last) = (most.min(16), None);
        loop {
            self.until = self.done + 0.2 * (0.3 - self.done);
            self.grow(count, factor);
            let error = self.error();
            self.tell(FitStage::Grow, error);
            // Refining lowers an error by some percent.
            if error <= 1.03 * target || count == most || self.rbfs.len() < count {
                break;
            }
            if let Some((fewer, larger)) = last {
                power = slope(fewer, larger, count, error);
            }
            last = Some((count, error));
            count = count_for(target, count, error, power).clamp(count + 1, 2 * count).min(most);
        }
        let error = loop {
            let grown = self.rbfs.len();
            self.refine(ROUNDS, self.done + 0.4 * (0.9 - self.done));
            let error = self.error();
            if error <= target || grown >= most {
                break error;
            }
            self.until = self.done;
            self.grow(count_for(target, grown, error, power).clamp(grown + 1, 2 * grown).min(most), factor);
            if self.rbfs.len() == grown {
                break error;
            }
        };
        if error <= target {
            self.trim(target, error, power);
        }
        error <= target
    }

    /// Takes Gaussians away as long as the target holds, to within 2 % of the fewest.
    fn trim(&mut self, target: f32, mut error: f32, power: f64) {
        let mut failed = 0usize;
        loop {
            let count = self.rbfs.len();
            let middle = if failed == 0 { 1 } else { (failed + count).div_ceil(2) };
            let wanted = count_for(target, count, error, power).max(middle);
            if wanted + count / 50 >= count {
                return;
            }
            let before = self.rbfs.clone();
            self.remove_least_significant(count - wanted);
            self.refine(TRIM_ROUNDS, self.done + 0.4 * (1.0 - self.done));
            let trimmed = self.error();
            if trimmed <= target {
                error = trimmed;
            } else {
                self.rbfs = before;
                failed = wanted;
            }
        }
    }
}

/// The power with which the error falls between two fits.
fn slope(fewer: usize, larger: f32, more: usize, smaller: f32) -> f64 {
    let fall = f64::from(larger / smaller).ln() / (more as f64 / fewer as f64).ln();
    fall.clamp(0.1, 1.0)
}

/// The number of Gaussians that should have the error `target`, where `count` have `error`.
pub(super) fn count_for(target: f32, count: usize, error: f32, power: f64) -> usize {
    (count as f64 * f64::from(error / target).powf(1.0 / power)).ceil() as usize
}
