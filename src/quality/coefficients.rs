//! What models cost and how far off they are, in numbers: `smoke study quality --write` writes this file.

use super::model::{Errors, Prices};

/// On a GPU.
pub const GPU_PRICES: Prices = [0.10835, 0.0, 0.21866, 0.0, 0.20378, 0.020759, 0.073864, 0.028288, 0.26819];

/// On a CPU.
pub const CPU_PRICES: Prices = [34.357, 62.75, 337.56, 125.82, 0.0, 22.476, 155.03, 85.378, 63.319];

/// Against path tracing; what is left out is taken for somewhat more than is likely.
pub const ERRORS: Errors = [
    [-2.7254, 1.39, 0.21616, 0.16394],
    [-3.6123, 1.1123, 0.82637, 0.68026],
    [-1.646, 0.97835, 0.8486, 0.0],
    [-5.8877, 1.4509, 0.20786, 0.0],
    [-1.2845, -1.2876, 0.65574, 0.0],
    [-7.4497, 6.0739, -2.0364, 0.0],
    [-3.3973, 1.2506, 0.0, 0.0],
];
