use glam::UVec3;
use proptest::prelude::*;

use super::*;
use crate::density::read;

fn file(name: &str) -> Vec<u8> {
    std::fs::read(path(name)).unwrap()
}

fn path(name: &str) -> std::path::PathBuf {
    std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/npy").join(name)
}

/// A file of one row of text as header, and data.
fn made(header: &str, data: &[u8]) -> Vec<u8> {
    [MAGIC, &[1, 0], &(header.len() as u16).to_le_bytes(), header.as_bytes(), data].concat()
}

#[test]
fn every_float_type_and_order_reads_the_same() {
    let names = ["f2", "f4", "f8", "f4_big_endian", "f4_fortran", "f8_big_endian_fortran", "f4_version3"];
    for name in names {
        let grid = read(path(&format!("{name}.npy")), None).unwrap();
        assert_eq!(grid.shape.dims, UVec3::new(4, 5, 6), "{name}");
        for index in 0..grid.shape.len() {
            let cell = grid.shape.cell(index);
            // make.py's formula: exact in every type.
            assert_eq!(grid.values[index], (cell.x + 10 * cell.y + 100 * cell.z) as f32 / 8.0, "{name}, cell {cell}");
        }
        assert_eq!(grid.placement, Placement { center: DVec3::ZERO, voxel_size: 1.0 / 6.0 });
        assert_eq!(grid.world_size(), 1.0);
        assert_eq!(grid.source, SourceInfo { active_voxels: 120, half: name == "f2", ..SourceInfo::default() });
    }
}

#[test]
fn negative_values_become_zero_and_are_counted() {
    let grid = read_npy(&file("negative.npy")).unwrap();
    assert_eq!(grid.get(UVec3::new(1, 2, 3)), 0.0);
    assert_eq!(grid.source.negative_voxels, 1);
}

#[test]
fn errors_say_what_is_wrong() {
    let message = |name| read(path(name), None).unwrap_err().to_string();
    for (name, expected) in [
        ("int.npy", "the array's elements are \"<i4\": save densities as 16-, 32- or 64-bit floats"),
        ("bool.npy", "the array's elements are \"|b1\""),
        ("complex.npy", "the array's elements are \"<c8\""),
        ("record.npy", "the array's elements are structures"),
        ("flat.npy", "the array has 2 dimensions: densities need three, [x, y, z]"),
        ("empty.npy", "an array of shape (2, 0, 2) has no cells"),
        ("infinite.npy", "the density of voxel (2, 3, 4) is inf"),
        ("make.py", "neither an OpenVDB (.vdb) nor a NumPy (.npy) file"),
        ("missing.npy", "cannot read "),
    ] {
        let message = message(name);
        assert!(message.contains(expected) && message.contains(name), "{name}: {message}");
    }
}

#[test]
fn false_shapes_ask_for_no_memory() {
    let error = |shape: &str| {
        let header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}");
        read_npy(&made(&header, &[0; 16])).unwrap_err().to_string()
    };
    let cut = "the file ends inside the array's values: it is cut short or damaged";
    assert_eq!(error("(1, 1, 5)"), cut);
    assert_eq!(error("(100000, 100000, 100000)"), cut);
    assert_eq!(error("(18446744073709551615, 18446744073709551615, 2)"), cut);
    assert_eq!(error("(1, 1, 3)"), "the file is damaged: 16 bytes of values, more than a shape of (1, 1, 3) holds");
    assert!(error("(1, 1, -4)").contains("is no shape"));
    assert!(error("(1, 1, 18446744073709551616)").contains("is no shape"));
    assert!(error("4").contains("no tuple"));
}

#[test]
fn every_truncation_is_an_error() {
    let whole = file("f4_fortran.npy");
    for length in 0..whole.len() {
        assert!(read_npy(&whole[..length]).is_err(), "{length} of {} bytes", whole.len());
    }
}

#[test]
fn written_arrays_read_back() {
    for dims in [[1, 1, 1], [3, 5, 2], [1000, 1, 1]] {
        let count = dims.iter().product::<u64>() as usize;
        let (shape, mut values) = allocate(dims, 0.0, MAX_CELLS).unwrap();
        (0..count).for_each(|i| values[i] = i as f32 / 7.0);
        let placement = Placement { center: DVec3::ZERO, voxel_size: 1.0 / f64::from(shape.longest()) };
        let source = SourceInfo { active_voxels: count as u64, ..Default::default() };
        let grid = DensityGrid { shape, values, placement, source };
        let bytes = write_npy(&grid);
        assert_eq!((bytes.len() - 4 * count) % 64, 0, "values are aligned");
        assert_eq!(read_npy(&bytes).unwrap(), grid);
    }
}

proptest! {
    #[test]
    fn no_header_panics(header in "[ -~]{0,60}('descr'|'shape'|'fortran_order')? ?: ?[ -~]{0,30}", data in any::<[u8; 8]>()) {
        let _ = read_npy(&made(&header, &data));
    }

    #[test]
    fn no_damage_panics(at in 0usize..200, byte in any::<u8>()) {
        let mut bytes = file("f8.npy");
        bytes[at] = byte;
        let _ = read_npy(&bytes);
    }
}
