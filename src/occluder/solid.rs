//! The inside of a triangle mesh, in cells.

use std::collections::VecDeque;

use glam::{Vec3, vec3};

/// Triangles in space.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriangleMesh {
    /// Corners.
    pub positions: Vec<Vec3>,
    /// Indices of three corners each, anticlockwise seen from outside. All must be there.
    pub triangles: Vec<[u32; 3]>,
}

impl TriangleMesh {
    /// The corners of every triangle.
    pub fn corners(&self) -> impl Iterator<Item = [Vec3; 3]> {
        self.triangles.iter().map(|corners| corners.map(|corner| self.positions[corner as usize]))
    }

    /// The volume that closed surfaces enclose, by the divergence theorem; twice where they enclose it twice.
    pub(super) fn signed_volume(&self) -> f32 {
        let [low, high] = self.bounds();
        let middle = 0.5 * (low + high);
        self.corners()
            .map(|corners| corners.map(|corner| corner - middle))
            .map(|[a, b, c]| a.dot(b.cross(c)) / 6.0)
            .sum()
    }

    /// The smallest and the largest coordinates of triangles along every axis.
    pub(super) fn bounds(&self) -> [Vec3; 2] {
        self.corners()
            .flatten()
            .fold([Vec3::INFINITY, Vec3::NEG_INFINITY], |[low, high], point| [low.min(point), high.max(point)])
    }
}

/// Cubic cells in a box. The centre of the cell (i, j, k) lies at `origin` + (i, j, k) · `cell`.
#[derive(Clone, Debug)]
pub(super) struct Lattice {
    pub origin: Vec3,
    pub cell: f32,
    pub dims: [usize; 3],
}

impl Lattice {
    /// A lattice with about `budget` cells inside a mesh, and room for an eighth of its box and two cells on every side.
    /// None where the box has no volume.
    pub fn around(mesh: &TriangleMesh, budget: usize) -> Option<Self> {
        let [low, high] = mesh.bounds();
        let size = high - low;
        if !(size.element_product() > 0.0 && size.is_finite()) {
            return None;
        }
        // Of an open mesh the volume says little.
        let volume = mesh.signed_volume().abs().clamp(size.element_product() / 64.0, size.element_product());
        // No more cells than this along a side, however flat the box is.
        let finest = size.max_element() / 192.0;
        let cell = (volume / budget as f32).cbrt().max(finest);
        // A whole number along the longest side: a cube's volume is exact.
        let cell = size.max_element() / (size.max_element() / cell).round();
        let margin = (size / (8.0 * cell)).ceil() + 2.0;
        let inner = (size / cell).round().max(Vec3::ONE);
        let origin = 0.5 * (low + high) - (0.5 * inner + margin - 0.5) * cell;
        let dims = (inner + 2.0 * margin).to_array().map(|cells| cells as usize);
        Some(Self { origin, cell, dims })
    }

    pub fn len(&self) -> usize {
        self.dims.iter().product()
    }

    pub fn strides(&self) -> [usize; 3] {
        [1, self.dims[0], self.dims[0] * self.dims[1]]
    }

    /// Where a cell is along each axis.
    pub fn place(&self, index: usize) -> [usize; 3] {
        [index % self.dims[0], index / self.dims[0] % self.dims[1], index / (self.dims[0] * self.dims[1])]
    }

    /// A cell's centre in units of cells.
    pub fn center(&self, index: usize) -> Vec3 {
        let [x, y, z] = self.place(index);
        vec3(x as f32, y as f32, z as f32)
    }

    /// From space to units of cells.
    pub fn from_space(&self, point: Vec3) -> Vec3 {
        (point - self.origin) / self.cell
    }

    /// From units of cells to space.
    pub fn to_space(&self, point: Vec3) -> Vec3 {
        self.origin + point * self.cell
    }

    /// The cell nearest to a point in units of cells.
    pub fn index_of(&self, point: Vec3) -> usize {
        let strides = self.strides();
        let place = point.round().to_array();
        (0..3).map(|axis| strides[axis] * (place[axis].max(0.0) as usize).min(self.dims[axis] - 1)).sum()
    }

    /// The cells that share a face with a cell.
    pub fn neighbors(&self, index: usize) -> impl Iterator<Item = usize> + use<> {
        let (place, dims, strides) = (self.place(index), self.dims, self.strides());
        (0..3).flat_map(move |axis| {
            let before = (place[axis] > 0).then(|| index - strides[axis]);
            let after = (place[axis] + 1 < dims[axis]).then(|| index + strides[axis]);
            [before, after].into_iter().flatten()
        })
    }

    /// For every cell the first of the seeds, which are cells too, that a flood from all of them brings there: about the
    /// nearest one.
    pub fn flood(&self, seeds: &[usize]) -> Vec<u32> {
        let mut from = vec![u32::MAX; self.len()];
        let mut queue = VecDeque::with_capacity(self.len());
        for (seed, cell) in seeds.iter().enumerate() {
            if from[*cell] == u32::MAX {
                from[*cell] = seed as u32;
                queue.push_back(*cell);
            }
        }
        while let Some(cell) = queue.pop_front() {
            for next in self.neighbors(cell) {
                if from[next] == u32::MAX {
                    from[next] = from[cell];
                    queue.push_back(next);
                }
            }
        }
        from
    }
}

/// Whether each cell's centre lies inside a mesh: whether its generalised winding number (Jacobson et al. 2013, *Robust
/// inside-outside segmentation using generalized winding numbers*), the mean over all directions of the signed number of
/// crossings, exceeds a half in size, with the six directions of the axes for all. Closed meshes get the exact answer,
/// whichever way they face, also where they overlap themselves; open ones are closed where most directions see a surface.
pub(super) fn inside(mesh: &TriangleMesh, lattice: &Lattice) -> Vec<bool> {
    let mut winding = vec![0_i16; lattice.len()];
    let strides = lattice.strides();
    for axis in 0..3 {
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        let mut crossings: Vec<(u32, f32, i16)> = Vec::new();
        for corners in mesh.corners() {
            // No mesh of round numbers has its edges on columns moved by this.
            let corners = corners.map(|corner| lattice.from_space(corner) + vec3(3.1e-4, 5.3e-4, 7.7e-4));
            cross_columns(corners, [axis, u, v], lattice.dims, |column, depth, sign| {
                crossings.push((column as u32, depth, sign));
            });
        }
        crossings.sort_unstable_by(|a, b| (a.0, a.1).partial_cmp(&(b.0, b.1)).expect("depths are finite"));
        for column in crossings.chunk_by(|a, b| a.0 == b.0) {
            let place = column[0].0 as usize;
            let start = place % lattice.dims[u] * strides[u] + place / lattice.dims[u] * strides[v];
            let mut ahead: i16 = column.iter().map(|crossing| crossing.2).sum();
            let mut behind = 0;
            let mut next = column.iter().peekable();
            for step in 0..lattice.dims[axis] {
                while let Some((_, _, sign)) = next.next_if(|crossing| crossing.1 < step as f32) {
                    ahead -= sign;
                    behind -= sign;
                }
                winding[start + step * strides[axis]] += ahead + behind;
            }
        }
    }
    winding.into_iter().map(|sum| sum.abs() > 3).collect()
}

/// The columns of cells along an axis that cross a triangle: each with the depth of the crossing, and the sign of the
/// triangle's normal along the axis. Of two triangles that share an edge exactly one has what is on it.
pub(super) fn cross_columns(
    corners: [Vec3; 3],
    [axis, u, v]: [usize; 3],
    dims: [usize; 3],
    mut crossing: impl FnMut(usize, f32, i16),
) {
    let flat = corners.map(|corner| [f64::from(corner[u]), f64::from(corner[v])]);
    let area = edge(flat[0], flat[1], flat[2]);
    if area == 0.0 || !area.is_finite() {
        return;
    }
    let range = |side: usize, cells: usize| {
        let low = flat.iter().map(|corner| corner[side]).fold(f64::INFINITY, f64::min).ceil().max(0.0);
        let high = flat.iter().map(|corner| corner[side]).fold(f64::NEG_INFINITY, f64::max).floor();
        // Saturates: nothing below 0.
        low as usize..((high + 1.0) as usize).min(cells)
    };
    for row in range(1, dims[v]) {
        for column in range(0, dims[u]) {
            let point = [column as f64, row as f64];
            let weights = [(1, 2), (2, 0), (0, 1)].map(|(a, b)| side(flat[a], flat[b], point));
            let facing = |(weight, on_left): (f64, bool)| (on_left == (area > 0.0)).then_some(weight);
            let [Some(a), Some(b), Some(c)] = weights.map(facing) else { continue };
            let depth =
                (a * f64::from(corners[0][axis]) + b * f64::from(corners[1][axis]) + c * f64::from(corners[2][axis]))
                    / (a + b + c);
            if depth.is_finite() {
                crossing(column + row * dims[u], depth as f32, if area > 0.0 { 1 } else { -1 });
            }
        }
    }
}

/// Twice the signed area of a triangle.
fn edge(a: [f64; 2], b: [f64; 2], point: [f64; 2]) -> f64 {
    (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0])
}

/// Twice the signed area of the triangle of an edge and a point, and whether the point is to the edge's left. Exactly
/// reversed for the edge reversed, so that no point falls between two triangles.
fn side(a: [f64; 2], b: [f64; 2], point: [f64; 2]) -> (f64, bool) {
    if a <= b {
        let area = edge(a, b, point);
        (area, area >= 0.0)
    } else {
        let area = edge(b, a, point);
        (-area, area < 0.0)
    }
}
