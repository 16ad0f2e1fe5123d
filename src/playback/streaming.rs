//! Keeps in memory the frames that playback is about to need, and no others.

use std::sync::Arc;

use bevy::platform::collections::{HashMap, HashSet};
use bevy::prelude::*;
use bevy::tasks::futures::check_ready;
use bevy::tasks::{AsyncComputeTaskPool, IoTaskPool, Task};

use super::SmokePlayback;
use super::moment::Moment;
use super::timeline::Position;
use crate::bundle::{FrameReadError, FrameStream, SmokeAnimation, SmokeFrame, SmokeFrames};
use crate::volume::SmokeVolume;

/// How frames are read ahead of playback.
///
/// Every volume keeps `frames_ahead` + 2 frames in memory: the two it blends and those that it will show next, in the
/// direction of play, around the end of a loop and back from a turn. Volumes with the same animation share the frames
/// that both want. Frames that no volume wants any more are dropped.
///
/// A frame takes 24 bytes for each RBF, 1 bit for each cell, 1 byte for each slot of the residual's hash (two for every cell
/// with a residual), 2 for each entry of its offset table: `smoke info --json` has the numbers. A frame of the examples'
/// animation, 56 × 96 × 56 cells and 300 RBFs, takes 0.5 MB at most; so a volume that plays such smoke keeps 5 MB.
#[derive(Resource, Clone, Debug, PartialEq, Eq, Reflect)]
#[reflect(Resource, Default, Debug, Clone, PartialEq)]
pub struct SmokeStreaming {
    /// Frames read ahead of the two that a volume blends. More help where a disk or a processor is busy at times;
    /// nothing helps where frames on average take longer to read than to play.
    pub frames_ahead: usize,
    /// Frames read at the same time, of all animations together; at least 1.
    pub max_tasks: usize,
}

impl Default for SmokeStreaming {
    fn default() -> Self {
        Self { frames_ahead: 8, max_tasks: 4 }
    }
}

/// What streaming has done so far, and holds now. Animations made in memory do not count.
#[derive(Resource, Clone, Debug, Default, PartialEq, Eq, Reflect)]
#[reflect(Resource, Default, Debug, Clone, PartialEq)]
pub struct SmokeStreamingStats {
    /// Frames in memory, not counting those that a volume still shows or the GPU still holds after they were dropped
    /// here.
    pub resident_frames: usize,
    /// Their size in bytes, as the bundles' frame tables have it.
    pub resident_bytes: u64,
    /// Frames being read.
    pub tasks: usize,
    /// Frames read and unpacked so far.
    pub frames_read: u64,
    /// How often, update by update and volume by volume, a volume that had been shown wanted a frame that was not there.
    pub frames_late: u64,
    /// Frames that could not be read so far: an error in the log names each.
    pub frames_damaged: u64,
}

/// The frames in memory, of all animations that are streamed.
#[derive(Resource, Default)]
pub(crate) struct FrameCache {
    animations: HashMap<AssetId<SmokeAnimation>, Cached>,
    generation: u64,
}

struct Cached {
    /// Where frames are from: a reloaded asset has another one.
    stream: Arc<FrameStream>,
    generation: u64,
    frames: HashMap<usize, Arc<SmokeFrame>>,
    reading: HashMap<usize, Task<Result<SmokeFrame, FrameReadError>>>,
    damaged: HashSet<usize>,
}

impl Cached {
    fn new(stream: &Arc<FrameStream>, generation: u64) -> Self {
        Self {
            stream: stream.clone(),
            generation,
            frames: HashMap::default(),
            reading: HashMap::default(),
            damaged: HashSet::default(),
        }
    }

    fn knows(&self, index: usize) -> bool {
        self.frames.contains_key(&index) || self.reading.contains_key(&index) || self.damaged.contains(&index)
    }

    /// Reads on the pool for waiting, unpacks on the pool for work.
    fn read(&mut self, index: usize, server: &AssetServer) {
        let (stream, server) = (self.stream.clone(), server.clone());
        let task = IoTaskPool::get().spawn(async move {
            let bytes = stream.bytes(index, &server).await?;
            AsyncComputeTaskPool::get().spawn(async move { stream.decode(index, &bytes) }).await
        });
        self.reading.insert(index, task);
    }

    /// Takes what has been read since the last update.
    fn receive(&mut self, stats: &mut SmokeStreamingStats) {
        let Self { stream, frames, reading, damaged, .. } = self;
        reading.retain(|&index, task| {
            match check_ready(task) {
                None => return true,
                Some(Ok(frame)) => {
                    frames.insert(index, Arc::new(frame));
                    stats.frames_read += 1;
                }
                Some(Err(error)) => {
                    let error = match error {
                        FrameReadError::Bundle(error) => error.to_string(),
                        error => format!("frame {index}: {error}"),
                    };
                    error!(
                        "{}: {error}; smoke shows the frame nearest to it, and does not try again until the asset is \
                         reloaded",
                        stream.path()
                    );
                    damaged.insert(index);
                    stats.frames_damaged += 1;
                }
            }
            false
        });
    }
}

/// An animation's frames, as far as they are in memory.
pub(super) struct Shelf<'a> {
    animation: &'a SmokeAnimation,
    cached: Option<&'a Cached>,
}

impl Shelf<'_> {
    fn frame(&self, index: usize) -> Option<&Arc<SmokeFrame>> {
        match self.cached {
            Some(cached) => cached.frames.get(&index),
            None => self.animation.frames.get(index),
        }
    }

    /// Which reading of the asset the frames are from.
    pub fn generation(&self) -> u64 {
        self.cached.map_or(0, |cached| cached.generation)
    }

    /// The moment at a position, if all that it needs is there.
    pub fn moment(&self, position: Position) -> Option<Moment> {
        let from = self.frame(position.index)?.clone();
        let to = if position.blend == 0.0 { from.clone() } else { self.frame(position.index + 1)?.clone() };
        Some(Moment { from, to, blend: position.blend, max_density: self.animation.max_density })
    }

    /// Whether the moment at a position will never be there.
    pub fn is_damaged(&self, position: Position) -> bool {
        self.cached.is_some_and(|cached| {
            cached.damaged.contains(&position.index)
                || position.blend > 0.0 && cached.damaged.contains(&(position.index + 1))
        })
    }

    /// The frame there that is nearest to a position.
    pub fn nearest(&self, position: Position) -> Option<Position> {
        let distance = |index: usize| (index as f64 - position.frame()).abs();
        let indices = self.cached?.frames.keys().copied();
        let index = indices.min_by(|a, b| distance(*a).total_cmp(&distance(*b)))?;
        Some(Position { index, blend: 0.0 })
    }
}

impl FrameCache {
    /// What is there of an animation.
    pub(super) fn shelf<'a>(&'a self, id: AssetId<SmokeAnimation>, animation: &'a SmokeAnimation) -> Shelf<'a> {
        Shelf { animation, cached: self.animations.get(&id) }
    }

    /// Forgets animations that are gone, and those whose asset has been replaced: with their frames goes all that is
    /// known to be damaged.
    fn forget(&mut self, animations: &Assets<SmokeAnimation>) {
        self.animations.retain(|id, cached| {
            let now = animations.get(*id).map(|animation| &animation.frames);
            matches!(now, Some(SmokeFrames::Stream(stream)) if Arc::ptr_eq(stream, &cached.stream))
        });
    }
}

/// Drops the frames that no volume wants, takes those that have come, and asks for those that are missing, the soonest
/// needed first.
pub(super) fn stream(
    mut cache: ResMut<FrameCache>,
    mut stats: ResMut<SmokeStreamingStats>,
    streaming: Res<SmokeStreaming>,
    server: Res<AssetServer>,
    animations: Res<Assets<SmokeAnimation>>,
    volumes: Query<(&SmokeVolume, &SmokePlayback)>,
) {
    cache.forget(&animations);
    // Frames with how many others are shown before them.
    let mut wanted = Vec::new();
    for (volume, playback) in &volumes {
        let Some(id) = volume.animation().map(Handle::id) else { continue };
        let Some(animation) = animations.get(id) else {
            continue;
        };
        let SmokeFrames::Stream(stream) = &animation.frames else {
            continue;
        };
        let FrameCache { animations, generation } = &mut *cache;
        animations.entry(id).or_insert_with(|| {
            *generation += 1;
            Cached::new(stream, *generation)
        });
        let ahead = playback.timeline(animation).ahead(playback.head(), playback.forwards());
        // More than all frames are never needed; there and back, they are met twice.
        let count = (streaming.frames_ahead.saturating_add(2)).min(2 * animation.frames.len());
        wanted.extend(ahead.take(count).enumerate().map(|(rank, index)| (rank, id, index)));
    }
    wanted.sort_unstable_by_key(|(rank, _, _)| *rank);
    let kept: HashSet<_> = wanted.iter().map(|(_, id, index)| (*id, *index)).collect();

    let mut now = stats.clone();
    for (id, cached) in &mut cache.animations {
        cached.frames.retain(|index, _| kept.contains(&(*id, *index)));
        // A frame that is no longer wanted is taken all the same, for one update: where playback outruns the disk it is
        // nearer to what is wanted than what is shown.
        cached.receive(&mut now);
    }
    let mut tasks: usize = cache.animations.values().map(|cached| cached.reading.len()).sum();
    for (_, id, index) in wanted {
        if tasks >= streaming.max_tasks.max(1) {
            break;
        }
        if let Some(cached) = cache.animations.get_mut(&id).filter(|cached| !cached.knows(index)) {
            cached.read(index, &server);
            tasks += 1;
        }
    }
    now.tasks = tasks;
    now.resident_frames = cache.animations.values().map(|cached| cached.frames.len()).sum();
    let size = |cached: &Cached| -> u64 {
        cached.frames.keys().map(|index| cached.stream.header().frames[*index].uncompressed).sum()
    };
    now.resident_bytes = cache.animations.values().map(size).sum();
    stats.set_if_neq(now);
}
