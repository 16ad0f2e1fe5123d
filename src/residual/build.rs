//! Building the hash: buckets find displacements that put all their cells into free slots.

use super::QuantizationLaw;
use super::hash::{
    HashedResidual, ResidualError, bucket, cell_count, check_law, check_length, displaced, displacement,
};
use crate::density::GridShape;

/// Slots per occupied cell at first. A looser table has smaller displacement numbers, so fewer bytes in the file, for
/// more bytes in memory: over 27 frames of a plume of 60×128×67 cells the offset table compresses to 10.5, 5.8 and 3.1 kB of
/// 114, 110 and 107 kB a frame at 1.5, 1.75 and 2 slots.
const SPACE: f64 = 2.0;

/// What the table grows by when a bucket finds no place.
const GROWTH: f64 = 1.05;

/// One mark a slot.
struct Slots(Vec<u64>);

impl Slots {
    fn taken(&self, slot: u32) -> bool {
        (self.0[(slot >> 6) as usize] >> (slot & 63)) & 1 != 0
    }

    fn take(&mut self, slot: u32) {
        self.0[(slot >> 6) as usize] |= 1 << (slot & 63);
    }

    fn free(&mut self, slot: u32) {
        self.0[(slot >> 6) as usize] &= !(1 << (slot & 63));
    }
}

impl HashedResidual {
    /// Hashes the quantised residual of a frame, one byte per cell in flat order; cells that are 0 take no space.
    ///
    /// The result depends on the input alone. It cannot fail to find a hash: a table as long as the grid needs no
    /// displacements.
    ///
    /// # Errors
    ///
    /// A grid of 2³² cells or more, a number of bytes other than its cells, an unusable law, or a byte of −128.
    pub fn build(shape: GridShape, quantized: &[i8], law: QuantizationLaw) -> Result<Self, ResidualError> {
        let cells = cell_count(shape)?;
        check_law(law)?;
        check_length("quantised residual", u64::from(cells), quantized.len())?;
        let mut occupancy = vec![0u32; cells.div_ceil(32) as usize];
        let mut keys = Vec::new();
        let mut values = Vec::new();
        for (index, &value) in (0u32..).zip(quantized) {
            if value != 0 {
                occupancy[(index >> 5) as usize] |= 1 << (index & 31);
                keys.push(index);
                values.push(value);
            }
        }
        if keys.is_empty() {
            return Self::from_parts(shape, law, occupancy, &values, 0, Vec::new(), 0);
        }
        let side = offset_side(keys.len());
        let buckets = Buckets::new(shape, &keys, side);
        let mut slots = ((keys.len() as f64 * SPACE).ceil() as u32).min(cells);
        loop {
            if let Some(offsets) = buckets.place(slots) {
                return Self::from_parts(shape, law, occupancy, &values, side, offsets, slots);
            }
            slots = ((f64::from(slots) * GROWTH).ceil() as u32).min(cells);
        }
    }
}

/// Side of the offset table for `count` occupied cells (Zhou et al. 2008, section 5.2).
fn offset_side(count: usize) -> u32 {
    (count as f64 / 3.0).cbrt().ceil() as u32 + 9
}

/// The occupied cells by bucket.
struct Buckets {
    /// Start of each bucket's cells; one more than there are buckets.
    starts: Vec<u32>,
    /// Flat indices, bucket after bucket.
    keys: Vec<u32>,
    /// Buckets that hold any, the fullest first.
    order: Vec<u32>,
}

impl Buckets {
    fn new(shape: GridShape, keys: &[u32], side: u32) -> Self {
        let bucket_of = |key: u32| bucket(shape.cell(key as usize), side) as usize;
        let mut starts = vec![0u32; (side * side * side) as usize + 1];
        for &key in keys {
            starts[bucket_of(key) + 1] += 1;
        }
        let mut order: Vec<u32> = (0u32..).zip(&starts[1..]).filter(|(_, n)| **n > 0).map(|(b, _)| b).collect();
        order.sort_by_key(|&b| std::cmp::Reverse(starts[b as usize + 1]));
        for b in 1..starts.len() {
            starts[b] += starts[b - 1];
        }
        let mut next = starts.clone();
        let mut sorted = vec![0; keys.len()];
        for &key in keys {
            let place = &mut next[bucket_of(key)];
            sorted[*place as usize] = key;
            *place += 1;
        }
        Self { starts, keys: sorted, order }
    }

    /// The displacement number of every bucket, or nothing if one finds no place in a table of `slots`.
    fn place(&self, slots: u32) -> Option<Vec<u16>> {
        let mut taken = Slots(vec![0; slots.div_ceil(64) as usize]);
        let mut numbers = vec![0u16; self.starts.len() - 1];
        let mut homes = Vec::new();
        for &b in &self.order {
            let [start, end] = [0, 1].map(|i| self.starts[b as usize + i] as usize);
            homes.clear();
            homes.extend(self.keys[start..end].iter().map(|key| key % slots));
            numbers[b as usize] = (0..=u16::MAX).find(|&number| {
                let by = displacement(u32::from(number), slots);
                for (done, &home) in homes.iter().enumerate() {
                    let slot = displaced(home, by, slots);
                    if taken.taken(slot) {
                        // Give back what this number took.
                        homes[..done].iter().for_each(|&home| taken.free(displaced(home, by, slots)));
                        return false;
                    }
                    taken.take(slot);
                }
                true
            })?;
        }
        Some(numbers)
    }
}
