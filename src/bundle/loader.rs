//! Loads `.smoke` files through Bevy's asset server.

use std::sync::Arc;

use bevy::asset::io::Reader;
use bevy::asset::{AssetLoader, LoadContext};
use bevy::reflect::TypePath;

use super::{BundleError, FrameStream, SmokeAnimation, SmokeFrames};

/// Loads a [`SmokeAnimation`] from a `.smoke` file: its header, checked, and the length of the file. Frames are read as
/// [playback](crate::playback) nears them, and checked then.
#[derive(Clone, Copy, Debug, Default, TypePath)]
pub struct SmokeAnimationLoader;

/// Why a `.smoke` asset cannot be loaded.
#[derive(Debug, thiserror::Error)]
pub enum SmokeLoadError {
    /// The bytes cannot be read.
    #[error("cannot read the asset: {0}")]
    Io(#[from] std::io::Error),
    /// The bytes are not a valid bundle.
    #[error(transparent)]
    Bundle(#[from] BundleError),
}

impl AssetLoader for SmokeAnimationLoader {
    type Asset = SmokeAnimation;
    type Settings = ();
    type Error = SmokeLoadError;

    async fn load(
        &self,
        reader: &mut dyn Reader,
        _settings: &Self::Settings,
        load_context: &mut LoadContext<'_>,
    ) -> Result<SmokeAnimation, SmokeLoadError> {
        let stream = Arc::new(FrameStream::open(load_context.path().without_label().into_owned(), reader).await?);
        Ok(stream.header().animation(SmokeFrames::Stream(stream.clone())))
    }

    fn extensions(&self) -> &[&str] {
        &["smoke"]
    }
}
