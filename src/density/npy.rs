//! NumPy's `.npy`: one dense array.

use glam::{DVec3, IVec3};
use half::f16;

use super::read::{MAX_CELLS, allocate, clamp};
use super::{DensityError, DensityGrid, Placement, SourceInfo};

/// The first bytes of a `.npy` file.
pub(super) const MAGIC: &[u8] = b"\x93NUMPY";

/// Reads a three-dimensional array of densities from the bytes of a `.npy` file (format versions 1 to 3).
///
/// Element `[x, y, z]` is the density of cell (x, y, z), as OpenVDB's Python `copyToArray` lays a grid out. Elements
/// are 16-, 32- or 64-bit floats of either byte order, in C order (z fastest) or Fortran order (x fastest). The format
/// knows no placement: the box is centred on the world's origin with its longest side 1.
///
/// # Errors
///
/// A damaged file, an array of other elements or dimensions, values that are not finite, or a box of more than 2³¹
/// cells. Negative densities are set to 0 and counted ([`SourceInfo::negative_voxels`]).
pub fn read_npy(bytes: &[u8]) -> Result<DensityGrid, DensityError> {
    let (header, data) = Header::split(bytes)?;
    let Header { kind, fortran_order, dims } = header;
    let [nx, ny, nz] = dims;
    let needed = dims.iter().try_fold(kind.bytes() as u64, |product, &side| product.checked_mul(side));
    if needed == Some(0) {
        return Err(DensityError::Unsupported(format!("an array of shape ({nx}, {ny}, {nz}) has no cells")));
    }
    // Comparing first keeps a false shape from asking for memory.
    if needed.is_none_or(|needed| needed > data.len() as u64) {
        return Err(DensityError::Truncated("the array's values"));
    }
    if needed != Some(data.len() as u64) {
        let extra = format!("{} bytes of values, more than a shape of ({nx}, {ny}, {nz}) holds", data.len());
        return Err(DensityError::Damaged(extra));
    }
    let (shape, mut values) = allocate(dims, 0.0, MAX_CELLS)?;
    if fortran_order {
        kind.decode(data, |stored, value| values[stored] = value);
    } else {
        let [ny, nz] = [ny as usize, nz as usize];
        let [dx, dy, dz] = [1, shape.dims.x as usize, (shape.dims.x * shape.dims.y) as usize];
        kind.decode(data, |stored, value| {
            let (x, y, z) = (stored / (ny * nz), stored / nz % ny, stored % nz);
            values[x * dx + y * dy + z * dz] = value;
        });
    }
    let negative_voxels = clamp(shape, IVec3::ZERO, &mut values)?;
    Ok(DensityGrid {
        shape,
        values,
        placement: Placement { center: DVec3::ZERO, voxel_size: 1.0 / f64::from(shape.longest()) },
        source: SourceInfo {
            active_voxels: shape.len() as u64,
            half: matches!(kind.float, Float::F16),
            negative_voxels,
            ..SourceInfo::default()
        },
    })
}

/// The densities of a grid as a `.npy` file (format version 1, 32-bit floats, Fortran order), which [`read_npy`] reads back
/// as they are. The format keeps no placement.
pub fn write_npy(grid: &DensityGrid) -> Vec<u8> {
    /// What the values begin at a multiple of.
    const ALIGNMENT: usize = 64;
    let [x, y, z] = grid.shape.dims.to_array();
    let text = format!("{{'descr': '<f4', 'fortran_order': True, 'shape': ({x}, {y}, {z}), }}");
    // Before the text: the magic bytes, two of version, two of length. After it: spaces and a line end.
    let start = MAGIC.len() + 4;
    let length = (start + text.len() + 1).next_multiple_of(ALIGNMENT) - start;
    let mut bytes = Vec::with_capacity(start + length + 4 * grid.values.len());
    bytes.extend_from_slice(MAGIC);
    bytes.extend_from_slice(&[1, 0]);
    // Three sides of at most ten digits leave the length far below 2¹⁶.
    bytes.extend_from_slice(&(length as u16).to_le_bytes());
    bytes.extend_from_slice(format!("{text:width$}\n", width = length - 1).as_bytes());
    bytes.extend(grid.values.iter().flat_map(|value| value.to_le_bytes()));
    bytes
}

/// How the array is stored.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Header {
    kind: Kind,
    fortran_order: bool,
    dims: [u64; 3],
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Kind {
    float: Float,
    big_endian: bool,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Float {
    F16,
    F32,
    F64,
}

impl Header {
    /// The header, and the bytes after it.
    fn split(bytes: &[u8]) -> Result<(Header, &[u8]), DensityError> {
        let truncated = || DensityError::Truncated("the NumPy header");
        let rest = bytes.strip_prefix(MAGIC).ok_or(DensityError::UnknownFormat)?;
        let (&[major, _minor], rest) = rest.split_first_chunk().ok_or_else(truncated)?;
        let (length, rest) = match major {
            1 => {
                let (&length, rest) = rest.split_first_chunk().ok_or_else(truncated)?;
                (u32::from(u16::from_le_bytes(length)), rest)
            }
            2 | 3 => {
                let (&length, rest) = rest.split_first_chunk().ok_or_else(truncated)?;
                (u32::from_le_bytes(length), rest)
            }
            _ => {
                return Err(DensityError::Unsupported(format!("NumPy format version {major} is not known")));
            }
        };
        let (text, data) = rest.split_at_checked(length as usize).ok_or_else(truncated)?;
        let text = str::from_utf8(text).map_err(|_| DensityError::Damaged("the NumPy header is not text".into()))?;
        Ok((Header::parse(text)?, data))
    }

    /// The header's text is a Python dictionary such as
    /// `{'descr': '<f4', 'fortran_order': False, 'shape': (4, 5, 6), }`.
    fn parse(text: &str) -> Result<Header, DensityError> {
        // What follows a key and its colon.
        let value = |key: &str| {
            [format!("'{key}'"), format!("\"{key}\"")]
                .iter()
                .find_map(|quoted| text.split_once(quoted.as_str()))
                .and_then(|(_, rest)| rest.trim_start().strip_prefix(':'))
                .map(str::trim_start)
                .ok_or_else(|| DensityError::Damaged(format!("the NumPy header has no \"{key}\"")))
        };
        Ok(Header {
            kind: Kind::parse(value("descr")?)?,
            fortran_order: match value("fortran_order")? {
                text if text.starts_with("True") => true,
                text if text.starts_with("False") => false,
                _ => {
                    return Err(DensityError::Damaged("the NumPy header's \"fortran_order\" is no boolean".into()));
                }
            },
            dims: parse_shape(value("shape")?)?,
        })
    }
}

impl Kind {
    /// A quoted type such as `'<f4'`: byte order, kind, bytes.
    fn parse(text: &str) -> Result<Kind, DensityError> {
        let unsupported = |kind: &str| {
            DensityError::Unsupported(format!(
                "the array's elements are {kind}: save densities as 16-, 32- or 64-bit floats (array.astype('float32'))"
            ))
        };
        let quote = text.chars().next().filter(|c| matches!(c, '\'' | '"')).ok_or_else(|| unsupported("structures"))?;
        let name = text[1..].split(quote).next().unwrap_or_default();
        let (big_endian, size) = match name.split_at_checked(2) {
            Some(("<f" | "=f" | "|f", size)) => (false, size),
            Some((">f", size)) => (true, size),
            _ => return Err(unsupported(&format!("\"{name}\""))),
        };
        let float = match size {
            "2" => Float::F16,
            "4" => Float::F32,
            "8" => Float::F64,
            _ => return Err(unsupported(&format!("\"{name}\""))),
        };
        Ok(Kind { float, big_endian })
    }

    fn bytes(self) -> usize {
        match self.float {
            Float::F16 => 2,
            Float::F32 => 4,
            Float::F64 => 8,
        }
    }

    /// Calls `store` with every element's place in the file, from 0, and its value.
    fn decode(self, data: &[u8], store: impl FnMut(usize, f32)) {
        match self.float {
            Float::F16 => self.decode_as(data, |bytes| f16::from_le_bytes(bytes).to_f32(), store),
            Float::F32 => self.decode_as(data, f32::from_le_bytes, store),
            Float::F64 => self.decode_as(data, |bytes| f64::from_le_bytes(bytes) as f32, store),
        }
    }

    fn decode_as<const N: usize>(self, data: &[u8], value: fn([u8; N]) -> f32, mut store: impl FnMut(usize, f32)) {
        for (index, &bytes) in data.as_chunks::<N>().0.iter().enumerate() {
            let mut bytes = bytes;
            if self.big_endian {
                bytes.reverse();
            }
            store(index, value(bytes));
        }
    }
}

/// A tuple of three whole numbers such as `(4, 5, 6)`.
fn parse_shape(text: &str) -> Result<[u64; 3], DensityError> {
    let inner = text.strip_prefix('(').and_then(|text| text.split_once(')')).map(|(inner, _)| inner);
    let inner = inner.ok_or_else(|| DensityError::Damaged("the NumPy header's \"shape\" is no tuple".into()))?;
    let sides: Vec<&str> = inner.split(',').map(str::trim).filter(|side| !side.is_empty()).collect();
    let [x, y, z] = sides[..] else {
        return Err(DensityError::Unsupported(format!(
            "the array has {} dimensions: densities need three, [x, y, z]",
            sides.len()
        )));
    };
    let side = |text: &str| {
        text.parse().map_err(|_| DensityError::Damaged(format!("the NumPy header's shape ({inner}) is no shape")))
    };
    Ok([side(x)?, side(y)?, side(z)?])
}

#[cfg(test)]
mod tests;
