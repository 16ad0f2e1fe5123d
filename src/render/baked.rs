//! A baked frame on the GPU: its residual, and what the choice of scattering knows of it. Moments share it.

use std::sync::Arc;

use bevy::math::DVec3;
use bevy::prelude::*;
use bevy::render::render_resource::{Buffer, BufferInitDescriptor, BufferUsages};
use bevy::render::renderer::RenderDevice;

use crate::bundle::SmokeFrame;
use crate::optics::gaussian_column;
use crate::rbf::{Rbf, SUPPORT};
use crate::residual::HashedResidual;

/// Words before the residual's arrays; as in `density.wgsl`.
const HEADER: usize = 8;

/// What does not change of a baked frame, however it is blended with its neighbours.
pub(super) struct GpuBakedFrame {
    /// Held, lest another frame come to its address.
    pub frame: Arc<SmokeFrame>,
    /// The residual, one array of words: see [`pack`].
    pub residual: Buffer,
    /// Density columns in all directions from within the smoke, density times bundle length: a sample.
    columns: Vec<f32>,
    /// Density times radius of an RBF, the mean over all smoke.
    pub typical_depth: f32,
}

impl GpuBakedFrame {
    pub fn new(frame: &Arc<SmokeFrame>, device: &RenderDevice) -> Self {
        let rbfs = &frame.rbfs.rbfs;
        Self {
            frame: frame.clone(),
            residual: device.create_buffer_with_data(&BufferInitDescriptor {
                label: Some("smoke_residual"),
                contents: bytemuck::cast_slice(&pack(&frame.residual)),
                usage: BufferUsages::STORAGE,
            }),
            columns: sample_columns(rbfs),
            typical_depth: typical_depth(rbfs),
        }
    }

    /// Bytes of a frame's residual on the GPU.
    pub fn residual_bytes(residual: &HashedResidual) -> u64 {
        let offsets = residual.offsets().len().div_ceil(2);
        4 * (HEADER + residual.occupancy().len() + offsets + residual.table().len()) as u64
    }

    /// The probability that light which has scattered meets smoke again, for an extinction per bundle unit and density:
    /// the mean of 1 − transmittance from within the smoke, an estimate.
    pub fn chance_to_meet_again(&self, sigma: f32) -> f32 {
        let met: f32 = self.columns.iter().map(|column| -(-sigma * column).exp_m1()).sum();
        met / self.columns.len().max(1) as f32
    }
}

/// A residual as the GPU reads it: a header (largest magnitude, exponent, side of the offset table, slots, where the
/// offsets and the table begin), occupancy, offsets two a word, table.
fn pack(residual: &HashedResidual) -> Vec<u32> {
    let (law, offsets) = (residual.law(), residual.packed_offsets());
    let offsets_at = HEADER + residual.occupancy().len();
    let table_at = offsets_at + offsets.len();
    let mut words = vec![
        law.max.to_bits(),
        law.exponent.to_bits(),
        residual.offset_side(),
        residual.slots(),
        offsets_at as u32,
        table_at as u32,
    ];
    words.resize(HEADER, 0);
    words.extend(residual.occupancy());
    words.extend(offsets);
    words.extend(residual.table());
    words
}

fn typical_depth(rbfs: &[Rbf]) -> f32 {
    let mass = |rbf: &Rbf| rbf.weight * rbf.radius.powi(3);
    let sum: f32 = rbfs.iter().map(|rbf| mass(rbf) * rbf.weight * rbf.radius).sum();
    sum / rbfs.iter().map(mass).sum::<f32>().max(f32::MIN_POSITIVE)
}

/// Columns along the axes from the centres of RBFs, spread over the list.
fn sample_columns(rbfs: &[Rbf]) -> Vec<f32> {
    const CENTERS: usize = 24;
    let from = rbfs.iter().step_by(rbfs.len().div_ceil(CENTERS).max(1));
    let center = |rbf: &Rbf| Vec3::from(rbf.center).as_dvec3();
    from.flat_map(|from| DVec3::AXES.into_iter().flat_map(|axis| [axis, -axis]).map(move |dir| (center(from), dir)))
        .map(|(from, dir)| {
            let columns = rbfs.iter().map(|rbf| {
                let (center, radius) = (center(rbf), f64::from(rbf.radius));
                // Most RBFs are beside the ray or behind it.
                let (offset, reach) = (center - from, f64::from(SUPPORT) * radius);
                let along = offset.dot(dir);
                if along < -reach || offset.length_squared() - along * along > reach * reach {
                    return 0.0;
                }
                gaussian_column(from, dir, center, radius, rbf.weight.into())
            });
            columns.sum::<f64>() as f32
        })
        .collect()
}
