use bevy::math::{DMat3, DVec4, Mat4, Quat};
use bevy::prelude::*;
use bevy::render::render_resource::TextureViewDimension;

use super::*;
use crate::bundle::SmokeAnimation;
use crate::constellation::{ConstellationShading, SmokeConstellation};
use crate::density::Placement;
use crate::lighting::SmokeEnvironment;
use crate::reference::Ray;
use crate::reference::constellation::median_cut::GRID;
use crate::reference::constellation::view::Scene;
use crate::reference::constellation::{Constellation, DistanceMap as TwinDistances, RadianceGrid};
use crate::reference::voxel_single::DistantLight;
use crate::render::constellation::lights::CutUniform;
use crate::render::constellation::mask::{self, MaskUniform};
use crate::render::constellation::{ConstellationPasses, Environment, distance};
use crate::render::environment::RadianceMap;
use crate::render::prepare::linear_sampler;
use crate::volume::SmokeVolume;

fn passes(gpu: &Gpu) -> &ConstellationPasses {
    gpu.world().resource()
}

/// What the passes make of an environment: mean, and direction and colour of every light.
fn cut(gpu: &Gpu, map: Option<RadianceMap>, coefficients: &[[f32; 4]], value: CutUniform) -> Vec<[f64; 3]> {
    let coefficients = gpu.buffer(coefficients);
    let environment = Environment { map, coefficients: &coefficients, version: 0 };
    let count = value.light_count as usize;
    let value = uniform(gpu.device(), gpu.queue(), "test", value);
    let pass = &passes(gpu).lights;
    let (job, lights) = pass.job(&environment, &value, gpu.device(), gpu.cache());
    gpu.run_all(&pass.jobs(&job).into_iter().map(|(pass, job)| (pass, job.clone())).collect::<Vec<_>>());
    let floats = gpu.read_floats(&lights);
    floats.as_chunks::<4>().0[..1 + 2 * count].iter().map(|v| [v[0], v[1], v[2]].map(f64::from)).collect()
}

fn flat(constellation: &Constellation) -> Vec<[f64; 3]> {
    let lights = constellation.lights.iter().flat_map(|light| [rgb(light.direction), rgb(light.irradiance)]);
    [rgb(constellation.mean)].into_iter().chain(lights).collect()
}

const DARK: [[f32; 4]; 16] = [[0.0; 4]; 16];

fn noise(random: &mut Random, count: u32) -> Vec<DVec3> {
    // Some texels a hundred times brighter than others; halves, so that every texture holds the very values.
    let texel =
        |random: &mut Random| (random.vector() * 10f64.powf(2.0 * random.next())).map(|v| f16::from_f64(v).into());
    (0..count).map(|_| texel(random)).collect()
}

#[test]
fn lights_of_an_image_match_their_twin() {
    let gpu = Gpu::new();
    for (width, height, count) in [(50, 23, 16), (300, 150, 256), (16, 8, 1)] {
        let texels = noise(&mut Random(3), width * height);
        let data: Vec<u8> =
            texels.iter().flat_map(|t| t.as_vec3().extend(1.0).to_array()).flat_map(f32::to_le_bytes).collect();
        let size = UVec3::new(width, height, 1);
        let texture = gpu.texture(size, TextureDimension::D2, TextureFormat::Rgba32Float, &data);
        let view = texture.create_view(&TextureViewDescriptor::default());
        let value = CutUniform { ambient: Vec3::new(0.3, 0.2, 0.1), scale: 0.7, light_count: count };
        let found = cut(&gpu, Some(RadianceMap::Equirect(&view)), &DARK, value);
        let grid = RadianceGrid::of_equirect(GRID, width as usize, &texels).scaled(0.7, DVec3::new(0.3, 0.2, 0.1));
        let expected = flat(&grid.median_cut(count as usize));
        let what = format!("lights, {width} x {height}, {count}");
        assert_close(&what, EXACT, found.into_flattened(), expected.into_flattened());
    }
}

#[test]
fn lights_of_coefficients_match_their_twin() {
    let gpu = Gpu::new();
    let coefficients = random_light(&mut Random(11));
    let value = CutUniform { ambient: Vec3::ZERO, scale: 1.0, light_count: 23 };
    let found = cut(&gpu, None, &pad(coefficients.0), value);
    let expected = flat(&RadianceGrid::of_coefficients(GRID, &coefficients).median_cut(23));
    assert_close("lights of coefficients", EXACT, found.into_flattened(), expected.into_flattened());
}

#[test]
fn lights_of_a_cube_map_are_its_light() {
    let gpu = Gpu::new();
    // A smooth function of direction, so that it does not matter how texels are filtered.
    let sky =
        |w: DVec3| DVec3::new(1.0 + w.x, 1.0 + w.y, 1.0 + w.z) * (2.0 * w.dot(DVec3::new(0.48, 0.6, -0.64))).exp();
    let side = 64;
    let texels = (0..6 * side * side).map(|i| {
        let (face, row, column) = (i / (side * side), i / side % side, i % side);
        sky(reference::environment::cubemap_direction(side, face, column, row).0)
    });
    let data: Vec<u8> =
        texels.flat_map(|t| t.extend(1.0).to_array()).flat_map(|v| f16::from_f64(v).to_le_bytes()).collect();
    let size = UVec3::new(side as u32, side as u32, 6);
    let texture = gpu.texture(size, TextureDimension::D2, TextureFormat::Rgba16Float, &data);
    let view = texture
        .create_view(&TextureViewDescriptor { dimension: Some(TextureViewDimension::Cube), ..Default::default() });
    let sampler = linear_sampler(gpu.device());
    let value = CutUniform { ambient: Vec3::ZERO, scale: 1.0, light_count: 16 };
    let found = cut(&gpu, Some(RadianceMap::Cube(&view, &sampler)), &DARK, value);
    let expected = flat(&RadianceGrid::of_directions(GRID, 2, sky).median_cut(16));
    // Between texels 1.4 degrees apart the map is off by their curvature, 3e-4 of it at most.
    assert_close("lights of a cube map", HALF, found.into_flattened(), expected.into_flattened());
}

/// The fixture's density as the texture holds it, less what counts as none, over [`MAX_DENSITY`].
fn scaled_density(frame: &SmokeFrame) -> Grid {
    let mut grid = twin_density(frame);
    for value in &mut grid.values {
        *value /= f64::from(MAX_DENSITY);
        *value = if *value < 1e-4 { 0.0 } else { *value };
    }
    grid
}

/// The distance map on the GPU, of a frame whose density is the twin's.
fn distance_map(gpu: &Gpu, frame: &SmokeFrame, density: &Grid) -> TextureView {
    let mut uploaded = gpu.frame(frame);
    uploaded.density = gpu.texture_3d(density.shape.dims, TextureFormat::R32Float, |cell| {
        density.values[density.shape.index(cell)] as f32 * MAX_DENSITY
    });
    let pass = &passes(gpu).distance;
    let map = distance::DistanceMap::new(&uploaded, pass, gpu.device(), gpu.cache());
    gpu.run_all(&pass.passes().into_iter().zip(map.jobs.clone()).collect::<Vec<_>>());
    map.texture
}

#[test]
fn distances_match_their_twin() {
    let gpu = Gpu::new();
    let mut random = Random(5);
    let shape = GridShape::new(UVec3::new(45, 38, 61));
    let frame = SmokeFrame::new(RbfModel::default(), HashedResidual::empty(shape));
    for cells in [0, 1, 3, 40] {
        let mut density = Grid { shape, values: vec![0.0; shape.len()] };
        for _ in 0..cells {
            let at = (random.next() * shape.len() as f64) as usize;
            density.values[at] = f64::from(f16::from_f64(0.1 + random.next()));
        }
        let texels = gpu.read_texels(&distance_map(&gpu, &frame, &density));
        let twin = TwinDistances::new(&density);
        for (i, texel) in texels.as_chunks::<4>().0.iter().enumerate() {
            assert_eq!(texel[0], twin.cells[i] as f32, "{cells} cells, {}", twin.padded.cell(i));
            let cell = twin.padded.cell(i);
            let inside = cell.cmpge(UVec3::ONE).all() && cell.cmple(shape.dims).all();
            let expected = if inside { density.values[shape.index(cell - 1)] } else { 0.0 };
            assert!((f64::from(texel[3]) - expected).abs() <= 1e-3 * expected);
        }
    }
}

const SIZE: UVec2 = UVec2::new(24, 18);

/// Rays of a camera through the middles of pixels.
fn rays(bundle_from_clip: Mat4, eye: DVec3) -> impl Iterator<Item = Ray> {
    let bundle_from_clip = bundle_from_clip.as_dmat4();
    (0..SIZE.y).flat_map(|y| (0..SIZE.x).map(move |x| (x, y))).map(move |(x, y)| {
        let ndc = 2.0 * (UVec2::new(x, y).as_dvec2() + 0.5) / SIZE.as_dvec2() - 1.0;
        let p = bundle_from_clip * DVec4::new(ndc.x, -ndc.y, 0.5, 1.0);
        Ray::new(eye, (p.truncate() / p.w - eye).normalize())
    })
}

fn no_lamps() -> Lamps {
    Lamps { lamps: vec![], softening: 0.0 }
}

#[test]
fn the_mask_matches_its_twin() {
    let gpu = Gpu::new();
    let frame = fixture();
    let mut density = scaled_density(&frame);
    // Much of it empty.
    for (i, value) in density.values.iter_mut().enumerate() {
        let cell = density.shape.cell(i);
        *value = if (cell / 9 % 3) == UVec3::ONE { *value } else { 0.0 };
    }
    let volume = distance_map(&gpu, &frame, &density);
    let eye = DVec3::new(0.5, 0.4, 1.3);
    let clip_from_view = Mat4::perspective_infinite_reverse_rh(0.8, SIZE.x as f32 / SIZE.y as f32, 0.01);
    let view = Mat4::look_at_rh(eye.as_vec3(), Vec3::ZERO, Vec3::Y);
    let bundle_from_clip = (clip_from_view * view).inverse();
    let step = 0.5 * density.shape.cell_size();
    let constellation = Constellation { lights: vec![], mean: DVec3::ONE };
    let scene = Scene {
        density: &density,
        medium: twin_medium(&medium([1.0; 3], 0.0), 1.0),
        constellation: &constellation,
        lamps: &no_lamps(),
        shading: ConstellationShading::Alpha,
        step: step.into(),
        shadow_step: 1.0,
        distances: None,
    };
    let expected: Vec<u32> = rays(bundle_from_clip, eye)
        .map(|ray| scene.first_sample(&ray).map_or(u32::MAX, |first| first as u32))
        .collect();
    let hits = expected.iter().filter(|first| **first != u32::MAX).count();
    assert!((20..400).contains(&hits), "{hits}");
    for skip_empty in [0, 1] {
        let value = uniform(
            gpu.device(),
            gpu.queue(),
            "test",
            MaskUniform {
                bundle_from_clip,
                eye: eye.as_vec3().extend(1.0),
                half_extent: density.shape.half_extent(),
                cell: density.shape.cell_size(),
                size: SIZE,
                step,
                skip_empty,
            },
        );
        let texture = mask::texture(SIZE, gpu.device());
        let (pass, sampler) = (&passes(&gpu).mask, linear_sampler(gpu.device()));
        let job = mask::job(pass, &value, (&volume, &sampler), &texture, SIZE, gpu.device(), gpu.cache());
        gpu.run(pass, job);
        let bytes = read_texture(gpu.device(), gpu.queue(), texture.texture());
        let found: Vec<u32> = bytes.as_chunks().0.iter().map(|b| u32::from_le_bytes(*b)).collect();
        // A sample within rounding of the end of some smoke may be on either side of it, and a GPU's filter rounds weights to
        // 1/256: more of them are off, by one sample.
        let off = |least| found.iter().zip(&expected).filter(|(a, b)| a.abs_diff(**b) >= least).count();
        println!("mask, skip {skip_empty}: {} of {hits} differ, {} by more than a sample", off(1), off(2));
        assert!(off(1) <= 6 && off(2) <= 3, "skip {skip_empty}: {} of {hits} pixels differ, {} far", off(1), off(2));
    }
}

#[test]
fn the_picture_matches_its_twin() {
    let frame = fixture();
    let shape = frame.residual.shape();
    let coefficients = random_light(&mut Random(23));
    let sun = (DVec3::new(0.6, 0.64, 0.48), DVec3::new(2.0, 1.5, 1.0));
    let medium = SmokeMedium { sigma_t: 3.0, ..medium([0.9, 0.7, 0.5], 0.4) };
    let at = Transform::from_xyz(0.3, -0.2, 0.1).with_rotation(Quat::from_rotation_y(0.6)).with_scale(Vec3::splat(2.5));
    let camera = Transform::from_xyz(2.0, 1.5, 4.0).looking_at(Vec3::ZERO, Vec3::Y);
    let bundle_from_world = at.to_matrix().inverse();
    let to_bundle = DMat3::from_quat(at.rotation.inverse().as_dquat());
    let clip_from_view = Mat4::perspective_infinite_reverse_rh(0.7, SIZE.x as f32 / SIZE.y as f32, 1e-3);
    let bundle_from_clip = bundle_from_world * camera.to_matrix() * clip_from_view.inverse();
    let eye = bundle_from_world.transform_point3(camera.translation).as_dvec3();

    let cut = |count: u32| {
        let mut constellation = RadianceGrid::of_coefficients(GRID, &coefficients).median_cut(count as usize);
        for DistantLight { direction, .. } in &mut constellation.lights {
            *direction = to_bundle * *direction;
        }
        constellation
    };
    let mut density = scaled_density(&frame);
    density.values.iter_mut().for_each(|value| *value *= f64::from(MAX_DENSITY));
    let lamps = Lamps { lamps: vec![Lamp::Sun { direction: to_bundle * sun.0, irradiance: sun.1 }], softening: 0.0 };
    let animation = SmokeAnimation {
        shape,
        placement: Placement { center: DVec3::ZERO, voxel_size: 1.0 },
        frames_per_second: 30.0,
        max_density: MAX_DENSITY,
        frames: vec![frame].into(),
    };
    for (shading, lights, mask) in [
        (ConstellationShading::Alpha, 5, true),
        (ConstellationShading::Primary, 19, false),
        (ConstellationShading::SelfShadow, 5, false),
        // Five draws.
        (ConstellationShading::SelfShadow, 19, true),
    ] {
        let settings = SmokeConstellation { lights, shading, mask, skip_empty: mask, ..default() };
        let mut headless = Headless::new(SIZE, TextureFormat::Rgba16Float).unwrap();
        let shows = headless.radiance_camera();
        let world = headless.app.world_mut();
        let animation = world.resource_mut::<Assets<SmokeAnimation>>().add(animation.clone());
        let environment =
            SmokeEnvironment::Coefficients { coefficients: coefficients.0.map(|c| c.as_vec3()), intensity: 1.0 };
        world.spawn((SmokeVolume::new(animation), medium, environment, at, settings));
        let color = Color::linear_rgb(1.0, 0.75, 0.5);
        let towards = Transform::default().looking_to(-sun.0.as_vec3(), Vec3::X);
        world.spawn((DirectionalLight { color, illuminance: 2.0, ..default() }, towards));
        let projection = Projection::Perspective(PerspectiveProjection { fov: 0.7, near: 1e-3, ..default() });
        world.spawn((shows, projection, camera));
        headless.settle().unwrap();
        let found = headless.float_pixels();

        let scene = Scene {
            density: &density,
            medium: twin_medium(&medium, f64::from(medium.sigma_t * at.scale.x)),
            constellation: &cut(lights),
            lamps: &lamps,
            shading,
            step: f64::from(settings.view_step * shape.cell_size()),
            shadow_step: f64::from(settings.shadow_step * shape.cell_size()),
            distances: None,
        };
        let expected = rays(bundle_from_clip, eye).flat_map(|ray| {
            let (radiance, transmittance) = scene.march(&ray, 0);
            [radiance.x, radiance.y, radiance.z, 1.0 - transmittance]
        });
        let what = format!("constellation, {shading:?}, {lights} lights");
        // Densities are halves, and so is the picture; every draw rounds once.
        assert_close(&what, HALF, found.iter().flatten().map(|&v| f64::from(v)), expected);
    }
}
