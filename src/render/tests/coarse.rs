use super::*;
use crate::reference;
use crate::render::coarse;

#[test]
fn coarse_matches_its_twin() {
    let (gpu, frame) = (Gpu::new(), fixture());
    let (shape, twin) = (frame.residual.shape(), twin_density(&frame));
    let mut uploaded = gpu.frame(&frame);
    uploaded.density =
        gpu.texture_3d(shape.dims, TextureFormat::R32Float, |cell| twin.values[shape.index(cell)] as f32);
    let pass = &gpu.passes().coarse;
    gpu.run(pass, coarse::job(pass, &uploaded, gpu.device(), gpu.cache()));

    let expected = reference::coarse::coarse(&twin);
    assert_eq!(expected.shape, shape.coarse());
    let padded = GridShape::new(expected.shape.dims + 2);
    let texels = gpu.read_texels(&uploaded.coarse);
    let expected = (0..padded.len()).map(|i| {
        let cell = padded.cell(i);
        let inside = cell.cmpge(UVec3::ONE).all() && cell.cmple(expected.shape.dims).all();
        if inside { expected.values[expected.shape.index(cell - 1)] } else { 0.0 }
    });
    assert_close("coarse", HALF, texels.iter().step_by(4).map(|&v| f64::from(v * MAX_DENSITY)), expected);
}
