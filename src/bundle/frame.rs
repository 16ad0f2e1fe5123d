//! One frame as bytes: counts, Gaussians and their numbers, occupancy mask, offset table, residual bytes. See `docs/format.md`.

use std::io::Read;

use ruzstd::decoding::{FrameDecoder, StreamingDecoder};

use super::{FrameError, SmokeFrame};
use crate::density::GridShape;
use crate::rbf::{Rbf, RbfModel};
use crate::residual::{HashedResidual, QuantizationLaw};

/// Gaussians in a frame, at most.
pub const MAX_RBFS: u32 = 65_535;
/// Radius of a Gaussian in bundle units, at least: far below the smallest cell.
pub const MIN_RADIUS: f32 = 1e-6;
/// Radius of a Gaussian in bundle units, at most: four times the box.
pub const MAX_RADIUS: f32 = 4.0;
/// Coordinates of a Gaussian's centre, at most: the box reaches to 0.5.
const MAX_COORDINATE: f32 = 4.0;
/// Densities, at most: so large that a sum over all Gaussians still fits a 32-bit number.
const MAX_DENSITY: f32 = 1e30;
/// Entries of the offset table beyond one a cell, at most: small boxes have tables larger than themselves.
const EXTRA_OFFSETS: u64 = 1 << 15;

const COUNTS: usize = 24;
const RBF: usize = size_of::<Rbf>();
/// A Gaussian with its number.
const NUMBERED: u64 = RBF as u64 + 4;
/// Zstandard windows up to this size are always accepted: what RFC 8878 asks every decoder to support.
const WINDOW: u64 = 8 << 20;

/// Sizes of a frame's arrays in bytes, for a number of Gaussians, a side of the offset table and a residual count.
fn sizes(shape: GridShape, rbfs: u32, offset_side: u32, residuals: u32) -> [u64; 4] {
    let rbfs = u64::from(rbfs) * NUMBERED;
    let occupancy = 4 * (shape.len() as u64).div_ceil(32);
    let offsets = 2 * u64::from(offset_side).pow(3);
    [rbfs, occupancy, offsets, u64::from(residuals)]
}

fn max_offsets(shape: GridShape) -> u64 {
    shape.len() as u64 + EXTRA_OFFSETS
}

/// The longest an uncompressed frame on `shape` can be.
pub(super) fn max_frame_bytes(shape: GridShape) -> u64 {
    let [rbfs, occupancy, _, residuals] = sizes(shape, MAX_RBFS, 0, shape.len() as u32);
    COUNTS as u64 + rbfs + occupancy + 2 * max_offsets(shape) + residuals
}

/// Reads a frame from its uncompressed bytes.
pub(super) fn decode(bytes: &[u8], shape: GridShape) -> Result<SmokeFrame, FrameError> {
    let found = bytes.len() as u64;
    let Some((counts, rest)) = bytes.split_first_chunk::<COUNTS>() else {
        return Err(FrameError::Length { expected: COUNTS as u64, found });
    };
    let [rbf_count, max, exponent, residual_count, offset_side, slots] = bytemuck::cast::<_, [[u8; 4]; 6]>(*counts);
    let [rbf_count, residual_count] = [rbf_count, residual_count].map(u32::from_le_bytes);
    let [offset_side, slots] = [offset_side, slots].map(u32::from_le_bytes);
    let law = QuantizationLaw { max: f32::from_le_bytes(max), exponent: f32::from_le_bytes(exponent) };

    if rbf_count > MAX_RBFS {
        return Err(FrameError::field("rbf_count", format!("{rbf_count} is above {MAX_RBFS}")));
    }
    // A power that does not fit is surely above the limit.
    let offsets = offset_side.checked_pow(3).map_or(u64::MAX, u64::from);
    if offsets > max_offsets(shape) {
        let problem = format!("{offset_side}, but a table on this box has at most {} entries", max_offsets(shape));
        return Err(FrameError::field("offset_side", problem));
    }
    let lengths = sizes(shape, rbf_count, offset_side, residual_count);
    let expected = COUNTS as u64 + lengths.iter().sum::<u64>();
    if found != expected {
        return Err(FrameError::Length { expected, found });
    }
    // The lengths add up to that of a slice, so each fits in usize.
    let (rbfs, rest) = rest.split_at(lengths[0] as usize);
    let (rbfs, ids) = rbfs.split_at(rbf_count as usize * RBF);
    let (occupancy, rest) = rest.split_at(lengths[1] as usize);
    let (offsets, values) = rest.split_at(lengths[2] as usize);

    let rbfs: Vec<Rbf> = rbfs.chunks_exact(RBF).map(read_rbf).collect();
    for (index, rbf) in rbfs.iter().enumerate() {
        check_rbf(rbf).map_err(|problem| FrameError::field("rbfs", format!("number {index} has {problem}")))?;
    }
    let ids: Vec<u32> = from_le(ids, u32::from_le_bytes);
    if let Some(twice) = first_repeated(&ids) {
        return Err(FrameError::field("ids", format!("two RBFs have the number {twice}")));
    }
    if law.max > MAX_DENSITY {
        return Err(FrameError::field("law_max", format!("{} is above {MAX_DENSITY}", law.max)));
    }
    let residual = HashedResidual::from_parts(
        shape,
        law,
        from_le(occupancy, u32::from_le_bytes),
        bytemuck::cast_slice(values),
        offset_side,
        from_le(offsets, u16::from_le_bytes),
        slots,
    )?;
    Ok(SmokeFrame { rbfs: RbfModel { rbfs }, ids, residual })
}

fn read_rbf(bytes: &[u8]) -> Rbf {
    let values: Vec<f32> = from_le(bytes, f32::from_le_bytes);
    Rbf { center: [values[0], values[1], values[2]], radius: values[3], weight: values[4] }
}

fn check_rbf(rbf: &Rbf) -> Result<(), String> {
    let Rbf { center, radius, weight } = *rbf;
    if !center.iter().all(|x| x.abs() <= MAX_COORDINATE) {
        return Err(format!("its centre at {center:?}, outside ±{MAX_COORDINATE}"));
    }
    if !(MIN_RADIUS..=MAX_RADIUS).contains(&radius) {
        return Err(format!("radius {radius}, outside {MIN_RADIUS} to {MAX_RADIUS}"));
    }
    if !(weight > 0.0 && weight <= MAX_DENSITY) {
        return Err(format!("weight {weight}, which is not above 0 and at most {MAX_DENSITY}"));
    }
    Ok(())
}

fn first_repeated(ids: &[u32]) -> Option<u32> {
    let mut sorted = ids.to_vec();
    sorted.sort_unstable();
    sorted.windows(2).find(|pair| pair[0] == pair[1]).map(|pair| pair[0])
}

fn from_le<const N: usize, T>(bytes: &[u8], read: fn([u8; N]) -> T) -> Vec<T> {
    bytes.as_chunks::<N>().0.iter().map(|chunk| read(*chunk)).collect()
}

/// Decompresses exactly `length` bytes from exactly all of `compressed`.
///
/// Memory is bounded by `length` and the window: a frame that asks for a larger window is refused, the decoder refuses
/// blocks above 128 KiB, and decompression stops one byte after `length`.
pub(super) fn decompress(compressed: &[u8], length: u64) -> Result<Vec<u8>, FrameError> {
    let fault = |problem: String| FrameError::Compression(problem);
    let mut source = compressed;
    let mut decoder = FrameDecoder::new();
    decoder.set_max_window_size(length.max(WINDOW));
    let stream = StreamingDecoder::new_with_decoder(&mut source, decoder).map_err(|error| fault(error.to_string()))?;
    let mut bytes = Vec::new();
    stream.take(length + 1).read_to_end(&mut bytes).map_err(|error| fault(error.to_string()))?;
    if bytes.len() as u64 > length {
        return Err(fault(format!("it goes on after the {length} bytes that the frame table gives")));
    }
    if (bytes.len() as u64) < length {
        return Err(fault(format!("it ends after {} of {length} bytes", bytes.len())));
    }
    if !source.is_empty() {
        return Err(fault(format!("{} bytes follow it", source.len())));
    }
    Ok(bytes)
}

#[cfg(feature = "bake")]
mod writing {
    use super::*;

    /// Zstandard's highest level that needs no special decoder settings.
    const LEVEL: i32 = 19;

    /// Uncompressed bytes of each part of a frame.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
    pub struct SectionBytes {
        /// Counts and quantisation law.
        pub counts: u64,
        /// Gaussians and their numbers.
        pub rbfs: u64,
        /// Occupancy mask, one bit a cell.
        pub occupancy: u64,
        /// Offset table of the spatial hash.
        pub offsets: u64,
        /// Residuals, one byte each.
        pub residuals: u64,
    }

    /// The uncompressed bytes that each part of a frame takes in a file.
    pub fn section_bytes(frame: &SmokeFrame) -> SectionBytes {
        let SmokeFrame { rbfs, residual, .. } = frame;
        let [rbfs, occupancy, offsets, residuals] =
            sizes(residual.shape(), rbfs.rbfs.len() as u32, residual.offset_side(), residual.count());
        SectionBytes { counts: COUNTS as u64, rbfs, occupancy, offsets, residuals }
    }

    /// The uncompressed bytes of a frame.
    pub(in crate::bundle) fn encode(frame: &SmokeFrame) -> Vec<u8> {
        let SmokeFrame { rbfs: RbfModel { rbfs }, ids, residual } = frame;
        let law = residual.law();
        let mut bytes = Vec::new();
        bytes.extend((rbfs.len() as u32).to_le_bytes());
        bytes.extend(law.max.to_le_bytes());
        bytes.extend(law.exponent.to_le_bytes());
        for count in [residual.count(), residual.offset_side(), residual.slots()] {
            bytes.extend(count.to_le_bytes());
        }
        for rbf in rbfs {
            let [x, y, z] = rbf.center;
            bytes.extend([x, y, z, rbf.radius, rbf.weight].iter().flat_map(|value| value.to_le_bytes()));
        }
        bytes.extend(ids.iter().flat_map(|id| id.to_le_bytes()));
        bytes.extend(residual.occupancy().iter().flat_map(|word| word.to_le_bytes()));
        bytes.extend(residual.offsets().iter().flat_map(|offset| offset.to_le_bytes()));
        bytes.extend(residual.values().iter().map(|&value| value as u8));
        bytes
    }

    pub(in crate::bundle) fn compress(bytes: &[u8]) -> Result<Vec<u8>, FrameError> {
        zstd::bulk::compress(bytes, LEVEL).map_err(|error| FrameError::Compression(error.to_string()))
    }
}

#[cfg(feature = "bake")]
pub use writing::{SectionBytes, section_bytes};
#[cfg(feature = "bake")]
pub(super) use writing::{compress, encode};
