//! Loads `.smoke` files through Bevy's asset server.

use bevy::asset::io::Reader;
use bevy::asset::{AssetLoader, LoadContext};
use bevy::reflect::TypePath;

use super::{BundleError, SmokeAnimation, read};

/// Loads a [`SmokeAnimation`] from a `.smoke` file.
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
        _load_context: &mut LoadContext<'_>,
    ) -> Result<SmokeAnimation, SmokeLoadError> {
        let mut bytes = Vec::new();
        reader.read_to_end(&mut bytes).await?;
        Ok(read(&bytes)?)
    }

    fn extensions(&self) -> &[&str] {
        &["smoke"]
    }
}
