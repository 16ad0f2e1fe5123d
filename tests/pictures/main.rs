//! Pictures of whole scenes, drawn by the real plug-in without a window, and numbers read off them.
//!
//! With `SMOKE_PICTURES=DIR` set, the tests also write what they draw to DIR as PNG files: the pictures under
//! `docs/pictures` are made so.

mod cameras;
mod compositing;
mod constellation;
mod debug;
mod effects;
mod endurance;
mod environments;
mod examples;
mod lamps;
mod live;
#[cfg(feature = "egui")]
mod panel;
mod playback;
mod quality;
mod scattering;
mod scene;
mod shadow_masks;
mod shadows;
mod transparency;
mod work;
