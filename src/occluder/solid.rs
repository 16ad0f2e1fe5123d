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
    pub fn in_cells(&self, point: Vec3) -> Vec3 {
        (point - self.origin) / self.cell
    }

    /// From units of cells to space.
    pub fn in_space(&self, point: Vec3) -> Vec3 {
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
            let corners = corners.map(|corner| lattice.in_cells(corner) + vec3(3.1e-4, 5.3e-4, 7.7e-4));
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::occluder::shapes;

    /// The share of cells whose answer differs from a formula's.
    fn wrong(mesh: &TriangleMesh, is_inside: impl Fn(Vec3) -> bool) -> f32 {
        let lattice = Lattice::around(mesh, 4000).unwrap();
        let found = inside(mesh, &lattice);
        let cells = found.iter().filter(|inside| **inside).count();
        let wrong =
            (0..lattice.len()).filter(|cell| found[*cell] != is_inside(lattice.in_space(lattice.center(*cell))));
        wrong.count() as f32 / cells as f32
    }

    fn in_box(size: Vec3) -> impl Fn(Vec3) -> bool {
        move |point| (point.abs().cmplt(0.5 * size)).all()
    }

    #[test]
    fn closed_meshes_are_exact() {
        let size = Vec3::new(1.0, 2.0, 0.7);
        let mesh = shapes::box_grid(size, [3, 5, 2]);
        assert_eq!(wrong(&mesh, in_box(size)), 0.0);
        let mut inside_out = mesh.clone();
        inside_out.triangles.iter_mut().for_each(|corners| corners.reverse());
        assert_eq!(wrong(&inside_out, in_box(size)), 0.0);
        let torus = shapes::torus(1.0, 0.4, 128, 64);
        let in_torus = |point: Vec3| (Vec3::new(point.x, 0.0, point.z).length() - 1.0).hypot(point.y) < 0.4;
        // Facets lie within the torus by half a per cent of its radius.
        assert!(wrong(&torus, in_torus) < 0.02);
    }

    #[test]
    fn meshes_may_overlap_themselves() {
        let mut mesh = shapes::box_grid(Vec3::ONE, [1; 3]);
        let other = shapes::box_grid(Vec3::new(0.5, 2.0, 0.5), [1; 3]);
        let first = mesh.positions.len() as u32;
        mesh.positions.extend(&other.positions);
        mesh.triangles.extend(other.triangles.iter().map(|corners| corners.map(|corner| corner + first)));
        let (a, b) = (in_box(Vec3::ONE), in_box(Vec3::new(0.5, 2.0, 0.5)));
        assert_eq!(wrong(&mesh, |point| a(point) || b(point)), 0.0);
    }

    #[test]
    fn holes_are_closed() {
        let mut mesh = shapes::box_grid(Vec3::ONE, [8; 3]);
        // The whole lid.
        let is_lid = |corners: &[u32; 3]| corners.iter().all(|corner| mesh.positions[*corner as usize].y > 0.499);
        let kept = mesh.triangles.iter().copied().filter(|corners| !is_lid(corners)).collect();
        mesh.triangles = kept;
        assert_eq!(wrong(&mesh, in_box(Vec3::ONE)), 0.0);
        // What is left of a sheet has no inside at all.
        mesh.triangles.truncate(128);
        assert!(!inside(&mesh, &Lattice { origin: Vec3::splat(-1.0), cell: 0.1, dims: [21; 3] }).contains(&true));
    }

    #[test]
    fn lattices_hold_about_the_cells_that_are_asked_for() {
        for size in [Vec3::ONE, Vec3::new(3.0, 0.1, 1.0), Vec3::new(0.2, 7.0, 0.3)] {
            let mesh = shapes::box_grid(size, [1; 3]);
            let lattice = Lattice::around(&mesh, 5000).unwrap();
            let cells = inside(&mesh, &lattice).iter().filter(|inside| **inside).count();
            // Thin boxes are a whole number of cells thick.
            assert!((3500..7000).contains(&cells), "{cells} cells in {size}");
        }
        assert!(Lattice::around(&shapes::box_grid(Vec3::new(1.0, 0.0, 1.0), [1; 3]), 100).is_none());
    }

    #[test]
    fn floods_find_the_nearest_seed() {
        let lattice = Lattice { origin: Vec3::ZERO, cell: 1.0, dims: [9, 5, 4] };
        let seeds = [lattice.index_of(Vec3::ZERO), lattice.index_of(vec3(8.0, 0.0, 0.0))];
        let nearest = lattice.flood(&seeds);
        assert_eq!(nearest.len(), lattice.len());
        for (cell, nearest) in nearest.into_iter().enumerate() {
            let x = lattice.place(cell)[0];
            assert!(x == 4 || nearest == u32::from(x > 4));
        }
    }
}
