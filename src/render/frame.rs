//! Smoke on the GPU as it is now: its RBFs and bins, rewritten in place as time goes on, and its density textures. Of a
//! moment of baked smoke RBFs come from the CPU, and density is unpacked from them and the residuals of two baked frames;
//! of live smoke density comes from a texture, and RBFs are laid through it on the GPU ([`lattice`](super::lattice)).

use std::sync::Arc;

use bevy::prelude::*;
use bevy::render::render_resource::{
    Buffer, BufferDescriptor, BufferUsages, Extent3d, ShaderType, TextureDescriptor, TextureDimension, TextureFormat,
    TextureUsages, TextureView, TextureViewDescriptor, UniformBuffer, encase,
};
use bevy::render::renderer::{RenderDevice, RenderQueue};

use super::baked::GpuBakedFrame;
use super::incident_light::PROBE_BYTES;
use crate::density::GridShape;
use crate::playback::Moment;
use crate::rbf::{Rbf, RbfBins, bin_shape};

/// Format of [`GpuSmokeFrame::density`]: read texel by texel, at full precision.
pub(super) const DENSITY_FORMAT: TextureFormat = TextureFormat::R32Float;
/// Format of the textures that are sampled with filtering; the one such format every WebGPU device can also store to.
pub(super) const FILTERED_FORMAT: TextureFormat = TextureFormat::Rgba16Float;

/// One moment on the GPU.
pub(super) struct GpuSmokeFrame {
    pub shape: GridShape,
    /// RBFs there are; of live smoke, of which only the GPU knows, RBFs there may be.
    pub rbf_count: u32,
    /// RBFs that every buffer of something an RBF has room for, here and in the volumes that show the moment.
    pub rbf_capacity: u32,
    /// Counts the rewrites.
    pub version: u32,
    /// What the value 1 of the filtered density textures stands for; above 0.
    max_density: f32,
    /// None of live smoke.
    blend: Option<Blend>,
    /// New, like the buffers after it, where RBFs or bins had outgrown them.
    pub uniform: Buffer,
    pub rbfs: Buffer,
    pub bin_offsets: Buffer,
    pub bin_indices: Buffer,
    /// Density of every cell, written by the density pass.
    pub density: TextureView,
    /// Coarse density, padded by an empty cell on each side, written by the coarse pass.
    pub coarse: TextureView,
}

/// Two baked frames, and the share of the second.
#[derive(Clone)]
struct Blend {
    baked: [Arc<GpuBakedFrame>; 2],
    share: f32,
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
    /// Multiplies the density before it is stored in half precision.
    density_scale: f32,
    blend: f32,
    rbf_capacity: u32,
}

/// The `Rbf` of `frame.wgsl`.
#[derive(ShaderType, Clone, Copy, Default)]
struct RbfEntry {
    center: Vec3,
    radius: f32,
    weight: f32,
}

impl GpuSmokeFrame {
    /// A moment, its RBFs as [`Moment::rbfs`] lists them.
    pub fn new(
        moment: &Moment,
        rbfs: &[Rbf],
        baked: [Arc<GpuBakedFrame>; 2],
        device: &RenderDevice,
        queue: &RenderQueue,
    ) -> Self {
        let shape = moment.shape();
        let bins = RbfBins::of_moment(rbfs, &moment.stays(), shape);
        let rbf_capacity = rbf_capacity(rbfs.len() as u32);
        let entries = entry_capacity(bins.indices.len() as u64);
        let mut frame = Self::empty(shape, rbf_capacity, bins.offsets.len() as u64, entries, device);
        frame.write_moment(moment, rbfs, &bins, baked, queue);
        frame
    }

    /// Live smoke of so many cells, with room for so many RBFs and entries of bins that the GPU fills in.
    pub fn live(
        shape: GridShape,
        max_density: f32,
        (rbfs, entries): (u32, u64),
        device: &RenderDevice,
        queue: &RenderQueue,
    ) -> Self {
        let bins = bin_shape(shape);
        let offsets = bins.len() as u64 + 1;
        let frame = Self { max_density, rbf_count: rbfs, ..Self::empty(shape, rbfs, offsets, entries, device) };
        // How many RBFs there are, the lattice's passes say.
        frame.write_uniform(FrameUniform { rbf_count: 0, ..frame.frame_uniform(bins.dims) }, queue);
        frame
    }

    fn empty(shape: GridShape, rbf_capacity: u32, bin_offsets: u64, bin_entries: u64, device: &RenderDevice) -> Self {
        let [uniform, rbfs, bin_offsets, bin_indices] = buffers(rbf_capacity, bin_offsets, bin_entries, device);
        Self {
            shape,
            rbf_count: 0,
            rbf_capacity,
            version: 0,
            max_density: 1.0,
            blend: None,
            uniform,
            rbfs,
            bin_offsets,
            bin_indices,
            density: texture_3d(device, "smoke_density", shape.dims, DENSITY_FORMAT),
            coarse: texture_3d(device, "smoke_coarse_density", shape.coarse().dims + 2, FILTERED_FORMAT),
        }
    }

    /// The same smoke with other RBFs, to light it at: what reads its density reads the same textures.
    pub fn level(&self, rbfs: &[Rbf], device: &RenderDevice, queue: &RenderQueue) -> Self {
        let bins = RbfBins::new(rbfs, self.shape);
        let rbf_capacity = rbf_capacity(rbfs.len() as u32);
        let entries = entry_capacity(bins.indices.len() as u64);
        let [uniform, rbf_buffer, bin_offsets, bin_indices] =
            buffers(rbf_capacity, bins.offsets.len() as u64, entries, device);
        let mut level = Self {
            rbf_capacity,
            version: 0,
            blend: self.blend.clone(),
            uniform,
            rbfs: rbf_buffer,
            bin_offsets,
            bin_indices,
            density: self.density.clone(),
            coarse: self.coarse.clone(),
            ..*self
        };
        level.write(rbfs, &bins, queue);
        level
    }

    /// Follows the moment that a level is of.
    pub fn rewrite_level(&mut self, moment: &Self, rbfs: &[Rbf], device: &RenderDevice, queue: &RenderQueue) {
        let bins = RbfBins::new(rbfs, self.shape);
        self.make_room(rbfs, &bins, device);
        self.version += 1;
        (self.blend, self.max_density) = (moment.blend.clone(), moment.max_density);
        self.write(rbfs, &bins, queue);
    }

    /// New buffers where RBFs or bins have outgrown them.
    fn make_room(&mut self, rbfs: &[Rbf], bins: &RbfBins, device: &RenderDevice) {
        if rbfs.len() as u32 > self.rbf_capacity || 4 * bins.indices.len() as u64 > self.bin_indices.size() {
            self.rbf_capacity = self.rbf_capacity.max(rbf_capacity(rbfs.len() as u32));
            let entries = entry_capacity(bins.indices.len() as u64);
            [self.uniform, self.rbfs, self.bin_offsets, self.bin_indices] =
                buffers(self.rbf_capacity, bins.offsets.len() as u64, entries, device);
        }
    }

    /// Shows another moment on the same cells: the density passes must run again.
    pub fn rewrite(
        &mut self,
        moment: &Moment,
        rbfs: &[Rbf],
        baked: [Arc<GpuBakedFrame>; 2],
        device: &RenderDevice,
        queue: &RenderQueue,
    ) {
        let bins = RbfBins::of_moment(rbfs, &moment.stays(), self.shape);
        self.make_room(rbfs, &bins, device);
        self.version += 1;
        self.write_moment(moment, rbfs, &bins, baked, queue);
    }

    fn write_moment(
        &mut self,
        moment: &Moment,
        rbfs: &[Rbf],
        bins: &RbfBins,
        baked: [Arc<GpuBakedFrame>; 2],
        queue: &RenderQueue,
    ) {
        self.blend = Some(Blend { baked, share: moment.blend });
        self.max_density = moment.density_scale();
        self.write(rbfs, bins, queue);
    }

    fn write(&mut self, rbfs: &[Rbf], bins: &RbfBins, queue: &RenderQueue) {
        self.rbf_count = rbfs.len() as u32;
        self.write_uniform(self.frame_uniform(bins.dims), queue);
        let entries: Vec<RbfEntry> =
            rbfs.iter().map(|r| RbfEntry { center: r.center.into(), radius: r.radius, weight: r.weight }).collect();
        let mut entry_bytes = encase::StorageBuffer::new(Vec::<u8>::new());
        entry_bytes.write(&entries).expect("a Vec grows as it is written to");
        queue.write_buffer(&self.rbfs, 0, entry_bytes.as_ref());
        queue.write_buffer(&self.bin_offsets, 0, bytemuck::cast_slice(&bins.offsets));
        queue.write_buffer(&self.bin_indices, 0, bytemuck::cast_slice(&bins.indices));
    }

    fn write_uniform(&self, value: FrameUniform, queue: &RenderQueue) {
        let mut uniform = encase::UniformBuffer::new(Vec::<u8>::new());
        uniform.write(&value).expect("a Vec grows as it is written to");
        queue.write_buffer(&self.uniform, 0, uniform.as_ref());
    }

    fn frame_uniform(&self, bins: UVec3) -> FrameUniform {
        let shape = self.shape;
        FrameUniform {
            dims: shape.dims,
            rbf_count: self.rbf_count,
            bins,
            cell: shape.cell_size(),
            coarse_dims: shape.coarse().dims,
            coarse_ratio: (shape.longest() as f32 / crate::density::COARSE_CELLS as f32).max(1.0),
            density_scale: 1.0 / self.max_density,
            blend: self.blend.as_ref().map_or(0.0, |blend| blend.share),
            rbf_capacity: self.rbf_capacity,
        }
    }

    /// The residuals that are blended, the same one twice where nothing is; None of live smoke.
    pub fn residuals(&self) -> Option<[&Buffer; 2]> {
        self.blend.as_ref().map(|blend| blend.baked.each_ref().map(|baked| &baked.residual))
    }

    /// The probability that light which has scattered meets smoke again, for an extinction per bundle unit and scaled
    /// density; None of live smoke.
    pub fn chance_to_meet_again(&self, sigma: f32) -> Option<f32> {
        self.mix(|baked| baked.chance_to_meet_again(sigma / self.max_density))
    }

    /// Scaled density times radius of an RBF, the mean over all smoke: its optical radius over the extinction; None of live
    /// smoke.
    pub fn typical_depth(&self) -> Option<f32> {
        self.mix(|baked| baked.typical_depth / self.max_density)
    }

    fn mix(&self, of: impl Fn(&GpuBakedFrame) -> f32) -> Option<f32> {
        let Blend { baked: [from, to], share } = self.blend.as_ref()?;
        Some((1.0 - share) * of(from) + if *share > 0.0 { share * of(to) } else { 0.0 })
    }

    /// Bytes on the GPU, without the residuals.
    pub fn bytes(&self) -> u64 {
        let buffers = [&self.uniform, &self.rbfs, &self.bin_offsets, &self.bin_indices];
        let textures = [&self.density, &self.coarse].map(|view| {
            let (size, texel) = (view.texture().size(), view.texture().format().block_copy_size(None));
            u64::from(size.width * size.height * size.depth_or_array_layers) * u64::from(texel.unwrap_or(0))
        });
        buffers.iter().map(|buffer| buffer.size()).sum::<u64>() + textures.iter().sum::<u64>()
    }
}

/// Room for so many RBFs, and for some that come and go as time goes on.
fn rbf_capacity(count: u32) -> u32 {
    (count + count / 16).max(1).next_multiple_of(64)
}

/// The same for the bins' entries.
fn entry_capacity(entries: u64) -> u64 {
    (entries + entries / 4).max(1).next_multiple_of(1024)
}

/// Uniform, RBFs, offsets and entries of the bins.
fn buffers(rbf_capacity: u32, bin_offsets: u64, bin_entries: u64, device: &RenderDevice) -> [Buffer; 4] {
    let buffer = |label, size, usage| {
        let usage = usage | BufferUsages::STORAGE | BufferUsages::COPY_DST | BufferUsages::COPY_SRC;
        device.create_buffer(&BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false })
    };
    [
        // Live smoke's passes write how many RBFs there are.
        buffer("smoke_frame", FrameUniform::min_size().get(), BufferUsages::UNIFORM),
        buffer("smoke_rbfs", u64::from(rbf_capacity) * RbfEntry::min_size().get(), BufferUsages::empty()),
        buffer("smoke_bin_offsets", 4 * bin_offsets, BufferUsages::empty()),
        buffer("smoke_bin_indices", 4 * bin_entries, BufferUsages::empty()),
    ]
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

/// Whether the device can hold so many cells; if not, why, and what to do.
pub(super) fn cells_fit(shape: GridShape, device: &RenderDevice) -> Result<(), String> {
    // The texture that is marched has a cell of padding on each side.
    let side = device.limits().max_texture_dimension_3d;
    if shape.longest() + 2 > side {
        return Err(format!(
            "it has {} cells, but this adapter's 3D textures end at {side} a side, two of them padding; take a smaller \
             grid",
            shape.dims
        ));
    }
    Ok(())
}

/// Whether the device can hold a moment; if not, why, and what to do.
pub(super) fn fits(moment: &Moment, rbfs: &[Rbf], device: &RenderDevice) -> Result<(), String> {
    let (shape, limits) = (moment.shape(), device.limits());
    cells_fit(shape, device)?;
    let bytes = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size);
    let residual = |frame: &crate::bundle::SmokeFrame| GpuBakedFrame::residual_bytes(&frame.residual);
    let largest = [
        ("probes", u64::from(rbf_capacity(rbfs.len() as u32)) * PROBE_BYTES),
        ("bins", 4 * entry_capacity(RbfBins::entry_bound(rbfs, shape))),
        ("residual", residual(&moment.from).max(residual(&moment.to))),
    ];
    match largest.into_iter().find(|(_, needed)| *needed > bytes) {
        Some((what, needed)) => Err(format!(
            "its {what} take {needed} bytes, but this adapter's buffers end at {bytes}; bake it with fewer RBFs or from \
             a smaller grid"
        )),
        None => Ok(()),
    }
}
