//! What accelerates the smoke: heat, its own weight, and the eddies that the grid blurs.

use glam::{UVec3, Vec3};

use super::lattice::{Lattice, Velocity, fill_planes, unit};
use crate::density::GridShape;

/// Adds `seconds` of an acceleration given at cell centres, in box lengths/s². Faces get the mean of the cells on either
/// side; those at the end of the box, of the one there is.
pub fn accelerate(velocity: &mut Velocity, shape: GridShape, seconds: f32, acceleration: &[Vec3]) {
    for (axis, face) in velocity.faces.iter_mut().enumerate() {
        face.update(|point, _, value| {
            let high = point.min(shape.dims - 1);
            let low = before(point, axis);
            let sum = acceleration[shape.index(low)][axis] + acceleration[shape.index(high)][axis];
            value + 0.5 * seconds * sum
        });
    }
}

/// Acceleration of every cell: `lift` · temperature − `weight` · density upward (Fedkiw et al. 2001, *Visual Simulation
/// of Smoke*, Eq. 8), and vorticity confinement (Eq. 11) h ε (∇|ω|/|∇|ω|| × ω), ω the curl of the velocity and h the side
/// of a cell, with ε = `vorticity` per second.
pub fn acceleration(
    velocity: &Velocity,
    density: &Lattice,
    temperature: &Lattice,
    lift: f32,
    weight: f32,
    vorticity: f32,
) -> Vec<Vec3> {
    let shape = density.shape;
    let mut centers = vec![Vec3::ZERO; shape.len()];
    fill_planes(shape, &mut centers, |cell, _, center| *center = velocity.at_center(cell));
    // Per cell: times the cells of a box length for a rate.
    let mut curl = vec![Vec3::ZERO; shape.len()];
    fill_planes(shape, &mut curl, |cell, _, curl| {
        let [dx, dy, dz] = gradient(shape, cell, |index| centers[index]);
        *curl = Vec3::new(dy.z - dz.y, dz.x - dx.z, dx.y - dy.x);
    });
    let mut result = centers;
    fill_planes(shape, &mut result, |cell, index, result| {
        let buoyancy = lift * temperature.values[index] - weight * density.values[index];
        let slope = Vec3::from(gradient(shape, cell, |index| curl[index].length()));
        // h ε × the rate: the side of a cell cancels.
        *result = buoyancy * Vec3::Y + vorticity * slope.normalize_or_zero().cross(curl[index]);
    });
    result
}

/// Central differences, per cell, one-sided at the box's end.
fn gradient<T: std::ops::Sub<Output = T> + std::ops::Mul<f32, Output = T>>(
    shape: GridShape,
    cell: UVec3,
    value: impl Fn(usize) -> T,
) -> [T; 3] {
    std::array::from_fn(|axis| {
        let high = (cell + unit(axis)).min(shape.dims - 1);
        let low = before(cell, axis);
        (value(shape.index(high)) - value(shape.index(low))) * (1.0 / (high[axis] - low[axis]) as f32)
    })
}

/// The point before along an axis; the first is its own.
fn before(mut point: UVec3, axis: usize) -> UVec3 {
    point[axis] = point[axis].saturating_sub(1);
    point
}
