//! What a game is told of playback: events on the volume's entity.

use bevy::prelude::*;

/// A volume's smoke can be seen: its first frame has come from the disk. Playback starts here.
///
/// Again when the volume is given another animation, not when its animation is reloaded.
///
/// ```
/// # use bevy::prelude::*;
/// # use bevy_smoke::prelude::*;
/// # fn example(mut commands: Commands, assets: Res<AssetServer>) {
/// commands
///     .spawn((SmokeVolume::new(assets.load("explosion.smoke")), SmokePlayback::once()))
///     .observe(|finished: On<SmokeFinished>, mut commands: Commands| commands.entity(finished.entity).despawn());
/// # }
/// ```
#[derive(EntityEvent, Clone, Copy, Debug, PartialEq, Eq, Reflect)]
#[reflect(Debug, Clone, PartialEq)]
pub struct SmokeReady {
    /// The volume.
    pub entity: Entity,
}

/// A volume's playback started over: [`Loop`](super::PlaybackMode::Loop) at either end, depending on the direction,
/// [`PingPong`](super::PlaybackMode::PingPong) back at the end where it began.
#[derive(EntityEvent, Clone, Copy, Debug, PartialEq, Eq, Reflect)]
#[reflect(Debug, Clone, PartialEq)]
pub struct SmokeLooped {
    /// The volume.
    pub entity: Entity,
    /// How often since the last update: more than once only where an update took longer than the animation.
    pub times: u32,
}

/// A volume's playback reached the end of [`Once`](super::PlaybackMode::Once): the last frame, or backwards the first.
#[derive(EntityEvent, Clone, Copy, Debug, PartialEq, Eq, Reflect)]
#[reflect(Debug, Clone, PartialEq)]
pub struct SmokeFinished {
    /// The volume.
    pub entity: Entity,
}
