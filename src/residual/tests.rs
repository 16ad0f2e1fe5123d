use glam::UVec3;
use proptest::prelude::*;

use super::*;
use crate::density::GridShape;

fn shape(x: u32, y: u32, z: u32) -> GridShape {
    GridShape::new(UVec3::new(x, y, z))
}

#[test]
fn a_linear_law_by_hand() {
    let law = QuantizationLaw { max: 1.27, exponent: 1.0 };
    assert_eq!(law.decode(0), 0.0);
    assert_eq!(law.decode(127), 1.27);
    assert!((law.decode(-50) + 0.5).abs() < 1e-6);
    assert_eq!(law.encode(0.024), 2);
    assert_eq!(law.encode(-0.026), -3);
    assert_eq!(law.encode(9.0), 127);
    assert_eq!(law.encode(0.004), 0);
    assert_eq!(law.encode(f32::NAN), 0);
}

proptest! {
    #[test]
    fn encoding_takes_the_nearest_code(residual in -3f32..3.0, exponent in 0.5f32..3.0) {
        let law = QuantizationLaw { max: 2.0, exponent };
        let error = |q: i8| (law.decode(q) - residual).abs();
        let nearest = (-127..=127).map(error).fold(f32::INFINITY, f32::min);
        prop_assert!(error(law.encode(residual)) <= nearest);
    }

    #[test]
    fn codes_survive_decoding(q in -127i8..=127, max in 1e-3f32..1e3, exponent in 0.5f32..3.0) {
        let law = QuantizationLaw { max, exponent };
        prop_assert_eq!(law.encode(law.decode(q)), q);
    }
}

#[test]
fn an_empty_residual() {
    let empty = HashedResidual::empty(shape(5, 6, 7));
    assert_eq!(empty.count(), 0);
    assert_eq!(empty.get(UVec3::new(4, 5, 6)), 0.0);
    assert_eq!(empty.decode_all(), vec![0.0; 210]);
    assert!(empty.values().is_empty());
}

#[cfg(feature = "bake")]
mod building {
    use super::*;

    const LAW: QuantizationLaw = QuantizationLaw { max: 2.0, exponent: 1.5 };

    /// Builds, and checks every cell, the way through a file, and that building again gives the same.
    fn round_trip(shape: GridShape, bytes: &[i8]) -> HashedResidual {
        let hashed = HashedResidual::build(shape, bytes, LAW).unwrap();
        for (index, &byte) in bytes.iter().enumerate() {
            assert_eq!(hashed.quantized(shape.cell(index)), byte, "cell {index}");
        }
        let decoded: Vec<f32> = bytes.iter().map(|&q| LAW.decode(q)).collect();
        assert_eq!(hashed.decode_all(), decoded);
        let stored: Vec<i8> = bytes.iter().copied().filter(|&q| q != 0).collect();
        assert_eq!(hashed.values(), stored);
        let loaded = HashedResidual::from_parts(
            shape,
            LAW,
            hashed.occupancy().to_vec(),
            &stored,
            hashed.offset_side(),
            hashed.offsets().to_vec(),
            hashed.slots(),
        );
        assert_eq!(loaded.as_ref(), Ok(&hashed));
        assert_eq!(HashedResidual::build(shape, bytes, LAW).as_ref(), Ok(&hashed));
        hashed
    }

    #[test]
    fn nothing_and_everything() {
        let shape = shape(13, 9, 11);
        assert_eq!(round_trip(shape, &vec![0; shape.len()]).count(), 0);
        let full: Vec<i8> = (0..shape.len()).map(|i| (i % 127) as i8 + 1).collect();
        let hashed = round_trip(shape, &full);
        // A full grid is its own table.
        assert_eq!(hashed.slots(), shape.len() as u32);
        assert!(hashed.offsets().iter().all(|&number| number == 0));
    }

    #[test]
    fn one_cell_anywhere() {
        let shape = shape(40, 3, 2);
        for index in 0..shape.len() {
            let mut bytes = vec![0; shape.len()];
            bytes[index] = -127;
            // Zhou et al.: ceil(cbrt(1/3)) + 9.
            assert_eq!(round_trip(shape, &bytes).offset_side(), 10);
        }
        round_trip(super::shape(1, 1, 1), &[5]);
    }

    #[test]
    fn lattices_that_fall_into_few_buckets() {
        let shape = shape(150, 30, 30);
        for step in 2..16 {
            let bytes: Vec<i8> = (0..shape.len())
                .map(|index| if (shape.cell(index) % step).cmpeq(UVec3::ZERO).all() { 7 } else { 0 })
                .collect();
            round_trip(shape, &bytes);
        }
    }

    #[test]
    fn a_table_of_half_a_million() {
        let shape = shape(100, 100, 100);
        let bytes: Vec<i8> =
            (0..1_000_000u32).map(|i| if i.wrapping_mul(0x9E37_79B1) >> 31 == 0 { 3 } else { 0 }).collect();
        let hashed = HashedResidual::build(shape, &bytes, LAW).unwrap();
        assert_eq!(hashed.count() as usize, bytes.iter().filter(|&&q| q != 0).count());
        assert!(f64::from(hashed.slots()) < 2.1 * f64::from(hashed.count()));
        assert!((0..1_000_000).step_by(37).all(|i| hashed.quantized(shape.cell(i)) == bytes[i]));
    }

    #[test]
    fn bad_input_is_refused() {
        let shape = shape(2, 2, 2);
        assert!(matches!(HashedResidual::build(shape, &[1; 7], LAW), Err(ResidualError::Length { .. })));
        assert!(matches!(HashedResidual::build(shape, &[-128; 8], LAW), Err(ResidualError::Value { .. })));
        let law = QuantizationLaw { max: f32::NAN, exponent: 1.0 };
        assert!(matches!(HashedResidual::build(shape, &[1; 8], law), Err(ResidualError::Law { .. })));
        let huge = super::shape(1 << 16, 1 << 16, 1);
        assert_eq!(HashedResidual::build(huge, &[], LAW), Err(ResidualError::GridTooLarge(1 << 32)));
    }

    #[test]
    fn packed_offsets_are_the_offsets() {
        let shape = shape(30, 30, 30);
        let bytes: Vec<i8> = (0..shape.len() as i32).map(|i| (i % 5 - 2) as i8).collect();
        let hashed = HashedResidual::build(shape, &bytes, LAW).unwrap();
        let packed = hashed.packed_offsets();
        for (b, &number) in hashed.offsets().iter().enumerate() {
            assert_eq!((packed[b >> 1] >> (16 * (b & 1))) & 0xFFFF, u32::from(number));
        }
    }

    #[test]
    fn parts_that_do_not_fit_are_refused() {
        let shape = shape(10, 10, 10);
        let bytes: Vec<i8> = (0..1000).map(|i| (i % 3) as i8).collect();
        let h = HashedResidual::build(shape, &bytes, LAW).unwrap();
        let (occupancy, values, offsets) = (h.occupancy().to_vec(), h.values(), h.offsets().to_vec());
        let load = |occupancy: &[u32], values: &[i8], side, offsets: &[u16], slots| {
            HashedResidual::from_parts(shape, LAW, occupancy.to_vec(), values, side, offsets.to_vec(), slots)
        };
        let (side, slots) = (h.offset_side(), h.slots());
        assert!(load(&occupancy, &values, side, &offsets, slots).is_ok());

        assert!(matches!(load(&occupancy[1..], &values, side, &offsets, slots), Err(ResidualError::Length { .. })));
        assert!(matches!(load(&occupancy, &values[1..], side, &offsets, slots), Err(ResidualError::Length { .. })));
        assert!(matches!(load(&occupancy, &values, side + 1, &offsets, slots), Err(ResidualError::Length { .. })));
        assert!(matches!(load(&occupancy, &values, u32::MAX, &offsets, slots), Err(ResidualError::Length { .. })));
        assert!(matches!(load(&occupancy, &values, 0, &[], slots), Err(ResidualError::TableLength { .. })));
        for slots in [0, h.count() - 1, 1001, u32::MAX] {
            assert!(matches!(load(&occupancy, &values, side, &offsets, slots), Err(ResidualError::TableLength { .. })));
        }
        let mut padded = occupancy.clone();
        *padded.last_mut().unwrap() |= 1 << 31;
        assert_eq!(load(&padded, &values, side, &offsets, slots), Err(ResidualError::OccupancyPadding));
        let mut zero = values.clone();
        zero[4] = 0;
        assert!(matches!(load(&occupancy, &zero, side, &offsets, slots), Err(ResidualError::Value { .. })));
        // Another table length: other slots, so cells meet.
        let tight = h.count();
        assert!(matches!(load(&occupancy, &values, side, &offsets, tight), Err(ResidualError::Collision(_))));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn every_cell_gives_its_value_back(
            x in 1u32..24, y in 1u32..24, z in 1u32..24, filled in 0u64..=16, seed: u64,
        ) {
            let shape = shape(x, y, z);
            let mut state = seed;
            let mut next = || {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                state >> 33
            };
            let bytes: Vec<i8> = (0..shape.len())
                .map(|_| if next() % 16 < filled { (next() % 255) as i8 } else { 0 })
                .map(|q| q.max(-127))
                .collect();
            round_trip(shape, &bytes);
        }

        #[test]
        fn damaged_offsets_are_found_or_harmless(at in 0usize..1000, number: u16) {
            let shape = shape(12, 12, 12);
            let bytes: Vec<i8> = (0..1728).map(|i| if i % 7 < 3 { 9 } else { 0 }).collect();
            let h = HashedResidual::build(shape, &bytes, LAW).unwrap();
            let mut offsets = h.offsets().to_vec();
            let at = at % offsets.len();
            offsets[at] = number;
            let loaded = HashedResidual::from_parts(
                shape, LAW, h.occupancy().to_vec(), &h.values(), h.offset_side(), offsets, h.slots(),
            );
            match loaded {
                Ok(loaded) => prop_assert_eq!(loaded.decode_all(), h.decode_all()),
                Err(error) => prop_assert!(matches!(error, ResidualError::Collision(_))),
            }
        }
    }
}
