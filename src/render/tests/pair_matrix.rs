use super::*;
use crate::reference::transport;
use crate::render::footprint::Footprints;
use crate::render::frame::uniform;
use crate::render::pair_matrix::{self, Bindings, ROW_BYTES};
use crate::render::prepare::linear_sampler;
use crate::sh::COEFFICIENTS;

/// The matrix of the pass and what goes with its rows, and the coarse density it saw.
fn run(gpu: &Gpu, frame: &SmokeFrame, sigma: f32) -> ([Vec<f32>; 2], Grid) {
    let (coarse, uploaded) = coarse_frame(gpu, frame);
    let lighting = LightingUniform { sigma_mean: sigma, coefficients: 16, ..Default::default() };
    let count = rbfs(frame).len();
    let matrix = gpu.buffer(&vec![0.0_f32; count * count]);
    let rows = gpu.buffer(&vec![0_u8; count * ROW_BYTES as usize]);
    let pass = &gpu.passes().pair_matrix;
    let bindings = Bindings {
        frame: &uploaded,
        lighting: &uniform(gpu.device(), gpu.queue(), "test", lighting),
        footprints: &Footprints::buffer(gpu.device(), gpu.queue()),
        sampler: &linear_sampler(gpu.device()),
        matrix: &matrix,
        rows: &rows,
    };
    let bind_group = pair_matrix::bind(pass, bindings, gpu.device(), gpu.cache());
    gpu.run(pass, Job { bind_group, workgroups: pair_matrix::workgroups(&uploaded) });
    let [matrix, rows] = [matrix, rows].map(|buffer| gpu.read_floats(&buffer));
    for row in matrix.chunks(count) {
        // Energy: all that is seen is some RBF. 40 roundings.
        let sum: f32 = row.iter().sum();
        assert!((sum - 1.0).abs() < 1e-5 && row.iter().all(|k| *k >= 0.0), "{sigma}: {sum}");
    }
    assert!(rows.iter().all(|value| value.is_finite()), "{sigma}");
    ([matrix, rows], coarse)
}

#[test]
fn pair_matrix_matches_its_twin() {
    let (gpu, frame) = (Gpu::new(), fixture());
    for sigma in [0.01, 5.0, 80.0] {
        let ([matrix, rows], coarse) = run(&gpu, &frame, sigma);
        let expected = transport::pair_matrix(rbfs(&frame), &coarse, sigma.into());
        assert_close(&format!("pair matrix at extinction {sigma}"), HALF, widen(&matrix), expected.iter().copied());
        let expected = twin_rows(rbfs(&frame), &coarse, sigma.into(), &expected);
        let weights = |rows: &[f64]| rows.iter().step_by(COEFFICIENTS).copied().collect::<Vec<_>>();
        let views = |rows: &[f64]| rows.chunks(COEFFICIENTS).flat_map(|row| row[1..].to_vec()).collect::<Vec<_>>();
        let found: Vec<f64> = widen(&rows).collect();
        assert_close(&format!("weights at extinction {sigma}"), HALF, weights(&found), weights(&expected));
        assert_close(&format!("surroundings at extinction {sigma}"), FILTERED, views(&found), views(&expected));
    }
}

#[test]
fn rows_sum_to_one_at_every_extinction() {
    let (gpu, mut frame) = (Gpu::new(), fixture());
    // Coincident centres see each other as they see themselves.
    frame.rbfs.rbfs[1].center = frame.rbfs.rbfs[0].center;
    for sigma in [0.0, 1e-20, 1e6, 1e30] {
        run(&gpu, &frame, sigma);
    }
}
