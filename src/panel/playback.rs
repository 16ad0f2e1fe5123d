//! Where a volume is in its animation.

use bevy::ecs::system::SystemParam;
use bevy::prelude::*;
use bevy_egui::egui::{Slider, SliderClamping, Ui};

use super::widgets;
use crate::bundle::SmokeAnimation;
use crate::playback::{PlaybackMode, SmokePlayback, SmokeStreamingStats};
use crate::volume::SmokeVolume;

#[derive(SystemParam)]
pub(super) struct Playback<'w, 's> {
    volumes: Query<'w, 's, (&'static SmokeVolume, &'static mut SmokePlayback)>,
    animations: Res<'w, Assets<SmokeAnimation>>,
    streaming: Res<'w, SmokeStreamingStats>,
}

impl Playback<'_, '_> {
    pub fn show(&mut self, ui: &mut Ui, volume: Entity) {
        let Ok((volume, mut playback)) = self.volumes.get_mut(volume) else { return };
        let mut next = playback.clone();
        let mut plays = !next.paused;
        ui.checkbox(&mut plays, "play");
        next.paused = !plays;
        widgets::number(ui, "speed", &mut next.speed, -4.0..=4.0);
        let modes =
            [(PlaybackMode::Loop, "loop"), (PlaybackMode::Once, "once"), (PlaybackMode::PingPong, "there and back")];
        widgets::choice(ui, "mode", &mut next.mode, &modes);
        if let Some(animation) = volume.animation().and_then(|animation| self.animations.get(animation)) {
            let count = animation.frames.len() as u32;
            scrub(ui, &mut next, count);
            ui.label(format!("{count} frames, {} a second.", animation.frames_per_second));
        }
        playback.set_if_neq(next);
        let SmokeStreamingStats { resident_frames, resident_bytes, frames_late, .. } = *self.streaming;
        if resident_frames > 0 {
            let megabytes = resident_bytes as f64 / 1e6;
            ui.label(format!("In memory: {resident_frames} frames, {megabytes:.1} MB; {frames_late} came late."));
        }
    }
}

/// Shows the frame, and goes to another.
fn scrub(ui: &mut Ui, playback: &mut SmokePlayback, count: u32) {
    let last = count.saturating_sub(1);
    let mut frame = playback.frame() as u32;
    let response = ui.add(Slider::new(&mut frame, 0..=last).text("frame").clamping(SliderClamping::Edits));
    if response.changed() {
        playback.seek_frame(frame);
    }
}
