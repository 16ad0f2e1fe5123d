use bevy::math::Vec4;

use super::*;
use crate::reference::outgoing::{Outgoing, Viewer};
use crate::reference::transport;
use crate::render::frame::uniform;
use crate::render::outgoing::{self, Bindings, LookUniform, OUTGOING_BYTES, SHADE_BYTES};

/// The seven coefficients of fits, with slopes per radius and curvatures per radius squared: all of one magnitude.
fn scaled(rbfs: &[Rbf], coefficients: impl Iterator<Item = [DVec3; 7]>) -> Vec<f64> {
    let scale = |(coefficients, rbf): ([DVec3; 7], &Rbf)| {
        let r = f64::from(rbf.radius);
        let factors = [1.0, r, r, r, r * r, r * r, r * r];
        coefficients.into_iter().zip(factors).flat_map(|(c, factor)| rgb(c * factor)).collect::<Vec<_>>()
    };
    coefficients.zip(rbfs).flat_map(scale).collect()
}

fn of_twin(fit: &Outgoing) -> [DVec3; 7] {
    let (g, q) = (fit.gradient, fit.curvature);
    [fit.center, g.x_axis, g.y_axis, g.z_axis, q.x_axis, q.y_axis, q.z_axis]
}

fn check(what: &str, eye: Vec4, viewer: Viewer, model: SmokeModel) {
    let (gpu, frame) = (Gpu::new(), fixture());
    let (coarse, uploaded) = coarse_frame(&gpu, &frame);
    let rbfs = rbfs(&frame);
    let mut random = Random(13);
    let mut incident = random_incident(&mut random, rbfs.len(), 0.9);
    if model.probes == 1 {
        incident = incident.iter().map(|probes| [probes[0]; PROBES]).collect();
    }
    let [probes, escapes] = pack_incident(&gpu, &incident);
    let pairs = transport::pair_matrix(rbfs, &coarse, 5.0);
    let rows: Vec<f32> = twin_rows(rbfs, &coarse, 5.0, &pairs).iter().map(|&v| v as f32).collect();
    let columns: Vec<f32> = (0..rbfs.len() * PROBES * MAX_LAMPS).map(|_| random.next() as f32).collect();
    // Light that scatters once, then also more often, evenly and forward.
    for (medium, multiple, coefficients) in [
        (medium([0.9, 0.6, 0.3], 0.7), false, 0),
        (medium([0.9, 0.6, 0.3], 0.0), true, 1),
        (medium([0.9, 0.6, 0.3], 0.7), true, model.order.pow(2)),
    ] {
        let lighting = LightingUniform::of_medium(&medium, 5.0, multiple).reduced(&model, false);
        let lighting = lit_by_lamps(lighting);
        assert_eq!(lighting.coefficients, coefficients);
        let mut gathered: Vec<ShRgb> = rbfs.iter().map(|_| random_light(&mut random)).collect();
        for light in &mut gathered {
            light.0[coefficients as usize..].fill(DVec3::ZERO);
        }
        let kept = pad(gathered.iter().flat_map(|light| light.0[..coefficients as usize].to_vec()));
        let kept = if kept.is_empty() { vec![[f32::NAN; 4]] } else { kept };
        let fits = gpu.buffer(&vec![0_u8; rbfs.len() * OUTGOING_BYTES as usize]);
        let shades = gpu.buffer(&vec![0_u8; rbfs.len() * SHADE_BYTES as usize]);
        let pass = &gpu.passes().outgoing;
        let bindings = Bindings {
            frame: &uploaded,
            lighting: &uniform(gpu.device(), gpu.queue(), "test", lighting),
            look: &uniform(gpu.device(), gpu.queue(), "test", LookUniform { eye }),
            probes: &probes,
            escapes: &escapes,
            gathered: &gpu.buffer(&kept),
            rows: &gpu.buffer(&rows),
            columns: &gpu.buffer(&columns),
            outgoing: &fits,
            shades: &shades,
        };
        let bind_group = outgoing::bind(pass, bindings, gpu.device(), gpu.cache());
        gpu.run(pass, Job { bind_group, workgroups: outgoing::workgroups(&uploaded) });

        let what = format!("{what}, {coefficients} coefficients");
        let medium = twin_medium(&medium, 5.0);
        let surroundings = transport::surroundings(rbfs, &pairs);
        let order = model.order as usize;
        let source = transport::source_radiance_of_order(&incident, &gathered, &surroundings, &medium, order);
        let expected = reference::outgoing::outgoing(rbfs, &source, viewer, 5.0);
        let found = gpu.read_floats(&fits);
        let found = found.as_chunks::<28>().0;
        let of_pass = |fit: &[f32; 28]| -> [DVec3; 7] {
            std::array::from_fn(|i| Vec3::from_slice(&fit[4 * i..4 * i + 3]).as_dvec3())
        };
        let [a, b] = [scaled(rbfs, found.iter().map(of_pass)), scaled(rbfs, expected.iter().map(of_twin))];
        assert_close(&what, EXACT, a, b);
        let bounds = found.iter().flat_map(|fit| (0..6).map(|i| f64::from(fit[4 * i + 3])));
        let expected = expected.iter().flat_map(|fit| [fit.low, fit.high]).flat_map(rgb);
        assert_close(&format!("{what}, bounds"), EXACT, bounds, expected);

        // Four lamps to a fit.
        let found = gpu.read_floats(&shades);
        let found = found.as_chunks::<56>().0;
        for lamp in 0..lamps().len() {
            let of_pass = |fits: &[f32; 56]| -> [DVec3; 7] {
                std::array::from_fn(|i| DVec3::splat(fits[28 * (lamp / 4) + 4 * i + lamp % 4].into()))
            };
            let of_twin = |(l, rbf): (usize, &Rbf)| {
                let value = |i: usize| {
                    let probe = if model.probes == 1 { 0 } else { i };
                    DVec3::splat(columns[(l * PROBES + probe) * MAX_LAMPS + lamp].into())
                };
                of_twin(&Outgoing::through(std::array::from_fn(value), rbf.radius.into()))
            };
            let expected = scaled(rbfs, rbfs.iter().enumerate().map(of_twin));
            assert_close(&format!("shade of lamp {lamp}"), EXACT, scaled(rbfs, found.iter().map(of_pass)), expected);
        }
    }
}

#[test]
fn outgoing_matches_its_twin_from_an_eye() {
    // Inside the smoke, where the directions to the probes differ most.
    let eye = Vec3::new(0.11, -0.07, 0.2);
    check("outgoing, perspective", eye.extend(1.0), Viewer::Perspective { eye: eye.as_dvec3() }, SmokeModel::FULL);
}

#[test]
fn outgoing_matches_its_twin_under_parallel_rays() {
    let forward = Vec3::new(1.0, -2.0, 0.5).normalize();
    let viewer = Viewer::Orthographic { forward: forward.as_dvec3() };
    check("outgoing, orthographic", forward.extend(0.0), viewer, SmokeModel::FULL);
    // From the centres alone, and with fewer bands.
    let model = SmokeModel { probes: 1, order: 2, ..SmokeModel::FULL };
    check("outgoing, one probe", forward.extend(0.0), viewer, model);
}
