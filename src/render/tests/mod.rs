//! Every GPU pass alone, on inputs of its own, against its f64 twin in [`crate::reference`].
//!
//! Tolerances are relative L2 over the pass's whole output. Buffers are f32: 2⁻²⁴ a rounding, and the adapter's `exp`,
//! `sin` and `pow` add a few units in the last place, so 1e-5 would hold; textures that are filtered are f16, which
//! alone costs 2⁻¹²/√3 to 2⁻¹¹/√3 (1.4e-4 to 2.8e-4). The common bound of 1e-3 leaves a factor 3 above that for
//! adapters whose trilinear weights have 8 bits; passes that touch no f16 are held to 2e-5.

mod coarse;
mod constellation;
mod debug;
mod density;
mod diffusion;
mod environment;
mod incident_light;
mod lattice;
mod moments;
mod outgoing;
mod pair_matrix;
mod paper;
mod pipelines;
mod scattering;
mod scenes;
mod shadow_probes;
mod view;
mod volume;

use std::sync::Arc;

use bevy::color::LinearRgba;
use bevy::math::{DAffine3, DMat4, DQuat, DVec3, DVec4, UVec2, UVec3, Vec3};
use bevy::render::RenderApp;
use bevy::render::render_resource::{
    Buffer, BufferInitDescriptor, BufferUsages, CommandEncoderDescriptor, ComputePassDescriptor, Extent3d,
    PipelineCache, Texture, TextureDescriptor, TextureDimension, TextureFormat, TextureUsages, TextureView,
    TextureViewDescriptor,
};
use bevy::render::renderer::{RenderDevice, RenderQueue};
use half::f16;

use super::SmokePasses;
use super::baked::GpuBakedFrame;
use super::casters::CasterUniform;
use super::frame::{FILTERED_FORMAT, GpuSmokeFrame, uniform};
use super::lighting::{LampUniform, LightingUniform, MAX_LAMPS};
use super::pass::{ComputePass, Job};
use super::surroundings::SurroundingsUniform;
use crate::bundle::SmokeFrame;
use crate::density::GridShape;
use crate::headless::{Headless, read_buffer, read_texture};
use crate::medium::SmokeMedium;
use crate::optics::erfcx;
use crate::playback::Moment;
use crate::quality::SmokeModel;
use crate::rbf::{Rbf, RbfModel};
use crate::reference::incident_light::{Incident, column, probes};
use crate::reference::lamp::{Cone, Lamp, Lamps};
use crate::reference::surroundings::{Other, Surroundings};
use crate::reference::{self, Grid, PROBES};
use crate::residual::{HashedResidual, QuantizationLaw};
use crate::sh::{Sh, ShRgb};

/// What the filtered density textures' 1 stands for.
const MAX_DENSITY: f32 = 2.0;
/// Bound for passes that read and write f32 only.
const EXACT: f64 = 2e-5;
/// Bound for passes that read or write f16 textures.
const HALF: f64 = 1e-3;
/// Bound for passes that march far through filtered textures: a GPU weighs texels in steps of 1/256, and may in steps of 1/16.
const FILTERED: f64 = 4e-3;

/// What stands around the smoke, on the GPU.
struct Around {
    surroundings: Buffer,
    spheres: Buffer,
    densities: TextureView,
}

impl Around {
    fn new(gpu: &Gpu, around: &Surroundings) -> Self {
        let mut value = SurroundingsUniform {
            caster_count: around.others.len() as u32,
            sphere_count: around.spheres.len() as u32,
            ..Default::default()
        };
        for (slot, other) in around.others.iter().enumerate() {
            value.casters[slot] = caster_uniform(other, slot as u32);
        }
        let spheres: Vec<[f32; 4]> = around.spheres.iter().map(|s| s.as_vec4().to_array()).collect();
        Self {
            surroundings: uniform(gpu.device(), gpu.queue(), "test", value),
            spheres: gpu.buffer(if spheres.is_empty() { &[[0.0; 4]] } else { &spheres[..] }),
            densities: caster_densities(gpu, &around.others),
        }
    }
}

fn caster_uniform(other: &Other, slot: u32) -> CasterUniform {
    let shape = other.coarse.shape;
    CasterUniform {
        bundle_from_here: DMat4::from(other.from_here).as_mat4(),
        half_extent: shape.half_extent(),
        sigma: other.sigma as f32,
        padded: (shape.dims + 2).as_vec3(),
        texel: shape.cell_size(),
        slot,
    }
}

/// The casters' coarse densities, a slot above the other.
fn caster_densities(gpu: &Gpu, others: &[Other]) -> TextureView {
    let dims = UVec3::new(66, 66, 66 * others.len().max(1) as u32);
    gpu.texture_3d(dims, FILTERED_FORMAT, |texel| {
        let Some(Other { coarse, .. }) = others.get((texel.z / 66) as usize) else { return 0.0 };
        let texel = UVec3::new(texel.x, texel.y, texel.z % 66);
        let inside = texel.cmpge(UVec3::ONE).all() && texel.cmple(coarse.shape.dims).all();
        if inside { coarse.values[coarse.shape.index(texel - 1)] as f32 } else { 0.0 }
    })
}

/// Other smoke and some spheres around the fixture; one sphere holds some of its probes, one the lamp in it.
fn surroundings(frame: &SmokeFrame) -> Surroundings {
    let coarse = crate::reference::coarse::coarse(&twin_density(frame));
    let at = |offset: DVec3, scale: f64| {
        let turn = DQuat::from_rotation_y(0.7);
        DAffine3::from_scale_rotation_translation(DVec3::splat(scale), turn, offset).inverse()
    };
    Surroundings {
        others: vec![
            Other { coarse: coarse.clone(), from_here: at(DVec3::new(0.6, 0.7, 0.2), 0.8), sigma: 2.0 },
            Other { coarse, from_here: at(DVec3::new(-0.3, -0.2, 0.9), 1.5), sigma: 0.7 },
        ],
        spheres: vec![
            DVec4::new(0.5, 0.4, -0.3, 0.25),
            DVec4::new(-0.1, -0.3, 0.1, 0.15),
            DVec4::new(0.06, -0.03, 0.1, 0.12),
            DVec4::new(0.0, -9.0, 0.0, 8.5),
        ],
    }
}

/// A device with the smoke pipelines on it.
struct Gpu {
    headless: Headless,
}

impl Gpu {
    fn new() -> Self {
        let mut headless = Headless::new(UVec2::splat(8), TextureFormat::Rgba16Float).unwrap();
        // Pipelines are compiled where they are queued; the shader assets arrive within a few updates.
        for _ in 0..100 {
            headless.app.update();
            let gpu = Self { headless };
            if gpu.passes().are_ready(gpu.cache()) {
                return gpu;
            }
            headless = gpu.headless;
        }
        let gpu = Self { headless };
        let failures: Vec<String> = gpu.passes().all().filter_map(|pass| pass.failure(gpu.cache())).collect();
        panic!("pipelines are not ready: {failures:?}");
    }

    fn world(&self) -> &bevy::prelude::World {
        self.headless.app.sub_app(RenderApp).world()
    }

    fn device(&self) -> &RenderDevice {
        self.world().resource()
    }

    fn queue(&self) -> &RenderQueue {
        self.world().resource()
    }

    fn cache(&self) -> &PipelineCache {
        self.world().resource()
    }

    fn passes(&self) -> &SmokePasses {
        self.world().resource()
    }

    fn run(&self, pass: &ComputePass, job: Job) {
        self.run_all(&[(pass, job)]);
    }

    fn run_all(&self, jobs: &[(&ComputePass, Job)]) {
        let mut encoder = self.device().create_command_encoder(&CommandEncoderDescriptor::default());
        for (pass, job) in jobs {
            let mut compute = encoder.begin_compute_pass(&ComputePassDescriptor::default());
            assert!(pass.record(&mut compute, job, self.cache()));
        }
        self.queue().submit([encoder.finish()]);
    }

    /// A storage buffer with values in it.
    fn buffer<T: bytemuck::NoUninit>(&self, values: &[T]) -> Buffer {
        self.device().create_buffer_with_data(&BufferInitDescriptor {
            label: None,
            contents: bytemuck::cast_slice(values),
            usage: BufferUsages::STORAGE | BufferUsages::COPY_SRC,
        })
    }

    fn read_floats(&self, buffer: &Buffer) -> Vec<f32> {
        let bytes = read_buffer(self.device(), self.queue(), buffer);
        bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
    }

    /// The texels of a texture of one 32-bit or four 16-bit floats.
    fn read_texels(&self, view: &TextureView) -> Vec<f32> {
        let texture = view.texture();
        let bytes = read_texture(self.device(), self.queue(), texture);
        match texture.format() {
            TextureFormat::R32Float => bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect(),
            _ => bytes.as_chunks().0.iter().map(|b| f16::from_le_bytes(*b).to_f32()).collect(),
        }
    }

    /// A 3D texture filled from `value(texel)`: its first channel, or all four.
    fn texture_3d(&self, dims: UVec3, format: TextureFormat, value: impl Fn(UVec3) -> f32) -> TextureView {
        let shape = GridShape::new(dims);
        let texels = (0..shape.len()).map(|i| value(shape.cell(i)));
        let data: Vec<u8> = match format {
            TextureFormat::R32Float => texels.flat_map(f32::to_le_bytes).collect(),
            _ => texels.flat_map(|v| [v, 0.0, 0.0, 0.0]).flat_map(|v| f16::from_f32(v).to_le_bytes()).collect(),
        };
        self.texture(dims, TextureDimension::D3, format, &data).create_view(&TextureViewDescriptor::default())
    }

    fn texture(&self, dims: UVec3, dimension: TextureDimension, format: TextureFormat, data: &[u8]) -> Texture {
        self.device().create_texture_with_data(
            self.queue(),
            &TextureDescriptor {
                label: None,
                size: Extent3d { width: dims.x, height: dims.y, depth_or_array_layers: dims.z },
                mip_level_count: 1,
                sample_count: 1,
                dimension,
                format,
                usage: TextureUsages::TEXTURE_BINDING,
                view_formats: &[],
            },
            wgpu::util::TextureDataOrder::LayerMajor,
            data,
        )
    }

    fn frame(&self, frame: &SmokeFrame) -> GpuSmokeFrame {
        self.moment(&Moment::frame(Arc::new(frame.clone()), MAX_DENSITY))
    }

    fn moment(&self, moment: &Moment) -> GpuSmokeFrame {
        let baked = [&moment.from, &moment.to].map(|frame| Arc::new(GpuBakedFrame::new(frame, self.device())));
        GpuSmokeFrame::new(moment, &moment.rbfs().rbfs, baked, self.device(), self.queue())
    }
}

/// A small pseudo-random sequence in 0..1, the same on every machine.
struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        // Knuth's MMIX generator.
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f64 / (1u64 << 24) as f64
    }

    fn vector(&mut self) -> DVec3 {
        DVec3::new(self.next(), self.next(), self.next())
    }
}

/// An odd-shaped frame: not a multiple of any workgroup or bin, RBFs of every size, some outside every other's reach,
/// and a residual of both signs in scattered cells.
fn fixture() -> SmokeFrame {
    let shape = GridShape::new(UVec3::new(37, 51, 29));
    let mut random = Random(7);
    let half_extent = shape.half_extent().as_dvec3();
    let rbfs = (0..40)
        .map(|_| Rbf {
            center: ((2.0 * random.vector() - 1.0) * 0.8 * half_extent).as_vec3().to_array(),
            radius: (0.015 + 0.075 * random.next()) as f32,
            weight: (0.05 + random.next()) as f32,
        })
        .collect();
    let law = QuantizationLaw { max: 0.7, exponent: 1.5 };
    let quantized: Vec<i8> =
        (0..shape.len()).map(|_| if random.next() < 0.3 { (random.next() * 254.0 - 127.0) as i8 } else { 0 }).collect();
    let residual = HashedResidual::build(shape, &quantized, law).unwrap();
    SmokeFrame::new(RbfModel { rbfs }, residual)
}

fn rbfs(frame: &SmokeFrame) -> &[Rbf] {
    &frame.rbfs.rbfs
}

/// The twin's coarse density of a frame, and the frame on the GPU with that density.
fn coarse_frame(gpu: &Gpu, frame: &SmokeFrame) -> (Grid, GpuSmokeFrame) {
    let coarse = crate::reference::coarse::coarse(&twin_density(frame));
    let mut uploaded = gpu.frame(frame);
    uploaded.coarse = gpu.texture_3d(coarse.shape.dims + 2, FILTERED_FORMAT, |texel| {
        let inside = texel.cmpge(UVec3::ONE).all() && texel.cmple(coarse.shape.dims).all();
        if inside { coarse.values[coarse.shape.index(texel - 1)] as f32 } else { 0.0 }
    });
    (coarse, uploaded)
}

/// Random coefficients of light that is mostly positive.
fn random_light(random: &mut Random) -> ShRgb {
    Sh(std::array::from_fn(|k| {
        let scale = if k == 0 { 3.0 } else { 0.6 };
        let value = scale * (random.vector() - if k == 0 { 0.0 } else { 0.5 });
        value.as_vec3().as_dvec3()
    }))
}

/// A buffer of coefficients, each padded to four floats.
fn pad(coefficients: impl IntoIterator<Item = DVec3>) -> Vec<[f32; 4]> {
    coefficients.into_iter().map(|c| c.as_vec3().extend(0.0).to_array()).collect()
}

/// The colours of padded coefficients.
fn unpad(floats: &[f32]) -> impl Iterator<Item = f64> + '_ {
    floats.as_chunks::<4>().0.iter().flat_map(|c| c[..3].to_vec()).map(f64::from)
}

/// A medium as the passes see it.
fn medium(albedo: [f32; 3], g: f32) -> SmokeMedium {
    SmokeMedium { albedo: LinearRgba::rgb(albedo[0], albedo[1], albedo[2]), g, ..SmokeMedium::default() }
}

/// The same as the twins see it.
fn twin_medium(medium: &SmokeMedium, sigma: f64) -> reference::Medium {
    let albedo = medium.albedo;
    let albedo = DVec3::new(albedo.red.into(), albedo.green.into(), albedo.blue.into());
    reference::Medium { sigma, albedo, g: medium.g.into() }
}

/// Light at the probes with shares of up to `escape` that get through, in a direction that has some of it.
fn random_incident(random: &mut Random, count: usize, escape: f64) -> Vec<[Incident; PROBES]> {
    let mut probe = || {
        let light = random_light(random);
        let escape = (escape * random.vector()).as_vec3().as_dvec3();
        // Grey transmittance with that mean, at most half as much again in any direction.
        let mean = escape.element_sum() / 3.0;
        let axis = (random.vector() - 0.5).normalize();
        let passing = Sh::constant(mean) + Sh::zonal(axis, &[0.0, 0.4, 0.2, 0.1], mean);
        Incident { light, escape, passing: Sh(passing.0.map(|c| f64::from(c as f32))) }
    };
    (0..count).map(|_| std::array::from_fn(|_| probe())).collect()
}

/// The probes' light and the shares that get through, as the incident-light pass leaves them.
fn pack_incident(gpu: &Gpu, incident: &[[Incident; PROBES]]) -> [Buffer; 2] {
    let probes = incident.iter().flatten();
    let light = |probe: &Incident| -> Vec<[f32; 4]> {
        let pairs = probe.light.0.into_iter().zip(probe.passing.0);
        pairs.map(|(light, passing)| light.as_vec3().extend(passing as f32).to_array()).collect()
    };
    [gpu.buffer(&probes.clone().flat_map(light).collect::<Vec<_>>()), gpu.buffer(&pad(probes.map(|p| p.escape)))]
}

/// Lamps of every kind, more than fit four columns: a sun, a point in the smoke, a spot, one that ends within, and one
/// outside.
fn lamps() -> [LampUniform; 5] {
    let everywhere = LampUniform { axis: Vec3::Z, spot_offset: 1.0, ..Default::default() };
    let axis = Vec3::new(-0.5, -0.8, 0.2).normalize();
    [
        LampUniform {
            position: Vec3::new(0.4, 0.8, -0.3).normalize(),
            color: Vec3::new(2.0, 1.5, 1.0),
            is_sun: 1,
            ..everywhere
        },
        LampUniform { position: Vec3::new(0.06, -0.03, 0.04), color: Vec3::new(0.1, 0.2, 0.3), ..everywhere },
        LampUniform {
            position: Vec3::new(0.45, 0.6, -0.1),
            color: Vec3::new(1.0, 0.8, 2.0),
            inverse_range_squared: 0.3,
            axis,
            spot_scale: 4.0,
            spot_offset: -3.0,
            ..everywhere
        },
        LampUniform {
            position: Vec3::new(-0.2, 0.25, 0.1),
            color: Vec3::new(0.5, 0.1, 0.2),
            inverse_range_squared: 9.0,
            ..everywhere
        },
        LampUniform { position: Vec3::new(-0.9, 0.3, 0.7), color: Vec3::splat(0.7), ..everywhere },
    ]
}

/// What is added to their squared distances.
const SOFTENING: f32 = 8.6e-4;

/// Lighting by them.
fn lit_by_lamps(lighting: LightingUniform) -> LightingUniform {
    let mut lit = LightingUniform { lamp_count: lamps().len() as u32, softening: SOFTENING, ..lighting };
    lit.lamps[..lamps().len()].copy_from_slice(&lamps());
    lit
}

/// The same lamps as the twins see them.
fn twin_lamps() -> Lamps {
    let lamp = |lamp: &LampUniform| {
        let (position, color) = (lamp.position.as_dvec3(), lamp.color.as_dvec3());
        if lamp.is_sun != 0 {
            return Lamp::Sun { direction: position, irradiance: color };
        }
        let (scale, offset) = (lamp.spot_scale.into(), lamp.spot_offset.into());
        let cone = Cone { axis: lamp.axis.as_dvec3(), scale, offset };
        Lamp::Point { position, intensity: color, range: f64::from(lamp.inverse_range_squared).sqrt().recip(), cone }
    };
    Lamps { lamps: lamps().iter().map(lamp).collect(), softening: SOFTENING.into() }
}

/// The twin's columns to them, [`MAX_LAMPS`] a probe, with probes as far out as `reach` says; below 0 to those that are
/// hidden.
fn twin_columns(
    rbfs: &[Rbf],
    coarse: &Grid,
    around: &Surroundings,
    sigma: DVec3,
    reach: impl Fn(&Rbf) -> f64,
) -> Vec<f32> {
    let lamps = twin_lamps().lamps;
    let to = |p: DVec3, lamp: &Lamp| {
        let ray = lamp.seen_from(p, 0.0).ray;
        let column = column(&ray, coarse) + around.other_depth(&ray) / (sigma.element_sum() / 3.0);
        (if around.hides(&ray) { -column.max(1e-20) } else { column }) as f32
    };
    let at = |p: DVec3| -> [f32; MAX_LAMPS] { std::array::from_fn(|i| lamps.get(i).map_or(0.0, |lamp| to(p, lamp))) };
    rbfs.iter().flat_map(|rbf| probes(rbf, reach(rbf)).map(at)).flatten().collect()
}

/// What goes with the rows of the twin's pair matrix, 16 values each: the weight in the balance of energy, w r^3 times
/// the row's sum before it was scaled, and H_1 .. H_15.
fn twin_rows(rbfs: &[Rbf], coarse: &Grid, sigma: f64, pairs: &[f64]) -> Vec<f64> {
    let surroundings = reference::transport::surroundings(rbfs, pairs);
    let row = |(l, h): (usize, &Sh<f64>)| {
        let (radius, weight) = (f64::from(rbfs[l].radius), f64::from(rbfs[l].weight));
        let density = coarse.sample(Vec3::from(rbfs[l].center).as_dvec3());
        // The row's sum, from its diagonal's share in it.
        let own = weight * radius * 0.5 * std::f64::consts::PI.sqrt() * erfcx(0.5 * sigma * density * radius);
        let mut row = h.0;
        row[0] = weight * radius.powi(3) * own / pairs[l * rbfs.len() + l] / f64::from(MAX_DENSITY).powi(2);
        row
    };
    surroundings.iter().enumerate().flat_map(row).collect()
}

/// The twin's density of a frame.
fn twin_density(frame: &SmokeFrame) -> Grid {
    let residual = |cell| f64::from(frame.residual.get(cell));
    crate::reference::density::density(rbfs(frame), residual, frame.residual.shape())
}

/// Relative L2 distance.
fn distance(found: impl IntoIterator<Item = f64>, expected: impl IntoIterator<Item = f64>) -> f64 {
    let (mut difference, mut norm, mut count) = (0.0, 0.0, 0);
    let mut found = found.into_iter();
    for e in expected {
        let f = found.next().expect("as many values as expected");
        difference += (f - e).powi(2);
        norm += e.powi(2);
        count += 1;
    }
    assert!(found.next().is_none() && count > 0 && norm > 0.0, "the outputs have different sizes, or nothing in them");
    (difference / norm).sqrt()
}

#[track_caller]
fn assert_close(
    what: &str,
    tolerance: f64,
    found: impl IntoIterator<Item = f64>,
    expected: impl IntoIterator<Item = f64>,
) {
    let distance = distance(found, expected);
    println!("{what}: relative L2 {distance:.2e} (bound {tolerance:.0e})");
    assert!(distance <= tolerance, "{what}: relative L2 {distance:.3e} is above {tolerance:.0e}");
}

fn widen(values: &[f32]) -> impl Iterator<Item = f64> + '_ {
    values.iter().map(|&v| f64::from(v))
}

fn rgb(v: DVec3) -> [f64; 3] {
    v.to_array()
}
