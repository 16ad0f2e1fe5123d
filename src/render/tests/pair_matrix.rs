use super::*;
use crate::reference::transport;
use crate::render::footprint::Footprints;
use crate::render::frame::uniform;
use crate::render::lighting::LightingUniform;
use crate::render::pair_matrix::{self, Bindings};
use crate::render::prepare::linear_sampler;

/// The matrix of the pass, and the coarse density it saw.
fn run(gpu: &Gpu, frame: &SmokeFrame, sigma: f32) -> (Vec<f32>, Grid) {
    let (coarse, uploaded) = coarse_frame(gpu, frame);
    let lighting = LightingUniform { sigma_mean: sigma, ..Default::default() };
    let count = rbfs(frame).len();
    let matrix = gpu.buffer(&vec![0.0_f32; count * count]);
    let pass = &gpu.passes().pair_matrix;
    let bindings = Bindings {
        frame: &uploaded,
        lighting: &uniform(gpu.device(), gpu.queue(), "test", lighting),
        footprints: &Footprints::buffer(gpu.device(), gpu.queue()),
        sampler: &linear_sampler(gpu.device()),
        matrix: &matrix,
    };
    let bind_group = pair_matrix::bind(pass, bindings, gpu.device(), gpu.cache());
    gpu.run(pass, Job { bind_group, workgroups: pair_matrix::workgroups(&uploaded) });
    let matrix = gpu.read_floats(&matrix);
    for row in matrix.chunks(count) {
        // Energy: all that is seen is some RBF. 40 roundings.
        let sum: f32 = row.iter().sum();
        assert!((sum - 1.0).abs() < 1e-5 && row.iter().all(|k| *k >= 0.0), "{sigma}: {sum}");
    }
    (matrix, coarse)
}

#[test]
fn pair_matrix_matches_its_twin() {
    let (gpu, frame) = (Gpu::new(), fixture());
    for sigma in [0.01, 5.0, 80.0] {
        let (found, coarse) = run(&gpu, &frame, sigma);
        let expected = transport::pair_matrix(rbfs(&frame), &coarse, sigma.into());
        assert_close(&format!("pair matrix at extinction {sigma}"), HALF, widen(&found), expected);
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
