//! The moments that volumes show: as many on the GPU as are shown at once, however long the animations are.
//!
//! Volumes that show the same moment share it. As time goes on a volume's moment is rewritten where it is, unless others
//! still show what it was; then the volume takes one that nobody has shown lately, or a new one. The residuals of baked
//! frames are shared between moments, so that going on to the next pair of frames uploads one.

use std::sync::Arc;

use bevy::platform::collections::{HashMap, HashSet};
use bevy::prelude::*;
use bevy::render::renderer::RenderDevice;
use bevy::render::sync_world::MainEntity;

use super::baked::GpuBakedFrame;
use super::extract::{Content, ExtractedSmoke};
use super::frame::{GpuSmokeFrame, fits};
use super::prepare::Gpu;
use super::stats::SmokeMemory;
use super::{SmokeWork, coarse, density};
use crate::bundle::SmokeFrame;
use crate::playback::Moment;

/// The moments on the GPU.
#[derive(Default)]
pub(super) struct Moments {
    residents: Vec<Resident>,
    /// Which resident a volume has shown last, by number.
    shown: HashMap<MainEntity, u32>,
    /// What volumes show now, seen or not.
    wanted: HashSet<MomentKey>,
    /// By the address of the frame, which they hold.
    baked: HashMap<usize, Arc<GpuBakedFrame>>,
    /// Volumes that this adapter cannot draw.
    refused: HashSet<MainEntity>,
    now: u32,
    created: u32,
}

struct Resident {
    number: u32,
    key: MomentKey,
    frame: GpuSmokeFrame,
    last_used: u32,
}

/// Tells moments apart: the addresses of the frames, and the bits of blend and density scale.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
struct MomentKey {
    from: usize,
    to: usize,
    blend: u32,
    max_density: u32,
}

impl MomentKey {
    fn of(moment: &Moment) -> Self {
        Self {
            from: address(&moment.from),
            to: address(shown_to(moment)),
            blend: moment.blend.to_bits(),
            max_density: moment.max_density.to_bits(),
        }
    }
}

fn address(frame: &Arc<SmokeFrame>) -> usize {
    Arc::as_ptr(frame) as usize
}

/// The frame that is blended in; where nothing is, the one that is shown.
fn shown_to(moment: &Moment) -> &Arc<SmokeFrame> {
    if moment.blend == 0.0 { &moment.from } else { &moment.to }
}

impl Moments {
    /// Starts a rendered frame.
    pub fn begin(&mut self, now: u32, smoke: &ExtractedSmoke) {
        self.now = now;
        let moments = smoke.volumes.values().filter_map(|volume| match &volume.content {
            Content::Baked(moment) => Some(moment),
            Content::Live(_) => None,
        });
        self.wanted = moments.map(MomentKey::of).collect();
    }

    /// A volume's moment on the GPU; None, with one error, where it does not fit the adapter.
    pub fn show(
        &mut self,
        volume: MainEntity,
        moment: &Moment,
        gpu: &Gpu,
        work: &mut SmokeWork,
    ) -> Option<&GpuSmokeFrame> {
        let key = MomentKey::of(moment);
        let index = match self.residents.iter().position(|resident| resident.key == key) {
            Some(index) => index,
            None => {
                let index = self.write(volume, moment, key, gpu)?;
                let frame = &self.residents[index].frame;
                work.density.push(density::job(&gpu.passes.density, frame, gpu.device, gpu.cache));
                work.coarse.push(coarse::job(&gpu.passes.coarse, frame, gpu.device, gpu.cache));
                index
            }
        };
        let resident = &mut self.residents[index];
        resident.last_used = self.now;
        self.shown.insert(volume, resident.number);
        Some(&resident.frame)
    }

    /// Writes a moment to the GPU, and says where.
    fn write(&mut self, volume: MainEntity, moment: &Moment, key: MomentKey, gpu: &Gpu) -> Option<usize> {
        let rbfs = moment.rbfs().rbfs;
        if let Err(problem) = fits(moment, &rbfs, gpu.device) {
            if self.refused.insert(volume) {
                error!("smoke volume {volume:?} is not drawn: {problem}");
            }
            return None;
        }
        let baked = [&moment.from, shown_to(moment)].map(|frame| self.baked(frame, gpu.device));
        match self.free(volume, moment) {
            Some(index) => {
                let resident = &mut self.residents[index];
                resident.key = key;
                resident.frame.rewrite(moment, &rbfs, baked, gpu.device, gpu.queue);
                Some(index)
            }
            None => {
                let frame = GpuSmokeFrame::new(moment, &rbfs, baked, gpu.device, gpu.queue);
                let number = self.created;
                self.created += 1;
                self.residents.push(Resident { number, key, frame, last_used: self.now });
                Some(self.residents.len() - 1)
            }
        }
    }

    /// One that may be rewritten: the volume's own, or one that was not shown in the frame before.
    fn free(&self, volume: MainEntity, moment: &Moment) -> Option<usize> {
        let own = self.shown.get(&volume);
        let usable =
            |resident: &Resident| resident.frame.shape == moment.shape() && !self.wanted.contains(&resident.key);
        let idle = |resident: &Resident| self.now.wrapping_sub(resident.last_used) > 1;
        let all = || self.residents.iter();
        all()
            .position(|resident| Some(&resident.number) == own && usable(resident))
            .or_else(|| all().position(|resident| idle(resident) && usable(resident)))
    }

    fn baked(&mut self, frame: &Arc<SmokeFrame>, device: &RenderDevice) -> Arc<GpuBakedFrame> {
        let baked = self.baked.entry(address(frame)).or_insert_with(|| Arc::new(GpuBakedFrame::new(frame, device)));
        debug_assert!(Arc::ptr_eq(&baked.frame, frame));
        baked.clone()
    }

    /// Lets go of what is not in use, and of residuals that no moment has.
    pub fn retain(&mut self, in_use: impl Fn(u32) -> bool, exists: impl Fn(MainEntity) -> bool) {
        self.residents.retain(|resident| in_use(resident.last_used));
        self.shown.retain(|volume, _| exists(*volume));
        self.refused.retain(|volume| exists(*volume));
        self.baked.retain(|_, baked| Arc::strong_count(baked) > 1);
    }

    pub fn memory(&self) -> SmokeMemory {
        let residuals = self.baked.values().map(|baked| baked.residual.size());
        SmokeMemory {
            moments: self.residents.len() as u32,
            moments_created: self.created,
            bytes: self.residents.iter().map(|resident| resident.frame.bytes()).chain(residuals).sum(),
        }
    }
}
