//! The perfect spatial hash: a residual of any cell in constant time.

use glam::UVec3;

use super::QuantizationLaw;
use crate::density::GridShape;

/// Multiplier of the displacement sequence: 2³² over the golden ratio, rounded to odd, so that successive candidates
/// spread over the table.
const STRIDE: u32 = 0x9E37_79B1;

/// A quantised residual field of which only the cells that are not zero take space.
///
/// # Layout
///
/// Four arrays, all of them u32 words on the GPU; `i` is a cell's flat index, `p` its coordinates:
///
/// | array | holds |
/// |---|---|
/// | [`occupancy`](Self::occupancy) | one bit a cell, bit `i & 31` of word `i >> 5`: the cell is in the table |
/// | [`offsets`](Self::offsets) | `side³` u16, two a word, low half first: the displacement number of bucket `p mod side` |
/// | [`table`](Self::table) | `slots` signed bytes, four a word, low byte first |
/// | law | decodes the byte |
///
/// An occupied cell's byte is in slot `(i mod slots + d) mod slots`, where `d = (n · 0x9E3779B1 mod 2³²) mod slots` and
/// `n` is its bucket's entry in the offset table. Lefebvre and Hoppe's `h = h₀(p) + Φ[h₁(p)]` with `h₁ = p mod side` as
/// theirs and `h₀` the flat index modulo the table length, so a table may have any length, and one as long as the grid
/// always works. Displacements are numbered, not stored: most numbers are tiny, and the file keeps few bits for them.
///
/// The side of the offset table is Zhou et al.'s `∛(K/3) + 9` for `K` occupied cells.
#[derive(Clone, Debug, PartialEq)]
pub struct HashedResidual {
    shape: GridShape,
    law: QuantizationLaw,
    occupancy: Vec<u32>,
    count: u32,
    offset_side: u32,
    offsets: Vec<u16>,
    slots: u32,
    table: Vec<u32>,
}

/// Why the parts of a [`HashedResidual`] do not fit together.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ResidualError {
    /// Flat indices are 32 bits.
    #[error("a grid of {0} cells is too large: flat indices are 32 bits")]
    GridTooLarge(u128),
    /// The law has a maximum or exponent that is not a usable number.
    #[error(
        "quantisation law with max {max} and exponent {exponent}: max must be finite and at least 0, the exponent within 0.1 to 10"
    )]
    Law {
        /// The law's maximum.
        max: f32,
        /// The law's exponent.
        exponent: f32,
    },
    /// An array is longer or shorter than the grid or its sizes say.
    #[error("the {part} has {found} entries where {expected} belong")]
    Length {
        /// Which array.
        part: &'static str,
        /// How many entries it should have.
        expected: u64,
        /// How many it has.
        found: u64,
    },
    /// The occupancy mask marks cells after the last one.
    #[error("the occupancy mask has bits set after the grid's last cell")]
    OccupancyPadding,
    /// A stored byte is 0 or −128, which no occupied cell has.
    #[error("occupied cell {cell} has the value {value}, outside -127..=127 or 0")]
    Value {
        /// Coordinates of the cell.
        cell: UVec3,
        /// The stored byte.
        value: i8,
    },
    /// The hash table is shorter than its content or longer than the grid.
    #[error(
        "a hash table of {slots} slots for {count} values in {cells} cells: it needs at least one a value and at most one a cell"
    )]
    TableLength {
        /// Slots in the table.
        slots: u32,
        /// Occupied cells.
        count: u32,
        /// Cells in the grid.
        cells: u32,
    },
    /// Two occupied cells share a slot: the offset table does not belong to this mask.
    #[error("cell {0} meets another in the hash table: the offset table does not belong to this occupancy mask")]
    Collision(UVec3),
}

impl HashedResidual {
    /// A frame whose residual is zero everywhere.
    pub fn empty(shape: GridShape) -> Self {
        Self {
            shape,
            law: QuantizationLaw { max: 0.0, exponent: 1.0 },
            occupancy: vec![0; shape.len().div_ceil(32)],
            count: 0,
            offset_side: 0,
            offsets: Vec::new(),
            slots: 0,
            table: Vec::new(),
        }
    }

    /// Puts a residual together from what a file carries, in time linear in the grid.
    ///
    /// `values` are the bytes of the occupied cells in flat order, each in −127..=127 and not 0; `offsets` holds
    /// `offset_side³` displacement numbers. The hash table itself (`slots` bytes) is refilled here. Memory is bounded by
    /// the grid's size, and the mask must already be as long as the grid, so a damaged file cannot ask for more.
    ///
    /// # Errors
    ///
    /// Whatever does not fit together, two cells in one slot included: a residual that loads never gives a wrong value.
    pub fn from_parts(
        shape: GridShape,
        law: QuantizationLaw,
        occupancy: Vec<u32>,
        values: &[i8],
        offset_side: u32,
        offsets: Vec<u16>,
        slots: u32,
    ) -> Result<Self, ResidualError> {
        let cells = cell_count(shape)?;
        check_law(law)?;
        check_length("occupancy mask", u64::from(cells.div_ceil(32)), occupancy.len())?;
        if cells % 32 != 0 && occupancy.last().is_some_and(|last| last >> (cells % 32) != 0) {
            return Err(ResidualError::OccupancyPadding);
        }
        let count: u32 = occupancy.iter().map(|word| word.count_ones()).sum();
        check_length("list of values", u64::from(count), values.len())?;
        let side = u64::from(offset_side);
        check_length("offset table", side.saturating_mul(side).saturating_mul(side), offsets.len())?;
        if slots < count || slots > cells || (count > 0 && offset_side == 0) {
            return Err(ResidualError::TableLength { slots, count, cells });
        }

        let mut residual = Self {
            table: vec![0; slots.div_ceil(4) as usize],
            shape,
            law,
            occupancy,
            count,
            offset_side,
            offsets,
            slots,
        };
        residual.fill(values)?;
        Ok(residual)
    }

    /// Writes every value to its slot.
    fn fill(&mut self, values: &[i8]) -> Result<(), ResidualError> {
        // A value is never 0, so a slot that is not 0 is taken.
        let mut table = std::mem::take(&mut self.table);
        for (index, &value) in self.occupied().zip(values) {
            let cell = self.shape.cell(index as usize);
            if matches!(value, 0 | i8::MIN) {
                return Err(ResidualError::Value { cell, value });
            }
            let slot = self.slot(cell);
            let (word, shift) = ((slot >> 2) as usize, 8 * (slot & 3));
            if (table[word] >> shift) & 0xFF != 0 {
                return Err(ResidualError::Collision(cell));
            }
            table[word] |= u32::from(value as u8) << shift;
        }
        self.table = table;
        Ok(())
    }

    /// The residual of a cell, in units of density: 0 where nothing is stored.
    pub fn get(&self, cell: UVec3) -> f32 {
        self.law.decode(self.quantized(cell))
    }

    /// The stored byte of a cell. Written in u32 arithmetic, as the shader is.
    pub fn quantized(&self, cell: UVec3) -> i8 {
        let index = cell.x + self.shape.dims.x * (cell.y + self.shape.dims.y * cell.z);
        if (self.occupancy[(index >> 5) as usize] >> (index & 31)) & 1 == 0 {
            return 0;
        }
        let slot = self.slot(cell);
        (self.table[(slot >> 2) as usize] >> (8 * (slot & 3))) as u8 as i8
    }

    /// The slot of an occupied cell.
    fn slot(&self, cell: UVec3) -> u32 {
        let number = self.offsets[bucket(cell, self.offset_side) as usize];
        let index = cell.x + self.shape.dims.x * (cell.y + self.shape.dims.y * cell.z);
        displaced(index % self.slots, displacement(u32::from(number), self.slots), self.slots)
    }

    /// The residual of every cell, in flat order.
    pub fn decode_all(&self) -> Vec<f32> {
        let decoded: Vec<f32> = (0..=255u8).map(|q| self.law.decode(q as i8)).collect();
        let mut values = vec![0.0; self.shape.len()];
        for (index, value) in self.occupied().zip(self.values()) {
            values[index as usize] = decoded[usize::from(value as u8)];
        }
        values
    }

    /// The bytes of the occupied cells in flat order: what [`from_parts`](Self::from_parts) takes.
    pub fn values(&self) -> Vec<i8> {
        self.occupied().map(|index| self.quantized(self.shape.cell(index as usize))).collect()
    }

    /// The flat indices of the occupied cells, ascending.
    fn occupied(&self) -> impl Iterator<Item = u32> {
        (0u32..).zip(&self.occupancy).flat_map(|(word, &bits)| {
            let mut rest = bits;
            std::iter::from_fn(move || {
                let bit = (rest != 0).then(|| rest.trailing_zeros())?;
                rest &= rest - 1;
                Some(32 * word + bit)
            })
        })
    }

    /// The grid that the residual belongs to.
    pub fn shape(&self) -> GridShape {
        self.shape
    }

    /// How bytes stand for residuals.
    pub fn law(&self) -> QuantizationLaw {
        self.law
    }

    /// The number of occupied cells.
    pub fn count(&self) -> u32 {
        self.count
    }

    /// One bit a cell: bit `i & 31` of word `i >> 5` for flat index `i`.
    pub fn occupancy(&self) -> &[u32] {
        &self.occupancy
    }

    /// Side of the offset table; 0 for an empty residual.
    pub fn offset_side(&self) -> u32 {
        self.offset_side
    }

    /// The displacement number of every bucket, x fastest.
    pub fn offsets(&self) -> &[u16] {
        &self.offsets
    }

    /// [`offsets`](Self::offsets) as the GPU reads them: two a word, low half first.
    pub fn packed_offsets(&self) -> Vec<u32> {
        self.offsets
            .chunks(2)
            .map(|pair| u32::from(pair[0]) | pair.get(1).map_or(0, |&high| u32::from(high) << 16))
            .collect()
    }

    /// Slots in the hash table; 0 for an empty residual.
    pub fn slots(&self) -> u32 {
        self.slots
    }

    /// The hash table: four signed bytes a word, low byte first.
    pub fn table(&self) -> &[u32] {
        &self.table
    }
}

/// The bucket of a cell: `p mod side`, flattened.
pub(super) fn bucket(cell: UVec3, side: u32) -> u32 {
    let p = cell % side;
    p.x + side * (p.y + side * p.z)
}

/// How far displacement `number` moves a key in a table of `slots`.
pub(super) fn displacement(number: u32, slots: u32) -> u32 {
    number.wrapping_mul(STRIDE) % slots
}

/// `home + by`, around the table's end; both are below `slots`, and their sum may pass 2³².
pub(super) fn displaced(home: u32, by: u32, slots: u32) -> u32 {
    if home < slots - by { home + by } else { home - (slots - by) }
}

/// The number of cells as a u32.
pub(super) fn cell_count(shape: GridShape) -> Result<u32, ResidualError> {
    let cells: u128 = shape.dims.to_array().map(u128::from).iter().product();
    u32::try_from(cells).map_err(|_| ResidualError::GridTooLarge(cells))
}

pub(super) fn check_law(law: QuantizationLaw) -> Result<(), ResidualError> {
    let QuantizationLaw { max, exponent } = law;
    let usable = max.is_finite() && max >= 0.0 && (0.1..=10.0).contains(&exponent);
    usable.then_some(()).ok_or(ResidualError::Law { max, exponent })
}

pub(super) fn check_length(part: &'static str, expected: u64, found: usize) -> Result<(), ResidualError> {
    let found = found as u64;
    (found == expected).then_some(()).ok_or(ResidualError::Length { part, expected, found })
}
