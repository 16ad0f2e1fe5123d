use bevy::color::LinearRgba;

use super::*;
use crate::medium::SmokeMedium;
use crate::quality::SmokeModel;
use crate::reference::{self, Medium, diffusion as twin};
use crate::render::diffusion::{Bindings, DiffusionJob, DiffusionUniform, control_buffer, solution_buffer};
use crate::render::frame::uniform;
use crate::render::incident_light::COLUMN_BYTES;
use crate::render::lighting::LightingUniform;
use crate::render::prepare::linear_sampler;
use crate::render::scattering::SolverReport;
use crate::sh::{COEFFICIENTS, Sh, ShRgb, henyey_greenstein_factors};

/// The light that the pass adds to so many probes of each RBF of the fixture, and what its twin adds; and the solver's report.
fn solve(g: f32, solves: usize, probes: u32) -> ([Vec<f64>; 2], SolverReport) {
    let (gpu, frame) = (Gpu::new(), fixture());
    let shape = frame.residual.shape();
    let (coarse, uploaded) = coarse_frame(&gpu, &frame);
    let mut random = Random(19);
    // Alike all over the smoke, as light is: between RBFs that overlap little, what is seen is how bins list them.
    let mean = random_light(&mut random);
    let mut light: Vec<[ShRgb; reference::PROBES]> =
        rbfs(&frame).iter().map(|_| core::array::from_fn(|_| mean + random_light(&mut random) * 0.1)).collect();
    if probes == 1 {
        // One stands for all.
        light.iter_mut().for_each(|probes| *probes = [probes[0]; reference::PROBES]);
    }
    let smoke = SmokeMedium { albedo: LinearRgba::rgb(0.9, 0.6, 0.2), g, ..SmokeMedium::default() };
    // Thin enough that the probes are a radius away.
    let sigma = 7.0;
    let model = SmokeModel { probes, ..SmokeModel::FULL };
    let lighting = LightingUniform::of_medium(&smoke, sigma, false).reduced(&model, true);
    let lighting = uniform(gpu.device(), gpu.queue(), "test", lighting);
    let diffusion = DiffusionUniform::new(shape, 1e-3);
    let diffusion = uniform(gpu.device(), gpu.queue(), "test", diffusion);
    let padded = pad(light.iter().flatten().flat_map(|probe| probe.0));
    let columns = vec![0_u8; rbfs(&frame).len() * COLUMN_BYTES as usize];
    let solution = solution_buffer(shape, gpu.device());
    let mut found = vec![];
    let mut report = None;
    for _ in 0..solves {
        let probes = gpu.buffer(&padded);
        let control = control_buffer(gpu.device());
        let bindings = Bindings {
            frame: &uploaded,
            lighting: &lighting,
            diffusion: &diffusion,
            sampler: &linear_sampler(gpu.device()),
            probes: &probes,
            columns: &gpu.buffer(&columns),
            solution: &solution,
            control: &control,
        };
        let pass = &gpu.passes().diffusion;
        let groups = bindings.bind(shape, pass, gpu.device(), gpu.cache());
        let job = DiffusionJob { bind_groups: Arc::new(groups), rbf_count: uploaded.rbf_count };
        gpu.run_all(&pass.jobs(&job));
        found = gpu.read_floats(&probes);
        report = SolverReport::from_bytes(&read_buffer(gpu.device(), gpu.queue(), &control));
    }
    let before = padded.iter().flat_map(|c| c[..3].to_vec()).map(f64::from);
    let added = unpad(&found).zip(before).map(|(after, before)| after - before).collect();

    let albedo = DVec3::new(0.9, 0.6, 0.2);
    let medium = Medium { sigma: sigma.into(), albedo: albedo.as_vec3().as_dvec3(), g: g.into() };
    let factors = henyey_greenstein_factors(medium.g);
    let scatter = |light: ShRgb| Sh(light.convolve(&factors).0.map(|c| c * medium.albedo));
    let single: Vec<_> = light.iter().map(|probes| probes.map(scatter)).collect();
    let cells = twin::cells(&coarse);
    let source = twin::cell_source(rbfs(&frame), &single, medium.sigma, cells.shape);
    let settings = twin::Settings { steps: 200, tolerance: 1e-6, ..twin::Settings::default() };
    let field = twin::diffuse(&cells, &source, &medium, &settings, None);
    // The pass adds light, which scatters later.
    let light = |sh: ShRgb| {
        Sh(core::array::from_fn(|k| {
            let factor = factors[crate::sh::band(k)];
            if factor == 0.0 { DVec3::ZERO } else { sh.0[k] / (medium.albedo * factor) }
        }))
    };
    let expected = field.scatter(rbfs(&frame), &medium);
    let added_to = |i: usize| if i < probes as usize { 1.0 } else { 0.0 };
    let all = expected.iter().flat_map(|rbf| rbf.iter().enumerate());
    let expected: Vec<f64> = all.flat_map(|(i, sh)| light(*sh * added_to(i)).0).flat_map(rgb).collect();
    assert_eq!(expected.len(), rbfs(&frame).len() * reference::PROBES * COEFFICIENTS * 3);
    ([added, expected], report.unwrap())
}

#[test]
fn diffusion_matches_its_twin() {
    // A cloud with holes takes more steps than one solve has: the next goes on.
    for probes in [7, 1] {
        let ([found, expected], report) = solve(0.4, 6, probes);
        println!("{report:?}");
        // The residual of the solution is 2e-4.
        assert_close(&format!("diffusion, {probes} probes"), FILTERED, found, expected);
        assert!(report.converged, "{report:?}");
    }
}

#[test]
fn a_solution_is_a_start() {
    let (_, cold) = solve(0.4, 1, 7);
    let (_, warm) = solve(0.4, 7, 7);
    println!("{cold:?} {warm:?}");
    assert!(cold.sweeps == 20 && warm.converged && warm.sweeps == 0, "{cold:?} {warm:?}");
}
