//! Distance: how far every cell is from smoke, so that rays can leave out what is empty.

use glam::{DVec3, IVec3, UVec3};

use crate::{
    density::GridShape,
    reference::{Grid, cell_size},
};

/// No distance is larger; as in `constellation_distance.wgsl`.
pub const FARTHEST: u32 = 32;

/// Chebyshev distance max(|x|, |y|, |z|) in cells from every cell to the nearest that is not empty, at most [`FARTHEST`]; of
/// the box and a cell of padding on each side.
#[derive(Clone, Debug, PartialEq)]
pub struct DistanceMap {
    /// The padded box.
    pub padded: GridShape,
    /// One distance a cell.
    pub cells: Vec<u32>,
}

impl DistanceMap {
    /// Axis by axis: d(x) = min over r of max(|r|, d'(x + r)) with d' the distance along the axes before.
    pub fn new(density: &Grid) -> Self {
        let padded = GridShape::new(density.shape.dims + 2);
        let occupied = |i: usize| {
            let cell = padded.cell(i);
            let inside = cell.cmpge(UVec3::ONE).all() && cell.cmple(density.shape.dims).all();
            inside && density.values[density.shape.index(cell - 1)] > 0.0
        };
        let mut cells: Vec<u32> = (0..padded.len()).map(|i| if occupied(i) { 0 } else { FARTHEST }).collect();
        for axis in [IVec3::X, IVec3::Y, IVec3::Z] {
            let before = |cell: IVec3| {
                let inside = cell.cmpge(IVec3::ZERO).all() && cell.cmplt(padded.dims.as_ivec3()).all();
                if inside { cells[padded.index(cell.as_uvec3())] } else { FARTHEST }
            };
            let along = |i: usize| {
                let cell = padded.cell(i).as_ivec3();
                let reach = FARTHEST as i32;
                (-reach..=reach).map(|r| before(cell + axis * r).max(r.unsigned_abs())).min().unwrap_or(FARTHEST)
            };
            cells = (0..padded.len()).map(along).collect();
        }
        Self { padded, cells }
    }

    /// The distance at a point in bundle space, trilinear as the texture is read: at most a cell too much.
    pub fn sample(&self, x: DVec3) -> f64 {
        let cell = 1.0 / f64::from(self.padded.longest() - 2);
        let position = x / cell + 0.5 * self.padded.dims.as_dvec3() - 0.5;
        let clamp = |at: IVec3| at.clamp(IVec3::ZERO, self.padded.dims.as_ivec3() - 1).as_uvec3();
        let value = |at: IVec3| f64::from(self.cells[self.padded.index(clamp(at))]);
        crate::reference::trilinear(position).map(|(at, weight)| weight * value(at)).sum()
    }

    /// How many samples, `step` apart along a unit vector, are sure to be empty after an empty one at `x`.
    ///
    /// With d the true distance at x, density is 0 where the distance is a cell or more, and a ray gets max(|vx|, |vy|, |vz|)
    /// nearer a unit of its length. The trilinear value is at most d + 1; 0.02 is for rounding.
    pub fn empty_samples(&self, shape: GridShape, x: DVec3, direction: DVec3, step: f64) -> usize {
        let free = (self.sample(x) - 2.02).max(0.0) * cell_size(shape);
        (free / (direction.abs().max_element() * step)) as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sh::fibonacci;
    use proptest::prelude::*;

    fn sparse(dims: UVec3, occupied: &[u32]) -> Grid {
        let shape = GridShape::new(dims);
        let mut values = vec![0.0; shape.len()];
        for cell in occupied {
            values[*cell as usize % shape.len()] = 1.0;
        }
        Grid { shape, values }
    }

    fn brute_force(density: &Grid) -> Vec<u32> {
        let padded = GridShape::new(density.shape.dims + 2);
        let smoke: Vec<IVec3> = (0..density.shape.len())
            .filter(|i| density.values[*i] > 0.0)
            .map(|i| density.shape.cell(i).as_ivec3() + 1)
            .collect();
        let nearest = |i: usize| {
            let cell = padded.cell(i).as_ivec3();
            let distances = smoke.iter().map(|other| (*other - cell).abs().max_element() as u32);
            distances.min().unwrap_or(FARTHEST).min(FARTHEST)
        };
        (0..padded.len()).map(nearest).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        #[test]
        fn distances_are_exact_and_nothing_skipped_has_smoke(
            dims in (1u32..24, 1u32..30, 1u32..20),
            occupied in prop::collection::vec(0u32..10_000, 0..6),
            at in (0.0..1.0f64, 0.0..1.0f64, 0.0..1.0f64),
            step in 0.1..2.0f64,
        ) {
            let density = sparse(dims.into(), &occupied);
            let map = DistanceMap::new(&density);
            prop_assert_eq!(&map.cells, &brute_force(&density));
            // From a point anywhere in the box, along many directions.
            let half = crate::reference::half_extent(density.shape);
            let x = (2.0 * DVec3::from(at) - 1.0) * half;
            let step = step * cell_size(density.shape);
            for direction in fibonacci(40).filter(|_| density.sample(x) == 0.0) {
                for i in 1..=map.empty_samples(density.shape, x, direction, step) {
                    prop_assert_eq!(density.sample(x + direction * (i as f64 * step)), 0.0);
                }
            }
        }
    }

    #[test]
    fn empty_space_is_left_in_strides() {
        // Along an axis 31 or 32 cells of distance are 29.9 free cells: 59 half-cell samples. Along the diagonal √3 more.
        let density = sparse(UVec3::splat(64), &[0]);
        let map = DistanceMap::new(&density);
        let samples = |direction: DVec3| map.empty_samples(density.shape, DVec3::ZERO, direction, 0.5 / 64.0);
        assert_eq!((samples(DVec3::X), samples(DVec3::ONE.normalize())), (59, 103));
        assert_eq!(map.empty_samples(density.shape, DVec3::splat(-0.48), DVec3::X, 0.5 / 64.0), 0);
    }
}
