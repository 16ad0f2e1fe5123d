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
        assert!((f64::from(exact.chance_to_meet_again(sigma).unwrap()) - a).abs() < 1e-4);
        assert!((f64::from(between.chance_to_meet_again(sigma).unwrap()) - (0.7 * a + 0.3 * b)).abs() < 1e-4);
    }
    let [a, b] = [&from, &to].map(|frame| GpuBakedFrame::new(frame, gpu.device()).typical_depth / MAX_DENSITY);
    assert_eq!(exact.typical_depth(), Some(a));
    assert!((between.typical_depth().unwrap() - (0.7 * a + 0.3 * b)).abs() < 1e-6 * a);
}
