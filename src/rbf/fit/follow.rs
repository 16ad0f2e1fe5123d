//! The next frame of a sequence: the Gaussians of the frame before move on (Zhou et al. 2008, section 5.1).
//!
//! [`follow`] deletes the few least significant Gaussians, lets L-BFGS-B take the others to the new frame, and while the
//! error is above a limit adds Gaussians where it is largest. Nothing is teleported: a Gaussian that goes on keeps its
//! number ([`NumberedRbfs::ids`]) and its place in the list, so that players can move it from frame to frame.

use std::time::Instant;

use super::objective::Objective;
use super::place::propose;
use super::search::{MIDDLE, Search, count_for};
use super::{FitError, FitProgress, FitReport, FitStage, WEIGHT, check, relative_error};
use crate::density::GridShape;
use crate::rbf::{Rbf, RbfModel};

/// Share of the Gaussians that is deleted before a frame is fitted: the least significant. Rounded down: few Gaussians are
/// all needed. On every other of 18 frames of a plume the fit's error is 15.9 % with none, 14.8 % with 2 % and 14.1 % with
/// 5 %; what lies half-way between two frames is 22.8 % off the frame there with each.
const DELETED: f64 = 0.02;
/// Share of the Gaussians that a frame better than its limit may lose, where as few are wanted as it takes.
const TRIMMED: f64 = 0.1;
/// Gaussians are added in batches that grow the model by at most this factor, and at most this many batches.
const GROWTH: f64 = 1.4;
const BATCHES: u32 = 12;
/// Iterations of the minimiser from the frame before, after a batch, and on the full grid. A third of the first two have
/// errors of 14.8 % for 13.2 % on the frames above, and 22.8 % for 22.3 % half-way. Moving centres alone at first, or
/// on a coarser copy, is worse half-way: 23.4 to 23.9 %; fading one frame into the other would be 28.4 % off.
const MOVE_ITERATIONS: u32 = 60;
const INSERT_ITERATIONS: u32 = 30;
const POLISH_ITERATIONS: u32 = 8;
/// Power of the count with which errors fall, for guesses of how many are missing.
const POWER: f64 = 0.35;

/// The Gaussians of a frame and who they are.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NumberedRbfs {
    /// The Gaussians, weights in units of density.
    pub model: RbfModel,
    /// The number of each, none twice.
    pub ids: Vec<u32>,
    /// The number that the next new Gaussian gets: above all that have been used.
    pub next_id: u32,
}

impl NumberedRbfs {
    /// New Gaussians, numbered from `next_id` on.
    pub fn new(model: RbfModel, next_id: u32) -> Self {
        let end = next_id + model.rbfs.len() as u32;
        Self { model, ids: (next_id..end).collect(), next_id: end }
    }
}

/// How closely to follow.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FollowSettings {
    /// Gaussians are added while the relative error is above this; above 0.
    pub limit: f32,
    /// Most Gaussians.
    pub max_rbfs: usize,
    /// Where the error is well below the limit, take more Gaussians away than the few that every frame loses.
    pub trim: bool,
}

/// The next frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Followed {
    /// Its Gaussians. Those that the frame before had are at the same index, unless the list has become shorter.
    pub rbfs: NumberedRbfs,
    /// How they came about; `reached` tells whether the error is within the limit.
    pub report: FitReport,
    /// Gaussians that the frame before did not have.
    pub inserted: usize,
    /// Gaussians that only the frame before had.
    pub deleted: usize,
}

/// Fits the frame after one that has been fitted, `values` in flat order over `shape`.
///
/// The result depends on the arguments alone, not on how `previous` came about nor on the number of threads.
///
/// # Errors
///
/// Only for input that makes no sense: see [`FitError`].
pub fn follow(
    shape: GridShape,
    values: &[f32],
    previous: &NumberedRbfs,
    settings: &FollowSettings,
    progress: &dyn Fn(FitProgress),
) -> Result<Followed, FitError> {
    check(shape, values)?;
    if !(settings.limit > 0.0 && settings.limit.is_finite()) {
        return Err(FitError::Target(settings.limit));
    }
    let before = previous.ids.len();
    let max = values.iter().copied().fold(0.0, f32::max);
    if max < f32::MIN_POSITIVE {
        let rbfs = NumberedRbfs { next_id: previous.next_id, ..NumberedRbfs::default() };
        let report = FitReport { reached: true, ..FitReport::default() };
        return Ok(Followed { rbfs, report, inserted: 0, deleted: before });
    }
    let mut track = Track::new(Search::new(shape, values, max, 0, progress), previous);
    track.run(settings);

    let Track { search, indices } = track;
    let model = search.model();
    let error = relative_error(shape, values, &model);
    let report = FitReport { error, reached: error <= settings.limit, ..search.report };
    let survivors = indices.iter().flatten().count();
    let inserted = indices.len() - survivors;
    Ok(Followed { rbfs: arrange(&model.rbfs, &indices, previous), report, inserted, deleted: before - survivors })
}

/// A frame being followed.
struct Track<'a> {
    search: Search<'a>,
    /// For each Gaussian of the search its index in the frame before, if it was there.
    indices: Vec<Option<usize>>,
}

impl<'a> Track<'a> {
    fn new(mut search: Search<'a>, previous: &NumberedRbfs) -> Self {
        let normalized = |rbf: &Rbf| Rbf { weight: rbf.weight / search.max, ..*rbf };
        search.rbfs = previous.model.rbfs.iter().map(|rbf| search.bounds.clamp(normalized(rbf))).collect();
        Self { search, indices: (0..previous.ids.len()).map(Some).collect() }
    }

    fn run(&mut self, settings: &FollowSettings) {
        let started = Instant::now();
        let FollowSettings { limit, max_rbfs, trim } = *settings;
        let few = (self.indices.len() as f64 * DELETED) as usize;
        self.delete(few.max(self.indices.len().saturating_sub(max_rbfs)));

        let factor = self.search.shape.longest().div_ceil(MIDDLE);
        let field = self.search.field(factor);
        let mut objective = Objective::new(&field);
        let mut error = self.minimize(&mut objective, MOVE_ITERATIONS, FitStage::Follow);
        let count = self.indices.len();
        // Those at the least weight would be gone if they could.
        let faded = self.search.rbfs.iter().filter(|rbf| rbf.weight <= WEIGHT.0).count();
        let spare = if trim && error < limit { count - count_for(limit, count, error, POWER).min(count) } else { 0 };
        self.delete(faded.max(spare.min((count as f64 * TRIMMED) as usize)));
        self.search.done = 0.5;
        if self.indices.len() < count {
            error = self.minimize(&mut objective, INSERT_ITERATIONS, FitStage::Follow);
        }
        self.search.add_seconds(FitStage::Follow, started);

        let started = Instant::now();
        self.search.done = 0.7;
        for _ in 0..BATCHES {
            let count = self.indices.len();
            if error <= limit || count >= max_rbfs {
                break;
            }
            let most = (count as f64 * GROWTH) as usize + 8;
            let wanted = count_for(limit, count, error, POWER).clamp(count + 1, most).min(max_rbfs);
            let mut added = self.search.propose(wanted - count);
            if added.is_empty() {
                // What is left is too small for the coarse copy.
                added = propose(&field, &objective.residual, &self.search.bounds, wanted - count);
            }
            if added.is_empty() {
                break;
            }
            self.indices.extend(added.iter().map(|_| None));
            self.search.rbfs.extend(added);
            error = self.minimize(&mut objective, INSERT_ITERATIONS, FitStage::Grow);
        }
        self.search.add_seconds(FitStage::Grow, started);

        if factor > 1 {
            let started = Instant::now();
            self.search.done = 0.9;
            let field = self.search.field(1);
            self.minimize(&mut Objective::new(&field), POLISH_ITERATIONS, FitStage::Polish);
            self.search.add_seconds(FitStage::Polish, started);
        }
    }

    /// Takes the `count` least significant Gaussians away.
    fn delete(&mut self, count: usize) {
        let kept = self.search.remove_least_significant(count);
        self.indices = kept.into_iter().map(|index| self.indices[index]).collect();
    }

    /// Runs the minimiser and returns the relative error.
    fn minimize(&mut self, objective: &mut Objective, iterations: u32, stage: FitStage) -> f32 {
        let hidden = objective.field.hidden / objective.field.energy;
        if self.search.rbfs.is_empty() {
            return 1.0;
        }
        (self.search.minimize(objective, iterations, stage) + hidden).sqrt() as f32
    }
}

/// The list of a frame: who was there before stays where it was, the rest fill what has become free.
fn arrange(rbfs: &[Rbf], indices: &[Option<usize>], previous: &NumberedRbfs) -> NumberedRbfs {
    let count = rbfs.len();
    let mut places: Vec<Option<(Rbf, u32)>> = vec![None; count];
    let mut others = Vec::new();
    let mut next_id = previous.next_id;
    for (&rbf, &index) in rbfs.iter().zip(indices) {
        match index {
            Some(index) if index < count => places[index] = Some((rbf, previous.ids[index])),
            Some(index) => others.push((rbf, previous.ids[index])),
            None => {
                others.push((rbf, next_id));
                next_id += 1;
            }
        }
    }
    let mut others = others.into_iter();
    let (rbfs, ids) =
        places.into_iter().map(|place| place.or_else(|| others.next()).expect("as many as there are places")).unzip();
    NumberedRbfs { model: RbfModel { rbfs }, ids, next_id }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn survivors_stay_where_they_were() {
        let rbf = |weight| Rbf { center: [0.0; 3], radius: 0.1, weight };
        let previous = NumberedRbfs { ids: vec![4, 9, 2, 7, 5], next_id: 10, ..Default::default() };
        // 9 and 7 have been deleted; one is new.
        let now = [rbf(1.0), rbf(2.0), rbf(3.0), rbf(4.0)];
        let arranged = arrange(&now, &[Some(0), Some(2), Some(4), None], &previous);
        assert_eq!(arranged.ids, [4, 5, 2, 10]);
        assert_eq!(arranged.model.rbfs.iter().map(|r| r.weight).collect::<Vec<_>>(), [1.0, 3.0, 2.0, 4.0]);
        assert_eq!(arranged.next_id, 11);
    }
}
