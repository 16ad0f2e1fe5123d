use clap::Parser;
use glam::{DVec3, IVec3, UVec3};

use super::*;
use crate::bundle::SmokeFrame;
use crate::density::{DensityGrid, GridShape, Placement, SourceInfo};
use crate::rbf::{Rbf, RbfModel};
use crate::residual::HashedResidual;

const SHAPE: GridShape = GridShape::new(UVec3::splat(24));
const FRAMES: usize = 4;

/// Blobs that rise and turn, as Gaussians and nothing else.
fn frame(time: f32) -> SmokeFrame {
    let rbf = |i: u8| {
        let i = f32::from(i);
        let angle = 2.4 * i + 0.1 * time;
        let out = 0.05 + 0.012 * i;
        let center = [out * angle.cos(), -0.25 + 0.04 * i + 0.02 * time, out * angle.sin()];
        Rbf { center, radius: 0.08 + 0.004 * i, weight: 1.2 }
    };
    SmokeFrame::new(RbfModel { rbfs: (0..10).map(rbf).collect() }, HashedResidual::empty(SHAPE))
}

/// A file of the density's values: x is the slowest index.
fn npy(path: &Path, density: &[f32]) {
    let [x, y, z] = SHAPE.dims.to_array();
    let header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({x}, {y}, {z}), }}");
    let mut bytes = b"\x93NUMPY\x01\x00\x76\x00".to_vec();
    bytes.extend(format!("{header:117}\n").as_bytes());
    for (x, y, z) in (0..x).flat_map(|x| (0..y).flat_map(move |y| (0..z).map(move |z| (x, y, z)))) {
        bytes.extend(density[SHAPE.index(UVec3::new(x, y, z))].to_le_bytes());
    }
    std::fs::write(path, bytes).unwrap();
}

/// Writes a bundle of these moments.
fn bundle(path: &Path, times: [f32; FRAMES]) {
    let frames = times.map(frame);
    let max_density = frames.iter().flat_map(|frame| frame.decode()).fold(0.0, f32::max);
    let placement = Placement { center: DVec3::ZERO, voxel_size: 1.0 / 24.0 };
    let frames = Vec::from(frames).into();
    let animation = SmokeAnimation { shape: SHAPE, placement, frames_per_second: 30.0, max_density, frames };
    std::fs::write(path, bundle::write(&animation).unwrap()).unwrap();
}

#[derive(Parser)]
struct Command {
    #[command(flatten)]
    args: FlickerArgs,
}

/// Runs the study in a folder, with the words of `line`; names with a dot are files there.
fn run_study(folder: &Path, line: &str) -> anyhow::Result<Report> {
    let word = |word: &str| if word.contains('.') { folder.join(word).into_os_string() } else { word.into() };
    study(&Command::try_parse_from(["flicker".into()].into_iter().chain(line.split_whitespace().map(word)))?.args)
}

/// Densities, three bundles of them and a scene.
fn files(folder: &Path) {
    for time in 0..FRAMES {
        npy(&folder.join(format!("{time}.npy")), &frame(time as f32).decode());
    }
    bundle(&folder.join("exact.smoke"), [0.0, 1.0, 2.0, 3.0]);
    bundle(&folder.join("late.smoke"), [-1.0, 0.0, 1.0, 2.0]);
    bundle(&folder.join("halting.smoke"), [0.0, 0.0, 2.0, 2.0]);
    let scene =
        DEFAULT_SCENE.replace("[0, 0, 6]", "[0, 0.2, 2.5]").replace("2.49", "3").replace("[96, 128]", "[20, 24]");
    std::fs::write(folder.join("scene.json"), scene).unwrap();
}

#[test]
fn exact_frames_hardly_flicker_and_halting_ones_do() {
    let dir = tempfile::tempdir().unwrap();
    files(dir.path());
    // Frames are sorted whatever their order on the command line.
    let line = "exact.smoke late.smoke halting.smoke --density 2.npy 0.npy 3.npy 1.npy --scene scene.json";
    let report = run_study(dir.path(), line).unwrap();
    assert_eq!((report.frames, report.size), (FRAMES, [20, 24]));
    for row in &report.bundles {
        println!("{}: {:?} {:.4}, {:.4}", row.bundle, row.flicker, row.error_mean, row.error_max);
        assert_eq!((row.errors.len(), row.changes.len()), (FRAMES, FRAMES - 1));
        assert!(row.error_max >= row.error_mean && row.error_mean > 0.0);
    }
    let [exact, late, halting] = report.bundles.as_slice() else { panic!() };
    let flicker = |row: &Row| row.flicker.unwrap();
    // What the method itself takes with ten Gaussians.
    assert!(exact.error_max < 0.04 && flicker(exact) < 0.12);
    // Late by a frame is wrong, and steadily so; a frame held and one leapt over change by as much as the smoke.
    assert!(late.error_mean > 2.0 * exact.error_mean && flicker(late) < 0.3);
    assert!(flicker(halting) > 0.8);
    // Bundles are not mixed up, nor frames: alone, the same.
    let alone = run_study(dir.path(), "late.smoke --density 0.npy 1.npy 2.npy 3.npy --scene scene.json").unwrap();
    assert_eq!(alone.bundles[0].errors, late.errors);
}

#[test]
fn a_density_is_where_its_box_places_it() {
    let scene = Scene::parse(DEFAULT_SCENE, Path::new("")).unwrap().0;
    let truth = Truth::new(&scene, 8).unwrap();
    let placement = Placement { center: DVec3::new(0.3, -0.2, 0.1), voxel_size: 0.1 };
    let source = SourceInfo { index_min: IVec3::new(-3, 5, 7), ..Default::default() };
    let grid = DensityGrid { shape: SHAPE, values: frame(0.0).decode(), placement, source };
    let far = grid.reframed(IVec3::new(-9, 1, 6), GridShape::new(UVec3::new(31, 30, 40)));
    let [own, far] = [grid, far].map(|grid| truth.picture(&grid));
    // The steps are others.
    let change = image_error([&own.radiance, &own.radiance], [&far.radiance, &far.radiance], &far.alpha).unwrap();
    println!("{change:?}");
    assert!(change.relative < 2e-3 && change.pixels > 500, "{change:?}");
}

#[test]
fn refusals() {
    let dir = tempfile::tempdir().unwrap();
    files(dir.path());
    let scene = std::fs::read_to_string(dir.path().join("scene.json")).unwrap();
    std::fs::write(dir.path().join("wide.json"), scene.replace("\"file\"", "\"width\", \"width_m\": 3")).unwrap();
    let lights = "\"lights\": [{ \"kind\": \"point\", \"pos\": [0, 0, 3], \"intensity\": 9 }], \"eye\"";
    std::fs::write(dir.path().join("lit.json"), scene.replace("\"eye\"", lights)).unwrap();
    for (line, expected) in [
        ("exact.smoke --density 0.npy 1.npy", "has 4 frames, but 2 density files"),
        ("none.smoke --density 0.npy 1.npy", "none.smoke"),
        ("exact.smoke --density 0.npy 1.npy --scene wide.json", "\"file\" is needed"),
        ("exact.smoke --density 0.npy 1.npy --scene lit.json", "by its environment alone"),
    ] {
        let message = format!("{:#}", run_study(dir.path(), line).err().unwrap());
        assert!(message.contains(expected), "{line}: {message}");
    }
}
