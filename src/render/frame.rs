//! A frame of smoke on the GPU: its RBFs, bins and hash tables, and the density textures that they are unpacked to.

use std::sync::atomic::{AtomicBool, Ordering};

use bevy::asset::AssetId;
use bevy::ecs::system::SystemParamItem;
use bevy::ecs::system::lifetimeless::SRes;
use bevy::math::DVec3;
use bevy::prelude::*;
use bevy::render::render_asset::{PrepareAssetError, RenderAsset};
use bevy::render::render_resource::{
    Buffer, BufferInitDescriptor, BufferUsages, Extent3d, ShaderType, TextureDescriptor, TextureDimension,
    TextureFormat, TextureUsages, TextureView, TextureViewDescriptor, UniformBuffer, encase,
};
use bevy::render::renderer::{RenderDevice, RenderQueue};

use super::incident_light::PROBE_BYTES;
use crate::bundle::{SmokeAnimation, SmokeFrame, SmokeFrames};
use crate::density::GridShape;
use crate::optics::gaussian_column;
use crate::rbf::{Rbf, RbfBins};

/// Format of [`GpuSmokeFrame::density`]: read texel by texel, at full precision.
pub(super) const DENSITY_FORMAT: TextureFormat = TextureFormat::R32Float;
/// Format of the textures that are sampled with filtering; the one such format every WebGPU device can also store to.
pub(super) const FILTERED_FORMAT: TextureFormat = TextureFormat::Rgba16Float;

/// An animation on the GPU.
pub struct GpuSmokeAnimation {
    pub(super) shape: GridShape,
    /// What the value 1 of the filtered density textures stands for; above 0.
    pub(super) max_density: f32,
    pub(super) frames: Vec<GpuSmokeFrame>,
}

/// One frame on the GPU.
pub(super) struct GpuSmokeFrame {
    pub rbf_count: u32,
    /// Density columns in all directions from within the smoke, scaled density times bundle length: a sample.
    columns: Vec<f32>,
    /// Scaled density times radius of an RBF, the mean over all smoke: its optical radius over the extinction.
    pub typical_depth: f32,
    pub uniform: Buffer,
    pub rbfs: Buffer,
    pub bin_offsets: Buffer,
    pub bin_indices: Buffer,
    pub occupancy: Buffer,
    pub hash_offsets: Buffer,
    pub hash_table: Buffer,
    /// Density of every cell, written by the density pass.
    pub density: TextureView,
    /// Coarse density, padded by an empty cell on each side, written by the coarse pass.
    pub coarse: TextureView,
    /// Whether `density` and `coarse` have been written.
    unpacked: AtomicBool,
}

/// The `Frame` of `frame.wgsl`.
#[derive(ShaderType, Clone, Debug)]
pub(super) struct FrameUniform {
    dims: UVec3,
    rbf_count: u32,
    bins: UVec3,
    cell: f32,
    coarse_dims: UVec3,
    coarse_ratio: f32,
    residual_max: f32,
    residual_exponent: f32,
    offset_side: u32,
    table_len: u32,
    /// Multiplies the density before it is stored in half precision.
    density_scale: f32,
}

/// The `Rbf` of `frame.wgsl`.
#[derive(ShaderType, Clone, Copy, Default)]
struct RbfEntry {
    center: Vec3,
    radius: f32,
    weight: f32,
}

impl GpuSmokeFrame {
    pub fn new(
        shape: GridShape,
        frame: &SmokeFrame,
        max_density: f32,
        device: &RenderDevice,
        queue: &RenderQueue,
    ) -> Self {
        let rbfs = &frame.rbfs.rbfs;
        let residual = &frame.residual;
        let bins = RbfBins::new(rbfs, shape);
        let coarse = shape.coarse();
        Self {
            rbf_count: rbfs.len() as u32,
            columns: sample_columns(rbfs, max_density),
            typical_depth: typical_depth(rbfs, max_density),
            uniform: uniform(device, queue, "smoke_frame", frame_uniform(shape, frame, &bins, max_density)),
            rbfs: rbf_buffer(device, rbfs),
            bin_offsets: storage(device, "smoke_bin_offsets", &bins.offsets),
            bin_indices: storage(device, "smoke_bin_indices", &bins.indices),
            occupancy: storage(device, "smoke_residual_occupancy", residual.occupancy()),
            hash_offsets: storage(device, "smoke_residual_offsets", &residual.packed_offsets()),
            hash_table: storage(device, "smoke_residual_table", residual.table()),
            density: texture_3d(device, "smoke_density", shape.dims, DENSITY_FORMAT),
            coarse: texture_3d(device, "smoke_coarse_density", coarse.dims + 2, FILTERED_FORMAT),
            unpacked: AtomicBool::new(false),
        }
    }

    /// The probability that light which has scattered meets smoke again, for an extinction per bundle unit and scaled
    /// density: the mean of 1 − transmittance from within the smoke, an estimate.
    pub fn chance_to_meet_again(&self, sigma: f32) -> f32 {
        let met: f32 = self.columns.iter().map(|column| -(-sigma * column).exp_m1()).sum();
        met / self.columns.len().max(1) as f32
    }

    /// True the first time it is asked: then the density passes must run.
    pub fn take_unpacking(&self) -> bool {
        !self.unpacked.swap(true, Ordering::Relaxed)
    }
}

fn typical_depth(rbfs: &[Rbf], max_density: f32) -> f32 {
    let mass = |rbf: &Rbf| rbf.weight * rbf.radius.powi(3);
    let sum: f32 = rbfs.iter().map(|rbf| mass(rbf) * rbf.weight / max_density * rbf.radius).sum();
    sum / rbfs.iter().map(mass).sum::<f32>().max(f32::MIN_POSITIVE)
}

/// Columns along the axes from the centres of RBFs, spread over the list.
fn sample_columns(rbfs: &[Rbf], max_density: f32) -> Vec<f32> {
    const CENTERS: usize = 24;
    let from = rbfs.iter().step_by(rbfs.len().div_ceil(CENTERS).max(1));
    let center = |rbf: &Rbf| Vec3::from(rbf.center).as_dvec3();
    from.flat_map(|from| DVec3::AXES.into_iter().flat_map(|axis| [axis, -axis]).map(move |dir| (center(from), dir)))
        .map(|(from, dir)| {
            let columns = rbfs.iter().map(|rbf| {
                gaussian_column(from, dir, center(rbf), rbf.radius.into(), (rbf.weight / max_density).into())
            });
            columns.sum::<f64>() as f32
        })
        .collect()
}

fn frame_uniform(shape: GridShape, frame: &SmokeFrame, bins: &RbfBins, max_density: f32) -> FrameUniform {
    let residual = &frame.residual;
    let longest = shape.longest() as f32;
    FrameUniform {
        dims: shape.dims,
        rbf_count: frame.rbfs.rbfs.len() as u32,
        bins: bins.dims,
        cell: shape.cell_size(),
        coarse_dims: shape.coarse().dims,
        coarse_ratio: (longest / crate::density::COARSE_CELLS as f32).max(1.0),
        residual_max: residual.law().max,
        residual_exponent: residual.law().exponent,
        offset_side: residual.offset_side(),
        table_len: residual.slots(),
        density_scale: 1.0 / max_density,
    }
}

fn rbf_buffer(device: &RenderDevice, rbfs: &[Rbf]) -> Buffer {
    let entries: Vec<RbfEntry> =
        rbfs.iter().map(|r| RbfEntry { center: r.center.into(), radius: r.radius, weight: r.weight }).collect();
    let mut bytes = encase::StorageBuffer::new(Vec::<u8>::new());
    bytes.write(&entries).expect("a Vec grows as it is written to");
    storage(device, "smoke_rbfs", &bytes.into_inner())
}

/// A read-only storage buffer; never empty, since empty buffers cannot be bound.
fn storage<T: bytemuck::NoUninit>(device: &RenderDevice, label: &str, data: &[T]) -> Buffer {
    let mut contents = bytemuck::cast_slice::<T, u8>(data).to_vec();
    contents.resize(contents.len().max(32).next_multiple_of(4), 0);
    device.create_buffer_with_data(&BufferInitDescriptor {
        label: Some(label),
        contents: &contents,
        usage: BufferUsages::STORAGE,
    })
}

/// A uniform buffer with a value that does not change.
pub(super) fn uniform<T: ShaderType + encase::internal::WriteInto>(
    device: &RenderDevice,
    queue: &RenderQueue,
    label: &'static str,
    value: T,
) -> Buffer {
    let mut buffer = UniformBuffer::from(value);
    buffer.set_label(Some(label));
    buffer.write_buffer(device, queue);
    buffer.buffer().expect("it has just been written").clone()
}

/// A 3D texture that a pass writes and others read.
pub(super) fn texture_3d(device: &RenderDevice, label: &str, dims: UVec3, format: TextureFormat) -> TextureView {
    let usage = TextureUsages::STORAGE_BINDING | TextureUsages::TEXTURE_BINDING | TextureUsages::COPY_SRC;
    let texture = device.create_texture(&TextureDescriptor {
        label: Some(label),
        size: Extent3d { width: dims.x, height: dims.y, depth_or_array_layers: dims.z },
        mip_level_count: 1,
        sample_count: 1,
        dimension: TextureDimension::D3,
        format,
        usage,
        view_formats: &[],
    });
    texture.create_view(&TextureViewDescriptor::default())
}

impl RenderAsset for GpuSmokeAnimation {
    type SourceAsset = SmokeAnimation;
    type Param = (SRes<RenderDevice>, SRes<RenderQueue>);

    fn prepare_asset(
        animation: SmokeAnimation,
        id: AssetId<SmokeAnimation>,
        (device, queue): &mut SystemParamItem<Self::Param>,
        _previous: Option<&Self>,
    ) -> Result<Self, PrepareAssetError<SmokeAnimation>> {
        let shape = animation.shape;
        let max_density = if animation.max_density > 0.0 { animation.max_density } else { 1.0 };
        let mut frames = Vec::new();
        let all = match &animation.frames {
            SmokeFrames::Memory(all) => &all[..],
            SmokeFrames::Stream(_) => &[],
        };
        match all.iter().try_for_each(|frame| fits(shape, frame, device)) {
            Ok(()) => {
                frames.extend(all.iter().map(|frame| GpuSmokeFrame::new(shape, frame, max_density, device, queue)))
            }
            Err(problem) => error!("smoke {id} is not drawn: {problem}"),
        }
        Ok(Self { shape, max_density, frames })
    }
}

/// Whether the device can hold a frame; if not, why, and what to do.
fn fits(shape: GridShape, frame: &SmokeFrame, device: &RenderDevice) -> Result<(), String> {
    let limits = device.limits();
    // The texture that is marched has a cell of padding on each side.
    let side = limits.max_texture_dimension_3d;
    if shape.longest() + 2 > side {
        return Err(format!(
            "it has {} cells, but this adapter's 3D textures end at {side} a side, two of them padding; bake it from a \
             smaller grid",
            shape.dims
        ));
    }
    let bytes = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size);
    let (rbfs, residual) = (&frame.rbfs.rbfs, &frame.residual);
    let probes = rbfs.len() as u64 * PROBE_BYTES;
    let largest = [
        ("probes", probes),
        ("bins", 4 * RbfBins::entry_bound(rbfs, shape)),
        ("residual", u64::from(residual.slots()).max(2 * residual.offsets().len() as u64)),
    ];
    match largest.into_iter().find(|(_, needed)| *needed > bytes) {
        Some((what, needed)) => Err(format!(
            "its {what} take {needed} bytes, but this adapter's buffers end at {bytes}; bake it with fewer RBFs or from \
             a smaller grid"
        )),
        None => Ok(()),
    }
}
