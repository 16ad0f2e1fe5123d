use bevy::math::{Mat3, Quat};

use super::*;
use crate::reference::shadow_probes::{SHADOW_DIRECTIONS, SHADOW_STEPS, position, probe};
use crate::render::prepare::linear_sampler;
use crate::render::shadow_probes::{self, Bindings, PROBE_TEXELS, PROBES};
use crate::render::sky::SkyUniform;

#[test]
fn shadow_probes_match_their_twin() {
    let (gpu, frame) = (Gpu::new(), fixture());
    let coarse = crate::reference::coarse::coarse(&twin_density(&frame));
    let mut random = Random(31);
    let environment = random_light(&mut random);
    let rotation = Quat::from_rotation_x(0.4) * Quat::from_rotation_y(2.1);
    let sun = (Vec3::new(0.6, 0.0, 0.8), Vec3::new(0.05, 0.1, 0.2));
    let sky = SkyUniform {
        environment_from_world: Mat3::from_quat(rotation),
        ambient: Vec3::new(0.3, 0.1, 0.7),
        scale: 0.5,
        sun_direction: sun.0,
        sun_irradiance: sun.1,
        unit: 1.0,
    };
    // Turned, moved and scaled, in the second of two slots.
    let world = DAffine3::from_scale_rotation_translation(
        DVec3::splat(2.0),
        DQuat::from_rotation_y(0.7) * DQuat::from_rotation_z(-0.4),
        DVec3::new(3.0, 1.0, -2.0),
    );
    let other = Other { coarse: coarse.clone(), from_here: world.inverse(), sigma: 3.0 };
    let output = shadow_probes::probe_texture(2, gpu.device());
    let pass = &gpu.passes().shadow_probes;
    let bindings = Bindings {
        caster: &uniform(gpu.device(), gpu.queue(), "test", caster_uniform(&other, 1)),
        sky: &uniform(gpu.device(), gpu.queue(), "test", sky),
        environment: &uniform(gpu.device(), gpu.queue(), "test", environment.0.map(|c| c.as_vec3().extend(0.0))),
        world_from_bundle: &uniform(gpu.device(), gpu.queue(), "test", DMat4::from(world).as_mat4()),
        densities: &caster_densities(&gpu, &[other.clone(), other.clone()]),
        sampler: &linear_sampler(gpu.device()),
        probes: &output,
    };
    let bind_group = shadow_probes::bind(pass, bindings, gpu.device(), gpu.cache());
    gpu.run(pass, Job { bind_group, workgroups: shadow_probes::workgroups() });

    let turn = DQuat::from_rotation_y(0.7) * DQuat::from_rotation_z(-0.4);
    let [x, y, z, w] = rotation.to_array().map(f64::from);
    let environment_from_bundle = DQuat::from_xyzw(x, y, z, w) * turn;
    let mut sunless = environment;
    sunless.accumulate(sun.0.as_dvec3(), -sun.1.as_dvec3());
    let radiance = |w: DVec3| 0.5 * sunless.evaluate(environment_from_bundle * w) + sky.ambient.as_dvec3();
    let half_extent = frame.residual.shape().half_extent().as_dvec3();
    let texels = gpu.read_texels(&output);
    let (mut found, mut expected) = (Vec::new(), Vec::new());
    for i in 0..PROBES.pow(3) {
        let at = UVec3::new(i % PROBES, i / PROBES % PROBES, i / PROBES.pow(2));
        let ends = at.cmpeq(UVec3::ZERO).any() || at.cmpeq(UVec3::splat(PROBES - 1)).any();
        // A few will do for the twin.
        if i % 7 != 0 && !ends {
            continue;
        }
        let twin = match ends {
            true => Default::default(),
            false => {
                probe(position(at, half_extent), &coarse, half_extent, 3.0, radiance, SHADOW_DIRECTIONS, SHADOW_STEPS)
            }
        };
        for (channel, missing) in twin.0.into_iter().enumerate() {
            // The twin's directions are the bundle's, the pass's the world's.
            let v = turn * DVec3::new(missing.y, missing.z, missing.w);
            expected.extend([missing.x, v.x, v.y, v.z]);
            let layer = (PROBE_TEXELS + channel as u32) * PROBES + at.z;
            let texel = 4 * (at.x + PROBES * (at.y + PROBES * layer)) as usize;
            found.extend(texels[texel..texel + 4].iter().map(|&v| f64::from(v)));
        }
    }
    assert!(expected.iter().any(|v| *v > 0.1) && texels[..4 * (PROBES.pow(3)) as usize].iter().all(|v| *v == 0.0));
    assert_close("shadow probes", HALF, found, expected);
}
