//! What models cost and how far off they are, in numbers: `smoke study quality --write` writes this file.

use super::model::{Errors, Prices};

/// On a GPU.
pub const GPU_PRICES: Prices = [0.108347, 0.0, 0.218662, 0.203778, 0.0207586, 0.0738645, 0.0282882, 0.268189];

/// On a CPU.
pub const CPU_PRICES: Prices = [37.952126, 115.51089, 531.49615, 62.910072, 21.98044, 156.10672, 179.8545, 74.61996];

/// Against path tracing, and of models against the full one.
pub const ERRORS: Errors = Errors {
    base: [-2.6776915, 1.429713, 0.22133456, 0.17410819],
    fewer: [-4.1520257, 1.0825918, 0.9300589, 0.6573602],
    probes: [-2.0834827, 0.8668647, 0.8802984],
    directions: [-6.327545, 1.5311764, 0.37770754],
    order: [-1.7088587, 1.9885542],
    step: [-7.6088386, 5.7326717, -1.800043],
    half: [-2.994328, 1.3486625],
};
