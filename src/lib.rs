//! Smoke that a Bevy game can afford, lit as a path tracer would light it.
//!
//! An artist's density animation is baked once into a small bundle: radial basis functions for the bulk of the smoke
//! and a hashed residual for its detail. A game adds [`SmokePlugin`], spawns a [`SmokeVolume`](volume::SmokeVolume)
//! with the bundle's handle, and the plug-in lights it every frame by the scene's environment, sun and lamps and
//! composites it with the scene's meshes.
//!
//! ```no_run
//! use bevy::prelude::*;
//! use bevy_smoke::prelude::*;
//!
//! fn main() {
//!     App::new()
//!         .add_plugins((DefaultPlugins, SmokePlugin))
//!         .add_systems(Startup, |mut commands: Commands, assets: Res<AssetServer>| {
//!             commands.spawn((
//!                 SmokeVolume::new(assets.load("plume.smoke")),
//!                 SmokeMedium { sigma_t: 4.0, ..default() },
//!                 SmokeEnvironment::constant(Vec3::ONE, 1000.0),
//!                 Transform::from_scale(Vec3::splat(3.0)),
//!             ));
//!             commands.spawn((Camera3d::default(), Transform::from_xyz(0.0, 0.0, 6.0)));
//!         })
//!         .run();
//! }
//! ```
//!
//! The volume plays its animation in a loop; a [`SmokePlayback`](playback::SmokePlayback) beside it plays it otherwise. Frames
//! are read from the bundle shortly before they are shown: see [`playback`].
//!
//! The method follows Zhou et al. 2008, *Real-Time Smoke Rendering Using Compensated Ray Marching*, and departs from
//! it where measurement showed something better: light is looked for at probes around every RBF's centre, not at the
//! centre alone, along fixed directions through a coarse copy of the density; light that scatters more than once is
//! transported between RBFs, not diffused; sharp lights are rays. See [`render`] for the passes.
//!
//! # Features
//!
//! The default library is what a game needs at run time. `bake` adds density readers (OpenVDB, NumPy), the RBF fit
//! and the bundle writer; `reference` adds a double-precision CPU twin of every GPU pass; `cli` adds the `smoke`
//! command; `egui` adds a panel that edits smoke while an app runs.

#![warn(missing_docs)]

#[cfg(feature = "bake")]
pub mod bake;
pub mod bundle;
#[cfg(feature = "cli")]
#[doc(hidden)]
pub mod cli;
pub mod constellation;
pub mod debug;
pub mod density;
#[cfg(feature = "cli")]
#[doc(hidden)]
pub mod headless;
pub mod lighting;
pub mod medium;
pub mod occluder;
pub mod optics;
#[cfg(feature = "egui")]
pub mod panel;
#[cfg(feature = "reference")]
pub mod paper;
pub mod playback;
pub mod quality;
mod random;
pub mod rbf;
#[cfg(feature = "reference")]
pub mod reference;
pub mod render;
pub mod residual;
pub mod scattering;
pub mod sh;
mod shaders;
pub mod shadows;
#[cfg(feature = "cli")]
#[doc(hidden)]
pub mod simulate;
mod sun;
pub mod volume;

use bevy::app::{App, Plugin};
use bevy::asset::AssetApp;

/// Everything a scene with smoke needs.
pub mod prelude {
    pub use crate::SmokePlugin;
    pub use crate::bundle::SmokeAnimation;
    pub use crate::constellation::{ConstellationShading, SmokeConstellation};
    pub use crate::debug::SmokeDebugView;
    pub use crate::lighting::SmokeEnvironment;
    pub use crate::medium::SmokeMedium;
    pub use crate::occluder::{OccluderShape, OccluderSphere, SmokeOccluder, SmokeOccluderFit};
    pub use crate::playback::{PlaybackMode, SmokeFinished, SmokeLooped, SmokePlayback, SmokeReady};
    pub use crate::quality::{SmokeModel, SmokeQuality};
    pub use crate::scattering::{ScatteringEvents, ScatteringSolver, SmokeScattering};
    pub use crate::shadows::{NoSmokeShadow, SmokeShadows};
    pub use crate::volume::{LiveDensity, SmokeDensity, SmokeVolume};
}

/// Adds smoke to an app: the bundle's asset type and loader, the components, and, where there is a renderer, the
/// passes of [`render`].
#[derive(Clone, Copy, Debug, Default)]
pub struct SmokePlugin;

impl Plugin for SmokePlugin {
    fn build(&self, app: &mut App) {
        #[cfg(feature = "reference")]
        app.register_type::<paper::SmokePaper>();
        #[cfg(feature = "bake")]
        app.register_asset_processor(bake::VdbBaker).set_default_asset_processor::<bake::VdbBaker>("vdb");
        app.init_asset::<bundle::SmokeAnimation>()
            .init_asset_loader::<bundle::SmokeAnimationLoader>()
            .register_type::<volume::SmokeVolume>()
            .register_type::<medium::SmokeMedium>()
            .register_type::<lighting::SmokeEnvironment>()
            .register_type::<scattering::SmokeScattering>()
            .register_type::<quality::SmokeQuality>()
            .register_type::<constellation::SmokeConstellation>()
            .register_type::<shadows::SmokeShadows>()
            .register_type::<shadows::NoSmokeShadow>()
            .add_plugins((
                volume::SmokeVolumePlugin,
                playback::SmokePlaybackPlugin,
                occluder::SmokeOccluderPlugin,
                debug::SmokeDebugPlugin,
                render::SmokeRenderPlugin,
            ));
    }
}
