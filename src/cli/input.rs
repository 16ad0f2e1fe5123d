//! The smoke that a command is given: a bundle, or raw density.

use std::path::Path;

use anyhow::{Context, ensure};
use bevy::prelude::*;

use crate::bundle::{BundleError, BundleHeader, SmokeAnimation};
use crate::density::{self, DensityGrid, GridShape, Placement};
use crate::prelude::*;

/// Smoke to draw.
#[derive(Clone)]
pub(super) enum Smoke {
    Baked(SmokeAnimation),
    Raw(DensityGrid),
}

impl Smoke {
    /// Reads a density file, or one frame of a bundle.
    pub fn read(path: &Path, frame: u32) -> anyhow::Result<Self> {
        if !is_density(path) {
            return Ok(Self::Baked(read_bundle(path, frame)?));
        }
        ensure!(frame == 0, "--frame {frame}: {} is one frame", path.display());
        Ok(Self::Raw(density::read(path, None)?))
    }

    pub fn shape(&self) -> GridShape {
        match self {
            Self::Baked(animation) => animation.shape,
            Self::Raw(grid) => grid.shape,
        }
    }

    pub fn placement(&self) -> Placement {
        match self {
            Self::Baked(animation) => animation.placement,
            Self::Raw(grid) => grid.placement,
        }
    }

    /// RBFs of the first frame; none where there is no telling.
    pub fn rbfs(&self) -> Option<usize> {
        match self {
            Self::Baked(animation) => Some(animation.frames.get(0).map_or(0, |frame| frame.rbfs.rbfs.len())),
            Self::Raw(_) => None,
        }
    }

    /// Adds it to an app's assets.
    pub fn volume(self, world: &mut World, lattice: u32) -> SmokeVolume {
        match self {
            Self::Baked(animation) => SmokeVolume::new(world.resource_mut::<Assets<SmokeAnimation>>().add(animation)),
            Self::Raw(grid) => {
                let image = world.resource_mut::<Assets<Image>>().add(LiveDensity::image_of(&grid));
                let max_density = grid.max();
                let live = LiveDensity { lattice, max_density, ..LiveDensity::new(image).still() };
                SmokeVolume { density: SmokeDensity::Live(live) }
            }
        }
    }
}

/// Whether a file is named like a density and not like a bundle.
pub(super) fn is_density(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("vdb") || e.eq_ignore_ascii_case("npy"))
}

/// Reads one frame of a bundle: an animation of that frame alone.
pub(super) fn read_bundle(path: &Path, frame: u32) -> anyhow::Result<SmokeAnimation> {
    ensure!(!is_density(path), "{} is a density file: bake it first (smoke bake {0} -o OUT.smoke)", path.display());
    let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    let read = || {
        let header = BundleHeader::read(&bytes)?;
        let frame = header.read_frame_of(&bytes, frame as usize)?;
        Ok(header.animation(vec![frame].into()))
    };
    read().map_err(|error: BundleError| anyhow::anyhow!("{}: {error}", path.display()))
}
