//! Time: which moment of its animation a volume shows, and which frames are in memory for it.
//!
//! Every update, in `PostUpdate`:
//!
//! 1. [`SmokePlayback`] advances by the game's time, and events tell of its ends.
//! 2. Frames that playback nears are read and unpacked on other threads, through the asset source that the animation was
//!    loaded from; others are dropped. [`SmokeStreaming`] bounds how many, [`SmokeStreamingStats`] counts them. Animations made
//!    in memory go without this.
//! 3. Every volume's moment is set: a frame, or a blend of two. Where a frame is late, smoke shows the nearest one that is
//!    there, at worst the one shown before; playback goes on.
//!
//! A changed file is taken up when Bevy reloads the asset: what is shown stays until the new frames are there.

mod control;
mod events;
mod moment;
mod streaming;
#[cfg(all(test, feature = "bake"))]
mod tests;
mod timeline;

use std::ops::RangeInclusive;

use bevy::prelude::*;

use crate::bundle::SmokeAnimation;
use crate::volume::SmokeVolume;
use streaming::FrameCache;

pub use control::{PlaybackMode, SmokePlayback};
pub use events::{SmokeFinished, SmokeLooped, SmokeReady};
pub use moment::Moment;
pub use streaming::{SmokeStreaming, SmokeStreamingStats};

/// What a volume shows now; nothing before the first frame has come.
#[derive(Component, Clone, Debug, Default)]
pub(crate) struct SmokeMoment(pub Option<Moment>);

/// What a volume's moment is of.
#[derive(Component, Clone, Copy, Debug, Default)]
pub(crate) struct Shown {
    /// The animation of which something has been shown: its playback goes on.
    animation: Option<AssetId<SmokeAnimation>>,
    /// Which reading of the asset the moment is of, and where in it.
    generation: u64,
    frame: f64,
}

/// Keeps every volume's moment.
pub(crate) struct SmokePlaybackPlugin;

impl Plugin for SmokePlaybackPlugin {
    fn build(&self, app: &mut App) {
        app.register_type::<SmokePlayback>()
            // Scenes with a range of frames can be saved.
            .register_type_data::<RangeInclusive<u32>, ReflectSerialize>()
            .register_type_data::<RangeInclusive<u32>, ReflectDeserialize>()
            .register_type::<SmokeStreaming>()
            .register_type::<SmokeStreamingStats>()
            .register_type::<SmokeReady>()
            .register_type::<SmokeLooped>()
            .register_type::<SmokeFinished>()
            .init_resource::<SmokeStreaming>()
            .init_resource::<SmokeStreamingStats>()
            .init_resource::<FrameCache>()
            .add_systems(PostUpdate, (advance, streaming::stream, show).chain());
    }
}

fn advance(
    mut commands: Commands,
    time: Res<Time>,
    animations: Res<Assets<SmokeAnimation>>,
    mut volumes: Query<(Entity, &SmokeVolume, &mut SmokePlayback, &Shown)>,
) {
    for (entity, volume, mut playback, shown) in &mut volumes {
        let Some(id) = volume.animation().map(Handle::id) else { continue };
        let Some(animation) = animations.get(id) else {
            continue;
        };
        if let Some(problem) = playback.problem() {
            warn_once!("smoke volume {entity} cannot be played with {problem}: it stands still (said once)");
        }
        let started = shown.animation == Some(id);
        let mut next = playback.clone();
        let passed = next.advance(if started { time.delta_secs_f64() } else { 0.0 }, animation);
        playback.set_if_neq(next);
        if passed.loops > 0 {
            commands.trigger(SmokeLooped { entity, times: passed.loops });
        }
        if passed.finished {
            commands.trigger(SmokeFinished { entity });
        }
    }
}

fn show(
    mut commands: Commands,
    cache: Res<FrameCache>,
    mut stats: ResMut<SmokeStreamingStats>,
    animations: Res<Assets<SmokeAnimation>>,
    mut volumes: Query<(Entity, &SmokeVolume, &SmokePlayback, &mut SmokeMoment, &mut Shown)>,
) {
    for (entity, volume, playback, mut moment, mut shown) in &mut volumes {
        let Some(id) = volume.animation().map(Handle::id) else { continue };
        let Some(animation) = animations.get(id) else {
            continue;
        };
        let shelf = cache.shelf(id, animation);
        let position = playback.position(animation);
        let started = shown.animation == Some(id);
        let found = shelf.moment(position).map(|moment| (position, moment)).or_else(|| {
            if started {
                stats.frames_late += 1;
            } else if !shelf.is_damaged(position) {
                // Smoke appears with its first frame, not with whichever is read first.
                return None;
            }
            let nearest = shelf.nearest(position)?;
            let distance = |frame: f64| (frame - position.frame()).abs();
            let nearer =
                !started || shown.generation != shelf.generation() || distance(nearest.frame()) < distance(shown.frame);
            nearer.then_some(())?;
            Some((nearest, shelf.moment(nearest)?))
        });
        let Some((position, next)) = found else {
            continue;
        };
        if !moment.0.as_ref().is_some_and(|moment| moment.is_same(&next)) {
            moment.0 = Some(next);
        }
        *shown = Shown { animation: Some(id), generation: shelf.generation(), frame: position.frame() };
        if !started {
            commands.trigger(SmokeReady { entity });
        }
    }
}
