//! Time: which moment of its animation a volume shows.

mod moment;

use bevy::prelude::*;

use crate::bundle::SmokeAnimation;
use crate::volume::SmokeVolume;

pub use moment::Moment;

/// Where a volume is in its animation.
#[derive(Component, Clone, Debug, Default, PartialEq, Reflect)]
#[reflect(Component, Default, Debug, Clone, PartialEq)]
pub struct SmokePlayback {
    /// The frame shown, from 0; past the end the last one is.
    pub frame: u32,
}

impl SmokePlayback {
    /// Stands still at a frame, counted from 0.
    pub fn at_frame(frame: u32) -> Self {
        Self { frame }
    }
}

/// What a volume shows now; nothing before the first frame has come.
#[derive(Component, Clone, Debug, Default)]
pub(crate) struct SmokeMoment(pub Option<Moment>);

/// Keeps every volume's moment.
pub(crate) struct SmokePlaybackPlugin;

impl Plugin for SmokePlaybackPlugin {
    fn build(&self, app: &mut App) {
        app.register_type::<SmokePlayback>().add_systems(PostUpdate, show);
    }
}

fn show(animations: Res<Assets<SmokeAnimation>>, mut volumes: Query<(&SmokeVolume, &SmokePlayback, &mut SmokeMoment)>) {
    for (volume, playback, mut moment) in &mut volumes {
        let Some(animation) = animations.get(&volume.animation) else {
            continue;
        };
        let index = (playback.frame as usize).min(animation.frames.len() - 1);
        if let Some(frame) = animation.frames.get(index) {
            moment.0 = Some(Moment::frame(frame.clone(), animation.max_density));
        }
    }
}
