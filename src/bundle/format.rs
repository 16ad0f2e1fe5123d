//! The `.smoke` container: a header with the frame table, then every frame on its own. See `docs/format.md`.

use std::sync::Arc;

use glam::{DVec3, UVec3};

use super::frame::{self, max_frame_bytes};
use super::{BundleError, FrameError, SmokeAnimation, SmokeFrame, SmokeFrames};
use crate::density::{GridShape, Placement};

/// Cells along a side of the box, at most.
pub const MAX_SIDE: u32 = 4096;
/// Cells in the box, at most.
pub const MAX_CELLS: u64 = 1 << 28;
/// Frames in a file, at most.
pub const MAX_FRAMES: u32 = 65_536;

/// Decompressed bytes that [`read`] takes into memory, at most: 8 GiB.
const MAX_IN_MEMORY: u64 = 8 << 30;

/// The first byte is not ASCII and the last two are a line end, so that transfers as text are caught.
const MAGIC: [u8; 8] = *b"\x89SMOKE\r\n";
/// The version of the format that this library reads and writes.
pub const VERSION: u32 = 2;
const TABLE_ENTRY: usize = 32;
const CHECKSUM: usize = 4;

/// Reads a whole file, all frames into memory. [`BundleHeader`] reads frames one by one, however many there are.
///
/// # Errors
///
/// Malformed input of any kind is an error that names the fault. Memory stays within what the claimed sizes need, and
/// those within what the claimed box of cells permits.
pub fn read(bytes: &[u8]) -> Result<SmokeAnimation, BundleError> {
    let header = BundleHeader::read(bytes)?;
    header.check_length(bytes.len() as u64)?;
    let total: u64 = header.frames.iter().map(|entry| entry.uncompressed).sum();
    if total > MAX_IN_MEMORY {
        let problem = format!("{total} bytes uncompressed in all, too many to hold at once: read frame by frame");
        return Err(BundleError::header("frames", problem));
    }
    let mut frames = Vec::new();
    for index in 0..header.frames.len() {
        frames.push(Arc::new(header.read_frame_of(bytes, index)?));
    }
    Ok(header.animation(SmokeFrames::Memory(frames)))
}

/// The header of a file: everything but the frames, and where to find each of them.
#[derive(Clone, Debug, PartialEq)]
pub struct BundleHeader {
    /// The box of cells that all frames share.
    pub shape: GridShape,
    /// Where the density file placed the box in the world.
    pub placement: Placement,
    /// Playback speed, above 0.
    pub frames_per_second: f32,
    /// The largest density of any cell in any frame, at least 0.
    pub max_density: f32,
    /// One entry a frame, at least one.
    pub frames: Vec<FrameEntry>,
}

/// Where a frame is in the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameEntry {
    /// First byte, from the start of the file.
    pub offset: u64,
    /// Compressed length in bytes.
    pub length: u64,
    /// Decompressed length in bytes.
    pub uncompressed: u64,
    /// CRC-32 of the compressed bytes.
    pub crc32: u32,
}

impl BundleHeader {
    /// Bytes before the frame table: what [`byte_length`](Self::byte_length) needs.
    pub const FIXED_BYTES: usize = 96;

    /// The length of the whole header in bytes, from the first [`FIXED_BYTES`](Self::FIXED_BYTES) of a file.
    ///
    /// # Errors
    ///
    /// The bytes are not the start of a file that this library reads.
    pub fn byte_length(start: &[u8]) -> Result<usize, BundleError> {
        if !start.starts_with(&MAGIC[..start.len().min(MAGIC.len())]) {
            return Err(BundleError::NotABundle);
        }
        if start.len() < Self::FIXED_BYTES {
            return Err(header_truncated(Self::FIXED_BYTES, start.len()));
        }
        let mut fields = Fields(&start[MAGIC.len()..]);
        let version = fields.u32();
        if version != VERSION {
            return Err(BundleError::Version(version));
        }
        let flags = fields.u32();
        if flags != 0 {
            return Err(BundleError::header(
                "flags",
                format!("{flags:#010x} has bits set that version {VERSION} does not know"),
            ));
        }
        let length = fields.u32();
        let frames = fields.u32();
        let expected = Self::length_with(check_count(u64::from(frames))?);
        if length as usize != expected {
            return Err(BundleError::header("header_length", format!("{length}, but {frames} frames need {expected}")));
        }
        Ok(expected)
    }

    /// Reads the header from the start of a file; frames need not be there yet.
    ///
    /// # Errors
    ///
    /// The header is cut short, damaged, or breaks a rule of the format.
    pub fn read(bytes: &[u8]) -> Result<Self, BundleError> {
        let length = Self::byte_length(bytes)?;
        let Some(header) = bytes.get(..length) else {
            return Err(header_truncated(length, bytes.len()));
        };
        let (body, checksum) = header.split_at(length - CHECKSUM);
        if crc32fast::hash(body) != Fields(checksum).u32() {
            return Err(BundleError::HeaderChecksum);
        }

        // Magic, version, flags and header length are known to be right.
        let mut fields = Fields(&body[MAGIC.len() + 12..]);
        let count = fields.u32() as usize;
        let shape = read_shape(&mut fields)?;
        let frames_per_second = fields.f32();
        if !(frames_per_second.is_finite() && frames_per_second > 0.0) {
            return Err(BundleError::header("frames_per_second", format!("{frames_per_second} is not above 0")));
        }
        let center = DVec3::new(fields.f64(), fields.f64(), fields.f64());
        if !center.is_finite() {
            return Err(BundleError::header("center", format!("{center} is not finite")));
        }
        let voxel_size = fields.f64();
        if !(voxel_size.is_finite() && voxel_size > 0.0) {
            return Err(BundleError::header("voxel_size", format!("{voxel_size} is not above 0")));
        }
        let max_density = fields.f32();
        if !(max_density.is_finite() && max_density >= 0.0) {
            return Err(BundleError::header("max_density", format!("{max_density} is not a finite density")));
        }
        let (reserved, table) = fields.0.split_at(Self::FIXED_BYTES - 76);
        if reserved.iter().any(|&byte| byte != 0) {
            return Err(BundleError::header("reserved", "not 0"));
        }
        let frames = read_table(table, count, length as u64, shape)?;
        Ok(Self { shape, placement: Placement { center, voxel_size }, frames_per_second, max_density, frames })
    }

    /// An animation of these frames, in the header's box.
    pub fn animation(&self, frames: SmokeFrames) -> SmokeAnimation {
        SmokeAnimation {
            shape: self.shape,
            placement: self.placement,
            frames_per_second: self.frames_per_second,
            max_density: self.max_density,
            frames,
        }
    }

    /// Whether a file has the bytes that its header says.
    ///
    /// # Errors
    ///
    /// It has more or fewer.
    pub fn check_length(&self, found: u64) -> Result<(), BundleError> {
        let expected = self.file_length();
        match found.checked_sub(expected) {
            Some(0) => Ok(()),
            Some(more) => Err(BundleError::TrailingBytes(more)),
            None => Err(BundleError::Truncated { part: "frames", expected, found }),
        }
    }

    /// Reads frame `index` from a whole file.
    ///
    /// # Errors
    ///
    /// There is no such frame, the file ends before it does, or it is damaged or breaks a rule of the format.
    pub fn read_frame_of(&self, file: &[u8], index: usize) -> Result<SmokeFrame, BundleError> {
        let entry = self.frames.get(index).ok_or(FrameError::Missing(self.frames.len()).at(index))?;
        let end = entry.offset + entry.length;
        let (expected, found) = (self.file_length(), file.len() as u64);
        if end > found {
            return Err(BundleError::Truncated { part: "frames", expected, found });
        }
        // Both fit in usize, for they lie within the file.
        self.read_frame(index, &file[entry.offset as usize..end as usize])
    }

    /// Reads frame `index` from its bytes: `length` of them from `offset` of its [`FrameEntry`].
    ///
    /// # Errors
    ///
    /// There is no such frame, or it is damaged or breaks a rule of the format.
    pub fn read_frame(&self, index: usize, bytes: &[u8]) -> Result<SmokeFrame, BundleError> {
        let entry = self.frames.get(index).ok_or(FrameError::Missing(self.frames.len()).at(index))?;
        let read = || {
            let (expected, found) = (entry.length, bytes.len() as u64);
            if found != expected {
                return Err(FrameError::Length { expected, found });
            }
            if crc32fast::hash(bytes) != entry.crc32 {
                return Err(FrameError::Checksum);
            }
            frame::decode(&frame::decompress(bytes, entry.uncompressed)?, self.shape)
        };
        read().map_err(|error| error.at(index))
    }

    /// The length of the whole file in bytes.
    pub fn file_length(&self) -> u64 {
        self.frames.last().map_or(0, |last| last.offset + last.length)
    }

    pub(super) const fn length_with(frames: usize) -> usize {
        Self::FIXED_BYTES + TABLE_ENTRY * frames + CHECKSUM
    }

    /// A header whose frame table is still empty.
    #[cfg(feature = "bake")]
    pub(super) fn without_frames(animation: &SmokeAnimation) -> Self {
        let SmokeAnimation { shape, placement, frames_per_second, max_density, .. } = *animation;
        Self { shape, placement, frames_per_second, max_density, frames: Vec::new() }
    }

    #[cfg(feature = "bake")]
    pub(super) fn encode(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(Self::length_with(self.frames.len()));
        bytes.extend(MAGIC);
        let count = self.frames.len() as u32;
        for value in [VERSION, 0, Self::length_with(self.frames.len()) as u32, count] {
            bytes.extend(value.to_le_bytes());
        }
        bytes.extend(self.shape.dims.to_array().iter().flat_map(|side| side.to_le_bytes()));
        bytes.extend(self.frames_per_second.to_le_bytes());
        bytes.extend(self.placement.center.to_array().iter().flat_map(|x| x.to_le_bytes()));
        bytes.extend(self.placement.voxel_size.to_le_bytes());
        bytes.extend(self.max_density.to_le_bytes());
        bytes.resize(Self::FIXED_BYTES, 0);
        for frame in &self.frames {
            bytes.extend(frame.offset.to_le_bytes());
            bytes.extend(frame.length.to_le_bytes());
            bytes.extend(frame.uncompressed.to_le_bytes());
            bytes.extend(frame.crc32.to_le_bytes());
            bytes.extend(0u32.to_le_bytes());
        }
        bytes.extend(crc32fast::hash(&bytes).to_le_bytes());
        bytes
    }
}

/// Whether a file may have `frames` frames.
pub(super) fn check_count(frames: u64) -> Result<usize, BundleError> {
    if !(1..=u64::from(MAX_FRAMES)).contains(&frames) {
        return Err(BundleError::header("frame_count", format!("{frames} is not from 1 to {MAX_FRAMES}")));
    }
    Ok(frames as usize)
}

fn header_truncated(expected: usize, found: usize) -> BundleError {
    BundleError::Truncated { part: "header", expected: expected as u64, found: found as u64 }
}

fn read_shape(fields: &mut Fields) -> Result<GridShape, BundleError> {
    let shape = GridShape { dims: UVec3::new(fields.u32(), fields.u32(), fields.u32()) };
    check_shape(shape)?;
    Ok(shape)
}

/// Whether a box of cells is within the format's limits.
pub(crate) fn check_shape(GridShape { dims }: GridShape) -> Result<(), BundleError> {
    if dims.to_array().iter().any(|side| !(1..=MAX_SIDE).contains(side)) {
        return Err(BundleError::header("dims", format!("{dims} cells; a side has 1 to {MAX_SIDE}")));
    }
    let cells: u64 = dims.to_array().map(u64::from).iter().product();
    if cells > MAX_CELLS {
        return Err(BundleError::header("dims", format!("{dims} are {cells} cells; the limit is {MAX_CELLS}")));
    }
    Ok(())
}

/// Frames follow the header and each other without gaps, so that no byte is read twice or not at all.
fn read_table(table: &[u8], count: usize, start: u64, shape: GridShape) -> Result<Vec<FrameEntry>, BundleError> {
    let mut end = start;
    let mut frames = Vec::with_capacity(count);
    for (index, entry) in table.chunks_exact(TABLE_ENTRY).enumerate() {
        let mut fields = Fields(entry);
        let entry =
            FrameEntry { offset: fields.u64(), length: fields.u64(), uncompressed: fields.u64(), crc32: fields.u32() };
        let fault = |field, problem| Err(FrameError::field(field, problem).at(index));
        if entry.offset != end {
            return fault("offset", format!("{}, where {end} follows from the frames before", entry.offset));
        }
        let limit = max_frame_bytes(shape);
        if entry.uncompressed > limit {
            return fault(
                "uncompressed",
                format!("{} bytes; a frame of this box has at most {limit}", entry.uncompressed),
            );
        }
        if entry.length == 0 || entry.length > 2 * limit {
            return fault("length", format!("{} bytes for {} uncompressed", entry.length, entry.uncompressed));
        }
        if fields.u32() != 0 {
            return fault("reserved", "not 0".into());
        }
        end += entry.length;
        frames.push(entry);
    }
    Ok(frames)
}

/// Little-endian numbers from the front of a slice that is known to be long enough.
struct Fields<'a>(&'a [u8]);

impl Fields<'_> {
    fn take<const N: usize>(&mut self) -> [u8; N] {
        let (field, rest) = self.0.split_first_chunk().expect("the length has been checked");
        self.0 = rest;
        *field
    }

    fn u32(&mut self) -> u32 {
        u32::from_le_bytes(self.take())
    }

    fn u64(&mut self) -> u64 {
        u64::from_le_bytes(self.take())
    }

    fn f32(&mut self) -> f32 {
        f32::from_le_bytes(self.take())
    }

    fn f64(&mut self) -> f64 {
        f64::from_le_bytes(self.take())
    }
}
