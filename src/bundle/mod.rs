//! Baked smoke: the asset a game loads, and the `.smoke` files it comes from.
//!
//! A [`SmokeAnimation`] is a row of frames over one box of cells. A frame's density is `D = D̃ + R`: a few hundred
//! Gaussians ([`RbfModel`]) and what they leave out, 8 bits a cell in a perfect hash ([`HashedResidual`]).
//! [`SmokeAnimationLoader`] loads it through the asset server, frames as [playback](crate::playback) nears them; [`read`]
//! reads all of it without Bevy, [`BundleHeader`] gives access to single frames, and `write` (feature `bake`) makes the
//! file. `docs/format.md` describes every byte.

mod error;
mod format;
mod frame;
mod loader;
mod stream;
#[cfg(all(test, feature = "bake"))]
mod tests;
#[cfg(feature = "bake")]
mod write;

use std::sync::Arc;

use bevy::asset::Asset;
use bevy::reflect::TypePath;

use crate::density::{GridShape, Placement};
use crate::rbf::RbfModel;
use crate::residual::HashedResidual;

pub use error::{BundleError, FrameError};
#[cfg(feature = "bake")]
pub(crate) use format::check_shape;
pub use format::{BundleHeader, FrameEntry, MAX_CELLS, MAX_FRAMES, MAX_SIDE, VERSION, read};
pub use frame::{MAX_RADIUS, MAX_RBFS, MIN_RADIUS};
#[cfg(feature = "bake")]
pub use frame::{SectionBytes, section_bytes};
pub use loader::{SmokeAnimationLoader, SmokeLoadError};
pub(crate) use stream::FrameReadError;
pub use stream::FrameStream;
#[cfg(feature = "bake")]
pub use write::{BundleWriter, PackedFrame, WriteError, write};

/// A baked animation of smoke density.
#[derive(Asset, TypePath, Clone, Debug, PartialEq)]
pub struct SmokeAnimation {
    /// The box of cells that all frames share.
    pub shape: GridShape,
    /// Where the density file placed the box in the world.
    pub placement: Placement,
    /// Playback speed, above 0.
    pub frames_per_second: f32,
    /// The largest density of any cell in any frame, at least 0.
    pub max_density: f32,
    /// The frames in order, at least one. Cloning the animation shares them.
    pub frames: SmokeFrames,
}

/// Where an animation's frames are.
#[derive(Clone, Debug, PartialEq)]
pub enum SmokeFrames {
    /// All of them in memory.
    Memory(Vec<Arc<SmokeFrame>>),
    /// In a file, from which playback reads those that it nears: what [`SmokeAnimationLoader`] loads.
    Stream(Arc<FrameStream>),
}

impl From<Vec<SmokeFrame>> for SmokeFrames {
    fn from(frames: Vec<SmokeFrame>) -> Self {
        Self::Memory(frames.into_iter().map(Arc::new).collect())
    }
}

impl SmokeFrames {
    /// How many there are, at least one.
    #[expect(clippy::len_without_is_empty, reason = "an animation has at least one frame")]
    pub fn len(&self) -> usize {
        match self {
            Self::Memory(frames) => frames.len(),
            Self::Stream(stream) => stream.header().frames.len(),
        }
    }

    /// A frame, if it exists and is in memory: no frame of a stream is.
    pub fn get(&self, index: usize) -> Option<&Arc<SmokeFrame>> {
        match self {
            Self::Memory(frames) => frames.get(index),
            Self::Stream(_) => None,
        }
    }
}

/// One moment of an animation: density `D = max(0, D̃ + R)`.
#[derive(Clone, Debug, PartialEq)]
pub struct SmokeFrame {
    /// The Gaussians `D̃`, in which light transport is computed.
    pub rbfs: RbfModel,
    /// Who the Gaussians are, one number each, none twice: a Gaussian that goes on in the next frame keeps its number there.
    /// Between two frames, Gaussians of the same number are one that moves.
    pub ids: Vec<u32>,
    /// What they leave out: `R`, on the animation's cells.
    pub residual: HashedResidual,
}

impl SmokeFrame {
    /// A frame on its own: its Gaussians are numbered from 0.
    pub fn new(rbfs: RbfModel, residual: HashedResidual) -> Self {
        let ids = (0..rbfs.rbfs.len() as u32).collect();
        Self { rbfs, ids, residual }
    }

    /// The density of every cell, in flat order: what the GPU's density pass computes.
    pub fn decode(&self) -> Vec<f32> {
        let mut density = self.rbfs.rasterize(self.residual.shape());
        for (d, r) in density.iter_mut().zip(self.residual.decode_all()) {
            *d = (*d + r).max(0.0);
        }
        density
    }
}
