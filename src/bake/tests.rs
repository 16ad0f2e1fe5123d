mod sequence;

use glam::{DVec3, UVec3};

use super::*;
use crate::bundle::SmokeFrame;
use crate::density::{GridShape, Placement, SourceInfo};

/// Two blobs and a ripple too fine for the Gaussians, so that there is something to leave to the residual.
fn grid() -> DensityGrid {
    let shape = GridShape::new(UVec3::new(18, 24, 15));
    let values = (0..shape.len()).map(|index| {
        let x = shape.center(shape.cell(index));
        let blob = |at: [f32; 3], r: f32| (-x.distance_squared(at.into()) / (r * r)).exp();
        let ripple = 1.0 + 0.2 * (60.0 * x.x).sin() * (50.0 * x.y).cos();
        let density = (2.0 * blob([0.0, -0.2, 0.05], 0.15) + blob([0.1, 0.15, -0.1], 0.2)) * ripple;
        if density > 0.01 { density } else { 0.0 }
    });
    DensityGrid {
        shape,
        values: values.collect(),
        placement: Placement { center: DVec3::new(1.0, 2.0, 3.0), voxel_size: 0.125 },
        source: SourceInfo { grid: "density".into(), active_voxels: 77, leaves: 5, ..SourceInfo::default() },
    }
}

fn settings() -> BakeSettings {
    BakeSettings { target: FitTarget::Count(12), ..BakeSettings::default() }
}

fn bake_quietly(grid: &DensityGrid, settings: &BakeSettings) -> Baked {
    bake(grid, settings, &|_| {}).unwrap()
}

fn frame(animation: &SmokeAnimation) -> &SmokeFrame {
    animation.frames.get(0).unwrap()
}

#[test]
fn the_bundle_decodes_to_the_grid() {
    let grid = grid();
    for residual_exponent in [1.0, 1.5, 2.0] {
        let Baked { animation, file, report } =
            bake_quietly(&grid, &BakeSettings { residual_exponent: Some(residual_exponent), ..settings() });
        assert_eq!(bundle::read(&file).unwrap(), animation);
        assert_eq!((animation.shape, animation.placement), (grid.shape, grid.placement));

        let Worst { error: half_steps, .. } = report.quantization.worst_half_steps;
        // Thousands of cells: some residual lies near the middle of two codes.
        assert!((0.8..=1.0).contains(&half_steps), "{half_steps}");
        // What the GPU will add up in 32 bits, against the input: the worst reported error plus the rounding of the sum.
        let decoded = frame(&animation).decode();
        let worst = grid.values.iter().zip(&decoded).map(|(d, x)| f64::from((d - x).abs())).fold(0.0, f64::max);
        assert!(worst <= report.quantization.worst_density.error + 1e-6, "{worst}");
        assert_eq!(animation.max_density, decoded.iter().copied().fold(0.0, f32::max));
        // The widest gap is that below the largest code: max · (1 − (126/127)^exponent).
        let step = f64::from(report.quantization.max) * (1.0 - (126.0f64 / 127.0).powf(residual_exponent.into()));
        assert!(report.quantization.worst_density.error <= 0.5 * step * (1.0 + 1e-4));
        assert!(report.quantization.rms_relative < 0.01);
    }
}

#[test]
fn the_report_agrees_with_the_bundle() {
    let grid = grid();
    let Baked { animation, file, report } = bake_quietly(&grid, &settings());
    let frame = frame(&animation);
    assert_eq!((report.source.active_voxels, report.source.leaves, report.source.dims), (77, 5, [18, 24, 15]));
    assert_eq!(report.source.max_density, grid.max());
    assert!(report.source.min_density > 0.01);
    assert_eq!(report.fit.rbfs, frame.rbfs.rbfs.len());
    let error = f64::from(crate::rbf::fit::relative_error(grid.shape, &grid.values, &frame.rbfs));
    assert!((report.fit.error - error).abs() < 1e-6);
    let frame_bytes = bundle::BundleHeader::read(&file).unwrap().frames[0].length;
    assert_eq!(report.bytes.file as u64, frame_bytes);
    assert_eq!(report.residual.count, frame.residual.count());
    // Quantisation is a small part of what the Gaussians leave out: 127 steps a side.
    assert!(report.picture.quantized > 0.0);
    assert!(report.picture.quantized < 0.05 * report.picture.without_residual);
    let json = serde_json::to_value(&report).unwrap();
    assert_eq!(json["quantization"]["worst_half_steps"]["cell"].as_array().unwrap().len(), 3);
}

#[test]
fn the_same_seed_gives_the_same_bytes() {
    assert_eq!(bake_quietly(&grid(), &settings()).file, bake_quietly(&grid(), &settings()).file);
}

#[test]
fn no_smoke_is_fine() {
    let mut grid = grid();
    grid.values.fill(0.0);
    let Baked { animation, report, .. } = bake_quietly(&grid, &settings());
    assert!(frame(&animation).decode().iter().all(|&d| d == 0.0));
    assert_eq!((report.fit.error, report.quantization.rms_relative, report.picture.quantized), (0.0, 0.0, 0.0));
    assert_eq!(report.source.min_density, 0.0);
}

#[test]
fn boxes_beyond_the_format_fail_before_the_fit() {
    let mut grid = grid();
    grid.shape = GridShape::new(UVec3::new(4097, 1, 1));
    let error = bake(&grid, &settings(), &|_| panic!("the fit has begun")).unwrap_err();
    assert!(error.to_string().contains("a side has 1 to 4096"), "{error}");
}
