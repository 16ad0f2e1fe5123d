use std::cell::RefCell;

use glam::{UVec3, Vec3};
use proptest::prelude::*;

use super::field::Field;
use super::objective::Objective;
use super::*;
use crate::random::SplitMix64;

fn shape(x: u32, y: u32, z: u32) -> GridShape {
    GridShape::new(UVec3::new(x, y, z))
}

fn quiet(_: FitProgress) {}

fn settings(target: FitTarget) -> FitSettings {
    FitSettings { target, ..FitSettings::default() }
}

/// Random Gaussians of all the sizes that a fit may use.
fn blobs(shape: GridShape, count: usize, seed: u64) -> RbfModel {
    let mut random = SplitMix64(seed);
    let mut uniform = move || random.below(1 << 20) as f32 / (1 << 20) as f32;
    let half = shape.half_extent();
    let rbfs = (0..count)
        .map(|_| Rbf {
            center: [0, 1, 2].map(|axis| half[axis] * 1.4 * (uniform() - 0.5)),
            radius: 0.02 + 0.06 * uniform(),
            weight: 0.2 + 0.8 * uniform(),
        })
        .collect();
    RbfModel { rbfs }
}

/// Something like smoke: blobs, roughened cell by cell.
fn smoke(shape: GridShape, seed: u64) -> Vec<f32> {
    let mut random = SplitMix64(seed ^ 99);
    let rough = blobs(shape, 40, seed).rasterize(shape);
    rough.iter().map(|value| value * (0.7 + 0.6 * random.below(1000) as f32 / 1000.0)).collect()
}

fn bytes(fit: &Fit) -> Vec<u8> {
    bytemuck::cast_slice(&fit.model.rbfs).to_vec()
}

#[test]
fn the_sum_of_squares_is_that_of_the_rasterized_model() {
    let shape = shape(21, 30, 17);
    let values = smoke(shape, 3);
    let model = blobs(shape, 12, 4);
    let field = Field::new(shape, &values, 1.0, 1);
    let cost = Objective::new(&field).evaluate(&model.rbfs);
    let direct = f64::from(relative_error(shape, &values, &model)).powi(2) * field.energy;
    // The objective takes supports in whole chunks: tails below e⁻⁹ of a weight differ.
    assert!((cost / direct - 1.0).abs() < 1e-3, "{cost} against {direct}");
}

#[test]
fn a_field_of_blocks_loses_only_what_varies_inside_them() {
    let fine = shape(13, 8, 9);
    let values = smoke(fine, 5);
    let field = Field::new(fine, &values, 1.0, 4);
    let squares: f64 = values.iter().map(|&v| f64::from(v).powi(2)).sum();
    assert!((field.energy * 64.0 / squares - 1.0).abs() < 1e-6);

    let model = blobs(fine, 5, 6);
    let rest: Vec<f32> = values.iter().zip(model.rasterize(fine)).map(|(v, m)| v - m).collect();
    let means = Field::new(fine, &rest, 1.0, 4);
    let expected = means.energy - means.hidden;
    let cost = Objective::new(&field).evaluate(&model.rbfs);
    // Block means of the Gaussians come from one-dimensional means, so only the edge of the support differs.
    assert!((cost / expected - 1.0).abs() < 5e-3, "{cost} against {expected}");
}

#[test]
fn gradients_agree_with_differences() {
    let shape = shape(30, 24, 26);
    let values = smoke(shape, 7);
    for factor in [1, 2, 3] {
        let field = Field::new(shape, &values, 1.0, factor);
        let mut objective = Objective::new(&field);
        let rbfs = blobs(shape, 6, 8).rbfs;
        objective.evaluate(&rbfs);
        let gradient = objective.gradient();
        for (index, gradient) in gradient.iter().enumerate() {
            let largest = gradient.iter().fold(0.0f64, |a, b| a.max(b.abs()));
            for (variable, &derivative) in gradient.iter().enumerate() {
                let mut cost = |step: f32| {
                    let mut moved = rbfs.clone();
                    let rbf = &mut moved[index];
                    match variable {
                        3 => rbf.radius += step,
                        4 => rbf.weight += step,
                        axis => rbf.center[axis] += step,
                    }
                    objective.evaluate(&moved)
                };
                let step = 1e-3 * if variable == 4 { 1.0 } else { rbfs[index].radius };
                let difference = 0.25 * (cost(step) - cost(-step)) / f64::from(step);
                // f32 sums and the cut at the edge of the support: 0.5 % of the largest component.
                let error = (derivative - difference).abs();
                assert!(error < 5e-3 * largest, "{factor} {index} {variable}: {derivative} {difference}");
            }
        }
    }
}

#[test]
fn finds_a_sum_of_gaussians_again() {
    let shape = shape(40, 48, 32);
    let rbfs = vec![
        Rbf { center: [-0.2, 0.1, 0.05], radius: 0.08, weight: 2.0 },
        Rbf { center: [0.15, -0.25, -0.1], radius: 0.05, weight: 1.0 },
        Rbf { center: [0.1, 0.2, 0.1], radius: 0.06, weight: 1.5 },
    ];
    let values = RbfModel { rbfs }.rasterize(shape);
    let fit = fit(shape, &values, &settings(FitTarget::Count(3)), &quiet).unwrap();
    assert!(fit.report.reached && fit.model.rbfs.len() == 3);
    // The model can be exact; what remains is where the minimiser stops.
    assert!(fit.report.error < 0.02, "{}", fit.report.error);
}

#[test]
fn more_gaussians_fit_better() {
    let shape = shape(48, 64, 48);
    let values = smoke(shape, 11);
    let errors = [5, 20, 60].map(|n| fit(shape, &values, &settings(FitTarget::Count(n)), &quiet).unwrap().report.error);
    assert!(errors[0] > errors[1] && errors[1] > errors[2], "{errors:?}");
    // What is left is the roughness: uniform in 0.7..1.3, so 0.17 of the density.
    assert!(errors[2] < 0.25, "{errors:?}");
}

#[test]
fn the_same_for_a_seed_on_any_number_of_threads() {
    let shape = shape(40, 56, 36);
    let values = smoke(shape, 13);
    let on = |threads: usize, seed: u64| {
        let settings = FitSettings { target: FitTarget::Count(40), seed, ..FitSettings::default() };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        // Callbacks need not be thread-safe, so they are made inside the pool.
        bytes(&pool.install(|| fit(shape, &values, &settings, &quiet).unwrap()))
    };
    let one = on(1, 5);
    assert_eq!(one, on(2, 5));
    assert_eq!(one, on(3, 5));
}

#[test]
fn a_target_error_takes_few_gaussians() {
    let shape = shape(48, 64, 48);
    let values = smoke(shape, 17);
    let reached = fit(shape, &values, &settings(FitTarget::Error(0.35)), &quiet).unwrap();
    assert!(reached.report.reached && reached.report.error <= 0.35);
    let n = reached.model.rbfs.len();
    // A tenth fewer do not reach it.
    let fewer = fit(shape, &values, &settings(FitTarget::Count(n * 9 / 10)), &quiet).unwrap();
    assert!(fewer.report.error > 0.35, "{n} spent, {} for a tenth fewer", fewer.report.error);
}

#[test]
fn a_target_out_of_reach_gives_the_best() {
    let shape = shape(24, 24, 24);
    let values = smoke(shape, 19);
    let settings = FitSettings { target: FitTarget::Error(1e-6), max_rbfs: 20, ..FitSettings::default() };
    let best = fit(shape, &values, &settings, &quiet).unwrap();
    assert!(!best.report.reached && best.model.rbfs.len() == 20);
    assert!(best.report.error < 0.9, "{}", best.report.error);
}

/// Blobs in a row, moved by `shift`.
fn row(shape: GridShape, count: usize, shift: f32) -> Vec<f32> {
    let rbf = |i: usize| Rbf {
        center: [0.14 * i as f32 - 0.35 + shift, 0.1 * (i % 2) as f32, 0.5 * shift],
        radius: 0.05 + 0.005 * i as f32,
        weight: 1.0 + 0.1 * i as f32,
    };
    RbfModel { rbfs: (0..count).map(rbf).collect() }.rasterize(shape)
}

fn followed(shape: GridShape, values: &[f32], previous: &NumberedRbfs, limit: f32, max_rbfs: usize) -> Followed {
    follow(shape, values, previous, &FollowSettings { limit, max_rbfs, trim: false }, &quiet).unwrap()
}

#[test]
fn gaussians_follow_the_smoke() {
    let shape = shape(56, 32, 24);
    let start = fit(shape, &row(shape, 6, 0.0), &settings(FitTarget::Count(20)), &quiet).unwrap();
    let start = NumberedRbfs::new(start.model, 7);
    let next = row(shape, 6, 0.03);
    let stayed = relative_error(shape, &next, &start.model);
    let after = followed(shape, &next, &start, 1.0, 40);
    assert!(after.report.error < 0.3 * stayed, "{} of {stayed}", after.report.error);
    assert_eq!(after.inserted, 0, "the limit is reached without");
    assert!((1..=4).contains(&after.deleted), "{}", after.deleted);
    assert_eq!(after.rbfs.next_id, start.next_id);
    // Whoever is still there has its place, unless the list has become too short for it.
    let places = after.rbfs.ids.iter().zip(&start.ids).filter(|(a, b)| a == b).count();
    assert!(places >= after.rbfs.ids.len() - after.deleted);
    assert!(after.rbfs.ids.iter().all(|id| start.ids.contains(id)));
}

#[test]
fn new_smoke_gets_new_gaussians_and_old_smoke_loses_them() {
    let shape = shape(56, 32, 24);
    let (few, many) = (row(shape, 2, 0.0), row(shape, 6, 0.0));
    let start = fit(shape, &few, &settings(FitTarget::Count(6)), &quiet).unwrap();
    let start = NumberedRbfs::new(start.model, 0);
    let grown = followed(shape, &many, &start, 0.1, 60);
    assert!(grown.report.reached && grown.inserted >= 4, "{} {}", grown.report.error, grown.inserted);
    assert_eq!(grown.rbfs.ids.len(), start.ids.len() - grown.deleted + grown.inserted);
    assert_eq!(grown.rbfs.next_id, start.next_id + grown.inserted as u32);
    let mut ids = grown.rbfs.ids.clone();
    ids.sort_unstable();
    ids.dedup();
    assert_eq!(ids.len(), grown.rbfs.ids.len());

    let faded = followed(shape, &few, &grown.rbfs, 0.1, 60);
    assert!(faded.report.reached && faded.deleted > grown.inserted / 2, "{} of {}", faded.deleted, grown.inserted);
    let most = followed(shape, &many, &start, 1e-4, 9);
    assert!(!most.report.reached && most.rbfs.ids.len() == 9);
    let none = followed(shape, &vec![0.0; shape.len()], &start, 0.1, 9);
    assert!(none.rbfs.ids.is_empty() && none.deleted == start.ids.len() && none.rbfs.next_id == start.next_id);
}

#[test]
fn following_is_the_same_on_any_number_of_threads() {
    let shape = shape(40, 56, 36);
    let start = NumberedRbfs::new(blobs(shape, 40, 3), 0);
    let values = smoke(shape, 13);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| followed(shape, &values, &start, 0.3, 60)).rbfs
    };
    let one = on(1);
    assert_eq!(one, on(2));
    assert_eq!(one, on(3));
}

#[test]
fn grids_of_few_cells() {
    for (x, y, z) in [(1, 1, 1), (2, 1, 1), (1, 7, 1), (16, 16, 1), (1, 200, 2), (3, 3, 3)] {
        let shape = shape(x, y, z);
        for count in [1, 5] {
            let fit = fit(shape, &vec![2.5; shape.len()], &settings(FitTarget::Count(count)), &quiet).unwrap();
            assert!(!fit.model.rbfs.is_empty() && fit.model.rbfs.len() <= count);
            assert!(fit.report.error < 1.0, "{x} {y} {z}: {}", fit.report.error);
        }
        let error = fit(shape, &vec![2.5; shape.len()], &settings(FitTarget::Error(0.5)), &quiet).unwrap();
        assert!(error.report.error.is_finite());
    }
    // One cell is one Gaussian, whatever is asked for.
    let one = fit(shape(1, 1, 1), &[3.0], &settings(FitTarget::Count(9)), &quiet).unwrap();
    assert_eq!(one.model.rbfs.len(), 1);
    assert!(one.report.error < 1e-3 && !one.report.reached);
}

#[test]
fn no_smoke_no_gaussians() {
    let shape = shape(9, 4, 3);
    for target in [FitTarget::Count(10), FitTarget::Error(0.1)] {
        let fit = fit(shape, &vec![0.0; shape.len()], &settings(target), &quiet).unwrap();
        assert!(fit.model.rbfs.is_empty() && fit.report.error == 0.0);
    }
    let none = fit(shape, &vec![1.0; shape.len()], &settings(FitTarget::Count(0)), &quiet).unwrap();
    assert!(none.model.rbfs.is_empty() && none.report.error == 1.0 && none.report.reached);
}

#[test]
fn input_that_makes_no_sense() {
    let shape = shape(2, 2, 2);
    let count = settings(FitTarget::Count(1));
    assert_eq!(fit(shape, &[1.0; 7], &count, &quiet).unwrap_err(), FitError::Length { expected: 8, found: 7 });
    let mut values = [1.0; 8];
    values[3] = f32::NAN;
    assert_eq!(fit(shape, &values, &count, &quiet).unwrap_err(), FitError::NotFinite(UVec3::new(1, 1, 0)));
    for error in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        let refused = fit(shape, &[1.0; 8], &settings(FitTarget::Error(error)), &quiet);
        assert!(matches!(refused, Err(FitError::Target(_))));
    }
}

#[test]
fn progress_only_rises() {
    let shape = shape(32, 32, 32);
    let values = smoke(shape, 23);
    for target in [FitTarget::Count(30), FitTarget::Error(0.4)] {
        let seen = RefCell::new(Vec::new());
        fit(shape, &values, &settings(target), &|progress| seen.borrow_mut().push(progress)).unwrap();
        let seen = seen.into_inner();
        assert!(seen.windows(2).all(|pair| pair[0].fraction <= pair[1].fraction));
        assert!(seen.iter().all(|p| (0.0..=1.0).contains(&p.fraction) && p.error.is_finite()));
        assert_eq!(seen.last().unwrap().fraction, 1.0);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn gaussians_stay_within_bounds(
        x in 1u32..12, y in 1u32..12, z in 1u32..12, count in 1usize..8, seed: u64, scale in -20f32..20.0,
    ) {
        let shape = shape(x, y, z);
        let mut random = SplitMix64(seed);
        let scale = 10f32.powf(scale);
        let values: Vec<f32> = (0..shape.len()).map(|_| scale * random.below(4) as f32).collect();
        let max = values.iter().copied().fold(0.0, f32::max);
        let fit = fit(shape, &values, &settings(FitTarget::Count(count)), &quiet).unwrap();
        prop_assert!(fit.model.rbfs.len() <= count);
        prop_assert!((0.0..=1.001).contains(&fit.report.error), "{}", fit.report.error);
        for rbf in &fit.model.rbfs {
            prop_assert!(Vec3::from(rbf.center).abs().cmple(shape.half_extent()).all());
            prop_assert!((RADIUS.0..=RADIUS.1).contains(&rbf.radius));
            // A rounding when densities are scaled back.
            prop_assert!(rbf.weight >= 0.999 * WEIGHT.0 * max && rbf.weight <= 1.001 * WEIGHT.1 * max);
        }
    }
}
