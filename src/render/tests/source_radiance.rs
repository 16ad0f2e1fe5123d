use bevy::math::{DMat3, DQuat, Mat3, Quat, Vec4};

use super::*;
use crate::reference::{self, source_radiance::Lighting};
use crate::render::frame::{FILTERED_FORMAT, uniform};
use crate::render::prepare::linear_sampler;
use crate::render::source_radiance::{self, Bindings, LightingUniform};
use crate::sh::{COEFFICIENTS, Sh};

#[test]
fn source_radiance_matches_its_twin() {
    let (gpu, frame) = (Gpu::new(), fixture());
    let shape = frame.residual.shape();
    let coarse = reference::coarse::coarse(&twin_density(&frame));
    let mut uploaded = gpu.frame(&frame);
    uploaded.coarse = gpu.texture_3d(coarse.shape.dims + 2, FILTERED_FORMAT, |texel| {
        let inside = texel.cmpge(UVec3::ONE).all() && texel.cmple(coarse.shape.dims).all();
        if inside { coarse.values[coarse.shape.index(texel - 1)] as f32 } else { 0.0 }
    });
    assert_eq!(coarse.shape, shape.coarse());

    let mut random = Random(11);
    let environment: [DVec3; COEFFICIENTS] = std::array::from_fn(|k| {
        let scale = if k == 0 { 3.0 } else { 0.6 };
        scale * (random.vector() - if k == 0 { 0.0 } else { 0.5 })
    });
    let rotation = Quat::from_rotation_x(0.4) * Quat::from_rotation_y(2.1);
    let (sigma, g) = (6.5, 0.45_f32);
    let albedo = Vec3::new(0.9, 0.6, 0.2);
    let lighting = uniform(
        gpu.device(),
        gpu.queue(),
        "test",
        LightingUniform {
            environment_from_bundle: Mat3::from_quat(rotation),
            albedo,
            sigma,
            bands: Vec4::new(1.0, g, g * g, g * g * g),
        },
    );
    let padded: Vec<[f32; 4]> = environment.iter().map(|c| c.as_vec3().extend(0.0).to_array()).collect();
    let coefficients = gpu.buffer(&padded);
    let count = rbfs(&frame).len() * 4 * COEFFICIENTS;
    let probes = gpu.buffer(&vec![[0.0_f32; 4]; count]);
    let pass = &gpu.passes().source_radiance;
    let sampler = linear_sampler(gpu.device());
    let bindings = Bindings {
        frame: &uploaded,
        lighting: &lighting,
        environment: &coefficients,
        sampler: &sampler,
        probes: &probes,
    };
    let bind_group = source_radiance::bind(pass, bindings, gpu.device(), gpu.cache());
    gpu.run(pass, Job { bind_group, workgroups: source_radiance::workgroups(&uploaded) });

    let lighting = Lighting {
        environment: Sh(environment),
        env_from_local: DMat3::from_quat(DQuat::from_xyzw(
            rotation.x.into(),
            rotation.y.into(),
            rotation.z.into(),
            rotation.w.into(),
        )),
    };
    let medium = reference::Medium { sigma: sigma.into(), albedo: albedo.as_dvec3(), g: g.into() };
    let expected = reference::source_radiance::source_radiance(rbfs(&frame), &coarse, &lighting, &medium);
    let found = gpu.read_floats(&probes);
    let found = found.as_chunks::<4>().0.iter().flat_map(|c| c[..3].to_vec()).map(f64::from);
    let expected = expected.iter().flatten().flat_map(|probe| probe.0).flat_map(rgb);
    assert_close("source radiance", HALF, found, expected);
}
