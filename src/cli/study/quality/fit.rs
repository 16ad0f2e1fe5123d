//! Fits the coefficients of `quality::model` to measurements.

use serde::Serialize;

use super::stage::Measurement;
use crate::quality::model::{Coefficients, Setting, WORK};
use crate::quality::{Pace, QualityChoice, SmokeModel, SmokeQuality};

/// The coefficients, in single precision as the plug-in has them.
#[derive(Clone, Debug, Serialize)]
pub struct Fit {
    #[serde(serialize_with = "as_debug")]
    coefficients: Coefficients,
}

fn as_debug<S: serde::Serializer>(value: &Coefficients, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&format_args!("{value:?}"))
}

/// A row of a least-squares problem: features, and what they should add up to.
type Row<const N: usize> = ([f64; N], f64);

impl Fit {
    pub fn error(&self, setting: &Setting, model: &SmokeModel) -> f64 {
        setting.error_with(model, &self.coefficients).into()
    }

    pub fn milliseconds(&self, setting: &Setting, model: &SmokeModel) -> f64 {
        setting.milliseconds_with(model, &self.coefficients).total().into()
    }

    /// What auto would choose.
    pub fn choose(&self, asked: SmokeQuality, setting: &Setting) -> SmokeModel {
        QualityChoice::best_with(asked, setting, &Pace::default(), &self.coefficients).model
    }

    /// The source of `quality::coefficients`.
    pub fn to_rust(&self) -> String {
        let Coefficients { prices, base, probes, directions, order, step, half } = self.coefficients;
        format!(
            "//! Written by `smoke study quality --write`.\n\n\
             use super::model::Coefficients;\n\n\
             /// Fitted to the measurements in docs/measurements/2026-11-26-quality.md.\n\
             pub(super) const COEFFICIENTS: Coefficients = Coefficients {{\n    \
             prices: {prices:?},\n    base: {base:?},\n    probes: {probes:?},\n    directions: {directions:?},\n    \
             order: {order:?},\n    step: {step:?},\n    half: {half:?},\n}};\n"
        )
    }
}

/// Fits all coefficients.
pub fn fit(measurements: &[Measurement]) -> Fit {
    let full = SmokeModel::FULL;
    let fitted: Vec<&Measurement> = measurements.iter().filter(|m| m.is_fitted).collect();
    let alone = |m: &&&Measurement, like: SmokeModel| m.model == like;
    let log = |value: f64| value.max(1e-5).ln();
    // The full model at several numbers of RBFs, against the truth.
    let base = fitted.iter().filter(|m| alone(m, SmokeModel { rbfs: m.model.rbfs, ..full }));
    let base = base.filter_map(|m| Some((m.setting.base_features(&m.model).map(f64::from), log(m.error?))));
    // The others against the full model's picture. Few RBFs change it too: what is left is what counts.
    let only = |change: fn(&SmokeModel) -> SmokeModel| {
        fitted.iter().filter(move |m| m.model != full && change(&m.model) == full).copied()
    };
    let probes = only(|m| SmokeModel { probes: 7, ..*m });
    let probes = probes.map(|m| ([1.0, f64::from(m.setting.base_features(&m.model)[1])], log(m.change)));
    let directions = only(|m| SmokeModel { directions: 64, ..*m });
    let directions = directions.map(|m| ([1.0, (64.0 / f64::from(m.model.directions)).ln()], log(m.change)));
    let order = only(|m| SmokeModel { order: 4, ..*m });
    let order =
        order.map(|m| ([1.0, f64::from(m.model.order) * f64::from(m.setting.g.abs().max(0.01)).ln()], log(m.change)));
    let step = only(|m| SmokeModel { step: 0.5, ..*m });
    let step = step.map(|m| ([1.0, f64::from(m.model.step).ln()], log(m.change)));
    // At the size that it was drawn at.
    let half = only(|m| SmokeModel { half_resolution: false, ..*m }).filter(|m| m.error.is_none());
    let half = half.map(|m| ([1.0, f64::from(m.setting.cells_a_pixel).ln()], log(m.change)));
    let coefficients = Coefficients {
        prices: prices(measurements),
        base: solve(base),
        probes: solve(probes),
        directions: solve(directions),
        order: solve(order),
        step: solve(step),
        half: solve(half),
    };
    Fit { coefficients }
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
