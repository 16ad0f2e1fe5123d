//! Fits the coefficients of `quality::model` to measurements.

use serde::Serialize;

use super::stage::Measurement;
use crate::quality::coefficients::{CPU_PRICES, GPU_PRICES};
use crate::quality::model::{Errors, FEATURES, PARTS, Prices, Setting, WORK, square};
use crate::quality::{Predictor, SmokeModel};

/// The coefficients, in single precision as the plug-in has them.
#[derive(Clone, Debug, Serialize)]
pub struct Fit {
    /// As the plug-in has them: what is left out is taken for so much worse than is likely.
    errors: Errors,
    likely: Errors,
    spread: f64,
    prices: Prices,
}

/// A row of a least-squares problem: features, and what they should add up to.
type Row<const N: usize> = ([f64; N], f64);

/// Weights of all parts of the error.
const WEIGHTS: usize = PARTS * FEATURES;

impl Fit {
    pub fn error(&self, setting: &Setting, model: &SmokeModel) -> f64 {
        setting.error(model, &self.errors).into()
    }

    pub fn likely_error(&self, setting: &Setting, model: &SmokeModel) -> f64 {
        setting.error(model, &self.likely).into()
    }

    pub fn milliseconds(&self, setting: &Setting, model: &SmokeModel) -> f64 {
        setting.milliseconds(model, &self.prices).total().into()
    }

    /// What auto predicts by, until something is measured.
    pub fn predictor(&self) -> Predictor {
        Predictor::with(self.prices, self.errors)
    }

    /// The source of `quality::coefficients`; the prices of the other kind of device stay as they are.
    pub fn to_rust(&self, on_gpu: bool) -> String {
        let (gpu, cpu) = if on_gpu { (self.prices, CPU_PRICES) } else { (GPU_PRICES, self.prices) };
        let errors: String = self.errors.iter().map(|weights| format!("    {weights:?},\n")).collect();
        format!(
            "//! What models cost and how far off they are, in numbers: `smoke study quality --write` writes this file.\n\n\
             use super::model::{{Errors, Prices}};\n\n\
             /// On a GPU.\npub const GPU_PRICES: Prices = {gpu:?};\n\n\
             /// On a CPU.\npub const CPU_PRICES: Prices = {cpu:?};\n\n\
             /// Against path tracing; what is left out is taken for somewhat more than is likely.\npub const ERRORS: Errors = \
             [\n{errors}];\n"
        )
    }
}

/// Fits all coefficients.
pub fn fit(measurements: &[Measurement]) -> Fit {
    let fitted: Vec<&Measurement> = measurements.iter().filter(|m| m.is_fitted).collect();
    let known: Vec<Known> = fitted.iter().flat_map(|m| Known::of(m)).collect();
    let (likely, spread) = errors(&known);
    let mut errors = likely;
    // The full model's own error is nobody's choice.
    for weights in &mut errors[1..] {
        weights[0] += spread.ln() as f32;
    }
    let (errors, likely) = (errors.map(|weights| weights.map(rounded)), likely.map(|weights| weights.map(rounded)));
    Fit { errors, likely, spread, prices: prices(&fitted).map(rounded) }
}

/// Five digits: more than measurements know.
fn rounded(value: f32) -> f32 {
    format!("{value:.4e}").parse().expect("it is a number")
}

/// What is known of parts of a picture's error.
struct Known {
    parts: [Option<[f32; FEATURES]>; PARTS],
    /// ln of them together.
    log: f64,
    weight: f64,
}

impl Known {
    /// A picture says what it is off. And if one thing is left out in it, then how much that changes it says what that thing is
    /// worth, though not all of it: what is left out and the full model's own error have something to do with each other.
    fn of(measurement: &Measurement) -> impl Iterator<Item = Self> + use<> {
        let Measurement { setting, model, error, change, .. } = measurement;
        let log = |value: f64| value.max(1e-5).ln();
        let all = setting.parts(model);
        let mut left_out = all;
        left_out[0] = None;
        let is_one = left_out.iter().flatten().count() == 1;
        let picture = error.map(|error| Self { parts: all, log: log(error), weight: 1.0 });
        picture.into_iter().chain(is_one.then(|| Self { parts: left_out, log: log(*change), weight: 0.3 }))
    }

    /// How far off the prediction of the logarithm is, and how it changes with the weights.
    fn residual(&self, errors: &Errors) -> Row<WEIGHTS> {
        let parts = || self.parts.iter().zip(errors).enumerate().filter_map(|(i, (part, w))| Some((i, (*part)?, w)));
        let sum: f64 = parts().map(|(_, features, weights)| f64::from(square(&features, weights))).sum();
        let mut slope = [0.0; WEIGHTS];
        for (i, features, weights) in parts() {
            let share = f64::from(square(&features, weights)) / sum;
            for (j, feature) in features.into_iter().enumerate() {
                slope[i * FEATURES + j] = self.weight * share * f64::from(feature);
            }
        }
        (slope, self.weight * (0.5 * sum.ln() - self.log))
    }
}

/// The weights that predict the logarithms of errors best, by Gauss and Newton, and the factor that pictures' are then off by
/// (root mean square of the logarithm).
fn errors(known: &[Known]) -> (Errors, f64) {
    let squares = |errors: &Errors| known.iter().map(|known| known.residual(errors).1.powi(2)).sum::<f64>();
    // Each part two percent, whatever its features.
    let mut errors: Errors = [core::array::from_fn(|j| if j == 0 { 0.02_f32.ln() } else { 0.0 }); PARTS];
    let mut now = squares(&errors);
    for _ in 0..STEPS {
        let step: [f32; WEIGHTS] = solve(known.iter().map(|known| known.residual(&errors)));
        // As much of the step as helps.
        let shorter = (0..10).map(|halvings| {
            let next: Errors = core::array::from_fn(|i| {
                core::array::from_fn(|j| errors[i][j] - step[i * FEATURES + j] * 0.5_f32.powi(halvings))
            });
            (next, squares(&next))
        });
        match shorter.into_iter().find(|(_, after)| *after < now) {
            Some(found) => (errors, now) = found,
            None => break,
        }
    }
    let pictures = || known.iter().filter(|known| known.parts[0].is_some());
    let off: f64 = pictures().map(|picture| picture.residual(&errors).1.powi(2)).sum();
    (errors, (off / pictures().count().max(1) as f64).sqrt().exp())
}

/// Steps after which nothing has ever been gained.
const STEPS: u32 = 100;

/// The prices of work, from the times of whole frames, all relative errors being alike.
fn prices(measurements: &[&Measurement]) -> [f32; WORK] {
    let rows = measurements.iter().map(|m| (m.setting.work(&m.model).map(f64::from), m.milliseconds));
    relative(
        rows.filter(|(_, time)| *time > IN_NOISE).map(|(features, time)| (features.map(|f| f / time), 1.0)).collect(),
    )
}

/// Least absolute residuals, so that times of which something else took its share count little; nothing below 0.
fn relative<const N: usize>(mut rows: Vec<Row<N>>) -> [f32; N] {
    // By least squares of rows that weigh less the farther off they are.
    let all = rows.clone();
    let mut found = not_negative(&rows);
    for _ in 0..ROUNDS {
        for (row, (features, value)) in rows.iter_mut().zip(&all) {
            let sum: f64 = features.iter().zip(found).map(|(feature, weight)| feature * f64::from(weight)).sum();
            let weight = (sum - value).abs().max(CLOSE).sqrt().recip();
            *row = (features.map(|feature| weight * feature), weight * value);
        }
        found = not_negative(&rows);
    }
    found
}

/// Milliseconds of frames that take no longer than those without smoke.
const IN_NOISE: f64 = 1e-3;
/// Rounds after which weights change no more.
const ROUNDS: u32 = 30;
/// What is as close as this is as good as exact.
const CLOSE: f64 = 0.05;

/// Least squares, with nothing below 0.
fn not_negative<const N: usize>(rows: &[Row<N>]) -> [f32; N] {
    // What helps none is left out, until nothing is below 0.
    let mut used = [true; N];
    loop {
        let keep = |features: [f64; N]| core::array::from_fn(|i| if used[i] { features[i] } else { 0.0 });
        let found: [f32; N] = solve(rows.iter().map(|(features, value)| (keep(*features), *value)));
        match (0..N).filter(|&i| found[i] < 0.0).min_by(|&a, &b| found[a].total_cmp(&found[b])) {
            Some(worst) => used[worst] = false,
            None => return found,
        }
    }
}

/// Least squares by the normal equations, with a ridge that decides where features are alike.
fn solve<const N: usize>(rows: impl Iterator<Item = Row<N>>) -> [f32; N] {
    let (mut matrix, mut right) = ([[0.0; N]; N], [0.0; N]);
    for (features, value) in rows {
        for i in 0..N {
            for j in 0..N {
                matrix[i][j] += features[i] * features[j];
            }
            right[i] += features[i] * value;
        }
    }
    for (i, row) in matrix.iter_mut().enumerate() {
        row[i] += 1e-6 * row[i] + 1e-12;
    }
    for i in 0..N {
        let (pivot, below) = matrix.split_at_mut(i + 1);
        let pivot = &pivot[i];
        for (row, values) in below.iter_mut().enumerate() {
            let factor = values[i] / pivot[i];
            values.iter_mut().zip(pivot).for_each(|(value, above)| *value -= factor * above);
            right[i + 1 + row] -= factor * right[i];
        }
    }
    let mut found = [0.0; N];
    for i in (0..N).rev() {
        let known: f64 = (i + 1..N).map(|j| matrix[i][j] * found[j]).sum();
        found[i] = (right[i] - known) / matrix[i][i];
    }
    found.map(|value| value as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::quality::coefficients::ERRORS;

    #[test]
    fn coefficients_are_as_written() {
        let fit = Fit { errors: ERRORS, likely: ERRORS, spread: 1.0, prices: CPU_PRICES };
        assert_eq!(fit.to_rust(false), include_str!("../../../quality/coefficients.rs"));
    }

    #[test]
    fn a_plane_is_found_again() {
        let rows = (0..20).map(|i| {
            let (x, y) = (f64::from(i), f64::from(i * i % 7));
            ([1.0, x, y], 2.0 - 0.5 * x + 3.0 * y)
        });
        let found = solve(rows);
        assert!(found.iter().zip([2.0, -0.5, 3.0]).all(|(a, b)| (a - b).abs() < 1e-3), "{found:?}");
    }

    #[test]
    fn weights_are_found_again_from_sums_of_parts() {
        let mut truth: Errors = [[0.0; FEATURES]; PARTS];
        truth[0] = [-4.5, 0.3, 0.0, 0.1];
        truth[1] = [-4.0, 0.2, 0.9, 0.0];
        let mut known: Vec<Known> = (0..60)
            .map(|i| {
                let x = i as f32;
                let mut parts = [None; PARTS];
                parts[0] = Some([1.0, (x * 0.7).sin(), (x * 1.3).cos(), (i % 2) as f32]);
                parts[1] = (i % 3 > 0).then(|| [1.0, (x * 0.7).sin(), (x * 2.1).cos(), (i % 2) as f32]);
                Known { parts, log: 0.0, weight: 1.0 }
            })
            .collect();
        for known in &mut known {
            known.log = known.residual(&truth).1;
        }
        let (found, spread) = errors(&known);
        assert!(spread < 1.001, "{spread}");
        let off = |i: usize, j: usize| (found[i][j] - truth[i][j]).abs();
        assert!((0..2).all(|i| (0..FEATURES).all(|j| off(i, j) < 0.01)), "{found:?}");
    }

    #[test]
    fn prices_are_not_negative_and_hiccups_count_little() {
        // Falls with the second: which then is left out.
        let found = relative((1..20).map(|i| ([1.0, 1.0 / f64::from(i)], 2.0 - 0.5 / f64::from(i))).collect());
        assert!(found[0] > 1.5 && found[1] == 0.0, "{found:?}");
        // Every fifth takes twice as long.
        let rows = (1..40).map(|i| {
            let time = if i % 5 == 0 { 2.0 } else { 1.0 } * (3.0 * f64::from(i) + 5.0);
            ([f64::from(i) / time, 1.0 / time], 1.0)
        });
        let found = relative(rows.collect());
        assert!((found[0] - 3.0).abs() < 0.2 && (found[1] - 5.0).abs() < 0.5, "{found:?}");
    }
}
