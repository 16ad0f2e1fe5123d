//! Values on the points of a regular lattice, and the staggered velocity made of three of them.

use glam::{IVec3, UVec3, Vec3};
use rayon::prelude::*;

use crate::density::GridShape;

/// What a [`Lattice`] holds beyond its outermost points.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outside {
    /// The value of the nearest point.
    Nearest,
    /// Nothing (0) past the open faces, the nearest point's value below the floor: clean air comes in.
    Empty,
}

/// One value at every point of a lattice with a spacing of one cell.
///
/// Positions are in cells from the box's lowest corner; point `(i, j, k)` is at `(i, j, k) + offset`. Values are in flat
/// index order (x fastest).
#[derive(Clone, Debug)]
pub struct Lattice {
    /// The points, at least 2 along every axis.
    pub shape: GridShape,
    /// Position of the first point.
    pub offset: Vec3,
    /// What is beyond.
    pub outside: Outside,
    /// One value a point.
    pub values: Vec<f32>,
}

impl Lattice {
    /// A lattice of zeros.
    pub fn new(dims: UVec3, offset: Vec3, outside: Outside) -> Self {
        debug_assert!(dims.min_element() >= 2);
        let shape = GridShape::new(dims);
        Self { shape, offset, outside, values: vec![0.0; shape.len()] }
    }

    /// Cell centres of a box of `dims` cells, empty outside.
    pub fn centers(dims: UVec3) -> Self {
        Self::new(dims, Vec3::splat(0.5), Outside::Empty)
    }

    /// Centres of the faces across `axis` of a box of `dims` cells.
    pub fn faces(dims: UVec3, axis: usize) -> Self {
        Self::new(dims + unit(axis), 0.5 * (Vec3::ONE - Vec3::AXES[axis]), Outside::Nearest)
    }

    /// The same lattice with the values `value(point, flat index)`, computed in parallel.
    pub fn map(&self, value: impl Fn(UVec3, usize) -> f32 + Sync) -> Self {
        let mut result = Self { values: vec![0.0; self.values.len()], ..*self };
        result.update(|point, index, _| value(point, index));
        result
    }

    /// Replaces every value by `value(point, flat index, value)`, in parallel.
    pub fn update(&mut self, value: impl Fn(UVec3, usize, f32) -> f32 + Sync) {
        fill_planes(self.shape, &mut self.values, |point, index, out| *out = value(point, index, *out));
    }

    /// Position of a point.
    pub fn position(&self, point: UVec3) -> Vec3 {
        point.as_vec3() + self.offset
    }

    /// The value at a position: trilinear.
    #[inline]
    pub fn sample(&self, position: Vec3) -> f32 {
        let (low, t) = self.locate(position);
        let dims = self.shape.dims.as_ivec3();
        let inside = self.outside == Outside::Nearest || low.cmpge(IVec3::ZERO).all() && low.cmplt(dims - 1).all();
        trilinear(&if inside { self.corners(low) } else { self.outer_corners(low) }, t)
    }

    /// The value at a position: Catmull–Rom's cubic along each axis, kept within the range of the eight points around;
    /// trilinear within a cell of the box's end.
    #[inline]
    pub fn sample_cubic(&self, position: Vec3) -> f32 {
        let (low, t) = self.locate(position);
        if !(low.cmpge(IVec3::ONE).all() && low.cmplt(self.shape.dims.as_ivec3() - 2).all()) {
            return self.sample(position);
        }
        let [x, y, z] = t.to_array().map(catmull_rom);
        let [nx, ny] = [self.shape.dims.x as usize, self.shape.dims.y as usize];
        let first = self.shape.index((low - 1).as_uvec3());
        let (mut value, mut least, mut most) = (0.0, f32::INFINITY, f32::NEG_INFINITY);
        for (k, z) in z.iter().enumerate() {
            for (j, y) in y.iter().enumerate() {
                let row = &self.values[first + nx * (j + ny * k)..][..4];
                value += z * y * (x[0] * row[0] + x[1] * row[1] + (x[2] * row[2] + x[3] * row[3]));
                if (1..3).contains(&j) && (1..3).contains(&k) {
                    least = least.min(row[1]).min(row[2]);
                    most = most.max(row[1]).max(row[2]);
                }
            }
        }
        value.clamp(least, most)
    }

    /// The lowest of the eight points around a position, and the position between them in 0..1.
    #[inline]
    fn locate(&self, position: Vec3) -> (IVec3, Vec3) {
        let at = position - self.offset;
        let dims = self.shape.dims.as_ivec3();
        // Conversion cuts off, which is cheaper than rounding down and the same above 0.
        let (at, low) = match self.outside {
            Outside::Nearest => {
                let at = at.clamp(Vec3::ZERO, (dims - 1).as_vec3());
                // The last pair of points serves the last point too: nearest values need no special case.
                (at, at.as_ivec3().min(dims - 2))
            }
            Outside::Empty => {
                let at = at.clamp(Vec3::new(-1.0, 0.0, -1.0), dims.as_vec3());
                (at, (at + 1.0).as_ivec3() - 1)
            }
        };
        (low, at - low.as_vec3())
    }

    /// The values of the eight points from `low` on, x fastest, all inside.
    #[inline]
    fn corners(&self, low: IVec3) -> [f32; 8] {
        let [nx, ny] = [self.shape.dims.x as usize, self.shape.dims.y as usize];
        let first = low.x as usize + nx * (low.y as usize + ny * low.z as usize);
        let [row, plane] = [nx, nx * ny];
        let v = &self.values[first..first + plane + row + 2];
        [v[0], v[1], v[row], v[row + 1], v[plane], v[plane + 1], v[plane + row], v[plane + row + 1]]
    }

    /// The same where some are outside, and 0.
    #[cold]
    fn outer_corners(&self, low: IVec3) -> [f32; 8] {
        std::array::from_fn(|corner| {
            let corner = corner as i32;
            // A step below 0 becomes a number above any side.
            let point = (low + IVec3::new(corner & 1, corner >> 1 & 1, corner >> 2)).as_uvec3();
            if point.cmplt(self.shape.dims).all() { self.values[self.shape.index(point)] } else { 0.0 }
        })
    }
}

/// Weights of four values in a row for a position between the middle two.
#[inline]
fn catmull_rom(t: f32) -> [f32; 4] {
    let s = 1.0 - t;
    [-0.5 * t * s * s, 1.0 + t * t * (1.5 * t - 2.5), 1.0 + s * s * (1.5 * s - 2.5), -0.5 * s * t * t]
}

/// Calls `value` for every point of a shape, planes of constant z in parallel.
pub fn fill_planes<T: Send>(shape: GridShape, values: &mut [T], value: impl Fn(UVec3, usize, &mut T) + Sync) {
    let [nx, ny] = [shape.dims.x as usize, shape.dims.y as usize];
    values.par_chunks_exact_mut(nx * ny).enumerate().for_each(|(z, plane)| {
        for (y, row) in plane.chunks_exact_mut(nx).enumerate() {
            let start = nx * (y + ny * z);
            for (x, out) in row.iter_mut().enumerate() {
                value(UVec3::new(x as u32, y as u32, z as u32), start + x, out);
            }
        }
    });
}

/// Between the values of a cube's corners, x fastest.
#[inline]
pub fn trilinear(c: &[f32; 8], t: Vec3) -> f32 {
    let x = |i: usize| c[i] + t.x * (c[i + 1] - c[i]);
    let y = |i: usize| x(i) + t.y * (x(i + 2) - x(i));
    y(0) + t.z * (y(4) - y(0))
}

/// One step along an axis.
pub fn unit(axis: usize) -> UVec3 {
    UVec3::AXES[axis]
}

/// A velocity on a staggered (MAC) grid (Harlow and Welch 1965): every component at the centres of the faces it crosses.
#[derive(Clone, Debug)]
pub struct Velocity {
    /// The components, in box lengths a second.
    pub faces: [Lattice; 3],
}

impl Velocity {
    /// Rest, on a box of `dims` cells.
    pub fn new(dims: UVec3) -> Self {
        Self { faces: std::array::from_fn(|axis| Lattice::faces(dims, axis)) }
    }

    /// The velocity at a position: trilinear by component.
    #[inline]
    pub fn at(&self, position: Vec3) -> Vec3 {
        let [x, y, z] = &self.faces;
        Vec3::new(x.sample(position), y.sample(position), z.sample(position))
    }

    /// The velocity at a cell's centre.
    pub fn at_center(&self, cell: UVec3) -> Vec3 {
        let mean = |axis: usize| {
            let face = &self.faces[axis];
            let low = face.shape.index(cell);
            let high = face.shape.index(cell + unit(axis));
            0.5 * (face.values[low] + face.values[high])
        };
        Vec3::new(mean(0), mean(1), mean(2))
    }

    /// The largest component anywhere.
    pub fn max(&self) -> f32 {
        // A maximum is the same in any order.
        let max = |face: &Lattice| face.values.par_iter().map(|v| v.abs()).reduce(|| 0.0, f32::max);
        self.faces.iter().map(max).fold(0.0, f32::max)
    }
}
