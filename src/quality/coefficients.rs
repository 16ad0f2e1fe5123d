//! What models cost and how far off they are, in numbers: `smoke study quality --write` writes this file.

use super::model::Coefficients;

/// Fitted to the measurements in docs/measurements/2026-11-26-quality.md.
pub(super) const COEFFICIENTS: Coefficients = Coefficients {
    prices: [514.453, 0.0, 1630.57, 326.114, 78.602, 151.602, 1775.89, 71.8174],
    base: [-2.84695, 0.826471, -0.0311571, 0.0212718],
    probes: [-2.43305, 0.642794],
    directions: [-6.25933, 1.54698],
    order: [1.0094, 2.19026],
    step: [-5.81215, 1.96075],
    half: [-2.8816, 1.42486],
};
