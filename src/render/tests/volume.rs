use bevy::math::Vec4;

use super::*;
use crate::rbf::RbfBins;
use crate::reference::{self, outgoing::Outgoing};
use crate::render::frame::{FILTERED_FORMAT, texture_3d, uniform};
use crate::render::lighting::LightingUniform;
use crate::render::outgoing::LookUniform;
use crate::render::volume::{self, Bindings};

#[test]
fn volume_matches_its_twin() {
    let (gpu, frame) = (Gpu::new(), fixture());
    let shape = frame.residual.shape();
    let density = twin_density(&frame);
    let mut uploaded = gpu.frame(&frame);
    uploaded.density =
        gpu.texture_3d(shape.dims, TextureFormat::R32Float, |cell| density.values[shape.index(cell)] as f32);
    let mut random = Random(17);
    // Gradients large enough that some cells would go below zero.
    let outgoing: Vec<Outgoing> = rbfs(&frame)
        .iter()
        .map(|_| Outgoing {
            center: random.vector(),
            gradient: bevy::math::DMat3::from_cols(
                10.0 * (random.vector() - 0.5),
                10.0 * (random.vector() - 0.5),
                10.0 * (random.vector() - 0.5),
            ),
            curvature: bevy::math::DMat3::ZERO,
            low: DVec3::NEG_INFINITY,
            high: DVec3::INFINITY,
        })
        .collect();
    let packed: Vec<[f32; 4]> = outgoing
        .iter()
        .flat_map(|o| [o.center, o.gradient.x_axis, o.gradient.y_axis, o.gradient.z_axis])
        .map(|v| v.as_vec3().extend(0.0).to_array())
        .collect();
    let buffer = gpu.buffer(&packed);
    let output = texture_3d(gpu.device(), "test", shape.dims + 2, FILTERED_FORMAT);
    let pass = &gpu.passes().volume;
    let bindings = Bindings {
        frame: &uploaded,
        lighting: &uniform(gpu.device(), gpu.queue(), "test", LightingUniform::default()),
        look: &uniform(gpu.device(), gpu.queue(), "test", LookUniform { eye: Vec4::Z }),
        outgoing: &buffer,
        shades: &gpu.buffer(&vec![[0.0_f32; 32]; rbfs(&frame).len()]),
        volume: &output,
    };
    let bind_group = volume::bind(pass, bindings, gpu.device(), gpu.cache());
    gpu.run(pass, Job { bind_group, workgroups: volume::workgroups(shape) });

    let texels = gpu.read_texels(&output);
    let texels = texels.as_chunks::<4>().0;
    let twin = reference::volume::volume(rbfs(&frame), &outgoing, &RbfBins::new(rbfs(&frame), shape), &density);
    assert_close(
        "volume, density",
        HALF,
        texels.iter().map(|t| f64::from(t[3] * MAX_DENSITY)),
        twin.density.iter().copied(),
    );
    // Where no density is near, the pass leaves black what the twin still computes: nothing ever reads it.
    let padded = GridShape::new(shape.dims + 2);
    let read = |i: &usize| {
        let cell = padded.cell(*i).as_ivec3() - 1;
        let near = |d: bevy::math::IVec3| {
            let other = cell + d;
            let inside = other.cmpge(bevy::math::IVec3::ZERO).all() && other.cmplt(shape.dims.as_ivec3()).all();
            inside && density.values[shape.index(other.as_uvec3())] > 0.0
        };
        (0..27).any(|n| near(bevy::math::IVec3::new(n % 3, n / 3 % 3, n / 9) - 1))
    };
    let cells: Vec<usize> = (0..padded.len()).filter(read).collect();
    assert!(cells.len() > padded.len() / 4 && cells.len() < padded.len());
    let found = cells.iter().flat_map(|&i| texels[i][..3].to_vec()).map(f64::from);
    let expected = cells.iter().flat_map(|&i| rgb(twin.radiance[i]));
    assert_close("volume, radiance", HALF, found, expected);
}
