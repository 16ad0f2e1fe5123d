use glam::{UVec3, Vec3};
use proptest::prelude::*;

use super::*;

fn rbf(center: [f32; 3], radius: f32, weight: f32) -> Rbf {
    Rbf { center, radius, weight }
}

fn models() -> impl Strategy<Value = Vec<Rbf>> {
    let coordinate = -0.5f32..0.5;
    let one = (prop::array::uniform3(coordinate), 0.015f32..0.09, 0.01f32..1.0);
    prop::collection::vec(one.prop_map(|(center, radius, weight)| rbf(center, radius, weight)), 0..12)
}

#[test]
fn a_gaussian_by_hand() {
    let model = RbfModel { rbfs: vec![rbf([0.1, 0.0, -0.2], 0.05, 2.0)] };
    assert_eq!(model.density(Vec3::new(0.1, 0.0, -0.2)), 2.0);
    // One radius away: 2/e.
    assert!((model.density(Vec3::new(0.15, 0.0, -0.2)) - 0.735_759).abs() < 1e-5);
    assert!(model.density(Vec3::new(0.1, 0.149, -0.2)) > 0.0);
    assert_eq!(model.density(Vec3::new(0.1, 0.151, -0.2)), 0.0);
}

#[test]
fn no_gaussians_no_density() {
    let model = RbfModel::default();
    let shape = GridShape::new(UVec3::new(9, 1, 2));
    assert_eq!(model.density(Vec3::ZERO), 0.0);
    assert_eq!(model.rasterize(shape), vec![0.0; 18]);
    let bins = RbfBins::new(&model.rbfs, shape);
    assert_eq!(bins.dims, UVec3::new(2, 1, 1));
    assert_eq!(bins.offsets, [0, 0, 0]);
}

#[test]
fn rbfs_are_twenty_bytes() {
    assert_eq!(size_of::<Rbf>(), 20);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn rasterizing_evaluates_every_cell(rbfs in models(), x in 1u32..20, y in 1u32..20, z in 1u32..20) {
        let shape = GridShape::new(UVec3::new(x, y, z));
        let model = RbfModel { rbfs };
        for (index, value) in model.rasterize(shape).into_iter().enumerate() {
            let direct = model.density(shape.center(shape.cell(index)));
            // Rounding, and at the very edge of a support one of the two may count e⁻⁹ of a weight.
            prop_assert!((value - direct).abs() < 1.3e-4, "{} {}", value, direct);
        }
    }

    #[test]
    fn bins_list_what_reaches_them(rbfs in models(), x in 1u32..40, y in 1u32..40, z in 1u32..40) {
        let shape = GridShape::new(UVec3::new(x, y, z));
        let bins = RbfBins::new(&rbfs, shape);
        let grid = GridShape::new(bins.dims);
        prop_assert_eq!(bins.offsets.len(), grid.len() + 1);
        prop_assert_eq!(*bins.offsets.last().unwrap() as usize, bins.indices.len());
        let cell = shape.cell_size();
        for bin in (0..grid.len()).map(|index| grid.cell(index)) {
            let list = bins.at(bin * BIN_CELLS);
            prop_assert!(list.windows(2).all(|pair| pair[0] < pair[1]));
            let low = shape.center(bin * BIN_CELLS) - 1.5 * cell;
            let high = shape.center(((bin + 1) * BIN_CELLS).min(shape.dims) - 1) + 1.5 * cell;
            let reaching: Vec<u32> = (0..rbfs.len() as u32).filter(|&i| {
                let rbf = rbfs[i as usize];
                let center = Vec3::from(rbf.center);
                center.clamp(low, high).distance(center) < SUPPORT * rbf.radius - 1e-6
            }).collect();
            prop_assert!(reaching.iter().all(|i| list.contains(i)), "{:?} {:?}", reaching, list);
            if reaching.is_empty() && !rbfs.is_empty() {
                // The nearest ones, unless a support touches the bin to rounding.
                prop_assert!(list.len() == rbfs.len().min(4) || list.len() == 1);
            }
        }
    }

    #[test]
    fn every_cell_finds_in_its_bin_all_that_it_sees(rbfs in models(), x in 1u32..40, y in 1u32..20, z in 1u32..20) {
        let shape = GridShape::new(UVec3::new(x, y, z));
        let bins = RbfBins::new(&rbfs, shape);
        for cell in (0..shape.len()).step_by(7).map(|index| shape.cell(index)) {
            let list = bins.at(cell);
            for (i, rbf) in (0..).zip(&rbfs) {
                prop_assert!(rbf.basis(shape.center(cell)) == 0.0 || list.contains(&i));
            }
        }
    }
}

#[test]
fn a_bin_out_of_reach_lists_the_nearest() {
    let rbfs: Vec<Rbf> = (0..8).map(|i| rbf([-0.49 + 0.01 * i as f32, 0.0, 0.0], 0.015, 1.0)).collect();
    let bins = RbfBins::new(&rbfs, GridShape::new(UVec3::new(64, 8, 8)));
    assert_eq!(bins.at(UVec3::new(63, 0, 0)), [4, 5, 6, 7]);
    // Cells in the padding use the nearest bin.
    assert_eq!(bins.at(UVec3::new(64, 8, 8)), [4, 5, 6, 7]);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn bins_out_of_reach_list_the_nearest_of_all(rbfs in models(), x in 1u32..90, y in 1u32..60, z in 1u32..60) {
        let shape = GridShape::new(UVec3::new(x, y, z));
        let bins = RbfBins::new(&rbfs, shape);
        let grid = GridShape::new(bins.dims);
        for bin in (0..grid.len()).map(|index| grid.cell(index)) {
            let (low, high) = (bin * BIN_CELLS, ((bin + 1) * BIN_CELLS).min(shape.dims) - 1);
            let center = 0.5 * (shape.center(low) + shape.center(high));
            let far = |rbf: &Rbf| center.distance(Vec3::from(rbf.center)) / rbf.radius;
            // Farther than the bin's corners, grown by a cell and more.
            if rbfs.iter().any(|rbf| center.distance(Vec3::from(rbf.center)) < SUPPORT * rbf.radius + 11.0 * shape.cell_size()) {
                continue;
            }
            let mut distances: Vec<f32> = rbfs.iter().map(far).collect();
            distances.sort_by(f32::total_cmp);
            let mut found: Vec<f32> = bins.at(low).iter().map(|&i| far(&rbfs[i as usize])).collect();
            found.sort_by(f32::total_cmp);
            prop_assert_eq!(found.len(), rbfs.len().min(4));
            prop_assert!(found.iter().zip(&distances).all(|(a, b)| (a - b).abs() < 1e-4 * b), "{:?} {:?}", found, distances);
        }
    }
}

#[test]
fn a_bin_that_passing_gaussians_meet_lists_the_nearest_that_stay_too() {
    let mut rbfs: Vec<Rbf> = (0..8).map(|i| rbf([-0.49 + 0.01 * i as f32, 0.0, 0.0], 0.015, 1.0)).collect();
    rbfs.insert(5, rbf([0.49, 0.0, 0.0], 0.02, 1e-6));
    let mut stays = vec![true; 9];
    stays[5] = false;
    let shape = GridShape::new(UVec3::new(64, 8, 8));
    assert_eq!(RbfBins::of_moment(&rbfs, &stays, shape).at(UVec3::new(63, 0, 0)), [4, 5, 6, 7, 8]);
    assert_eq!(RbfBins::new(&rbfs, shape).at(UVec3::new(63, 0, 0)), [5]);
    // Elsewhere it is as if there were none.
    assert_eq!(RbfBins::of_moment(&rbfs, &stays, shape).at(UVec3::new(33, 0, 0)), [4, 6, 7, 8]);
}
