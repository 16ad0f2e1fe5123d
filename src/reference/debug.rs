//! Debug: the fields that a volume's debug view shows, in false colour.

use glam::{DVec3, UVec3};

use super::density::gaussian;
use super::volume::Volume;
use super::{Grid, center};
use crate::density::GridShape;
use crate::rbf::Rbf;

/// A field of a volume.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Field {
    /// The density.
    Density,
    /// The sum of the Gaussians.
    Rbfs,
    /// What the one is above the other.
    Residual,
}

/// A residual below this share of the largest density is none: density as the sum of Gaussians, rounded.
const NOTHING: f64 = 1e-5;

/// A field's colours, and its magnitude in multiples of the largest density, on the padded grid.
pub fn field(field: Field, rbfs: &[Rbf], density: &Grid, max_density: f64) -> Volume {
    let shape = density.shape;
    let padded = GridShape::new(shape.dims + 2);
    let cells = (0..padded.len()).map(|index| {
        let cell = padded.cell(index);
        let inside = cell.min_element() > 0 && cell.cmple(shape.dims).all();
        // Outside the box there is nothing, in the colour of the nearest cell.
        let nearest = cell.clamp(UVec3::ONE, shape.dims) - 1;
        let density = density.values[shape.index(nearest)] / max_density;
        let gaussians: f64 = rbfs.iter().map(|rbf| gaussian(rbf, center(shape, nearest))).sum::<f64>() / max_density;
        let (color, scaled) = match field {
            Field::Density => (by_density(density), density),
            Field::Rbfs => (by_density(gaussians), gaussians),
            Field::Residual => {
                let residual = density - gaussians;
                let red = if residual.abs() < NOTHING { 0.5 } else { f64::from(u8::from(residual > 0.0)) };
                (DVec3::new(red, 0.0, 1.0 - red), residual.abs())
            }
        };
        (color, if inside { scaled } else { 0.0 })
    });
    let (radiance, density) = cells.unzip();
    Volume { shape, radiance, density }
}

/// Blue at 0, green at ½, red at 1 and above.
pub fn by_density(t: f64) -> DVec3 {
    let t = t.min(1.0);
    DVec3::new(2.0 * t - 1.0, 1.0 - (2.0 * t - 1.0).abs(), 1.0 - 2.0 * t).clamp(DVec3::ZERO, DVec3::ONE)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colors_by_density() {
        for (t, color) in
            [(0.0, DVec3::Z), (0.25, DVec3::new(0.0, 0.5, 0.5)), (0.5, DVec3::Y), (1.0, DVec3::X), (9.0, DVec3::X)]
        {
            assert!((by_density(t) - color).length() < 1e-12, "{t}");
        }
    }

    #[test]
    fn a_residual_is_red_where_it_adds_and_blue_where_it_takes_away() {
        let shape = GridShape::new(UVec3::new(3, 1, 1));
        // One wide Gaussian, 1 at the middle cell, e^-1 beside it.
        let rbf = Rbf { center: [0.0; 3], radius: 1.0 / 3.0, weight: 1.0 };
        let density = Grid { shape, values: vec![(-1.0_f64).exp(), 1.5, 0.0] };
        let shown = field(Field::Residual, &[rbf], &density, 2.0);
        let padded = GridShape::new(shape.dims + 2);
        let at = |x: u32| {
            let index = padded.index(UVec3::new(x + 1, 1, 1));
            (shown.radiance[index], shown.density[index])
        };
        // The radius is a third in f32.
        let close = |a: (DVec3, f64), b: (DVec3, f64)| (a.0 - b.0).length() < 1e-6 && (a.1 - b.1).abs() < 1e-6;
        assert!(close(at(0), (DVec3::new(0.5, 0.0, 0.5), 0.0)), "{:?}", at(0));
        assert!(close(at(1), (DVec3::X, 0.25)));
        assert!(close(at(2), (DVec3::Z, 0.5 * (-1.0_f64).exp())));
        assert_eq!(shown.density[0], 0.0);
    }
}
