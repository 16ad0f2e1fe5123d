//! The component by which a game controls what a volume plays.

use std::ops::RangeInclusive;

use bevy::prelude::*;

use super::timeline::{Head, Passed, Position, Timeline};
use crate::bundle::SmokeAnimation;

/// What happens where an animation ends.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Reflect)]
#[reflect(Default, Debug, Clone, PartialEq, Hash)]
pub enum PlaybackMode {
    /// It starts over. The last frame is shown for one frame's time; it is not blended with the first, which does not go on
    /// from it unless the animation was made so, and then there is nothing to blend.
    #[default]
    Loop,
    /// It stops at the last frame (backwards: the first) and stays there.
    Once,
    /// It turns at both ends.
    PingPong,
}

/// Where a volume is in its animation, and how it goes on from there.
///
/// The plug-in moves it by [`Time`], which is virtual time in games: where the game is paused or slowed down, so is its
/// smoke. Playback starts when its first frame has come from the disk ([`SmokeReady`](super::SmokeReady)).
///
/// Positions count frames from the bundle's first, 0. Between two frames smoke is a blend of both, so that slow motion
/// is smooth.
///
/// ```
/// # use bevy_smoke::playback::SmokePlayback;
/// let explosion = SmokePlayback::once().with_speed(0.5);
/// let still = SmokePlayback::at_frame(12);
/// let backwards = SmokePlayback::once().with_speed(-1.0).starting_at_frame(u32::MAX);
/// ```
#[derive(Component, Clone, Debug, PartialEq, Reflect)]
#[reflect(Component, Default, Debug, Clone, PartialEq)]
pub struct SmokePlayback {
    /// Seconds of animation a second: 1 is as baked, 0.1 slow motion, −1 backwards.
    pub speed: f32,
    /// Whether it stands still.
    pub paused: bool,
    /// What happens where it ends.
    pub mode: PlaybackMode,
    /// The frames played; all of the bundle's where `None`. What lies outside the bundle is left out.
    pub range: Option<RangeInclusive<u32>>,
    /// Frames a second at speed 1, above 0; the bundle's own rate where `None`.
    pub frames_per_second: Option<f32>,
    frame: f64,
    returning: bool,
    /// Seconds to go to at the next update: how many frames they are, the bundle says.
    seek: Option<f64>,
}

impl Default for SmokePlayback {
    fn default() -> Self {
        Self {
            speed: 1.0,
            paused: false,
            mode: PlaybackMode::Loop,
            range: None,
            frames_per_second: None,
            frame: 0.0,
            returning: false,
            seek: None,
        }
    }
}

impl SmokePlayback {
    /// Plays to the end and stops there.
    pub fn once() -> Self {
        Self { mode: PlaybackMode::Once, ..default() }
    }

    /// Plays there and back, over and over.
    pub fn ping_pong() -> Self {
        Self { mode: PlaybackMode::PingPong, ..default() }
    }

    /// Stands still at a frame, counted from 0; past the end at the last one.
    pub fn at_frame(frame: u32) -> Self {
        Self { paused: true, frame: frame.into(), ..default() }
    }

    /// The same at another [`speed`](Self::speed).
    pub fn with_speed(self, speed: f32) -> Self {
        Self { speed, ..self }
    }

    /// The same with only these frames played, counted from 0.
    pub fn with_range(self, frames: RangeInclusive<u32>) -> Self {
        Self { range: Some(frames), ..self }
    }

    /// The same at a rate of its own, in place of the bundle's.
    pub fn with_frames_per_second(self, frames_per_second: f32) -> Self {
        Self { frames_per_second: Some(frames_per_second), ..self }
    }

    /// The same from another time on: see [`seek`](Self::seek).
    pub fn starting_at(mut self, seconds: f64) -> Self {
        self.seek(seconds);
        self
    }

    /// The same from another frame on: see [`seek_frame`](Self::seek_frame).
    pub fn starting_at_frame(mut self, frame: u32) -> Self {
        self.seek_frame(frame);
        self
    }

    /// Goes to a time in seconds from the bundle's first frame, at the next update; outside the range to its nearest
    /// frame. No event tells of ends that are skipped.
    pub fn seek(&mut self, seconds: f64) {
        if seconds.is_finite() {
            self.seek = Some(seconds);
            self.returning = false;
        } else {
            warn_once!("smoke cannot be played from second {seconds}: it stays where it is (said once)");
        }
    }

    /// Goes to a frame, counted from 0; outside the range to its nearest frame.
    pub fn seek_frame(&mut self, frame: u32) {
        self.frame = frame.into();
        self.returning = false;
        self.seek = None;
    }

    /// Where it was at the last update: frames from the bundle's first, with the part of the way to the next one.
    pub fn frame(&self) -> f64 {
        self.frame
    }

    /// The same in seconds from the bundle's first frame.
    pub fn time(&self, animation: &SmokeAnimation) -> f64 {
        self.frame / self.rate(animation)
    }

    /// Why playback cannot go on as it is set.
    pub(super) fn problem(&self) -> Option<String> {
        if !self.speed.is_finite() {
            return Some(format!("a speed of {}", self.speed));
        }
        match (&self.frames_per_second, &self.range) {
            (Some(rate), _) if !is_rate(*rate) => Some(format!("{rate} frames a second")),
            (_, Some(range)) if range.is_empty() => Some(format!("a range of frames of {range:?}")),
            _ => None,
        }
    }

    /// Whether it plays towards the last frame, before [`PlaybackMode::PingPong`] turns it.
    pub(super) fn forwards(&self) -> bool {
        self.speed >= 0.0
    }

    fn rate(&self, animation: &SmokeAnimation) -> f64 {
        self.frames_per_second.filter(|rate| is_rate(*rate)).unwrap_or(animation.frames_per_second).into()
    }

    /// The frames played of an animation.
    pub(super) fn timeline(&self, animation: &SmokeAnimation) -> Timeline {
        let end = animation.frames.len() as u32 - 1;
        let (first, last) = self.range.as_ref().map_or((0, end), |range| (*range.start(), *range.end()));
        let first = first.min(end);
        Timeline { first, last: last.clamp(first, end), mode: self.mode }
    }

    pub(super) fn head(&self) -> Head {
        Head { frame: self.frame, returning: self.returning }
    }

    /// What of an animation is to be shown.
    pub(super) fn position(&self, animation: &SmokeAnimation) -> Position {
        self.timeline(animation).position(self.frame)
    }

    /// Goes where it was told to, and on by so many seconds unless it stands still.
    pub(super) fn advance(&mut self, seconds: f64, animation: &SmokeAnimation) -> Passed {
        if let Some(target) = self.seek.take() {
            self.frame = target * self.rate(animation);
        }
        let timeline = self.timeline(animation);
        self.frame = timeline.clamp(self.frame);
        let frames = seconds * f64::from(self.speed) * self.rate(animation);
        if frames == 0.0 || self.paused || self.problem().is_some() {
            return Passed::default();
        }
        let (head, passed) = timeline.advance(self.head(), frames);
        (self.frame, self.returning) = (head.frame, head.returning);
        passed
    }
}

fn is_rate(frames_per_second: f32) -> bool {
    frames_per_second.is_finite() && frames_per_second > 0.0
}
