//! Moving values along the flow.

use glam::Vec3;

use super::lattice::{Lattice, Velocity, fill_planes};

/// Where the flow carries a position to, and where it comes from, in `step` seconds a cell length: one midpoint step
/// (Runge–Kutta of order 2) each.
#[inline]
fn trace(velocity: &Velocity, position: Vec3, step: f32) -> [Vec3; 2] {
    let half = 0.5 * step * velocity.at(position);
    [position + step * velocity.at(position + half), position - step * velocity.at(position - half)]
}

/// Carries values on one and the same lattice along the flow for `step` (time over the side of a cell), by MacCormack's
/// scheme on semi-Lagrangian steps (Selle et al. 2008, *An Unconditionally Stable MacCormack Method*).
///
/// Values are looked up where they come from; half of what is lost on the way there and back is given back. No value
/// leaves the range of the eight it comes from: no negative density, no new maxima.
pub fn advect<const N: usize>(fields: [&mut Lattice; N], velocity: &Velocity, step: f32) {
    let Some(lattice) = fields.first() else { return };
    let mut traces = vec![[Vec3::ZERO; 2]; lattice.values.len()];
    fill_planes(lattice.shape, &mut traces, |point, _, ends| *ends = trace(velocity, lattice.position(point), step));
    for field in fields {
        let forward = field.map(|_, index| field.sample(traces[index][1]));
        *field = field.map(|_, index| {
            let [to, from] = traces[index];
            let (corners, _) = field.stencil(from);
            let (low, high) = corners.iter().fold((f32::MAX, f32::MIN), |(low, high), &v| (low.min(v), high.max(v)));
            let back = forward.sample(to);
            let corrected = forward.values[index] + 0.5 * (field.values[index] - back);
            if (low..=high).contains(&corrected) { corrected } else { forward.values[index] }
        });
    }
}

/// One semi-Lagrangian step (Stam 1999): what [`advect`] improves on.
#[cfg(test)]
pub fn semi_lagrangian(field: &Lattice, velocity: &Velocity, step: f32) -> Lattice {
    field.map(|point, _| field.sample(trace(velocity, field.position(point), step)[1]))
}
