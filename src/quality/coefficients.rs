// Written by `smoke study quality`.

use super::model::Coefficients;

/// Fitted to measurements: docs/measurements has them.
pub(super) const COEFFICIENTS: Coefficients = Coefficients {
    prices: [1.0; 8],
    base: [-4.0, 0.5, -0.3, 0.0],
    probes: [-3.3, 0.5],
    directions: [-4.6, 1.0],
    order: [-1.0, 1.0, -1.0],
    step: [-5.0, 2.0],
    half: [-3.0, 1.5],
};
