//! Lights pass: an environment → the directions and colours of a constellation of distant lights, by median cut. Runs when
//! the environment, or how bright it is beside the ambient light, changes; not when it turns.

use bevy::prelude::*;
use bevy::render::render_resource::binding_types::{
    sampler, storage_buffer_read_only_sized, storage_buffer_sized, texture_2d, texture_cube, uniform_buffer,
};
use bevy::render::render_resource::{
    BindGroupLayoutEntries, Buffer, BufferDescriptor, BufferId, BufferUsages, PipelineCache, SamplerBindingType,
    ShaderStages, ShaderType, TextureSampleType,
};
use bevy::render::renderer::RenderDevice;
use bevy::shader::Shader;

use super::ConstellationWork;
use crate::constellation::SmokeConstellation;
use crate::render::environment::RadianceMap;
use crate::render::lighting::LightingUniform;
use crate::render::lit::{Cached, storage_buffer};
use crate::render::pass::{ComputePass, Job};
use crate::render::prepare::Gpu;

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_constellation_lights";

/// Texels of the grid that environments are resampled to; as in `constellation_radiance.wgsl`.
pub(super) const GRID: UVec2 = UVec2::new(128, 64);

/// The `Cut` of `constellation_lights.wgsl`.
#[derive(ShaderType, Clone, Debug, PartialEq)]
pub(in crate::render) struct CutUniform {
    pub ambient: Vec3,
    pub scale: f32,
    pub light_count: u32,
}

/// The `Constellation` of `constellation.wgsl`.
#[derive(ShaderType)]
pub(super) struct ConstellationUniform {
    _mean: Vec3,
    /// Direction and colour of every light.
    _lights: [Vec4; 2 * SmokeConstellation::MAX_LIGHTS as usize],
}

/// The pass: one resampling for each kind of environment, and the median cut.
pub(in crate::render) struct LightsPass {
    cube: ComputePass,
    equirect: ComputePass,
    coefficients: ComputePass,
    cut: ComputePass,
}

/// An environment as a volume uses it.
pub(in crate::render) struct Environment<'a> {
    /// Its radiance; none where it is known by its coefficients.
    pub map: Option<RadianceMap<'a>>,
    pub coefficients: &'a Buffer,
    /// Counts the changes.
    pub version: u32,
}

/// The dispatches for one constellation; the first where the environment has changed.
pub(in crate::render) struct LightsJob {
    resample: Option<(Kind, Job)>,
    cut: Job,
}

#[derive(Clone, Copy)]
enum Kind {
    Cube,
    Equirect,
    Coefficients,
}

impl LightsPass {
    pub fn new(radiance: &Handle<Shader>, lights: &Handle<Shader>, cache: &PipelineCache) -> Self {
        let compute = ShaderStages::COMPUTE;
        let storage = || storage_buffer_sized(false, None);
        let read = || storage_buffer_read_only_sized(false, None);
        let cube = BindGroupLayoutEntries::sequential(
            compute,
            (
                storage(),
                texture_cube(TextureSampleType::Float { filterable: true }),
                sampler(SamplerBindingType::Filtering),
            ),
        );
        let equirect = BindGroupLayoutEntries::sequential(
            compute,
            (storage(), texture_2d(TextureSampleType::Float { filterable: false })),
        );
        let coefficients = BindGroupLayoutEntries::sequential(compute, (storage(), read()));
        let cut = BindGroupLayoutEntries::sequential(
            compute,
            (uniform_buffer::<CutUniform>(false), read(), storage(), storage()),
        );
        let resample = |layout: &[_], defs| ComputePass::new(LABEL, layout, radiance, "resample", defs, cache);
        Self {
            cube: resample(&cube, vec![]),
            equirect: resample(&equirect, vec!["EQUIRECT".into()]),
            coefficients: resample(&coefficients, vec!["COEFFICIENTS".into()]),
            cut: ComputePass::new("smoke_median_cut", &cut, lights, "median_cut", vec![], cache),
        }
    }

    pub fn passes(&self) -> [&ComputePass; 4] {
        [&self.cube, &self.equirect, &self.coefficients, &self.cut]
    }

    /// Resamples an environment to a grid.
    fn resample_job(
        &self,
        environment: &Environment,
        grid: &Buffer,
        device: &RenderDevice,
        cache: &PipelineCache,
    ) -> (Kind, Job) {
        let grid = grid.as_entire_binding();
        let (kind, bind_group) = match environment.map {
            Some(RadianceMap::Cube(view, sampler)) => {
                (Kind::Cube, self.cube.bind(device, cache, (grid, view, sampler)))
            }
            Some(RadianceMap::Equirect(view)) => (Kind::Equirect, self.equirect.bind(device, cache, (grid, view))),
            None => {
                let coefficients = environment.coefficients.as_entire_binding();
                (Kind::Coefficients, self.coefficients.bind(device, cache, (grid, coefficients)))
            }
        };
        (kind, Job { bind_group, workgroups: GRID.extend(8) / 8 })
    }

    /// Cuts a grid into lights.
    fn cut_job(
        &self,
        cut: &Buffer,
        grid: &Buffer,
        lights: &Buffer,
        device: &RenderDevice,
        cache: &PipelineCache,
    ) -> Job {
        let sums = storage_buffer(device, "smoke_radiance_sums", 4 * u64::from((GRID + 1).element_product()));
        let bindings =
            (cut.as_entire_binding(), grid.as_entire_binding(), sums.as_entire_binding(), lights.as_entire_binding());
        Job { bind_group: self.cut.bind(device, cache, bindings), workgroups: UVec3::ONE }
    }

    /// All of it for one environment, and the lights.
    #[cfg(all(test, feature = "cli"))]
    pub fn job(
        &self,
        environment: &Environment,
        cut: &Buffer,
        device: &RenderDevice,
        cache: &PipelineCache,
    ) -> (LightsJob, Buffer) {
        let [grid, lights] = buffers(device);
        let resample = Some(self.resample_job(environment, &grid, device, cache));
        (LightsJob { resample, cut: self.cut_job(cut, &grid, &lights, device, cache) }, lights)
    }

    /// The dispatches of a job, each with its pass.
    pub fn jobs<'a>(&'a self, job: &'a LightsJob) -> Vec<(&'a ComputePass, &'a Job)> {
        let resample = job.resample.as_ref().map(|(kind, job)| (self.resample(*kind), job));
        resample.into_iter().chain([(&self.cut, &job.cut)]).collect()
    }

    fn resample(&self, kind: Kind) -> &ComputePass {
        match kind {
            Kind::Cube => &self.cube,
            Kind::Equirect => &self.equirect,
            Kind::Coefficients => &self.coefficients,
        }
    }
}

/// The grid, and the `Constellation` of `constellation.wgsl`.
fn buffers(device: &RenderDevice) -> [Buffer; 2] {
    let grid = storage_buffer(device, "smoke_radiance_grid", 16 * u64::from(GRID.element_product()));
    let lights = device.create_buffer(&BufferDescriptor {
        label: Some("smoke_constellation"),
        size: ConstellationUniform::min_size().get(),
        usage: BufferUsages::STORAGE | BufferUsages::UNIFORM | BufferUsages::COPY_SRC,
        mapped_at_creation: false,
    });
    [grid, lights]
}

/// A constellation on the GPU.
pub(super) struct Constellation {
    grid: Buffer,
    cut: Cached<CutUniform>,
    cut_job: Job,
    lights: Buffer,
    /// The environment's coefficients, and its version, that it was made of.
    made_of: Option<(BufferId, u32)>,
}

impl Constellation {
    /// Dark until it is updated.
    pub fn new(passes: &LightsPass, gpu: &Gpu) -> Self {
        let [grid, lights] = buffers(gpu.device);
        let cut = Cached::new(CutUniform { ambient: Vec3::ZERO, scale: 0.0, light_count: 0 }, gpu);
        let cut_job = passes.cut_job(cut.buffer(), &grid, &lights, gpu.device, gpu.cache);
        Self { grid, cut, cut_job, lights, made_of: None }
    }

    /// The `Constellation` of `constellation.wgsl`.
    pub fn buffer(&self) -> &Buffer {
        &self.lights
    }

    /// Lists the work where anything has changed but the environment's rotation.
    pub fn update(
        &mut self,
        environment: &Environment,
        lighting: &LightingUniform,
        light_count: u32,
        passes: &LightsPass,
        gpu: &Gpu,
        work: &mut ConstellationWork,
    ) {
        let cut = CutUniform { ambient: lighting.ambient, scale: lighting.environment_scale, light_count };
        let cut_anew = self.cut.set(cut, gpu);
        let made_of = Some((environment.coefficients.id(), environment.version));
        let resample = (self.made_of != made_of).then(|| {
            self.made_of = made_of;
            passes.resample_job(environment, &self.grid, gpu.device, gpu.cache)
        });
        if cut_anew || resample.is_some() {
            work.lights.push(LightsJob { resample, cut: self.cut_job.clone() });
        }
    }
}
