//! Fits the coefficients of `quality::model` to measurements.

use serde::Serialize;

use super::stage::Measurement;
use crate::quality::coefficients::{CPU_PRICES, GPU_PRICES};
use crate::quality::model::{Errors, Prices, Setting, WORK};
use crate::quality::{Machine, QualityChoice, SmokeModel, SmokeQuality};

/// The coefficients, in single precision as the plug-in has them.
#[derive(Clone, Debug, Serialize)]
pub struct Fit {
    errors: Errors,
    prices: Prices,
}

/// A row of a least-squares problem: features, and what they should add up to.
type Row<const N: usize> = ([f64; N], f64);

impl Fit {
    pub fn error(&self, setting: &Setting, model: &SmokeModel) -> f64 {
        setting.error_with(model, &self.errors).into()
    }

    pub fn milliseconds(&self, setting: &Setting, model: &SmokeModel) -> f64 {
        setting.milliseconds(model, &self.prices).total().into()
    }

    /// What auto would choose.
    pub fn choose(&self, asked: SmokeQuality, setting: &Setting) -> SmokeModel {
        QualityChoice::best_with(asked, setting, &Machine::with(self.prices), &self.errors).model
    }

    /// The source of `quality::coefficients`; the prices of the other kind of device stay as they are.
    pub fn to_rust(&self, on_gpu: bool) -> String {
        let Errors { base, fewer, probes, directions, order, step, half } = self.errors;
        let (gpu, cpu) = if on_gpu { (self.prices, CPU_PRICES) } else { (GPU_PRICES, self.prices) };
        format!(
            "//! What models cost and how far off they are, in numbers: `smoke study quality --write` writes this file.\n\n\
             use super::model::{{Errors, Prices}};\n\n\
             /// On a GPU.\npub const GPU_PRICES: Prices = {gpu:?};\n\n\
             /// On a CPU.\npub const CPU_PRICES: Prices = {cpu:?};\n\n\
             /// Against path tracing, and of models against the full one.\n\
             pub const ERRORS: Errors = Errors {{\n    base: {base:?},\n    fewer: {fewer:?},\n    probes: {probes:?},\n    \
             directions: {directions:?},\n    order: {order:?},\n    step: {step:?},\n    half: {half:?},\n}};\n"
        )
    }
}

/// Fits all coefficients.
pub fn fit(measurements: &[Measurement]) -> Fit {
    let full = SmokeModel::FULL;
    let fitted: Vec<&Measurement> = measurements.iter().filter(|m| m.is_fitted).collect();
    let log = |value: f64| value.max(1e-5).ln();
    // The full model against the truth.
    let base = fitted.iter().filter(|m| m.model == full).filter_map(|m| {
        let radius = m.setting.radius(&full);
        Some(([1.0, radius, radius * radius, m.setting.once()].map(f64::from), log(m.error?)))
    });
    // The others against the full model's picture. Few RBFs change it too: what is left is what counts.
    let only = |change: fn(&SmokeModel) -> SmokeModel| {
        fitted.iter().filter(move |m| m.model != full && change(&m.model) == full).copied()
    };
    let fewer = only(|m| SmokeModel { rbfs: u32::MAX, ..*m });
    let fewer = fewer.map(|m| {
        let features = [1.0, m.setting.radius(&full), m.setting.fewer(&m.model), m.setting.once()];
        (features.map(f64::from), log(m.change))
    });
    let probes = only(|m| SmokeModel { probes: 7, ..*m });
    let probes = probes.map(|m| ([1.0, m.setting.radius(&m.model).into(), m.setting.once().into()], log(m.change)));
    let directions = only(|m| SmokeModel { directions: 64, ..*m });
    let directions = directions
        .map(|m| ([1.0, (64.0 / f64::from(m.model.directions)).ln(), m.setting.once().into()], log(m.change)));
    let order = only(|m| SmokeModel { order: 4, ..*m });
    let order =
        order.map(|m| ([1.0, f64::from(m.model.order) * f64::from(m.setting.g.abs().max(0.01)).ln()], log(m.change)));
    let step = only(|m| SmokeModel { step: 0.5, ..*m });
    let step = step.map(|m| {
        let step = f64::from(m.model.step).ln();
        ([1.0, step, step * step], log(m.change))
    });
    // At the size that it was drawn at.
    let half = only(|m| SmokeModel { half_resolution: false, ..*m }).filter(|m| m.error.is_none());
    let half = half.map(|m| ([1.0, f64::from(m.setting.cells_a_pixel).ln()], log(m.change)));
    let errors = Errors {
        base: solve(base),
        fewer: solve(fewer),
        probes: solve(probes),
        directions: solve(directions),
        order: solve(order),
        step: solve(step),
        half: solve(half),
    };
    Fit { errors, prices: prices(measurements) }
}

/// The prices of work, from the times of whole frames, all relative errors being alike.
fn prices(measurements: &[Measurement]) -> [f32; WORK] {
    let seen = measurements.iter().filter(|m| !m.held_out);
    relative(seen.map(|m| (m.setting.work(&m.model).map(f64::from), m.milliseconds)))
}

/// Least squares in which each row counts by its relative error; nothing below 0.
fn relative<const N: usize>(rows: impl Iterator<Item = Row<N>>) -> [f32; N] {
    let rows: Vec<Row<N>> =
        rows.filter(|(_, time)| *time > 0.0).map(|(features, time)| (features.map(|f| f / time), 1.0)).collect();
    // What helps none is left out, until nothing is below 0.
    let mut used = [true; N];
    loop {
        let keep = |features: [f64; N]| core::array::from_fn(|i| if used[i] { features[i] } else { 0.0 });
        let found: [f32; N] = solve(rows.iter().map(|(features, one)| (keep(*features), *one)));
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
    fn prices_are_not_negative() {
        // Falls with the second: which then is left out.
        let found = relative((1..20).map(|i| ([f64::from(i), 1.0], 2.0 * f64::from(i) - 0.5)));
        assert!(found[0] > 1.5 && found[1] == 0.0, "{found:?}");
    }
}
