use bevy::render::render_resource::TextureViewDimension;

use super::*;
use crate::reference;
use crate::render::environment::{RadianceMap, coefficient_buffer};
use crate::render::prepare::linear_sampler;
use crate::sh::ShRgb;

fn project(gpu: &Gpu, map: RadianceMap<'_>) -> Vec<f32> {
    let coefficients = coefficient_buffer(gpu.device());
    let pass = &gpu.passes().environment;
    let job = pass.job(map, &coefficients, gpu.device(), gpu.cache());
    gpu.run_all(&pass.jobs(&job));
    let padded = gpu.read_floats(&coefficients);
    padded.as_chunks::<4>().0.iter().flat_map(|texel| texel[..3].to_vec()).collect()
}

#[test]
fn one_texel_a_face_is_a_sky_of_one_colour() {
    let gpu = Gpu::new();
    let data: Vec<u8> =
        [3.0, 2.0, 0.5, 1.0].repeat(6).into_iter().flat_map(|v| f16::from_f32(v).to_le_bytes()).collect();
    let texture = gpu.texture(UVec3::new(1, 1, 6), TextureDimension::D2, TextureFormat::Rgba16Float, &data);
    let view = texture
        .create_view(&TextureViewDescriptor { dimension: Some(TextureViewDimension::Cube), ..Default::default() });
    let sampler = linear_sampler(gpu.device());
    let found = project(&gpu, RadianceMap::Cube(&view, &sampler));
    let expected = ShRgb::constant(DVec3::new(3.0, 2.0, 0.5));
    // The midpoint rule on 32 samples a side is off by about its spacing squared over 6: (2/32)^2 / 6 = 7e-4.
    assert_close("environment, one texel a face", HALF, widen(&found), flat(&expected));
}

fn flat(sh: &ShRgb) -> Vec<f64> {
    sh.0.iter().flat_map(|&c| rgb(c)).collect()
}

#[test]
fn equirect_projection_matches_its_twin() {
    let gpu = Gpu::new();
    let (width, height) = (50, 23);
    let mut random = Random(3);
    let texels: Vec<DVec3> = (0..width * height).map(|_| 20.0 * random.vector()).collect();
    let data: Vec<u8> =
        texels.iter().flat_map(|t| t.as_vec3().extend(1.0).to_array()).flat_map(f32::to_le_bytes).collect();
    let size = UVec3::new(width, height, 1);
    let texture = gpu.texture(size, TextureDimension::D2, TextureFormat::Rgba32Float, &data);
    let view = texture.create_view(&TextureViewDescriptor::default());
    let found = project(&gpu, RadianceMap::Equirect(&view));
    let expected = reference::environment::equirect(width as usize, &texels);
    assert_close("environment, equirect", EXACT, widen(&found), flat(&expected));
}

#[test]
fn cube_projection_matches_its_twin() {
    let gpu = Gpu::new();
    // At least 32: below that the pass samples between the texels.
    let side = 37usize;
    let mut random = Random(5);
    // Halves, so that the texture holds the very values.
    let half = |v: f64| f64::from(f16::from_f64(v));
    let faces: Vec<Vec<DVec3>> =
        (0..6).map(|_| (0..side * side).map(|_| (20.0 * random.vector()).map(half)).collect()).collect();
    let data: Vec<u8> = faces
        .iter()
        .flatten()
        .flat_map(|t| t.extend(1.0).to_array())
        .flat_map(|v| f16::from_f64(v).to_le_bytes())
        .collect();
    let size = UVec3::new(side as u32, side as u32, 6);
    let texture = gpu.texture(size, TextureDimension::D2, TextureFormat::Rgba16Float, &data);
    let view = texture
        .create_view(&TextureViewDescriptor { dimension: Some(TextureViewDimension::Cube), ..Default::default() });
    let sampler = linear_sampler(gpu.device());
    let found = project(&gpu, RadianceMap::Cube(&view, &sampler));
    let faces: [&[DVec3]; 6] = std::array::from_fn(|i| &faces[i][..]);
    let expected = reference::environment::cubemap(side, faces);
    // Sampling at a texel's centre still filters: weights have at least 8 bits, and random neighbours differ by all
    // they can, so the bound is that of filtered textures.
    assert_close("environment, cube map", HALF, widen(&found), flat(&expected));
}
