//! Meshes to fit spheres to: for tests, and for `smoke study spheres`.

use core::f32::consts::TAU;

use glam::{Affine3A, Mat4, Vec3, vec3};

use super::skin::Skin;
use super::solid::TriangleMesh;

/// A box about the origin whose faces are cut into so many rectangles along each axis.
pub(crate) fn box_grid(size: Vec3, cuts: [usize; 3]) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    for axis in 0..3 {
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        for side in [-0.5_f32, 0.5] {
            let first = mesh.positions.len() as u32;
            for j in 0..=cuts[v] {
                for i in 0..=cuts[u] {
                    let mut point = [0.0; 3];
                    point[axis] = side;
                    point[u] = i as f32 / cuts[u] as f32 - 0.5;
                    point[v] = j as f32 / cuts[v] as f32 - 0.5;
                    mesh.positions.push(Vec3::from_array(point) * size);
                }
            }
            let place = |i: usize, j: usize| first + (i + j * (cuts[u] + 1)) as u32;
            for j in 0..cuts[v] {
                for i in 0..cuts[u] {
                    let mut corners = [place(i, j), place(i + 1, j), place(i + 1, j + 1), place(i, j + 1)];
                    if side < 0.0 {
                        corners.reverse();
                    }
                    let [a, b, c, d] = corners;
                    mesh.triangles.extend([[a, b, c], [a, c, d]]);
                }
            }
        }
    }
    mesh
}

/// A torus about the Y axis: `ring` is the radius of its middle line, `tube` that of its tube.
pub(crate) fn torus(ring: f32, tube: f32, around: u32, across: u32) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    for i in 0..around {
        let (sine, cosine) = (TAU * i as f32 / around as f32).sin_cos();
        for j in 0..across {
            let (up, out) = (TAU * j as f32 / across as f32).sin_cos();
            mesh.positions.push(vec3((ring + tube * out) * cosine, tube * up, -(ring + tube * out) * sine));
            let place = |i: u32, j: u32| (i % around) * across + j % across;
            let [a, b, c, d] = [place(i, j), place(i + 1, j), place(i + 1, j + 1), place(i, j + 1)];
            mesh.triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
    mesh
}

/// A skinned mesh in the pose that its joints have.
pub(crate) fn posed(mesh: &TriangleMesh, skin: &Skin, joints: &[Affine3A]) -> TriangleMesh {
    let poses: Vec<Mat4> =
        joints.iter().zip(&skin.inverse_bindposes).map(|(joint, inverse)| Mat4::from(*joint) * *inverse).collect();
    let positions = mesh.positions.iter().enumerate().map(|(vertex, position)| {
        let parts = skin.joints[vertex].iter().zip(skin.weights[vertex]);
        parts.map(|(joint, weight)| weight * poses[usize::from(*joint)].transform_point3(*position)).sum()
    });
    TriangleMesh { positions: positions.collect(), triangles: mesh.triangles.clone() }
}
