//! The values of a node: half precision, three compressions, and inactive values left out.

use half::f16;

use super::DensityError;
use super::cursor::Cursor;
use super::header::{Descriptor, GridHeader};

// Compression flags of a grid.
const ZIP: u32 = 1;
const ACTIVE_MASK: u32 = 2;
const BLOSC: u32 = 4;

const WHAT: &str = "a node's values";

/// Reads the values of nodes.
pub(super) struct ValueReader {
    compression: u32,
    double: bool,
    half: bool,
    /// The value of empty space, which nodes refer to; known once the tree's root is read.
    pub background: f32,
    // Buffers kept from node to node.
    unpacked: Vec<u8>,
    stored: Vec<f32>,
    values: Vec<f32>,
}

/// A bit per value of a node, bit 0 of byte 0 first.
pub(super) fn is_set(mask: &[u8], index: usize) -> bool {
    mask[index / 8] >> (index % 8) & 1 != 0
}

/// The number of bits set.
pub(super) fn count_set(mask: &[u8]) -> usize {
    mask.iter().map(|byte| byte.count_ones() as usize).sum()
}

impl ValueReader {
    pub fn new(grid: &Descriptor, header: &GridHeader) -> Result<Self, DensityError> {
        let double = match grid.value_type() {
            "float" => false,
            "double" => true,
            other => {
                let name = grid.display_name();
                return Err(DensityError::Unsupported(format!(
                    "the grid \"{name}\" holds {other}: a density is a grid of float or double"
                )));
            }
        };
        if header.compression & !(ZIP | ACTIVE_MASK | BLOSC) != 0 {
            return Err(DensityError::Unsupported(format!("compression {:#x} is not known", header.compression)));
        }
        Ok(Self {
            compression: header.compression,
            double,
            // OpenVDB goes by the metadata; the type's suffix says the same for readers that skip it.
            half: header.half.unwrap_or(grid.half),
            background: 0.0,
            unpacked: Vec::new(),
            stored: Vec::new(),
            values: Vec::new(),
        })
    }

    /// Values are saved with half precision.
    pub fn half(&self) -> bool {
        self.half
    }

    /// A single value. It has the grid's full width even where node values have half precision.
    pub fn scalar(&self, at: &mut Cursor) -> Result<f32, DensityError> {
        if self.double { at.f64(WHAT).map(|value| value as f32) } else { at.f32(WHAT) }
    }

    /// All values of a node, one per bit of the mask of its active values.
    ///
    /// A byte says which inactive values there are (b is the background):
    ///
    /// | byte | inactive values | stored with it |
    /// |---|---|---|
    /// | 0 | all b | |
    /// | 1 | all −b | |
    /// | 2 | all v | v |
    /// | 3 | −b, or b where selected | selection mask |
    /// | 4 | v, or b where selected | v, selection mask |
    /// | 5 | v, or w where selected | v, w, selection mask |
    /// | 6 | any | |
    ///
    /// With the flag `ACTIVE_MASK` and a byte below 6 only the active values follow, otherwise all.
    pub fn node(&mut self, at: &mut Cursor, active: &[u8]) -> Result<&[f32], DensityError> {
        let kind = at.u8(WHAT)?;
        let b = self.background;
        let (inactive, selects) = match kind {
            0 | 6 => ([b, b], false),
            1 => ([-b, b], false),
            2 => ([self.scalar(at)?, b], false),
            3 => ([-b, b], true),
            4 => ([self.scalar(at)?, b], true),
            5 => ([self.scalar(at)?, self.scalar(at)?], true),
            _ => return Err(DensityError::Damaged(format!("{kind} is no kind of node compression"))),
        };
        let selection = if selects { Some(at.take(active.len(), WHAT)?) } else { None };

        let count = 8 * active.len();
        if self.compression & ACTIVE_MASK == 0 || kind == 6 {
            self.read_stored(at, count)?;
            return Ok(&self.stored);
        }
        self.read_stored(at, count_set(active))?;
        let mut stored = self.stored.iter();
        self.values.clear();
        self.values.extend((0..count).map(|index| {
            if is_set(active, index) {
                // There are as many stored values as active ones.
                stored.next().copied().unwrap_or_default()
            } else {
                inactive[usize::from(selection.is_some_and(|selection| is_set(selection, index)))]
            }
        }));
        Ok(&self.values)
    }

    /// Reads `count` values into `stored`.
    fn read_stored(&mut self, at: &mut Cursor, count: usize) -> Result<(), DensityError> {
        self.stored.clear();
        // For half precision OpenVDB writes nothing at all where there are no values; else the length of an empty block.
        if count == 0 && self.half {
            return Ok(());
        }
        let width = match (self.half, self.double) {
            (true, _) => 2,
            (false, false) => 4,
            (false, true) => 8,
        };
        let length = count * width;
        let bytes = match self.compression {
            c if c & BLOSC != 0 => unpack(at, length, &mut self.unpacked, unblosc)?,
            c if c & ZIP != 0 => unpack(at, length, &mut self.unpacked, unzip)?,
            _ => at.take(length, WHAT)?,
        };
        if self.half {
            self.stored.extend(bytes.as_chunks().0.iter().map(|&two| f16::from_le_bytes(two).to_f32()));
        } else if self.double {
            self.stored.extend(bytes.as_chunks().0.iter().map(|&eight| f64::from_le_bytes(eight) as f32));
        } else {
            self.stored.extend(bytes.as_chunks().0.iter().map(|&four| f32::from_le_bytes(four)));
        }
        Ok(())
    }
}

/// Reads a block that unpacks to `length` bytes: its packed length, negative where it is not packed, and its bytes.
fn unpack<'b, 'a: 'b>(
    at: &mut Cursor<'a>,
    length: usize,
    buffer: &'b mut Vec<u8>,
    method: fn(&[u8], &mut [u8]) -> bool,
) -> Result<&'b [u8], DensityError> {
    let packed = at.i64(WHAT)?;
    if packed <= 0 {
        if packed.unsigned_abs() != length as u64 {
            return Err(DensityError::Damaged(format!(
                "a block of {} bytes should have {length}",
                packed.unsigned_abs()
            )));
        }
        return at.take(length, WHAT);
    }
    let bytes = at.take(usize::try_from(packed).unwrap_or(usize::MAX), WHAT)?;
    buffer.clear();
    buffer.resize(length, 0);
    if !method(bytes, buffer) {
        return Err(DensityError::Damaged(format!("a compressed block of {packed} bytes does not unpack to {length}")));
    }
    Ok(buffer)
}

/// Unpacks a zlib stream that fills `out` exactly.
fn unzip(packed: &[u8], out: &mut [u8]) -> bool {
    let mut zlib = flate2::Decompress::new(true);
    let status = zlib.decompress(packed, out, flate2::FlushDecompress::Finish);
    matches!(status, Ok(flate2::Status::StreamEnd)) && zlib.total_out() == out.len() as u64
}

/// Unpacks a Blosc block that fills `out` exactly.
fn unblosc(packed: &[u8], out: &mut [u8]) -> bool {
    let mut length = 0;
    // SAFETY: both pointers go with their true lengths. A valid block is what Blosc asks for before it decompresses;
    // from there on it checks every length against `packed` and `out`. One thread, no global state.
    unsafe {
        blosc_src::blosc_cbuffer_validate(packed.as_ptr().cast(), packed.len(), &mut length) == 0
            && length == out.len()
            && blosc_src::blosc_decompress_ctx(packed.as_ptr().cast(), out.as_mut_ptr().cast(), out.len(), 1)
                == out.len() as i32
    }
}
