//! The low-frequency model of a density field: a sum of Gaussian radial basis functions (Zhou et al. 2008, section 4).
//!
//! A frame of smoke is `D(x) = D̃(x) + R(x)`. This module holds `D̃(x) = Σ w_l B_l(x)`, a few hundred Gaussians with
//! compact support, in which light transport is computed; [`residual`](crate::residual) holds what they leave out.
//! [`RbfBins`] lists which Gaussians matter where, and `fit` (feature `bake`) finds them.

mod bins;
#[cfg(feature = "bake")]
pub mod fit;
mod reduce;
#[cfg(test)]
mod tests;

pub(crate) use bins::bin_shape;
pub use bins::{BIN_CELLS, RbfBins};
pub use reduce::reduced;

use bytemuck::{Pod, Zeroable};
use glam::{UVec3, Vec3};

use crate::density::GridShape;

/// Support of a Gaussian in multiples of its radius: `B(x) = 0` where `|x − c| ≥ SUPPORT · r`.
///
/// At the edge a Gaussian has fallen to `e⁻⁹ ≈ 1.2·10⁻⁴` of its weight.
pub const SUPPORT: f32 = 3.0;

/// One Gaussian, `w · exp(−|x − c|² / r²)` within its [`SUPPORT`]: 20 bytes, laid out as the GPU reads it.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct Rbf {
    /// Centre `c` in bundle space (the box centred on the origin, its longest side 1).
    pub center: [f32; 3],
    /// Radius `r` in bundle units, above 0: the Gaussian falls to `1/e` there.
    pub radius: f32,
    /// Weight `w`, in units of density.
    pub weight: f32,
}

impl Rbf {
    /// `B(x)`: the Gaussian without its weight, exactly 0 outside its support.
    pub fn basis(&self, x: Vec3) -> f32 {
        let d2 = x.distance_squared(Vec3::from(self.center));
        let r2 = self.radius * self.radius;
        if d2 < SUPPORT * SUPPORT * r2 { (-d2 / r2).exp() } else { 0.0 }
    }
}

/// The RBF approximation `D̃` of one frame. Empty for a frame without smoke.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RbfModel {
    /// The Gaussians; their order is part of the model (sums run in this order).
    pub rbfs: Vec<Rbf>,
}

impl RbfModel {
    /// `D̃(x) = Σ w_l B_l(x)` at a point in bundle space.
    pub fn density(&self, x: Vec3) -> f32 {
        self.rbfs.iter().map(|rbf| rbf.weight * rbf.basis(x)).sum()
    }

    /// `D̃` at every cell centre of `shape`, in flat order: what the GPU's density pass adds the residual to.
    ///
    /// Gaussians are separable, so each costs three short tables of exponentials and one product per cell; this agrees
    /// with [`density`](Self::density) to rounding (a few 10⁻⁷ of the weights that meet in a cell).
    pub fn rasterize(&self, shape: GridShape) -> Vec<f32> {
        let mut values = vec![0.0; shape.len()];
        let centers: [Vec<f32>; 3] =
            std::array::from_fn(|axis| (0..shape.dims[axis]).map(|i| shape.center(UVec3::splat(i))[axis]).collect());
        for rbf in &self.rbfs {
            splat(rbf, shape, &centers, &mut values);
        }
        values
    }
}

/// Adds one Gaussian to the cells within its support.
fn splat(rbf: &Rbf, shape: GridShape, centers: &[Vec<f32>; 3], values: &mut [f32]) {
    let reach2 = SUPPORT * SUPPORT * rbf.radius * rbf.radius;
    // Per axis: the range of cells within reach, squared distances and exponentials there.
    let ranges: [std::ops::Range<usize>; 3] = std::array::from_fn(|axis| {
        let inside = |x: &f32| (x - rbf.center[axis]).powi(2) < reach2;
        let start = centers[axis].iter().position(inside).unwrap_or(0);
        let end = centers[axis].iter().rposition(inside).map_or(0, |last| last + 1);
        start..end
    });
    let distance2: [Vec<f32>; 3] = std::array::from_fn(|axis| {
        centers[axis][ranges[axis].clone()].iter().map(|x| (x - rbf.center[axis]).powi(2)).collect()
    });
    let inverse = 1.0 / (rbf.radius * rbf.radius);
    let gauss: [Vec<f32>; 3] =
        std::array::from_fn(|axis| distance2[axis].iter().map(|d2| (-d2 * inverse).exp()).collect());

    let [nx, ny] = [shape.dims.x as usize, shape.dims.y as usize];
    for (z, (dz2, gz)) in ranges[2].clone().zip(distance2[2].iter().zip(&gauss[2])) {
        for (y, (dy2, gy)) in ranges[1].clone().zip(distance2[1].iter().zip(&gauss[1])) {
            let (rest2, scale) = (dy2 + dz2, rbf.weight * gy * gz);
            let start = nx * (y + ny * z);
            let row = &mut values[start + ranges[0].start..start + ranges[0].end];
            for (value, (dx2, gx)) in row.iter_mut().zip(distance2[0].iter().zip(&gauss[0])) {
                *value += if dx2 + rest2 < reach2 { scale * gx } else { 0.0 };
            }
        }
    }
}
