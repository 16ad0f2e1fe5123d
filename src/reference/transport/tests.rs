use glam::{DMat3, UVec3};

use super::*;
use crate::density::GridShape;
use crate::optics::{gaussian_column, henyey_greenstein};
use crate::reference::DIRECTIONS;
use crate::reference::{
    coarse::coarse,
    density::density,
    incident_light::{incident, probes},
};
use crate::sh::SphereRule;

/// A handful of overlapping Gaussians of several sizes, two of them on one centre.
fn rbfs() -> Vec<Rbf> {
    let at = |x, y, z, radius, weight| Rbf { center: [x, y, z], radius, weight };
    vec![
        at(0.0, 0.0, 0.0, 0.09, 1.0),
        at(0.1, 0.05, -0.02, 0.06, 1.5),
        at(-0.05, 0.12, 0.08, 0.08, 0.7),
        at(0.02, -0.15, 0.05, 0.05, 2.0),
        at(-0.12, -0.06, -0.1, 0.07, 1.2),
        at(-0.12, -0.06, -0.1, 0.04, 0.9),
        at(0.3, 0.3, 0.2, 0.05, 0.4),
    ]
}

fn grid(rbfs: &[Rbf]) -> Grid {
    coarse(&density(rbfs, |_| 0.0, GridShape::new(UVec3::splat(32))))
}

fn lit_by(environment: ShRgb) -> Lighting {
    Lighting { environment, env_from_local: DMat3::IDENTITY }
}

fn sky() -> Lighting {
    lit_by(
        ShRgb::constant(DVec3::new(0.4, 0.5, 0.7))
            + ShRgb::zonal(DVec3::new(0.6, 0.0, 0.8), &[1.0, 0.8, 0.5, 0.2], DVec3::new(3.0, 2.0, 1.0)),
    )
}

fn assert_close(a: &ShRgb, b: &ShRgb, tolerance: f64) {
    for (k, (a, b)) in a.0.iter().zip(&b.0).enumerate() {
        assert!((*a - *b).abs().max_element() < tolerance, "{k}: {a} for {b}");
    }
}

#[test]
fn delta_m_keeps_absorption_and_transport() {
    let medium = Medium { sigma: 3.0, albedo: DVec3::new(1.0, 0.8, 0.3), g: 0.7 };
    let DeltaM { sigma, albedo, factors } = DeltaM::new(&medium);
    // What absorbs, and every moment of the phase function that is kept, is the same: σ'(1−Ω') = σ(1−Ω) and
    // σ'(1−Ω'g'_l) = σ(1−Ωg^l).
    for (factor, full) in factors.into_iter().zip(henyey_greenstein_factors(0.7)) {
        let expected = medium.sigma * (1.0 - medium.albedo * full);
        assert!((sigma * (1.0 - albedo * factor) - expected).abs().max_element() < 1e-14);
    }
    assert!((albedo.x - 1.0).abs() < 1e-15 && sigma.cmplt(DVec3::splat(3.0)).all());
    assert!((factors[0] - 1.0).abs() < 1e-15);
    // f = g⁴ = 0.2401 by hand.
    assert!((sigma.z - 3.0 * (1.0 - 0.3 * 0.2401)).abs() < 1e-14);
    for g in [0.0, -0.6] {
        let same = DeltaM::new(&Medium { g, ..medium });
        assert_eq!((same.sigma, same.albedo), (DVec3::splat(3.0), medium.albedo));
        assert_eq!(same.factors, henyey_greenstein_factors(g));
    }
}

#[test]
fn pairs_follow_the_formula() {
    // Two Gaussians a radius of the second apart, in a uniform box: Daw(1) = 0.53807950691 and Daw(1/2) =
    // 0.42443638350 (the first is twice as large), erfcx(0.3) = 0.73459933457,
    // erfcx(0.15) = 0.85093630867.
    let shape = GridShape::new(UVec3::splat(16));
    let coarse = Grid { shape, values: vec![1.5; shape.len()] };
    let rbf = |x, radius, weight| Rbf { center: [x, 0.0, 0.0], radius, weight };
    let rbfs = [rbf(0.0, 0.25, 1.0), rbf(0.125, 0.125, 3.0)];
    let sigma = 1.6;
    let tau = (-sigma * 1.5 * 0.125f64).exp();
    let expected = [
        [0.25 * 0.734_599_334_6, 0.375 * 0.538_079_506_9 * tau],
        [0.25 * (2.0 * 0.424_436_383_5) * tau, 0.375 * 0.850_936_308_7],
    ];
    let found = pair_matrix(&rbfs, &coarse, sigma);
    for (found, [a, b]) in found.chunks(2).zip(expected) {
        assert!((found[0] - a / (a + b)).abs() < 1e-8, "{found:?} for {a} {b}");
        assert!((found[1] - b / (a + b)).abs() < 1e-8);
    }
}

#[test]
fn thin_smoke_is_seen_as_its_mean_optical_depth() {
    // Without attenuation a row is the mean over directions of each Gaussian's exact optical depth.
    let rbfs = rbfs();
    let pairs = pair_matrix(&rbfs, &grid(&rbfs), 0.0);
    let rule = SphereRule::new(48);
    for (to, row) in rbfs.iter().zip(pairs.chunks(rbfs.len())) {
        let mean = |rbf: &Rbf| -> f64 {
            let (radius, weight) = (f64::from(rbf.radius), f64::from(rbf.weight));
            rule.integrate(|w| gaussian_column(rbf_center(to), w, rbf_center(rbf), radius, weight))
        };
        let depths: Vec<f64> = rbfs.iter().map(mean).collect();
        let total: f64 = depths.iter().sum();
        for (share, depth) in row.iter().zip(&depths) {
            // The last Gaussian is 9 of its radii away, 1/160 of the way around: 48 nodes in z resolve it to 1e-5.
            assert!((share - depth / total).abs() < 1e-4, "{share} for {}", depth / total);
        }
        assert!((row.iter().sum::<f64>() - 1.0).abs() < 1e-14);
    }
}

#[test]
fn single_scattering_scales_the_bands() {
    let rbf = Rbf { center: [0.1, 0.0, 0.0], radius: 0.2, weight: 1.0 };
    let shape = GridShape::new(UVec3::splat(8));
    let grid = Grid { shape, values: vec![0.5; shape.len()] };
    let medium = Medium { sigma: 2.0, albedo: DVec3::new(0.9, 0.6, 0.3), g: 0.4 };
    let found = single_scattering(&[rbf], &grid, &sky(), &medium);
    assert_eq!(found.len(), 1);
    for (j, p) in found[0].iter().zip(probes(&rbf, rbf.radius.into())) {
        let (sigma, alone) = (DVec3::splat(medium.sigma), Surroundings::default());
        let direct = incident(p, &grid, &sky(), sigma, &alone, DIRECTIONS).light;
        for k in 0..16 {
            let expected = medium.albedo * direct.0[k] * 0.4f64.powi(band(k) as i32);
            assert!((j.0[k] - expected).length() < 1e-14);
        }
        // Which is the integral of light times phase: light from ω travels along −ω and leaves along −v.
        let v = DVec3::new(0.48, -0.6, 0.64);
        let gathered = SphereRule::new(48).integrate(|w| direct.evaluate(w) * henyey_greenstein(w.dot(v), 0.4));
        assert!((j.evaluate(v) - medium.albedo * gathered).length() < 1e-10);
    }
}

#[test]
fn white_furnace() {
    // White smoke under constant light has that radiance: however dense it is and it scatters, at every probe and in
    // every direction.
    let rbfs = rbfs();
    let coarse = grid(&rbfs);
    let light = ShRgb::constant(DVec3::new(1.0, 0.5, 0.25));
    for g in [-0.8, 0.0, 0.4, 0.8] {
        for sigma in [0.0, 0.1, 3.0, 30.0] {
            let medium = Medium { sigma, albedo: DVec3::ONE, g };
            let found = multiple_scattering(&rbfs, &coarse, &lit_by(light), &Lamps::default(), &medium);
            let worst = found.iter().flatten().flat_map(|j| j.0.into_iter().zip(light.0));
            let worst = worst.map(|(a, b)| (a - b).abs().max_element()).fold(0.0, f64::max);
            println!("g {g}, σ {sigma}: off by {worst:.1e}");
            // The sweeps stop at changes of 1e-12; the slowest (σ 30) shrink by 5 % a sweep.
            assert!(worst < 1e-10, "g {g}, σ {sigma}: {worst}");
        }
    }
}

#[test]
fn white_furnaces_rest() {
    // Where everything has radiance 1 it keeps it, to rounding: also in smoke (σ 300) that sweeps would take too long
    // to fill with light, since 3e-4 of it leaves a sweep.
    let rbfs = rbfs();
    let coarse = grid(&rbfs);
    let light = ShRgb::constant(DVec3::ONE);
    for g in [-0.8, 0.0, 0.4, 0.8] {
        for sigma in [0.1, 3.0, 30.0, 300.0] {
            let medium = Medium { sigma, albedo: DVec3::ONE, g };
            let sigma = DeltaM::new(&medium).sigma;
            let incident = incident_light(&rbfs, &coarse, &lit_by(light), sigma);
            let pairs = pair_matrix(&rbfs, &coarse, sigma.x);
            let gathered = gather(&pairs, &lobes(&rbfs), &vec![light; rbfs.len()]);
            let found = source_radiance(&incident, &gathered, &surroundings(&rbfs, &pairs), &medium);
            for probe in found.iter().flatten() {
                assert_close(probe, &light, 1e-13);
            }
        }
    }
}

#[test]
fn surroundings_are_what_light_of_one_gathers() {
    let rbfs = rbfs();
    let pairs = pair_matrix(&rbfs, &grid(&rbfs), 5.0);
    let gathered = gather(&pairs, &lobes(&rbfs), &vec![ShRgb::constant(DVec3::ONE); rbfs.len()]);
    for (found, expected) in surroundings(&rbfs, &pairs).iter().zip(&gathered) {
        for (found, expected) in found.0.iter().zip(expected.0) {
            assert!((found - expected.x).abs() < 1e-14);
        }
    }
}

#[test]
fn grey_furnaces_lose_what_is_absorbed() {
    // A single albedo under constant light: no brighter than Ω, and brighter the whiter.
    let rbfs = rbfs();
    let coarse = grid(&rbfs);
    let medium = Medium { sigma: 6.0, albedo: DVec3::new(0.99, 0.9, 0.5), g: 0.0 };
    let found = multiple_scattering(&rbfs, &coarse, &lit_by(ShRgb::constant(DVec3::ONE)), &Lamps::default(), &medium);
    for probe in found.iter().flatten() {
        let j = probe.evaluate(DVec3::Z);
        assert!(j.cmplt(medium.albedo).all() && j.x > j.y && j.y > j.z && j.z > 0.0, "{j}");
    }
}

#[test]
fn scattering_more_than_once_never_darkens() {
    let rbfs = rbfs();
    let coarse = grid(&rbfs);
    let medium = Medium { sigma: 8.0, albedo: DVec3::new(0.95, 0.8, 0.3), g: 0.0 };
    let incident = incident_light(&rbfs, &coarse, &sky(), DVec3::splat(8.0));
    let pairs = pair_matrix(&rbfs, &coarse, 8.0);
    assert!(pairs.iter().all(|&share| share >= 0.0));
    for g in scattered_light(&rbfs, &pairs, &incident, &medium) {
        assert!(g.0[0].min_element() > 0.0);
        assert!(g.0[1..].iter().all(|&c| c == DVec3::ZERO));
    }
}

/// Ω' g'_l L_m of J, in one channel (red): the matrix of the sweeps, `16 n` a side, by columns.
fn operator(pairs: &[f64], rbfs: &[Rbf], means: &[Incident], medium: &Medium) -> Vec<Vec<f64>> {
    let DeltaM { albedo, factors, .. } = DeltaM::new(medium);
    let (lobes, surroundings) = (lobes(rbfs), surroundings(rbfs, pairs));
    let n = rbfs.len();
    (0..n * COEFFICIENTS)
        .map(|column| {
            let mut unit = vec![ShRgb::default(); n];
            unit[column / COEFFICIENTS].0[column % COEFFICIENTS] = DVec3::X;
            let gathered = gather(pairs, &lobes, &unit);
            let light = |l: usize| scattered_before(&means[l], &gathered[l], &surroundings[l]);
            (0..n).flat_map(|l| scatter(&light(l), albedo, &factors).0.map(|c| c.x)).collect()
        })
        .collect()
}

#[test]
fn sweeps_reach_the_solution_of_the_linear_system() {
    let rbfs = rbfs();
    let coarse = grid(&rbfs);
    for g in [0.0, 0.5, -0.4] {
        let medium = Medium { sigma: 7.0, albedo: DVec3::splat(0.97), g };
        let DeltaM { sigma, albedo, factors } = DeltaM::new(&medium);
        let incident = incident_light(&rbfs, &coarse, &sky(), sigma);
        let pairs = pair_matrix(&rbfs, &coarse, sigma.x);
        let means: Vec<Incident> = incident.iter().map(mean).collect();
        let columns = operator(&pairs, &rbfs, &means, &medium);
        // (I − A) J = Ω' g'_l L̄_d, red channel, by elimination with partial pivoting.
        let n = columns.len();
        let mut rows: Vec<Vec<f64>> = (0..n)
            .map(|i| {
                let direct = means[i / COEFFICIENTS].light.0[i % COEFFICIENTS].x;
                let known = albedo.x * factors[band(i % COEFFICIENTS)] * direct;
                let entry = |(j, column): (usize, &Vec<f64>)| f64::from(i == j) - column[i];
                columns.iter().enumerate().map(entry).chain([known]).collect()
            })
            .collect();
        for i in 0..n {
            let pivot = (i..n).max_by(|&a, &b| rows[a][i].abs().total_cmp(&rows[b][i].abs())).unwrap();
            rows.swap(i, pivot);
            for r in 0..n {
                if r != i {
                    let (factor, pivot) = (rows[r][i] / rows[i][i], rows[i].clone());
                    rows[r].iter_mut().zip(pivot).for_each(|(entry, p)| *entry -= factor * p);
                }
            }
        }
        let gathered = scattered_light(&rbfs, &pairs, &incident, &medium);
        let largest = (0..n).map(|i| rows[i][n] / rows[i][i]).fold(0.0, f64::max);
        let surroundings = surroundings(&rbfs, &pairs);
        for (l, incident) in means.iter().enumerate() {
            let light = incident.light + scattered_before(incident, &gathered[l], &surroundings[l]);
            let source = scatter(&light, albedo, &factors);
            for k in 0..COEFFICIENTS {
                let i = l * COEFFICIENTS + k;
                let exact = rows[i][n] / rows[i][i];
                assert!((source.0[k].x - exact).abs() < 1e-10 * largest, "g {g}: {} for {exact}", source.0[k].x);
            }
        }
    }
}

#[test]
fn sweeps_shrink_by_albedo_and_enclosure() {
    // Power iteration for the spectral radius, of the isotropic and of the order 4 form.
    let rbfs = rbfs();
    let coarse = grid(&rbfs);
    for (sigma, g) in [(1.0, 0.0), (7.0, 0.0), (7.0, 0.4), (7.0, 0.8), (40.0, 0.8), (40.0, -0.8)] {
        let medium = Medium { sigma, albedo: DVec3::ONE, g };
        let sigma = DeltaM::new(&medium).sigma;
        let pairs = pair_matrix(&rbfs, &coarse, sigma.x);
        let means: Vec<Incident> = incident_light(&rbfs, &coarse, &sky(), sigma).iter().map(mean).collect();
        let enclosed: Vec<f64> = means.iter().map(|m| 1.0 - m.escape.x).collect();
        let columns = operator(&pairs, &rbfs, &means, &medium);
        let mut x = vec![1.0; columns.len()];
        let mut radius = 0.0;
        for _ in 0..500 {
            let mut next = vec![0.0; x.len()];
            for (column, &x) in columns.iter().zip(&x) {
                next.iter_mut().zip(column).for_each(|(next, entry)| *next += x * entry);
            }
            radius = next.iter().map(|v| v * v).sum::<f64>().sqrt();
            x = next.into_iter().map(|v| v / radius).collect();
        }
        let bound = enclosed.iter().copied().fold(0.0, f64::max);
        println!("σ {:.1}, g {g}: spectral radius {radius:.3}, bound {bound:.3}", sigma.x);
        assert!(radius <= bound, "σ {sigma}, g {g}: {radius} > {bound}");
    }
}

#[test]
fn turning_everything_turns_the_light() {
    // Lobes follow the centres; K̂ does not depend on axes, up to the grid it was marched through.
    let rbfs = rbfs();
    let pairs = pair_matrix(&rbfs, &grid(&rbfs), 5.0);
    let turn = DMat3::from_axis_angle(DVec3::new(0.48, -0.6, 0.64), 2.1);
    let turned: Vec<Rbf> =
        rbfs.iter().map(|rbf| Rbf { center: (turn * rbf_center(rbf)).as_vec3().to_array(), ..*rbf }).collect();
    let source: Vec<ShRgb> = (0..rbfs.len())
        .map(|l| Sh(core::array::from_fn(|k| DVec3::new(1.0, 2.0, 3.0) * (1.7 * (k + 5 * l) as f64).sin())))
        .collect();
    let turned_source: Vec<ShRgb> = source.iter().map(|j| j.rotate(turn)).collect();
    let expected = gather(&pairs, &lobes(&rbfs), &source);
    let found = gather(&pairs, &lobes(&turned), &turned_source);
    for (expected, found) in expected.iter().zip(&found) {
        // Centres are stored in f32: lobes turn by 1e-6.
        assert_close(found, &expected.rotate(turn), 1e-5);
    }
    // A quarter turn about z, (x, y) → (−y, x), maps a cubic grid onto itself.
    let coarse = grid(&rbfs);
    let shape = coarse.shape;
    let from = |cell: UVec3| UVec3::new(cell.y, shape.dims.x - 1 - cell.x, cell.z);
    let values = (0..shape.len()).map(|i| coarse.values[shape.index(from(shape.cell(i)))]).collect();
    let quarter: Vec<Rbf> =
        rbfs.iter().map(|rbf| Rbf { center: [-rbf.center[1], rbf.center[0], rbf.center[2]], ..*rbf }).collect();
    for (a, b) in pair_matrix(&quarter, &Grid { shape, values }, 5.0).iter().zip(&pairs) {
        assert!((a - b).abs() < 1e-13);
    }
}

#[test]
fn lobes_carry_light_from_where_it_is() {
    // One bright Gaussian far along d: its light arrives from there, as bright as it is towards us.
    let rbf = |x: f32| Rbf { center: [x, 0.0, 0.0], radius: 0.01, weight: 1.0 };
    let rbfs = [rbf(0.0), rbf(0.4)];
    let lobe = &lobes(&rbfs)[1];
    // u = 40: a_l = 1 − l(l+1)/(4u²), within 1 % of 1.
    assert!(lobe.bands.iter().all(|a| (a - 1.0).abs() < 0.01));
    let bright = ShRgb::zonal(DVec3::X, &[1.0, 0.5, 0.2, 0.1], DVec3::ONE);
    let found = gather(&[0.0, 1.0, 0.0, 1.0], &lobes(&rbfs), &[ShRgb::default(), bright]);
    let seen = bright.evaluate(DVec3::X).x;
    for (k, y) in basis(DVec3::X).into_iter().enumerate() {
        // The mean over directions is what is seen: 4π y_k(d) J(d), and band 0 is √(4π) J(d).
        assert!((found[0].0[k].x - 4.0 * PI * y * seen).abs() < 0.02 * 4.0 * PI * seen);
    }
    // Around its own centre it is all there is: unchanged but for nothing.
    assert_close(&found[1], &bright, 1e-14);
}

#[test]
fn coincident_centres_are_one() {
    // A Gaussian cut in two of half the weight: in thin smoke, where self-attenuation does not show, the same light.
    let whole = rbfs()[..5].to_vec();
    let mut cut = whole.clone();
    cut[0].weight *= 0.5;
    cut.push(cut[0]);
    let coarse = grid(&whole);
    let solve = |rbfs: &[Rbf], sigma| {
        let medium = Medium { sigma, albedo: DVec3::splat(0.9), g: 0.5 };
        multiple_scattering(rbfs, &coarse, &sky(), &Lamps::default(), &medium)
    };
    let difference = |sigma| {
        let (whole, cut) = (solve(&whole, sigma), solve(&cut, sigma));
        assert_eq!(cut[0].map(|j| j.0.map(|c| c.as_vec3())), cut[5].map(|j| j.0.map(|c| c.as_vec3())));
        let pairs = cut[..5].iter().zip(&whole).flat_map(|(a, b)| a.iter().zip(b));
        pairs.flat_map(|(a, b)| a.0.into_iter().zip(b.0)).map(|(a, b)| (a - b).length()).fold(0.0, f64::max)
    };
    // σ D r ≈ σ 0.1: erfcx(x) = 1 − 1.13x, times 1 − τ̄ ≈ σ 0.1: second order in σ.
    let (thin, thinner, dense) = (difference(0.1), difference(0.05), difference(10.0));
    assert!(thin < 1e-3 && (3.0..5.0).contains(&(thin / thinner)), "{thin} {thinner}");
    assert!(dense.is_finite() && dense < 1.0, "{dense}");
}

#[test]
fn no_smoke_is_fine() {
    let shape = GridShape::new(UVec3::splat(4));
    let empty = Grid { shape, values: vec![0.0; shape.len()] };
    let medium = Medium { sigma: 4.0, albedo: DVec3::ONE, g: 0.3 };
    assert!(multiple_scattering(&[], &empty, &sky(), &Lamps::default(), &medium).is_empty());
    assert!(multiple_scattering(&[], &empty, &sky(), &Lamps::default(), &Medium { g: 0.0, ..medium }).is_empty());
}
