use bevy::math::Vec4;

use super::*;
use crate::reference::{self, outgoing::Viewer};
use crate::render::frame::uniform;
use crate::render::lighting::{LightingUniform, MAX_LAMPS};
use crate::render::outgoing::{self, Bindings, LookUniform};
use crate::sh::{COEFFICIENTS, Sh, ShRgb};

fn check(what: &str, eye: Vec4, viewer: Viewer) {
    let (gpu, frame) = (Gpu::new(), fixture());
    let uploaded = gpu.frame(&frame);
    let mut random = Random(13);
    let source: Vec<[ShRgb; reference::PROBES]> = rbfs(&frame)
        .iter()
        .map(|_| std::array::from_fn(|_| Sh(std::array::from_fn(|_| random.vector().as_vec3().as_dvec3()))))
        .collect();
    // Light that meets a medium which keeps it as it is: albedo 1 in every band, nothing scattered twice.
    let lighting = LightingUniform { scatter: [Vec4::ONE; 4], ..Default::default() };
    let lighting = uniform(gpu.device(), gpu.queue(), "test", lighting);
    let padded = pad(source.iter().flatten().flat_map(|probe| probe.0));
    assert_eq!(padded.len(), rbfs(&frame).len() * reference::PROBES * COEFFICIENTS);
    let probes = gpu.buffer(&padded);
    let output = gpu.buffer(&vec![[0.0_f32; 16]; rbfs(&frame).len()]);
    let zeros = |floats: usize| gpu.buffer(&vec![0.0_f32; floats * rbfs(&frame).len()]);
    let look = uniform(gpu.device(), gpu.queue(), "test", LookUniform { eye });
    let pass = &gpu.passes().outgoing;
    let bindings = Bindings {
        frame: &uploaded,
        lighting: &lighting,
        look: &look,
        probes: &probes,
        gathered: &zeros(64),
        columns: &zeros(4 * MAX_LAMPS),
        outgoing: &output,
        shades: &zeros(32),
    };
    let bind_group = outgoing::bind(pass, bindings, gpu.device(), gpu.cache());
    gpu.run(pass, Job { bind_group, workgroups: outgoing::workgroups(&uploaded) });

    let found = gpu.read_floats(&output);
    let expected = reference::outgoing::outgoing(rbfs(&frame), &source, viewer);
    // The gradient's columns are the derivatives along x, y and z.
    let expected =
        expected.iter().flat_map(|o| [o.center, o.gradient.x_axis, o.gradient.y_axis, o.gradient.z_axis]).flat_map(rgb);
    assert_close(what, EXACT, unpad(&found), expected);
}

#[test]
fn outgoing_matches_its_twin_from_an_eye() {
    // Inside the smoke, where the directions to the probes differ most.
    let eye = Vec3::new(0.11, -0.07, 0.2);
    check("outgoing, perspective", eye.extend(1.0), Viewer::Perspective { eye: eye.as_dvec3() });
}

#[test]
fn outgoing_matches_its_twin_under_parallel_rays() {
    let forward = Vec3::new(1.0, -2.0, 0.5).normalize();
    check("outgoing, orthographic", forward.extend(0.0), Viewer::Orthographic { forward: forward.as_dvec3() });
}
