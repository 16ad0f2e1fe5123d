//! Incident-light pass: environment, lamps and coarse density → light that reaches every RBF's probes straight
//! from the environment, as spherical harmonics, the share of it that does not get through, and density columns to the
//! lamps. Runs when light, medium, density or what stands around changed.

use bevy::prelude::*;
use bevy::render::render_resource::binding_types::{
    sampler, storage_buffer_read_only_sized, storage_buffer_sized, texture_3d, uniform_buffer,
};
use bevy::render::render_resource::{
    BindGroup, BindGroupLayoutEntries, Buffer, PipelineCache, Sampler, SamplerBindingType, ShaderStages,
    TextureSampleType, TextureView,
};
use bevy::render::renderer::{RenderContext, RenderDevice};
use bevy::shader::{Shader, ShaderDefVal};

use super::frame::{FrameUniform, GpuSmokeFrame};
use super::lighting::{LightingUniform, MAX_LAMPS};
use super::pass::{ComputePass, Job};
use super::surroundings::SurroundingsUniform;
use super::{SmokePasses, SmokeRenderStats, SmokeWork};

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_incident_light";

/// Probes around an RBF; as in `lighting.wgsl`.
pub(super) const PROBES: u32 = 7;

/// Bytes an RBF's probes take: 16 coefficients each.
pub(super) const PROBE_BYTES: u64 = PROBES as u64 * 16 * 16;
/// Bytes an RBF's probes take for the share of light that gets through.
pub(super) const ESCAPE_BYTES: u64 = PROBES as u64 * 16;
/// Bytes an RBF's columns to the lamps take.
pub(super) const COLUMN_BYTES: u64 = PROBES as u64 * MAX_LAMPS as u64 * 4;

/// Directions in which probes can look: a variant of the pass each.
const DIRECTIONS: [u32; 3] = [16, 32, 64];
/// Threads of a workgroup; as in `incident_light.wgsl`.
const THREADS: u32 = 64;

/// The pass, for each number of directions.
pub(crate) struct IncidentLightPass([ComputePass; DIRECTIONS.len()]);

impl IncidentLightPass {
    pub fn new(shader: &Handle<Shader>, cache: &PipelineCache) -> Self {
        Self(DIRECTIONS.map(|directions| pass(shader, directions, cache)))
    }

    pub fn passes(&self) -> &[ComputePass] {
        &self.0
    }

    /// Of so many directions, rounded up to a number that there is.
    pub fn of(&self, directions: u32) -> &ComputePass {
        let index = DIRECTIONS.partition_point(|there| *there < directions);
        &self.0[index.min(DIRECTIONS.len() - 1)]
    }
}

fn pass(shader: &Handle<Shader>, directions: u32, cache: &PipelineCache) -> ComputePass {
    let defs = vec![ShaderDefVal::UInt("DIRECTIONS".into(), directions)];
    let entries = BindGroupLayoutEntries::sequential(
        ShaderStages::COMPUTE,
        (
            uniform_buffer::<FrameUniform>(false),
            uniform_buffer::<LightingUniform>(false),
            storage_buffer_read_only_sized(false, None),
            storage_buffer_read_only_sized(false, None),
            texture_3d(TextureSampleType::Float { filterable: true }),
            sampler(SamplerBindingType::Filtering),
            storage_buffer_sized(false, None),
            storage_buffer_sized(false, None),
            storage_buffer_sized(false, None),
            uniform_buffer::<SurroundingsUniform>(false),
            storage_buffer_read_only_sized(false, None),
            texture_3d(TextureSampleType::Float { filterable: true }),
        ),
    );
    ComputePass::new(LABEL, &entries, shader, "gather", defs, cache)
}

/// What one dispatch reads and writes.
pub(super) struct Bindings<'a> {
    pub frame: &'a GpuSmokeFrame,
    pub lighting: &'a Buffer,
    pub environment: &'a Buffer,
    pub sampler: &'a Sampler,
    pub probes: &'a Buffer,
    pub escapes: &'a Buffer,
    pub columns: &'a Buffer,
    pub surroundings: &'a Buffer,
    pub spheres: &'a Buffer,
    pub densities: &'a TextureView,
}

/// The variants of the pass share their layout.
pub(super) fn bind(pass: &IncidentLightPass, b: Bindings, device: &RenderDevice, cache: &PipelineCache) -> BindGroup {
    pass.0[0].bind(
        device,
        cache,
        (
            b.frame.uniform.as_entire_binding(),
            b.lighting.as_entire_binding(),
            b.frame.rbfs.as_entire_binding(),
            b.environment.as_entire_binding(),
            &b.frame.coarse,
            b.sampler,
            b.probes.as_entire_binding(),
            b.escapes.as_entire_binding(),
            b.columns.as_entire_binding(),
            b.surroundings.as_entire_binding(),
            b.spheres.as_entire_binding(),
            b.densities,
        ),
    )
}

/// One thread a direction, for so many probes an RBF.
pub(super) fn workgroups(frame: &GpuSmokeFrame, probes: u32, directions: u32) -> UVec3 {
    UVec3::new(frame.rbf_count.div_ceil(THREADS / directions), probes, 1)
}

/// One dispatch.
pub(super) struct IncidentLightJob {
    pub directions: u32,
    pub job: Job,
}

/// Lights the probes of every volume whose light, medium or density changed.
pub(super) fn incident_light(
    work: Res<SmokeWork>,
    passes: Res<SmokePasses>,
    cache: Res<PipelineCache>,
    stats: Res<SmokeRenderStats>,
    mut ctx: RenderContext,
) {
    let pass = &passes.incident_light;
    let jobs: Vec<_> = work.incident_light.iter().map(|job| (pass.of(job.directions), &job.job)).collect();
    ComputePass::run_all(LABEL, &jobs, &cache, &stats.incident_light, &mut ctx);
}
