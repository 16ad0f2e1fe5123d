use bevy::color::LinearRgba;
use bevy::math::DVec3;

use super::*;
use crate::medium::SmokeMedium;
use crate::reference;
use crate::reference::PROBES;
use crate::reference::incident_light::Incident;
use crate::reference::transport::{self, DeltaM};
use crate::render::footprint::Footprints;
use crate::render::frame::uniform;
use crate::render::incident_light::{COLUMN_BYTES, PROBE_BYTES};
use crate::render::lighting::LightingUniform;
use crate::render::scattering::{Bindings, CONTROL_BYTES, SOURCE_BYTES, STATE_BYTES, SolverReport, StepUniform};

/// What the RBFs see of each other according to the pass and to the twin, and what the solver said of itself.
fn solve(medium: SmokeMedium, escape: f64, tolerance: f32) -> ([Vec<f64>; 2], SolverReport) {
    let (gpu, frame) = (Gpu::new(), fixture());
    let (coarse, uploaded) = coarse_frame(&gpu, &frame);
    let mut random = Random(23);
    let incident: Vec<[Incident; PROBES]> = rbfs(&frame)
        .iter()
        .map(|_| {
            std::array::from_fn(|_| Incident {
                light: random_light(&mut random),
                escape: (escape * random.vector()).as_vec3().as_dvec3(),
                ..Incident::default()
            })
        })
        .collect();
    let medium_f64 = reference::Medium {
        sigma: 5.0,
        albedo: DVec3::new(medium.albedo.red.into(), medium.albedo.green.into(), medium.albedo.blue.into()),
        g: medium.g.into(),
    };
    let sigma = DeltaM::new(&medium_f64).sigma.element_sum() / 3.0;
    let pairs = transport::pair_matrix(rbfs(&frame), &coarse, sigma);

    let lighting = LightingUniform::of_medium(&medium, 5.0, true);
    let coefficients = lighting.coefficients;
    let probes: Vec<[f32; 4]> = incident
        .iter()
        .flatten()
        .flat_map(|probe| {
            let mut padded = pad(probe.light.0);
            for (c, escape) in rgb(probe.escape).into_iter().enumerate() {
                padded[c][3] = escape as f32;
            }
            padded
        })
        .collect();
    let count = rbfs(&frame).len();
    assert_eq!(probes.len() as u64 * 16, count as u64 * PROBE_BYTES);
    let zeros = |bytes: u64| gpu.buffer(&vec![0_u8; bytes as usize]);
    let (control, gathered) = (zeros(CONTROL_BYTES), zeros(count as u64 * 256));
    let matrix: Vec<f32> = pairs.iter().map(|&k| k as f32).collect();
    let bindings = Bindings {
        frame: &uploaded,
        lighting: &uniform(gpu.device(), gpu.queue(), "test", lighting),
        footprints: &Footprints::buffer(gpu.device(), gpu.queue()),
        steps: &StepUniform::all(tolerance).map(|step| uniform(gpu.device(), gpu.queue(), "test", step)),
        probes: &gpu.buffer(&probes),
        columns: &zeros(count as u64 * COLUMN_BYTES),
        matrix: &gpu.buffer(&matrix),
        sources: &zeros(count as u64 * SOURCE_BYTES),
        // What was left there must not matter, whatever it is.
        states: &gpu.buffer(&vec![f32::NAN; count * STATE_BYTES as usize / 4]),
        gathered: &gathered,
        control: &control,
    };
    let pass = &gpu.passes().scattering;
    let groups = pass.bind(&bindings, gpu.device(), gpu.cache());
    gpu.run_all(&pass.jobs(&groups, count as u32, coefficients));

    let report = SolverReport::from_bytes(&read_buffer(gpu.device(), gpu.queue(), &control)).unwrap();
    let found = gpu.read_floats(&gathered);
    let found = unpad(&found[..count * coefficients as usize * 4]).collect();
    let expected = transport::scattered_light(rbfs(&frame), &pairs, &incident, &medium_f64);
    let expected = expected.iter().flat_map(|g| g.0[..coefficients as usize].to_vec()).flat_map(rgb).collect();
    ([found, expected], report)
}

fn medium(albedo: [f32; 3], g: f32) -> SmokeMedium {
    SmokeMedium { albedo: LinearRgba::rgb(albedo[0], albedo[1], albedo[2]), g, ..SmokeMedium::default() }
}

#[test]
fn scattering_matches_its_twin() {
    // Isotropic, forward (delta-M) and backward. Solved to 1e-5 the pass is off by that and by rounding; the tables' 1e-4
    // shows where the phase function is not isotropic.
    for (g, bound) in [(0.0, 5e-5), (0.7, 5e-4), (-0.5, 5e-4)] {
        let ([found, expected], report) = solve(medium([0.8, 0.5, 0.2], g), 0.9, 1e-5);
        println!("{report:?}");
        assert_close(&format!("scattering, g {g}"), bound, found, expected);
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
                let ([found, expected], report) = solve(medium(albedo, g), escape, tolerance);
                let error = distance(found, expected);
                println!("albedo {albedo:?}, g {g}, escape {escape}: {report:?}, true error {error:.2e}");
                assert!(report.converged && error <= f64::from(tolerance), "{report:?} {error}");
            }
        }
    }
}
