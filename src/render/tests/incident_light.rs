use bevy::color::LinearRgba;
use bevy::math::{DMat3, DQuat, Mat3, Quat};

use super::*;
use crate::medium::SmokeMedium;
use crate::reference::PROBES;
use crate::reference::incident_light::Lighting;
use crate::render::frame::uniform;
use crate::render::incident_light::{self, Bindings};
use crate::render::lighting::{LightingUniform, MAX_LAMPS};
use crate::render::prepare::linear_sampler;
use crate::sh::COEFFICIENTS;

#[test]
fn incident_light_matches_its_twin() {
    let (gpu, frame) = (Gpu::new(), fixture());
    let (coarse, uploaded) = coarse_frame(&gpu, &frame);
    let mut random = Random(11);
    let environment = random_light(&mut random);
    let rotation = Quat::from_rotation_x(0.4) * Quat::from_rotation_y(2.1);
    // Coloured, so that delta-M gives every channel its own extinction.
    let medium = SmokeMedium { albedo: LinearRgba::rgb(0.9, 0.6, 0.2), g: 0.7, ..SmokeMedium::default() };
    let lighting = LightingUniform {
        environment_from_bundle: Mat3::from_quat(rotation),
        environment_scale: 1.0,
        ..LightingUniform::of_medium(&medium, 6.5, true)
    };
    let sigma = lighting.sigma.as_dvec3();
    let lighting = uniform(gpu.device(), gpu.queue(), "test", lighting);
    let coefficients = gpu.buffer(&pad(environment.0));
    let count = rbfs(&frame).len() * PROBES;
    let probes = gpu.buffer(&vec![[0.0_f32; 4]; count * COEFFICIENTS]);
    let columns = gpu.buffer(&vec![0.0_f32; count * MAX_LAMPS]);
    let pass = &gpu.passes().incident_light;
    let sampler = linear_sampler(gpu.device());
    let bindings = Bindings {
        frame: &uploaded,
        lighting: &lighting,
        environment: &coefficients,
        sampler: &sampler,
        probes: &probes,
        columns: &columns,
    };
    let bind_group = incident_light::bind(pass, bindings, gpu.device(), gpu.cache());
    gpu.run(pass, Job { bind_group, workgroups: incident_light::workgroups(&uploaded) });

    let [x, y, z, w] = rotation.to_array().map(f64::from);
    let lighting = Lighting { environment, env_from_local: DMat3::from_quat(DQuat::from_xyzw(x, y, z, w)) };
    let expected = crate::reference::incident_light::incident_light(rbfs(&frame), &coarse, &lighting, sigma);
    let found = gpu.read_floats(&probes);
    let light = expected.iter().flatten().flat_map(|probe| probe.light.0).flat_map(rgb);
    assert_close("incident light", HALF, unpad(&found), light);
    let escape = found.as_chunks::<64>().0.iter().flat_map(|probe| [probe[3], probe[7], probe[11]]);
    let expected = expected.iter().flatten().flat_map(|probe| rgb(probe.escape));
    assert_close("escaping light", HALF, escape.map(f64::from), expected);
}
