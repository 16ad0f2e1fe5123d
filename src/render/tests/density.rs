use super::*;
use crate::render::density;

#[test]
fn density_matches_its_twin() {
    let (gpu, frame) = (Gpu::new(), fixture());
    let uploaded = gpu.frame(&frame);
    let pass = &gpu.passes().density;
    gpu.run(pass, density::job(pass, frame.residual.shape(), &uploaded, gpu.device(), gpu.cache()));
    // A cell at the very edge of an RBF's support may fall on either side of it: e^-9 = 1.2e-4 of its weight, in a few
    // of 55,000 cells. That is far below EXACT in the mean.
    let twin = twin_density(&frame);
    assert_close("density", EXACT, widen(&gpu.read_texels(&uploaded.density)), twin.values);
}

#[test]
fn density_of_an_empty_frame_is_zero() {
    let gpu = Gpu::new();
    let shape = GridShape::new(UVec3::new(5, 1, 9));
    let frame = SmokeFrame::new(RbfModel::default(), HashedResidual::empty(shape));
    let uploaded = gpu.frame(&frame);
    let pass = &gpu.passes().density;
    gpu.run(pass, density::job(pass, shape, &uploaded, gpu.device(), gpu.cache()));
    assert_eq!(gpu.read_texels(&uploaded.density), vec![0.0; shape.len()]);
}
