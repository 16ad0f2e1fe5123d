//! Volume: source radiance and density on the grid that the view pass samples.

use glam::{DVec3, IVec3, UVec3};
use rayon::prelude::*;

use super::{Grid, cell_size, center, outgoing::Outgoing, rbf_center, trilinear};
use crate::{
    density::GridShape,
    rbf::{Rbf, RbfBins},
};

/// Source radiance and density at the cells of a box and one more cell on every side.
#[derive(Clone, Debug, PartialEq)]
pub struct Volume {
    /// The box without the padding.
    pub shape: GridShape,
    /// RGB source radiance towards the eye; `shape.dims + 2` cells in flat index order.
    pub radiance: Vec<DVec3>,
    /// Density, 0 in the padding; likewise.
    pub density: Vec<f64>,
}

impl Volume {
    /// Source radiance and density at a point of the box, trilinear between cell centres.
    pub fn sample(&self, x: DVec3) -> (DVec3, f64) {
        let padded = GridShape::new(self.shape.dims + 2);
        let last = padded.dims.as_ivec3() - 1;
        // Cell (0,0,0) of the padded grid has its centre at −0.5 in units of cells from the box's corner.
        let position = x * f64::from(self.shape.longest()) + 0.5 * self.shape.dims.as_dvec3() + 0.5;
        let (mut radiance, mut density) = (DVec3::ZERO, 0.0);
        for (cell, weight) in trilinear(position) {
            let index = padded.index(cell.clamp(IVec3::ZERO, last).as_uvec3());
            radiance += weight * self.radiance[index];
            density += weight * self.density[index];
        }
        (radiance, density)
    }
}

/// Source radiance from the RBFs' fits, and density, at every cell of the padded grid.
pub fn volume(rbfs: &[Rbf], outgoing: &[Outgoing], bins: &RbfBins, density: &Grid) -> Volume {
    let shape = density.shape;
    let padded = GridShape::new(shape.dims + 2);
    let mut values = vec![0.0; padded.len()];
    for (index, &value) in density.values.iter().enumerate() {
        values[padded.index(shape.cell(index) + 1)] = value;
    }
    Volume { shape, radiance: blend_cells(rbfs, outgoing, bins, shape), density: values }
}

/// The RBFs' fits interpolated to every cell of the padded grid, with the RBFs listed in the cell's bin (padding cells:
/// in the bin of the nearest cell of the box).
pub(super) fn blend_cells(rbfs: &[Rbf], fits: &[Outgoing], bins: &RbfBins, shape: GridShape) -> Vec<DVec3> {
    let padded = GridShape::new(shape.dims + 2);
    let value = |index| {
        let cell = padded.cell(index);
        let nearest = cell.clamp(UVec3::ONE, shape.dims) - 1;
        let list = bins.at(nearest).iter().map(|&l| (&rbfs[l as usize], &fits[l as usize]));
        interpolate(padded_center(shape, cell), list)
    };
    (0..padded.len()).into_par_iter().map(value).collect()
}

/// The centre of a cell of the padded grid in bundle space.
pub(super) fn padded_center(shape: GridShape, cell: UVec3) -> DVec3 {
    center(shape, cell) - cell_size(shape)
}

/// What [`volume`] gives a point: [`blend`], but never below zero.
fn interpolate<'a>(x: DVec3, rbfs: impl Iterator<Item = (&'a Rbf, &'a Outgoing)>) -> DVec3 {
    blend(x, rbfs).max(DVec3::ZERO)
}

/// J(x) = Σ φ J_l(x) / Σ φ, with φ = w (exp(−u²) + 1e-6/(1+u²)²), u = |x−c|/r, of the RBFs' fits. The tail of φ carries
/// radiance beyond the Gaussians. Black without any RBF.
pub(super) fn blend<'a>(x: DVec3, rbfs: impl Iterator<Item = (&'a Rbf, &'a Outgoing)>) -> DVec3 {
    let (mut sum, mut total) = (DVec3::ZERO, 0.0);
    for (rbf, outgoing) in rbfs {
        let (radius, weight) = (f64::from(rbf.radius), f64::from(rbf.weight));
        let offset = x - rbf_center(rbf);
        let u_squared = offset.length_squared() / (radius * radius);
        let phi = weight * ((-u_squared).exp() + 1e-6 / (1.0 + u_squared).powi(2));
        sum += phi * outgoing.value(offset);
        total += phi;
    }
    if total > 0.0 { sum / total } else { DVec3::ZERO }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DMat3;

    const DIMS: UVec3 = UVec3::new(20, 32, 11);

    fn rbfs() -> Vec<Rbf> {
        let at = |x, y, z, radius, weight| Rbf { center: [x, y, z], radius, weight };
        vec![at(0.0, 0.1, 0.0, 0.06, 1.0), at(-0.1, -0.2, 0.05, 0.04, 0.3), at(0.2, 0.0, -0.1, 0.05, 2.0)]
    }

    fn linear(center: DVec3, gradient: DMat3) -> Outgoing {
        let bounds = [f64::NEG_INFINITY, f64::INFINITY].map(DVec3::splat);
        Outgoing { center, gradient, curvature: DMat3::ZERO, low: bounds[0], high: bounds[1], reach: f64::INFINITY }
    }

    fn constant(center: DVec3) -> Outgoing {
        linear(center, DMat3::ZERO)
    }

    fn build(outgoing: impl Fn(&Rbf) -> Outgoing) -> Volume {
        let (rbfs, shape) = (rbfs(), GridShape::new(DIMS));
        let outgoing: Vec<_> = rbfs.iter().map(outgoing).collect();
        let density = Grid { shape, values: (0..shape.len()).map(|i| 1.0 + i as f64).collect() };
        volume(&rbfs, &outgoing, &RbfBins::new(&rbfs, shape), &density)
    }

    #[test]
    fn a_constant_reproduces_itself_everywhere() {
        // Also far outside every Gaussian, where exp(−u²) underflows the f32 of the pass but the tail does not.
        let rgb = DVec3::new(1.0, 0.5, 0.25);
        let volume = build(|_| constant(rgb));
        assert_eq!(volume.radiance.len(), 22 * 34 * 13);
        for j in &volume.radiance {
            assert!((*j - rgb).length() < 1e-14);
        }
        for x in [DVec3::ZERO, DVec3::new(0.3125, -0.5, 0.17)] {
            assert!((volume.sample(x).0 - rgb).length() < 1e-14);
        }
    }

    #[test]
    fn a_linear_field_is_reproduced_by_the_gradients() {
        let gradient =
            DMat3::from_cols(DVec3::new(1.0, 0.2, 0.0), DVec3::new(-0.5, 0.0, 0.3), DVec3::new(0.7, 0.1, -0.2));
        let field = |x: DVec3| DVec3::ONE + gradient * x;
        let volume = build(|rbf| linear(field(rbf_center(rbf)), gradient));
        // Wherever no listed Gaussian is further than 1.5r, or those that are weigh nothing: at the three centres. A far
        // one's share is at most its tail, 1e-6 · w ratio 7, times a field difference below 1.
        let rbfs = rbfs();
        for rbf in &rbfs {
            let x = rbf_center(rbf) + DVec3::new(0.02, -0.01, 0.01);
            assert!((volume.sample(x).0 - field(x)).length() < 1e-5);
        }
        // One RBF alone, 6 radii away: the offset is shortened to 1.5.
        let x = rbf_center(&rbfs[0]) + DVec3::X * 0.36;
        let outgoing = Outgoing { reach: rbfs[0].radius.into(), ..linear(DVec3::ONE, gradient) };
        let expected = DVec3::ONE + gradient * DVec3::X * (1.5 * f64::from(rbfs[0].radius));
        assert!((interpolate(x, [(&rbfs[0], &outgoing)].into_iter()) - expected).length() < 1e-12);
    }

    #[test]
    fn weights_follow_the_formula() {
        let rbfs = rbfs();
        let [a, b] = [1.0, 3.0].map(|j| constant(DVec3::splat(j)));
        // x on rbf 0's centre; |c0−c1|² = 0.01 + 0.09 + 0.0025, u1² = 0.1025/0.0016 = 64.0625: only its tail is left.
        let x = DVec3::new(0.0, 0.1, 0.0);
        let (phi0, phi1) = (1.0 + 1e-6, 0.3 * 1e-6 / 65.0625f64.powi(2));
        let found = interpolate(x, [(&rbfs[0], &a), (&rbfs[1], &b)].into_iter());
        let expected = (phi0 + 3.0 * phi1) / (phi0 + phi1);
        // φ1 is 7e-11 of φ0: resolve it, allowing for RBFs stored in f32.
        assert!(((found.x - 1.0) / (expected - 1.0) - 1.0).abs() < 1e-5, "{found} {expected}");
    }

    #[test]
    fn radiance_is_never_negative_and_black_without_rbfs() {
        let gradient = DMat3::from_diagonal(DVec3::splat(100.0));
        let volume = build(|_| linear(DVec3::ONE, gradient));
        assert!(volume.radiance.iter().all(|j| j.min_element() >= 0.0));
        assert!(volume.radiance.iter().any(|j| j.min_element() == 0.0));
        let shape = GridShape::new(UVec3::splat(3));
        let density = Grid { shape, values: vec![1.0; 27] };
        let empty = super::volume(&[], &[], &RbfBins::new(&[], shape), &density);
        assert!(empty.radiance.iter().all(|&j| j == DVec3::ZERO));
    }

    #[test]
    fn density_is_copied_and_padded_with_zeros() {
        let volume = build(|_| constant(DVec3::ONE));
        let (shape, padded) = (volume.shape, GridShape::new(DIMS + 2));
        for index in 0..shape.len() {
            let cell = shape.cell(index);
            assert_eq!(volume.density[padded.index(cell + 1)], 1.0 + index as f64);
            assert!((volume.sample(center(shape, cell)).1 - 1.0 - index as f64).abs() < 1e-9);
        }
        let total: f64 = volume.density.iter().sum();
        let n = shape.len() as f64;
        assert_eq!(total, n * (n + 1.0) / 2.0);
        // Half on the face between a cell and its padding.
        let face = center(shape, UVec3::new(5, 5, 5)) * DVec3::new(1.0, 1.0, 0.0) + DVec3::Z * (5.5 / 32.0);
        let last = volume.density[padded.index(UVec3::new(6, 6, 11))];
        assert!((volume.sample(face).1 - 0.5 * last).abs() < 1e-9);
    }
}
