//! What quantisation costs, cell by cell, measured on the finished bundle.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::bundle::SmokeFrame;
use crate::residual::QuantizationLaw;

/// The error that 8 bits a residual leave, over all cells of a frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct QuantizationReport {
    /// The law in words.
    pub law: Cow<'static, str>,
    /// Its maximum: the largest |R|, in units of density.
    pub max: f32,
    /// Its exponent.
    pub exponent: f32,
    /// The worst error in units of half the quantisation step at that cell's residual, to four decimals: at most 1, for
    /// every residual is stored as the nearest code.
    pub worst_half_steps: Worst,
    /// The worst error in units of density.
    pub worst_density: Worst,
    /// Root mean square error, relative to the root mean square density.
    pub rms_relative: f64,
}

/// The largest error of any cell, and where it is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Worst {
    /// The error.
    pub error: f64,
    /// Coordinates of the cell in the box.
    pub cell: [u32; 3],
}

impl QuantizationReport {
    /// Compares a frame, looked up through its hash, with the density it was made from.
    pub fn measure(density: &[f32], frame: &SmokeFrame) -> Self {
        let shape = frame.residual.shape();
        let law = frame.residual.law();
        let levels = Levels::new(law);
        let residuals = difference(density, &frame.rbfs.rasterize(shape));
        let (mut worst_half_steps, mut worst_density) = (Worst::default(), Worst::default());
        let (mut error_sum, mut density_sum) = (0.0, 0.0);
        for (index, (&residual, &density)) in residuals.iter().zip(density).enumerate() {
            let cell = shape.cell(index);
            let error = (f64::from(residual) - f64::from(frame.residual.get(cell))).abs();
            let half_steps = if error == 0.0 { 0.0 } else { error / levels.half_step(residual) };
            for (worst, error) in [(&mut worst_half_steps, half_steps), (&mut worst_density, error)] {
                if error > worst.error {
                    *worst = Worst { error, cell: cell.to_array() };
                }
            }
            error_sum += error * error;
            density_sum += f64::from(density).powi(2);
        }
        worst_half_steps.error = (worst_half_steps.error * 1e4).round() / 1e4;
        Self {
            law: "R(q) = sign(q) * max * (|q| / 127)^exponent, q in -127..=127".into(),
            max: law.max,
            exponent: law.exponent,
            worst_half_steps,
            worst_density,
            rms_relative: relative(error_sum, density_sum),
        }
    }
}

/// `sqrt(error / reference)` of two sums of squares; 0 where both are.
pub(super) fn relative(error: f64, reference: f64) -> f64 {
    if error == 0.0 { 0.0 } else { (error / reference).sqrt() }
}

/// `R = D − D̃`, cell by cell.
pub(super) fn difference(density: &[f32], model: &[f32]) -> Vec<f32> {
    density.iter().zip(model).map(|(d, m)| d - m).collect()
}

/// The magnitudes a law can represent, ascending.
struct Levels([f64; 128]);

impl Levels {
    fn new(law: QuantizationLaw) -> Self {
        Self(std::array::from_fn(|q| f64::from(law.decode(q as i8))))
    }

    /// Half the distance between the two levels that a residual lies between.
    fn half_step(&self, residual: f32) -> f64 {
        let magnitude = f64::from(residual.abs());
        let above = self.0.partition_point(|&level| level <= magnitude).clamp(1, 127);
        (self.0[above] - self.0[above - 1]) / 2.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_lie_between_neighbouring_levels() {
        let linear = Levels::new(QuantizationLaw { max: 127.0, exponent: 1.0 });
        // Levels are 0, 1 … 127 up to the rounding of q / 127 in 32 bits.
        for residual in [0.0, 0.3, -5.5, 126.9, 127.0] {
            assert!((linear.half_step(residual) - 0.5).abs() < 1e-5, "{residual}");
        }
        let square = Levels::new(QuantizationLaw { max: 127.0 * 127.0, exponent: 2.0 });
        assert!((square.half_step(9.5) - 3.5).abs() < 1e-3, "between 3² and 4²");
    }
}
