//! Environment pass: radiance image → 16 RGB spherical-harmonic coefficients. Runs when an image arrives or changes.

use bevy::prelude::*;
use bevy::render::render_resource::binding_types::{sampler, storage_buffer_sized, texture_2d, texture_cube};
use bevy::render::render_resource::{
    BindGroup, BindGroupLayoutEntries, Buffer, BufferDescriptor, BufferUsages, PipelineCache, Sampler,
    SamplerBindingType, ShaderStages, TextureSampleType, TextureView,
};
use bevy::render::renderer::{RenderContext, RenderDevice};
use bevy::shader::Shader;

use super::pass::{ComputePass, Job};
use super::{SmokePasses, SmokeRenderStats, SmokeWork};

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_environment";

/// Workgroups that share the texels; as in `environment.wgsl`.
const GROUPS: u32 = 64;
/// Bytes of 16 coefficients, each padded to four floats.
const COEFFICIENT_BYTES: u64 = 16 * 16;

/// The pass: one projection for cube maps, one for latitude-longitude images, and the sum of the workgroups' shares.
pub(crate) struct EnvironmentPass {
    cube: ComputePass,
    equirect: ComputePass,
    reduce: ComputePass,
}

impl EnvironmentPass {
    pub fn new(shader: &Handle<Shader>, cache: &PipelineCache) -> Self {
        let compute = ShaderStages::COMPUTE;
        let storage = || storage_buffer_sized(false, None);
        let cube = BindGroupLayoutEntries::sequential(
            compute,
            (
                storage(),
                storage(),
                texture_cube(TextureSampleType::Float { filterable: true }),
                sampler(SamplerBindingType::Filtering),
            ),
        );
        let equirect = BindGroupLayoutEntries::sequential(
            compute,
            (storage(), storage(), texture_2d(TextureSampleType::Float { filterable: false })),
        );
        let reduce = BindGroupLayoutEntries::sequential(compute, (storage(), storage()));
        let equirect_def = || vec!["EQUIRECT".into()];
        Self {
            cube: ComputePass::new(LABEL, &cube, shader, "project", vec![], cache),
            equirect: ComputePass::new(LABEL, &equirect, shader, "project", equirect_def(), cache),
            reduce: ComputePass::new("smoke_environment_reduce", &reduce, shader, "reduce", equirect_def(), cache),
        }
    }

    pub fn passes(&self) -> [&ComputePass; 3] {
        [&self.cube, &self.equirect, &self.reduce]
    }

    pub fn job(
        &self,
        map: RadianceMap<'_>,
        coefficients: &Buffer,
        device: &RenderDevice,
        cache: &PipelineCache,
    ) -> EnvironmentJob {
        let partial_sums = device.create_buffer(&BufferDescriptor {
            label: Some("smoke_environment_partial_sums"),
            size: u64::from(GROUPS) * COEFFICIENT_BYTES,
            usage: BufferUsages::STORAGE,
            mapped_at_creation: false,
        });
        let (partials, coefficients) = (partial_sums.as_entire_binding(), coefficients.as_entire_binding());
        let (is_cube, project) = match map {
            RadianceMap::Cube(view, sampler) => {
                let bindings = (partials.clone(), coefficients.clone(), view, sampler);
                (true, self.cube.bind(device, cache, bindings))
            }
            RadianceMap::Equirect(view) => {
                (false, self.equirect.bind(device, cache, (partials.clone(), coefficients.clone(), view)))
            }
        };
        EnvironmentJob { is_cube, project, reduce: self.reduce.bind(device, cache, (partials, coefficients)) }
    }

    /// The two dispatches of a job, each with its pass.
    pub fn jobs(&self, job: &EnvironmentJob) -> [(&ComputePass, Job); 2] {
        let project = if job.is_cube { &self.cube } else { &self.equirect };
        [
            (project, Job { bind_group: job.project.clone(), workgroups: UVec3::new(GROUPS, 1, 1) }),
            (&self.reduce, Job { bind_group: job.reduce.clone(), workgroups: UVec3::ONE }),
        ]
    }
}

/// An environment's radiance as a texture.
#[derive(Clone, Copy)]
pub(crate) enum RadianceMap<'a> {
    /// A cube map, with a sampler for it.
    Cube(&'a TextureView, &'a Sampler),
    /// A latitude-longitude image.
    Equirect(&'a TextureView),
}

/// One environment to project.
pub(crate) struct EnvironmentJob {
    is_cube: bool,
    project: BindGroup,
    reduce: BindGroup,
}

/// A buffer for one environment's coefficients.
pub(super) fn coefficient_buffer(device: &RenderDevice) -> Buffer {
    device.create_buffer(&BufferDescriptor {
        label: Some("smoke_environment_coefficients"),
        size: COEFFICIENT_BYTES,
        usage: BufferUsages::STORAGE | BufferUsages::UNIFORM | BufferUsages::COPY_DST | BufferUsages::COPY_SRC,
        mapped_at_creation: false,
    })
}

/// Projects every new environment.
pub(super) fn environment(
    work: Res<SmokeWork>,
    passes: Res<SmokePasses>,
    cache: Res<PipelineCache>,
    stats: Res<SmokeRenderStats>,
    mut ctx: RenderContext,
) {
    let jobs: Vec<_> = work.environment.iter().flat_map(|job| passes.environment.jobs(job)).collect();
    let jobs: Vec<_> = jobs.iter().map(|(pass, job)| (*pass, job)).collect();
    ComputePass::run_all(LABEL, &jobs, &cache, &stats.environment, &mut ctx);
}
