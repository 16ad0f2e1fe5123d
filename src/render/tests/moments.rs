use super::density::neighbours;
use super::*;
use crate::optics::gaussian_column;

/// The chance to meet smoke again by its definition, without leaving anything out.
fn chance(rbfs: &[Rbf], sigma: f64) -> f64 {
    let center = |rbf: &Rbf| Vec3::from(rbf.center).as_dvec3();
    let from = rbfs.iter().step_by(rbfs.len().div_ceil(24));
    let met: Vec<f64> = from
        .flat_map(|from| DVec3::AXES.into_iter().flat_map(|axis| [axis, -axis]).map(move |dir| (center(from), dir)))
        .map(|(from, dir)| {
            let column = |rbf: &Rbf| gaussian_column(from, dir, center(rbf), rbf.radius.into(), rbf.weight.into());
            1.0 - (-sigma * rbfs.iter().map(column).sum::<f64>()).exp()
        })
        .collect();
    met.iter().sum::<f64>() / met.len() as f64
}

#[test]
fn what_is_known_of_baked_frames_is_blended() {
    let gpu = Gpu::new();
    let [from, to] = neighbours();
    let moment = |blend| Moment { from: from.clone(), to: to.clone(), blend, max_density: MAX_DENSITY };
    let [exact, between] = [0.0, 0.3].map(|blend| gpu.moment(&moment(blend)));
    for sigma in [0.1, 3.0, 40.0] {
        let [a, b] = [&from, &to].map(|frame| chance(rbfs(frame), f64::from(sigma / MAX_DENSITY)));
        // RBFs that a ray passes at three radii and more are left out: e^-9 of their column.
        assert!((f64::from(exact.chance_to_meet_again(sigma)) - a).abs() < 1e-4);
        assert!((f64::from(between.chance_to_meet_again(sigma)) - (0.7 * a + 0.3 * b)).abs() < 1e-4);
    }
    let [a, b] = [&from, &to].map(|frame| GpuBakedFrame::new(frame, gpu.device()).typical_depth / MAX_DENSITY);
    assert_eq!(exact.typical_depth(), a);
    assert!((between.typical_depth() - (0.7 * a + 0.3 * b)).abs() < 1e-6 * a);
}

#[test]
fn timing() {
    use std::time::Instant;
    let gpu = Gpu::new();
    let bytes = std::fs::read(std::env::var("TIMING").unwrap()).unwrap();
    let animation = crate::bundle::read(&bytes).unwrap();
    let a = animation.frames.get(0).unwrap().clone();
    let b = Arc::new(SmokeFrame::clone(&a));
    let shape = animation.shape;
    let moment = Moment { from: a.clone(), to: b.clone(), blend: 0.3, max_density: animation.max_density };
    let time = |what: &str, run: &mut dyn FnMut()| {
        let mut times: Vec<f64> = (0..21)
            .map(|_| {
                let start = Instant::now();
                run();
                start.elapsed().as_secs_f64() * 1e3
            })
            .collect();
        times.sort_by(f64::total_cmp);
        println!("TIMING {what}: min {:.3} median {:.3} ms", times[0], times[10]);
    };
    let rbfs = moment.rbfs().rbfs;
    println!("TIMING {} rbfs, {:?}", rbfs.len(), shape);
    time("Moment::rbfs", &mut || drop(moment.rbfs()));
    time("RbfBins::new", &mut || drop(crate::rbf::RbfBins::of_moment(&rbfs, &moment.stays(), shape)));
    println!("TIMING entries {}", crate::rbf::RbfBins::new(&rbfs, shape).indices.len());
    time("fits", &mut || super::super::frame::fits(&moment, &rbfs, gpu.device()).unwrap());
    time("GpuBakedFrame::new", &mut || drop(GpuBakedFrame::new(&a, gpu.device())));
    let baked = [&a, &b].map(|frame| Arc::new(GpuBakedFrame::new(frame, gpu.device())));
    let mut frame = GpuSmokeFrame::new(&moment, &rbfs, baked.clone(), gpu.device(), gpu.queue());
    time("rewrite", &mut || frame.rewrite(&moment, &rbfs, baked.clone(), gpu.device(), gpu.queue()));
    time("chance", &mut || assert!(frame.chance_to_meet_again(3.0) > 0.0));
}
