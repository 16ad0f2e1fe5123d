//! Writing a file frame after frame, so that only one has to be in memory.

use std::io::{self, Seek, SeekFrom, Write};

use super::format::check_count;
use super::frame;
use super::{BundleError, BundleHeader, FrameEntry, FrameError, SmokeAnimation, SmokeFrame, SmokeFrames};
use crate::density::GridShape;

/// The bytes of a file holding `animation`.
///
/// # Errors
///
/// An animation whose frames are not in memory, or one that breaks a limit of the format, so that
/// [`read`](super::read) would refuse it.
pub fn write(animation: &SmokeAnimation) -> Result<Vec<u8>, BundleError> {
    let SmokeFrames::Memory(frames) = &animation.frames else {
        return Err(BundleError::NotInMemory);
    };
    let header = BundleHeader::without_frames(animation);
    let mut writer = BundleWriter::new(io::Cursor::new(Vec::new()), header, frames.len()).map_err(in_memory)?;
    for (index, smoke) in frames.iter().enumerate() {
        if smoke.residual.shape() != animation.shape {
            return Err(FrameError::field("residual", "its box is not the animation's").at(index));
        }
        let packed = PackedFrame::new(smoke).map_err(|error| error.at(index))?;
        // The reader's checks are the format's definition: what it accepts is well-formed.
        packed.unpack(animation.shape).map_err(|error| error.at(index))?;
        writer.push(&packed).map_err(in_memory)?;
    }
    Ok(writer.finish(animation.max_density).map_err(in_memory)?.0.into_inner())
}

fn in_memory(error: WriteError) -> BundleError {
    match error {
        WriteError::Bundle(error) => error,
        WriteError::Io(error) => unreachable!("memory takes every byte: {error}"),
    }
}

/// Why a file cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// The bytes cannot be stored.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// They would not be a valid bundle.
    #[error(transparent)]
    Bundle(#[from] BundleError),
}

/// A frame as it is in a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PackedFrame {
    /// The compressed frame.
    pub bytes: Vec<u8>,
    /// Its length before compression.
    pub uncompressed: u64,
}

impl PackedFrame {
    /// Encodes and compresses a frame.
    ///
    /// # Errors
    ///
    /// The compressor fails.
    pub fn new(frame: &SmokeFrame) -> Result<Self, FrameError> {
        let payload = frame::encode(frame);
        Ok(Self { bytes: frame::compress(&payload)?, uncompressed: payload.len() as u64 })
    }

    /// The frame again, in a box of `shape`.
    ///
    /// # Errors
    ///
    /// It is damaged or breaks a rule of the format.
    pub fn unpack(&self, shape: GridShape) -> Result<SmokeFrame, FrameError> {
        frame::decode(&frame::decompress(&self.bytes, self.uncompressed)?, shape)
    }

    fn entry(&self, offset: u64) -> FrameEntry {
        let length = self.bytes.len() as u64;
        FrameEntry { offset, length, uncompressed: self.uncompressed, crc32: crc32fast::hash(&self.bytes) }
    }
}

/// Writes a file frame after frame. Until [`finish`](Self::finish) it has no header and does not load.
pub struct BundleWriter<W> {
    file: W,
    header: BundleHeader,
    count: usize,
}

impl<W: Write + Seek> BundleWriter<W> {
    /// Begins a file of `count` frames at the start of `file`, which is empty. `header` has no frames yet.
    ///
    /// # Errors
    ///
    /// The file cannot be written, or the header breaks a rule of the format.
    pub fn new(mut file: W, header: BundleHeader, count: usize) -> Result<Self, WriteError> {
        file.write_all(&vec![0; BundleHeader::length_with(check_count(count as u64)?)])?;
        Ok(Self { file, header, count })
    }

    /// Adds a frame.
    ///
    /// # Errors
    ///
    /// The file cannot be written.
    pub fn push(&mut self, frame: &PackedFrame) -> Result<(), WriteError> {
        let start = BundleHeader::length_with(self.count) as u64;
        let offset = self.header.frames.last().map_or(start, |last| last.offset + last.length);
        self.file.write_all(&frame.bytes)?;
        self.header.frames.push(frame.entry(offset));
        Ok(())
    }

    /// Puts the header in its place and returns the file with it.
    ///
    /// # Errors
    ///
    /// The file cannot be written, has not got the frames it began with, or breaks a rule of the format.
    pub fn finish(mut self, max_density: f32) -> Result<(W, BundleHeader), WriteError> {
        self.header.max_density = max_density;
        let bytes = self.header.encode();
        if self.header.frames.len() != self.count {
            let problem = format!("{} frames where {} were to come", self.header.frames.len(), self.count);
            return Err(BundleError::header("frame_count", problem).into());
        }
        BundleHeader::read(&bytes)?;
        self.file.seek(SeekFrom::Start(0))?;
        self.file.write_all(&bytes)?;
        self.file.flush()?;
        Ok((self.file, self.header))
    }
}
