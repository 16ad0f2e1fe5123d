use bevy::math::{DMat3, DQuat, Mat3, Quat};

use super::*;
use crate::reference::DIRECTIONS;
use crate::reference::incident_light::Lighting;
use crate::render::frame::uniform;
use crate::render::incident_light::{self, Bindings};
use crate::render::prepare::linear_sampler;
use crate::sh::COEFFICIENTS;

fn check(extinction: f32, around: &Surroundings, directions: usize) {
    let (gpu, frame) = (Gpu::new(), fixture());
    let buffers = Around::new(&gpu, around);
    let (coarse, uploaded) = coarse_frame(&gpu, &frame);
    let mut random = Random(11);
    let environment = random_light(&mut random);
    let ambient = Vec3::new(0.3, 0.1, 0.7);
    let rotation = Quat::from_rotation_x(0.4) * Quat::from_rotation_y(2.1);
    // Coloured, so that delta-M gives every channel its own extinction.
    let medium = medium([0.9, 0.6, 0.2], 0.7);
    let lighting = lit_by_lamps(LightingUniform {
        environment_from_bundle: Mat3::from_quat(rotation),
        ambient,
        environment_scale: 0.5,
        ..LightingUniform::of_medium(&medium, extinction, true)
    });
    let sigma = lighting.sigma.as_dvec3();
    let lighting = uniform(gpu.device(), gpu.queue(), "test", lighting);
    let count = rbfs(&frame).len() * PROBES;
    let light = gpu.buffer(&vec![[0.0_f32; 4]; count * COEFFICIENTS]);
    let escapes = gpu.buffer(&vec![[0.0_f32; 4]; count]);
    let columns = gpu.buffer(&vec![0.0_f32; count * MAX_LAMPS]);
    let passes = &gpu.passes().incident_light;
    let bindings = Bindings {
        frame: &uploaded,
        lighting: &lighting,
        environment: &gpu.buffer(&pad(environment.0)),
        sampler: &linear_sampler(gpu.device()),
        probes: &light,
        escapes: &escapes,
        columns: &columns,
        surroundings: &buffers.surroundings,
        spheres: &buffers.spheres,
        densities: &buffers.densities,
    };
    let bind_group = incident_light::bind(passes, bindings, gpu.device(), gpu.cache());
    gpu.run(
        passes.of(directions as u32),
        Job { bind_group, workgroups: incident_light::workgroups(&uploaded, PROBES as u32, directions as u32) },
    );

    let [x, y, z, w] = rotation.to_array().map(f64::from);
    let environment = Sh(environment.0.map(|c| 0.5 * c)) + Sh::constant(ambient.as_dvec3());
    let lighting = Lighting { environment, env_from_local: DMat3::from_quat(DQuat::from_xyzw(x, y, z, w)) };
    // The passes see densities, and so RBFs, scaled; this coarse density is not.
    let scaled: Vec<Rbf> = rbfs(&frame).iter().map(|rbf| Rbf { weight: rbf.weight / MAX_DENSITY, ..*rbf }).collect();
    let reach = |rbf: &Rbf| reference::incident_light::reach(rbf, sigma.element_sum() / 3.0);
    let at = |p: DVec3| reference::incident_light::incident(p, &coarse, &lighting, sigma, around, directions);
    let expected: Vec<_> = scaled.iter().flat_map(|rbf| probes(rbf, reach(rbf)).map(at)).collect();
    let expected = || expected.iter();
    let found = gpu.read_floats(&light);
    assert_close("incident light", FILTERED, unpad(&found), expected().flat_map(|probe| probe.light.0).flat_map(rgb));
    let passing = found.iter().skip(3).step_by(4).map(|&t| f64::from(t));
    assert_close("transmittance by direction", FILTERED, passing, expected().flat_map(|probe| probe.passing.0));
    let found = gpu.read_floats(&escapes);
    assert_close("escaping light", FILTERED, unpad(&found), expected().flat_map(|probe| rgb(probe.escape)));
    // The other lamps' are never read.
    let found = gpu.read_floats(&columns);
    let expected = twin_columns(&scaled, &coarse, around, sigma, reach);
    let magnitudes = found.iter().map(|column| f64::from(column.abs()));
    assert_close("columns to lamps", HALF, magnitudes, expected.iter().map(|column| f64::from(column.abs())));
    // A ray that grazes a sphere may fall to either side.
    let differ = found.iter().zip(&expected).filter(|(a, b)| (**a < 0.0) != (**b < 0.0)).count();
    assert!(differ * 1000 < found.len(), "{differ} of {} lamps are hidden here or there", found.len());
    if !around.spheres.is_empty() {
        let hidden = expected.iter().filter(|column| **column < 0.0).count();
        assert!(hidden * 20 > expected.len(), "only {hidden} of {} lamps are hidden", expected.len());
    }
}

#[test]
fn incident_light_matches_its_twin() {
    check(6.5, &Surroundings::default(), DIRECTIONS);
}

#[test]
fn incident_light_matches_its_twin_where_probes_are_moved_out() {
    // Optical depths of up to 50, of which only what passes is seen.
    check(300.0, &Surroundings::default(), DIRECTIONS);
}

#[test]
fn incident_light_matches_its_twin_among_spheres_and_other_smoke() {
    check(6.5, &surroundings(&fixture()), DIRECTIONS);
}

#[test]
fn incident_light_matches_its_twin_in_fewer_directions() {
    // 40 RBFs: workgroups of two and of four are full, of the last.
    check(6.5, &Surroundings::default(), 32);
    check(6.5, &Surroundings::default(), 16);
}
