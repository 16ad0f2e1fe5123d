//! Level of detail of a volume's light: fewer RBFs that stand for all, on the same density.

use bevy::platform::collections::HashMap;
use bevy::render::render_resource::BufferId;
use bevy::render::sync_world::MainEntity;

use super::extract::Content;
use super::frame::GpuSmokeFrame;
use super::prepare::Gpu;
use crate::rbf::reduced;

/// The levels of detail of the volumes that have fewer RBFs than their moment.
#[derive(Default)]
pub(super) struct Levels(HashMap<MainEntity, Level>);

struct Level {
    /// The moment that it is of, and its version.
    of: (BufferId, u32),
    limit: u32,
    frame: GpuSmokeFrame,
    last_used: u32,
}

impl Levels {
    /// What a volume is lit at: `frame`, or where that has more than `limit` RBFs, the same with so many. Live smoke has as
    /// many as its lattice says.
    pub fn of<'a>(
        &'a mut self,
        volume: MainEntity,
        frame: &'a GpuSmokeFrame,
        content: &Content,
        limit: u32,
        now: u32,
        gpu: &Gpu,
    ) -> &'a GpuSmokeFrame {
        let moment = match content {
            Content::Baked(moment) if frame.rbf_count > limit => moment,
            _ => {
                self.0.remove(&volume);
                return frame;
            }
        };
        let of = (frame.uniform.id(), frame.version);
        let rbfs = || reduced(&moment.rbfs().rbfs, limit as usize);
        let level = self.0.entry(volume).or_insert_with(|| {
            let level = frame.level(&rbfs(), gpu.device, gpu.queue);
            Level { of, limit, frame: level, last_used: now }
        });
        if level.of.0 != of.0 {
            level.frame = frame.level(&rbfs(), gpu.device, gpu.queue);
        } else if level.of.1 != of.1 || level.limit != limit {
            level.frame.rewrite_level(frame, &rbfs(), gpu.device, gpu.queue);
        }
        (level.of, level.limit, level.last_used) = (of, limit, now);
        &level.frame
    }

    pub fn retain(&mut self, in_use: impl Fn(u32) -> bool) {
        self.0.retain(|_, level| in_use(level.last_used));
    }
}
