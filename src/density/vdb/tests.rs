//! The files of tests/data/vdb, made by OpenVDB, against what OpenVDB itself reads from them (expected.txt).

use std::path::PathBuf;

use glam::{DVec3, UVec3};
use proptest::prelude::*;

use super::*;
use crate::density::read;

/// Keeps damaged files from asking for gigabytes: 2²³ cells, above the largest test file's.
const FEW_CELLS: u64 = 1 << 23;

fn path(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/data/vdb").join(name)
}

fn file(name: &str) -> Vec<u8> {
    std::fs::read(path(name)).unwrap()
}

fn error(name: &str, grid: Option<&str>) -> String {
    read_vdb(&file(name), grid).unwrap_err().to_string()
}

/// What a line of expected.txt says, as make.cpp writes it.
fn expected_line(line: &str) -> (String, DensityGrid, u32) {
    let fields: Vec<&str> = line.split_whitespace().collect();
    let int = |i: usize| fields[i].parse::<i32>().unwrap();
    let real = |i: usize| fields[i].parse::<f64>().unwrap();
    let grid = DensityGrid {
        shape: super::super::GridShape::new(UVec3::new(int(2) as u32, int(3) as u32, int(4) as u32)),
        values: vec![],
        placement: super::super::Placement { voxel_size: real(8), center: DVec3::new(real(9), real(10), real(11)) },
        source: SourceInfo {
            grid: fields[1].into(),
            index_min: IVec3::new(int(5), int(6), int(7)),
            active_voxels: int(12) as u64,
            leaves: int(13) as u64,
            background: fields[14].parse().unwrap(),
            half: fields[15] == "1",
            negative_voxels: int(16) as u64,
        },
    };
    (fields[0].into(), grid, u32::from_str_radix(fields[17], 16).unwrap())
}

#[test]
fn every_grid_reads_as_openvdb_reads_it() {
    let expected = String::from_utf8(file("expected.txt")).unwrap();
    assert_eq!(expected.lines().count(), 19);
    for line in expected.lines() {
        let (name, expected, crc) = expected_line(line);
        let what = format!("{name}, grid {}", expected.source.grid);
        let grid = read(path(&name), Some(&expected.source.grid)).unwrap_or_else(|error| panic!("{what}: {error}"));
        assert_eq!(grid.shape, expected.shape, "{what}");
        assert_eq!(grid.source, expected.source, "{what}");
        let distance = (grid.placement.center - expected.placement.center).length();
        // OpenVDB may add in another order: a few roundings of numbers up to 4100.
        assert!(distance < 1e-12 * (1.0 + expected.placement.center.length()), "{what}: {distance}");
        assert_eq!(grid.placement.voxel_size, expected.placement.voxel_size, "{what}");
        // Every bit of every voxel.
        let bytes: Vec<u8> = grid.values.iter().flat_map(|value| value.to_le_bytes()).collect();
        assert_eq!(crc32fast::hash(&bytes), crc, "{what}");
    }
}

#[test]
fn values_lie_where_they_belong() {
    // One tile, voxel or background value from each level of make.cpp's tree, by file index.
    let grid = read_vdb(&file("tiles.vdb"), None).unwrap();
    let at = |x, y, z| grid.get((IVec3::new(x, y, z) - grid.source.index_min).as_uvec3());
    assert_eq!(at(4087, 7, 7), 1.5, "active tile of 8³");
    assert_eq!(at(4088, 8, 0), 0.125, "inactive tile of 8³");
    assert_eq!(at(4000, 100, 200), 0.7, "active tile of 128³");
    assert_eq!(at(4096, 0, 0), 0.9, "inactive tile of the root");
    assert_eq!(at(4090, 5, 5), 2.0, "voxel");
    assert_eq!(at(4091, 5, 5), 0.0, "negative inactive voxel");
    assert_eq!(at(4092, 5, 5), 0.3, "inactive voxel beside it");
    assert_eq!(at(4100, -3, 5), 3.0, "voxel of another node");
    assert_eq!(at(4099, -3, 5), 0.3, "background");
}

#[test]
fn grids_are_chosen_by_name() {
    let several = file("several.vdb");
    assert_eq!(read_vdb(&several, None).unwrap().source.grid, "density");
    let heat = read_vdb(&several, Some("heat")).unwrap();
    let flame = read_vdb(&several, Some("flame")).unwrap();
    assert_eq!(heat.values, flame.values, "an instance of heat");
    assert_eq!(flame.placement.center - heat.placement.center, DVec3::new(1.0, 2.0, 3.0), "placed by itself");

    assert_eq!(
        error("several.vdb", Some("smoke")),
        "there is no grid named \"smoke\". The file has: vel (vec3s), heat (float), density (float), flame (float)"
    );
    assert!(error("several.vdb", Some("vel")).contains("the grid \"vel\" holds vec3s"));
    assert!(
        error("two.vdb", None)
            .contains("several others: name the one to use. The file has: heat (float), flame (float)")
    );
    assert!(error("same_name.vdb", Some("density")).contains("density[0] (float), density[1] (float)"));
    assert_eq!(read_vdb(&file("same_name.vdb"), Some("density[1]")).unwrap().source.grid, "density[1]");
    assert_eq!(error("no_grids.vdb", None), "there is no grid of floats. The file has: no grids");
}

#[test]
fn errors_say_what_is_wrong() {
    for (name, expected) in [
        ("int.vdb", "the grid \"density\" holds int32: a density is a grid of float or double"),
        ("level_set.vdb", "the grid \"surface\" is a level set"),
        ("empty.vdb", "the grid \"density\" is empty: it has no active voxels"),
        ("nan.vdb", "the density of voxel (5, 7, 6) is NaN"),
        ("huge.vdb", "a box of 4001 × 4001 × 4001 cells is too large"),
        ("stretched.vdb", "the transform of grid \"density\" scales the axes differently"),
        ("mirrored.vdb", "the transform of grid \"density\" mirrors"),
        ("rotated.vdb", "the transform of grid \"density\" rotates"),
        ("frustum.vdb", "the grid's transform is a camera frustum"),
        ("make.cpp", "neither an OpenVDB (.vdb) nor a NumPy (.npy) file"),
    ] {
        let message = read(path(name), None).unwrap_err().to_string();
        assert!(message.contains(expected) && message.contains(name), "{name}: {message}");
    }
}

#[test]
fn file_versions() {
    let mut bytes = file("half_blosc.vdb");
    let newest = read_vdb(&bytes, None).unwrap();
    for version in 222..=225u32 {
        bytes[8..12].copy_from_slice(&version.to_le_bytes());
        assert_eq!(read_vdb(&bytes, None).unwrap(), newest, "version {version}");
    }
    for version in [221u32, 226] {
        bytes[8..12].copy_from_slice(&version.to_le_bytes());
        let message = read_vdb(&bytes, None).unwrap_err().to_string();
        assert!(message.starts_with(&format!("OpenVDB file version {version} is not supported")), "{message}");
    }
}

#[test]
fn truncated_files_are_errors() {
    for name in ["half_blosc.vdb", "float_zip.vdb", "stream.vdb"] {
        let whole = file(name);
        for length in (0..whole.len()).step_by(7).chain(whole.len() - 20..whole.len()) {
            // The file without offsets is cut inside its second grid at the latest.
            assert!(read_within(&whole[..length], Some("density"), FEW_CELLS).is_err(), "{name}: {length} bytes");
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    /// Damage may go unnoticed, since the format has no checksums, but never panics, hangs or asks for much memory.
    #[test]
    fn no_damage_panics(
        file_index in 0usize..6,
        damage in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), 0u8..3), 1..6),
        cut in prop::option::of(any::<prop::sample::Index>()),
    ) {
        const FILES: [&str; 6] =
            ["half_blosc.vdb", "float_zip.vdb", "double_half.vdb", "inactive.vdb", "several.vdb", "stream.vdb"];
        let mut bytes = file(FILES[file_index]);
        for (place, byte, region) in damage {
            // Most of a file is the masks of large nodes: aim also at its first bytes and at its last.
            let (start, length) = match region {
                0 => (0, bytes.len()),
                1 => (0, 1200),
                _ => (bytes.len() - 3000, 3000),
            };
            bytes[start + place.index(length)] = byte;
        }
        if let Some(cut) = cut {
            bytes.truncate(cut.index(bytes.len()));
        }
        let _ = read_within(&bytes, None, FEW_CELLS);
    }
}
