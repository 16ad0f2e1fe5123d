use super::*;
use crate::reference::lamp::with_lamps;
use crate::reference::transport::{self, DeltaM};
use crate::render::footprint::Footprints;
use crate::render::frame::uniform;
use crate::render::scattering::{
    Bindings, CONTROL_BYTES, SOURCE_BYTES, STATE_BYTES, ScatteringJob, SolverReport, StepUniform,
};

/// Whether lamps light what scatters.
#[derive(Clone, Copy, PartialEq)]
enum Sharp {
    Lamps,
    No,
}

/// What the RBFs see of each other according to the pass and to the twin, and what the solver said of itself.
fn solve(medium: SmokeMedium, escape: f64, tolerance: f32, sharp: Sharp, order: u32) -> ([Vec<f64>; 2], SolverReport) {
    let (gpu, frame) = (Gpu::new(), fixture());
    let (coarse, uploaded) = coarse_frame(&gpu, &frame);
    let rbfs = rbfs(&frame);
    let count = rbfs.len();
    let incident = random_incident(&mut Random(23), count, escape);
    let medium_f64 = twin_medium(&medium, 5.0);
    let sigma = DeltaM::new(&medium_f64).sigma;
    let grey = sigma.element_sum() / 3.0;
    let pairs = transport::pair_matrix(rbfs, &coarse, grey);
    let rows: Vec<f32> = twin_rows(rbfs, &coarse, grey, &pairs).iter().map(|&v| v as f32).collect();

    let mut lighting =
        LightingUniform::of_medium(&medium, 5.0, true).reduced(&SmokeModel { order, ..SmokeModel::FULL }, false);
    if sharp == Sharp::Lamps {
        lighting = lit_by_lamps(lighting);
    }
    let coefficients = lighting.coefficients;
    let [probes, escapes] = pack_incident(&gpu, &incident);
    let zeros = |bytes: u64| gpu.buffer(&vec![0_u8; bytes as usize]);
    let (control, gathered) = (zeros(CONTROL_BYTES), zeros(count as u64 * 256));
    let matrix: Vec<f32> = pairs.iter().map(|&k| k as f32).collect();
    let bindings = Bindings {
        frame: &uploaded,
        lighting: &uniform(gpu.device(), gpu.queue(), "test", lighting),
        footprints: &Footprints::buffer(gpu.device(), gpu.queue()),
        steps: &StepUniform::all(tolerance).map(|step| uniform(gpu.device(), gpu.queue(), "test", step)),
        probes: &probes,
        escapes: &escapes,
        columns: &gpu.buffer(&twin_columns(rbfs, &coarse, &surroundings(&frame), sigma, |rbf| rbf.radius.into())),
        matrix: &gpu.buffer(&matrix),
        rows: &gpu.buffer(&rows),
        sources: &zeros(count as u64 * SOURCE_BYTES),
        // What was left there must not matter, whatever it is.
        states: &gpu.buffer(&vec![f32::NAN; uploaded.rbf_capacity as usize * STATE_BYTES as usize / 4]),
        gathered: &gathered,
        control: &control,
    };
    let pass = &gpu.passes().scattering;
    let groups = pass.bind(&bindings, gpu.device(), gpu.cache());
    let (rbf_count, rbf_capacity) = (uploaded.rbf_count, uploaded.rbf_capacity);
    let job = ScatteringJob { bind_groups: Arc::new(groups), rbf_count, rbf_capacity, coefficients, cycles: 6 };
    gpu.run_all(&pass.jobs(&job));

    let report = SolverReport::from_bytes(&read_buffer(gpu.device(), gpu.queue(), &control)).unwrap();
    let found = gpu.read_floats(&gathered);
    let found = unpad(&found[..count * coefficients as usize * 4]).collect();
    let incident = match sharp {
        Sharp::Lamps => with_lamps(&incident, rbfs, &coarse, &twin_lamps(), sigma, &surroundings(&frame)),
        Sharp::No => incident,
    };
    let expected = transport::scattered_light_of_order(rbfs, &pairs, &incident, &medium_f64, order as usize);
    let expected = expected.iter().flat_map(|g| g.0[..coefficients as usize].to_vec()).flat_map(rgb).collect();
    ([found, expected], report)
}

#[test]
fn scattering_matches_its_twin() {
    // Isotropic, forward (delta-M) and backward. Solved to 1e-5 the pass is off by that and by rounding; the tables' 1e-4
    // shows where the phase function is not isotropic, or lamps are near.
    for (g, sharp, order, bound) in [
        (0.0, Sharp::No, 4, 5e-5),
        (0.7, Sharp::No, 4, 5e-4),
        (-0.5, Sharp::No, 4, 5e-4),
        (0.0, Sharp::Lamps, 4, 5e-4),
        (0.7, Sharp::Lamps, 4, 5e-4),
        // Fewer bands.
        (0.7, Sharp::Lamps, 3, 5e-4),
        (0.7, Sharp::No, 2, 5e-4),
        (-0.5, Sharp::No, 1, 5e-4),
    ] {
        let ([found, expected], report) = solve(medium([0.8, 0.5, 0.2], g), 0.9, 1e-5, sharp, order);
        println!("{report:?}");
        let lamps = if sharp == Sharp::Lamps { " and lamps" } else { "" };
        assert_close(&format!("scattering, g {g}, order {order}{lamps}"), bound, found, expected);
        assert!(report.converged, "{report:?}");
    }
}

#[test]
fn the_solver_knows_its_error_where_sweeps_crawl() {
    // Nearly white and nearly closed: a sweep takes as little as 0.5 % off the error, and changes less than single
    // precision holds when it is 1e-5 away.
    for albedo in [[1.0, 0.995, 0.9], [0.99; 3]] {
        for g in [0.0, 0.6, -0.5] {
            for (escape, tolerance) in [(0.9, 0.005), (0.02, 0.005), (0.01, 0.005), (0.01, 0.001)] {
                let ([found, expected], report) = solve(medium(albedo, g), escape, tolerance, Sharp::No, 4);
                let error = distance(found, expected);
                println!("albedo {albedo:?}, g {g}, escape {escape}: {report:?}, true error {error:.2e}");
                assert!(report.converged && error <= f64::from(tolerance), "{report:?} {error}");
            }
        }
    }
}
