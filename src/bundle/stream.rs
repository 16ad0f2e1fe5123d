//! Frames that stay in their file until they are needed.

use std::io::SeekFrom;
use std::sync::Arc;

use bevy::asset::io::{
    AssetReaderError, AssetSourceId, MissingAssetSourceError, MissingProcessedAssetReaderError, Reader,
};
use bevy::asset::{AssetPath, AssetServer, AssetServerMode, AsyncReadExt, AsyncSeekExt};

use super::{BundleError, BundleHeader, SmokeFrame, SmokeLoadError};

/// A `.smoke` file whose frames are read one by one, through the asset source that it was loaded from.
///
/// In memory are the header (32 bytes a frame) and, where the source cannot read from the middle of a file, the file's
/// bytes, compressed as they are: see [`held_bytes`](Self::held_bytes).
#[derive(Clone, Debug, PartialEq)]
pub struct FrameStream {
    path: AssetPath<'static>,
    header: BundleHeader,
    held: Option<Arc<[u8]>>,
}

/// Why a frame of a stream cannot be had.
#[derive(Debug, thiserror::Error)]
pub(crate) enum FrameReadError {
    #[error(transparent)]
    Source(#[from] MissingAssetSourceError),
    #[error(transparent)]
    Processed(#[from] MissingProcessedAssetReaderError),
    #[error(transparent)]
    Asset(#[from] AssetReaderError),
    #[error("it cannot be read: {0}")]
    Io(#[from] std::io::Error),
    #[error(transparent)]
    Bundle(#[from] BundleError),
}

impl FrameStream {
    /// Reads the header, and the rest only if it has to be held.
    pub(super) async fn open(path: AssetPath<'static>, reader: &mut dyn Reader) -> Result<Self, SmokeLoadError> {
        let seekable = !reads_whole_files(path.source()) && reader.seekable().is_ok();
        if !seekable {
            let mut bytes = Vec::new();
            reader.read_to_end(&mut bytes).await?;
            let header = BundleHeader::read(&bytes)?;
            header.check_length(bytes.len() as u64)?;
            return Ok(Self { path, header, held: Some(bytes.into()) });
        }
        // What is cut short is the header's to say, not the reader's.
        let mut bytes = Vec::new();
        (&mut *reader).take(BundleHeader::FIXED_BYTES as u64).read_to_end(&mut bytes).await?;
        let rest = BundleHeader::byte_length(&bytes)? - BundleHeader::FIXED_BYTES;
        (&mut *reader).take(rest as u64).read_to_end(&mut bytes).await?;
        let header = BundleHeader::read(&bytes)?;
        let seekable = reader.seekable().map_err(std::io::Error::other)?;
        header.check_length(seekable.seek(SeekFrom::End(0)).await?)?;
        Ok(Self { path, header, held: None })
    }

    /// The file's path.
    pub fn path(&self) -> &AssetPath<'static> {
        &self.path
    }

    /// The file's header.
    pub fn header(&self) -> &BundleHeader {
        &self.header
    }

    /// Bytes of the file that are kept in memory: all where the source cannot read from the middle of a file (as over
    /// HTTP), else none.
    pub fn held_bytes(&self) -> usize {
        self.held.as_ref().map_or(0, |bytes| bytes.len())
    }

    /// The compressed bytes of a frame that the header lists.
    pub(crate) async fn bytes(&self, index: usize, server: &AssetServer) -> Result<Vec<u8>, FrameReadError> {
        let entry = &self.header.frames[index];
        if let Some(file) = &self.held {
            // The file has the length that the header says.
            return Ok(file[entry.offset as usize..][..entry.length as usize].to_vec());
        }
        let source = server.get_source(self.path.source())?;
        let source = match server.mode() {
            AssetServerMode::Unprocessed => source.reader(),
            AssetServerMode::Processed => source.processed_reader()?,
        };
        let mut reader = source.read(self.path.path()).await?;
        let seekable = reader.seekable().map_err(std::io::Error::other)?;
        seekable.seek(SeekFrom::Start(entry.offset)).await?;
        let mut bytes = Vec::new();
        seekable.take(entry.length).read_to_end(&mut bytes).await?;
        Ok(bytes)
    }

    /// Checks and unpacks a frame's bytes.
    pub(crate) fn decode(&self, index: usize, bytes: &[u8]) -> Result<SmokeFrame, FrameReadError> {
        Ok(self.header.read_frame(index, bytes)?)
    }
}

/// Whether readers of a source, though they seek, first fetch the whole file every time they are opened: Bevy's web
/// sources do.
fn reads_whole_files(source: &AssetSourceId) -> bool {
    cfg!(target_arch = "wasm32") || matches!(source.as_str(), Some("http" | "https"))
}
