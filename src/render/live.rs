//! Live density: the textures that games write, copied to where the passes read density, and what is laid through them.

use bevy::asset::AssetId;
use bevy::platform::collections::{HashMap, HashSet};
use bevy::prelude::*;
use bevy::render::render_asset::RenderAssets;
use bevy::render::render_resource::binding_types::{texture_3d, texture_storage_3d};
use bevy::render::render_resource::{
    BindGroupLayoutEntries, PipelineCache, ShaderStages, StorageTextureAccess, TextureDimension, TextureSampleType,
    TextureUsages, TextureView, TextureViewId,
};
use bevy::render::renderer::{RenderContext, RenderDevice};
use bevy::render::sync_world::MainEntity;
use bevy::render::texture::GpuImage;
use bevy::shader::Shader;

use super::coarse;
use super::frame::{DENSITY_FORMAT, GpuSmokeFrame, cells_fit};
use super::lattice;
use super::pass::{ComputePass, Job, workgroups};
use super::prepare::Gpu;
use super::{SmokePasses, SmokeRenderStats, SmokeWork};
use crate::density::GridShape;
use crate::volume::{LiveDensity, shape_of};

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_live";

/// A volume's live density, its values inside their range.
#[derive(Clone, Copy, Debug)]
pub(super) struct Live {
    pub image: AssetId<Image>,
    pub max_density: f32,
    changes: bool,
    lattice: u32,
}

impl Live {
    pub fn extract(entity: Entity, live: &LiveDensity) -> Self {
        let clamped = live.clamped();
        if clamped != *live {
            warn_once!("{live:?} of smoke volume {entity} is out of range: it is drawn as {clamped:?} (said once)");
        }
        let LiveDensity { image, changes, max_density, lattice } = clamped;
        Self { image: image.id(), max_density, changes, lattice }
    }

    fn key(&self) -> LiveKey {
        LiveKey { image: self.image, max_density: self.max_density.to_bits(), lattice: self.lattice }
    }
}

/// Tells one use of a texture from another.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
struct LiveKey {
    image: AssetId<Image>,
    max_density: u32,
    lattice: u32,
}

/// The live smoke on the GPU.
#[derive(Default)]
pub(super) struct LiveFrames {
    frames: HashMap<LiveKey, LiveFrame>,
    /// Volumes whose texture cannot be drawn.
    refused: HashSet<MainEntity>,
    now: u32,
}

struct LiveFrame {
    frame: GpuSmokeFrame,
    source: TextureViewId,
    copy: Job,
    coarse: Job,
    lattice: Vec<(lattice::Step, Job)>,
    /// Whether the texture is not what was copied last.
    stale: bool,
    /// The frame in which it was copied last.
    copied_at: u32,
    last_used: u32,
}

impl LiveFrames {
    /// Starts a rendered frame, in which these images came or changed.
    pub fn begin<'a>(&mut self, now: u32, changed: impl Iterator<Item = &'a AssetId<Image>>) {
        self.now = now;
        for image in changed {
            for (_, frame) in self.frames.iter_mut().filter(|(key, _)| key.image == *image) {
                frame.stale = true;
            }
        }
    }

    /// A volume's live smoke on the GPU; None while its texture is not there, and, with one error, where it cannot be drawn.
    pub fn show(
        &mut self,
        volume: MainEntity,
        live: &Live,
        images: &RenderAssets<GpuImage>,
        gpu: &Gpu,
        work: &mut SmokeWork,
    ) -> Option<&GpuSmokeFrame> {
        let image = images.get(live.image)?;
        let shape = shape_of(image.texture_descriptor.size);
        if let Err(problem) = usable(image).and_then(|()| cells_fit(shape, gpu.device)) {
            if self.refused.insert(volume) {
                error!("smoke volume {volume:?} is not drawn: its texture cannot be read as density: {problem}");
            }
            return None;
        }
        self.refused.remove(&volume);
        let (source, now, key) = (image.texture_view.id(), self.now, live.key());
        if !self.frames.contains_key(&key) {
            // A density that is bounded anew every frame does not pile up.
            let is_another = |other: &LiveKey| (other.image, other.lattice) != (key.image, key.lattice);
            self.frames.retain(|other, frame| is_another(other) || now.wrapping_sub(frame.last_used) <= 1);
        }
        let live_frame = self
            .frames
            .entry(key)
            .and_modify(|before| {
                if before.source != source {
                    *before = LiveFrame::new(live, image, shape, gpu);
                }
            })
            .or_insert_with(|| LiveFrame::new(live, image, shape, gpu));
        if live_frame.stale || live.changes && live_frame.copied_at != now {
            (live_frame.stale, live_frame.copied_at) = (false, now);
            live_frame.frame.version += 1;
            work.live.push(live_frame.copy.clone());
            work.coarse.push(live_frame.coarse.clone());
            work.lattice.extend(live_frame.lattice.iter().cloned());
        }
        live_frame.last_used = now;
        Some(&live_frame.frame)
    }

    /// Lets go of what is not in use.
    pub fn retain(&mut self, in_use: impl Fn(u32) -> bool, exists: impl Fn(MainEntity) -> bool) {
        self.frames.retain(|_, frame| in_use(frame.last_used));
        self.refused.retain(|volume| exists(*volume));
    }

    /// How many there are, and their bytes.
    pub fn memory(&self) -> (u32, u64) {
        (self.frames.len() as u32, self.frames.values().map(|live| live.frame.bytes()).sum())
    }
}

/// Whether an image holds what density is read from; if not, why, and what to do.
fn usable(image: &GpuImage) -> Result<(), String> {
    let descriptor = &image.texture_descriptor;
    if descriptor.dimension != TextureDimension::D3 {
        return Err(format!("its dimension is {:?}; make it a 3D one", descriptor.dimension));
    }
    if !descriptor.usage.contains(TextureUsages::TEXTURE_BINDING) {
        return Err("its usage lacks TEXTURE_BINDING".into());
    }
    match descriptor.format.sample_type(None, None) {
        Some(TextureSampleType::Float { .. }) => Ok(()),
        _ => Err(format!("shaders do not read {:?} as floats; take R16Float or R32Float", descriptor.format)),
    }
}

impl LiveFrame {
    fn new(live: &Live, image: &GpuImage, shape: GridShape, gpu: &Gpu) -> Self {
        let &Gpu { device, queue, cache, passes, .. } = gpu;
        let room = lattice::room(shape, live.lattice);
        let frame = GpuSmokeFrame::live(shape, live.max_density, room, device, queue);
        Self {
            source: image.texture_view.id(),
            copy: job(&passes.live, &image.texture_view, &frame, device, cache),
            coarse: coarse::job(&passes.coarse, &frame, device, cache),
            lattice: lattice::jobs(&passes.lattice, &frame, live.lattice, device, queue, cache),
            frame,
            stale: true,
            copied_at: 0,
            last_used: 0,
        }
    }
}

pub(super) fn pass(shader: &Handle<Shader>, cache: &PipelineCache) -> ComputePass {
    let entries = BindGroupLayoutEntries::sequential(
        ShaderStages::COMPUTE,
        (
            texture_3d(TextureSampleType::Float { filterable: false }),
            texture_storage_3d(DENSITY_FORMAT, StorageTextureAccess::WriteOnly),
        ),
    );
    ComputePass::new(LABEL, &entries, shader, "copy", vec![], cache)
}

pub(super) fn job(
    pass: &ComputePass,
    source: &TextureView,
    frame: &GpuSmokeFrame,
    device: &RenderDevice,
    cache: &PipelineCache,
) -> Job {
    let bind_group = pass.bind(device, cache, (source, &frame.density));
    Job { bind_group, workgroups: workgroups(frame.shape.dims, UVec3::new(8, 8, 4)) }
}

/// Copies the textures of all live smoke that changed.
pub(super) fn live(
    work: Res<SmokeWork>,
    passes: Res<SmokePasses>,
    cache: Res<PipelineCache>,
    stats: Res<SmokeRenderStats>,
    mut ctx: RenderContext,
) {
    passes.live.run(&work.live, &cache, &stats.live, &mut ctx);
}
