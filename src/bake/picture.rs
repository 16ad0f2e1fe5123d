//! What quantisation does to a picture.

use serde::{Deserialize, Serialize};

use super::verify::relative;
use crate::bundle::SmokeFrame;
use crate::density::{DensityGrid, GridShape};

/// Mean optical depth of the pixels with smoke.
const OPTICAL_DEPTH: f64 = 2.0;
/// Pixels with less opacity hold no smoke.
const SMOKE_OPACITY: f64 = 0.02;

/// What quantisation does to a picture: errors, relative root mean square over the pixels with smoke.
///
/// The picture is the simplest that smoke can give: looked at along z without perspective, every point of the smoke
/// shining with source radiance 1, so that a pixel is 1 − e^(−σ ∫ D dz), which is also the smoke's opacity. σ is set so
/// that the optical depth averages 2 over the pixels with smoke in them (opacity above 0.02): thin enough to see in,
/// thick enough to shade. There is no light to compute and no noise, so what differs comes from the density alone.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PictureError {
    /// With the bundle's density: what quantisation costs.
    pub quantized: f64,
    /// With the Gaussians alone: what the residual saves.
    pub without_residual: f64,
    /// Pixels with smoke.
    pub pixels: usize,
    /// The σ of the picture, per unit of density and cell.
    pub sigma_per_cell: f64,
}

/// Measures the picture of a frame against that of the grid it was made from.
pub fn picture_error(grid: &DensityGrid, frame: &SmokeFrame) -> PictureError {
    let picture = Picture::new(grid);
    let (quantized, pixels) = picture.error(&frame.decode());
    let (without_residual, _) = picture.error(&frame.rbfs.rasterize(grid.shape));
    PictureError { quantized, without_residual, pixels, sigma_per_cell: picture.sigma }
}

/// The picture of a grid, to compare others with.
pub(super) struct Picture {
    shape: GridShape,
    exact: Vec<f64>,
    sigma: f64,
}

impl Picture {
    pub fn new(grid: &DensityGrid) -> Self {
        let exact = columns(grid.shape, &grid.values);
        Self { shape: grid.shape, sigma: extinction(&exact), exact }
    }

    /// Relative RMS error of the picture that `density` gives, and the number of pixels with smoke.
    pub fn error(&self, density: &[f32]) -> (f64, usize) {
        let opacity = |column: &f64| -(-self.sigma * column).exp_m1();
        let (mut difference, mut reference, mut pixels) = (0.0, 0.0, 0);
        for (a, b) in self.exact.iter().zip(&columns(self.shape, density)) {
            let (a, b) = (opacity(a), opacity(b));
            if a > SMOKE_OPACITY {
                difference += (a - b) * (a - b);
                reference += a * a;
                pixels += 1;
            }
        }
        (relative(difference, reference), pixels)
    }
}

/// Density summed along z.
fn columns(shape: GridShape, density: &[f32]) -> Vec<f64> {
    let pixels = (shape.dims.x * shape.dims.y) as usize;
    let mut columns = vec![0.0; pixels];
    for layer in density.chunks_exact(pixels) {
        for (column, &d) in columns.iter_mut().zip(layer) {
            *column += f64::from(d);
        }
    }
    columns
}

/// The σ at which the pixels with smoke have the mean optical depth. Which those are depends on σ, so this goes back
/// and forth; the set changes by few pixels after the first round.
fn extinction(columns: &[f64]) -> f64 {
    let mut sigma = f64::INFINITY;
    for _ in 0..8 {
        let smoke = columns.iter().filter(|&&column| column > 0.0 && -(-sigma * column).exp_m1() > SMOKE_OPACITY);
        let (sum, count) = smoke.fold((0.0, 0.0), |(sum, count), column| (sum + column, count + 1.0));
        if sum == 0.0 {
            return 0.0;
        }
        sigma = OPTICAL_DEPTH * count / sum;
    }
    sigma
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn extinction_gives_the_mean_depth() {
        // A pixel of 1000 times less smoke is no smoke pixel and does not count.
        let columns = [0.0, 1.0, 3.0, 0.002];
        let sigma = extinction(&columns);
        assert!((sigma * (1.0 + 3.0) / 2.0 - OPTICAL_DEPTH).abs() < 1e-12);
        assert_eq!(extinction(&[0.0; 4]), 0.0);
    }

    #[test]
    fn columns_run_along_z() {
        let shape = GridShape::new(glam::UVec3::new(2, 1, 3));
        assert_eq!(columns(shape, &[1.0, 2.0, 10.0, 20.0, 100.0, 200.0]), [111.0, 222.0]);
    }
}
