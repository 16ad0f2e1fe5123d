use super::*;
use crate::render::density;

#[test]
fn density_matches_its_twin() {
    let (gpu, frame) = (Gpu::new(), fixture());
    let uploaded = gpu.frame(&frame);
    let pass = &gpu.passes().density;
    gpu.run(pass, density::job(pass, &uploaded, gpu.device(), gpu.cache()));
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
    gpu.run(pass, density::job(pass, &uploaded, gpu.device(), gpu.cache()));
    assert_eq!(gpu.read_texels(&uploaded.density), vec![0.0; shape.len()]);
}

/// Two frames that share most of their RBFs: some move from one to the other, some go, some come.
pub(super) fn neighbours() -> [Arc<SmokeFrame>; 2] {
    let (from, mut to) = (fixture(), fixture());
    let mut random = Random(41);
    for rbf in &mut to.rbfs.rbfs {
        rbf.center = (Vec3::from(rbf.center) + 0.02 * (random.vector() - 0.5).as_vec3()).to_array();
        rbf.weight *= 0.8 + 0.4 * random.next() as f32;
    }
    // 3 goes, and 100 comes in its place; 7 changes places; 101 comes.
    to.ids[3] = 100;
    to.ids.swap(7, 20);
    to.rbfs.rbfs.swap(7, 20);
    to.ids.push(101);
    to.rbfs.rbfs.push(Rbf { center: [0.1, 0.2, -0.1], radius: 0.08, weight: 0.9 });
    let shape = to.residual.shape();
    let quantized: Vec<i8> =
        (0..shape.len()).map(|_| if random.next() < 0.2 { (random.next() * 254.0 - 127.0) as i8 } else { 0 }).collect();
    to.residual = HashedResidual::build(shape, &quantized, QuantizationLaw { max: 0.4, exponent: 2.0 }).unwrap();
    [Arc::new(from), Arc::new(to)]
}

#[test]
fn density_between_two_frames_matches_its_twin() {
    let gpu = Gpu::new();
    let [from, to] = neighbours();
    let pass = &gpu.passes().density;
    let mut uploaded = None;
    for blend in [0.0, 0.3, 1e-6, 1.0 - 1e-6] {
        let moment = Moment { from: from.clone(), to: to.clone(), blend, max_density: MAX_DENSITY };
        // The first is written anew, the others over the one before.
        let moment_rbfs = moment.rbfs().rbfs;
        let uploaded = match &mut uploaded {
            None => uploaded.insert(gpu.moment(&moment)),
            Some(uploaded) => {
                let baked = [&from, &to].map(|frame| Arc::new(GpuBakedFrame::new(frame, gpu.device())));
                uploaded.rewrite(&moment, &moment_rbfs, baked, gpu.device(), gpu.queue());
                uploaded
            }
        };
        assert_eq!(uploaded.rbf_count as usize, 40 + 2 * usize::from(blend > 0.0));
        gpu.run(pass, density::job(pass, uploaded, gpu.device(), gpu.cache()));
        assert_close(
            &format!("density at {blend}"),
            EXACT,
            widen(&gpu.read_texels(&uploaded.density)),
            widen(&moment.decode()),
        );
    }
}
