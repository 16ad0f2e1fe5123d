//! Scattering pass: light at the probes + pair matrix → what every RBF sees of the others' scattered light. Runs when
//! the light at the probes changed, where light scatters more than once.
//!
//! The transport equation between RBFs, J = S + Ω'g'^l (1 − τ̄) K̂ J, is solved by sweeps from the solution
//! before, of the same light or another, of this moment or the one before: RBFs are known by their place in the list, and
//! new ones start black. After every [`SWEEPS`] of them their best combination is taken (reduced-rank extrapolation, the same as
//! GMRES on so many steps) and its error estimated; what is left is skipped on the GPU once that is below the
//! tolerance. A last sweep from there leaves no light negative that was not before. No step waits for the CPU.

use bevy::prelude::*;
use bevy::render::render_resource::binding_types::{
    storage_buffer_read_only_sized, storage_buffer_sized, uniform_buffer,
};
use bevy::render::render_resource::{
    BindGroup, BindGroupLayoutEntries, Buffer, PipelineCache, ShaderStages, ShaderType,
};
use bevy::render::renderer::{RenderContext, RenderDevice};

use super::footprint::Footprints;
use super::frame::{FrameUniform, GpuSmokeFrame};
use super::lighting::LightingUniform;
use super::pass::{ComputePass, DispatchCounter, Job};
use super::{SmokePasses, SmokeRenderStats, SmokeWork};
use crate::shaders::Shaders;

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_scattering";

/// Sweeps between extrapolations; as in `extrapolate.wgsl`.
pub(super) const SWEEPS: u32 = 5;
/// Bytes of the solver's [`Control`](ControlState).
pub(super) const CONTROL_BYTES: u64 = 16;
/// Bytes an RBF takes in the list of sources: 16 coefficients, and how much of what it sees is smoke.
pub(super) const SOURCE_BYTES: u64 = 17 * 16;
/// Bytes an RBF takes in the list of solutions.
pub(super) const STATE_BYTES: u64 = (SWEEPS as u64 + 1) * 16 * 16;

/// The `Step` of `scattering.wgsl`.
#[derive(ShaderType, Clone, Copy, Debug, PartialEq)]
pub(super) struct StepUniform {
    pub from_slot: u32,
    pub to_slot: u32,
    pub always: u32,
    pub tolerance: f32,
}

impl StepUniform {
    /// The sweeps of a cycle, then the last sweep of all.
    pub fn all(tolerance: f32) -> [Self; SWEEPS as usize + 1] {
        core::array::from_fn(|i| {
            let last = i == SWEEPS as usize;
            let from_slot = if last { 0 } else { i as u32 };
            Self { from_slot, to_slot: from_slot + 1, always: u32::from(last), tolerance }
        })
    }
}

/// What the solver did: the `Control` of `scattering.wgsl`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SolverReport {
    /// Whether the estimated error reached the tolerance.
    pub converged: bool,
    /// Sweeps done, without the last.
    pub sweeps: u32,
    /// Estimated error relative to the root mean square of the solution.
    pub error: f32,
}

impl SolverReport {
    /// Reads the solver's buffer.
    #[cfg(feature = "cli")]
    pub(crate) fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let word = |i: usize| Some(u32::from_le_bytes(bytes.get(4 * i..4 * i + 4)?.try_into().ok()?));
        Some(Self { converged: word(0)? != 0, sweeps: word(1)?, error: f32::from_bits(word(2)?) })
    }
}

/// The pass: what starts the solver, its sweeps, and their extrapolation.
pub(crate) struct ScatteringPass {
    start: ComputePass,
    sweep: ComputePass,
    sweep_isotropic: ComputePass,
    extrapolate: ComputePass,
}

impl ScatteringPass {
    pub fn new(shaders: &Shaders, cache: &PipelineCache) -> Self {
        let compute = ShaderStages::COMPUTE;
        let read = || storage_buffer_read_only_sized(false, None);
        let write = || storage_buffer_sized(false, None);
        let frame = || uniform_buffer::<FrameUniform>(false);
        let lighting = || uniform_buffer::<LightingUniform>(false);
        let step = || uniform_buffer::<StepUniform>(false);
        let footprints = || uniform_buffer::<Footprints>(false);
        let start = BindGroupLayoutEntries::sequential(
            compute,
            (frame(), lighting(), footprints(), read(), read(), read(), read(), read(), write(), write(), write()),
        );
        let sweep = BindGroupLayoutEntries::sequential(
            compute,
            (frame(), lighting(), footprints(), step(), read(), read(), read(), write(), write(), read()),
        );
        let extrapolate = BindGroupLayoutEntries::sequential(
            compute,
            (frame(), lighting(), step(), read(), read(), read(), write(), write()),
        );
        let pass = |label, entries: &[_], shader, entry_point| {
            ComputePass::new(label, entries, shader, entry_point, vec![], cache)
        };
        Self {
            start: pass("smoke_scattering_start", &start, &shaders.scattering_source, "start"),
            sweep: pass("smoke_scattering_sweep", &sweep, &shaders.sweep, "sweep"),
            sweep_isotropic: pass("smoke_scattering_sweep_isotropic", &sweep, &shaders.sweep, "sweep_isotropic"),
            extrapolate: pass("smoke_scattering_extrapolate", &extrapolate, &shaders.extrapolate, "extrapolate"),
        }
    }

    pub fn passes(&self) -> [&ComputePass; 4] {
        [&self.start, &self.sweep, &self.sweep_isotropic, &self.extrapolate]
    }

    pub fn bind(&self, b: &Bindings, device: &RenderDevice, cache: &PipelineCache) -> BindGroups {
        let (frame, lighting) = (b.frame.uniform.as_entire_binding(), b.lighting.as_entire_binding());
        let rbfs = b.frame.rbfs.as_entire_binding();
        let (sources, states) = (b.sources.as_entire_binding(), b.states.as_entire_binding());
        let (matrix, rows) = (b.matrix.as_entire_binding(), b.rows.as_entire_binding());
        let control = b.control.as_entire_binding();
        let start = (
            frame.clone(),
            lighting.clone(),
            b.footprints.as_entire_binding(),
            rbfs.clone(),
            b.probes.as_entire_binding(),
            b.escapes.as_entire_binding(),
            b.columns.as_entire_binding(),
            rows.clone(),
            sources.clone(),
            states.clone(),
            control.clone(),
        );
        let sweep = |step: &Buffer| {
            let bindings = (
                frame.clone(),
                lighting.clone(),
                b.footprints.as_entire_binding(),
                step.as_entire_binding(),
                rbfs.clone(),
                matrix.clone(),
                sources.clone(),
                states.clone(),
                b.gathered.as_entire_binding(),
                control.clone(),
            );
            // The two entry points share their layout.
            self.sweep.bind(device, cache, bindings)
        };
        let step = b.steps[0].as_entire_binding();
        let extrapolate = (
            frame.clone(),
            lighting.clone(),
            step,
            matrix.clone(),
            rows.clone(),
            sources.clone(),
            states.clone(),
            control.clone(),
        );
        BindGroups {
            start: self.start.bind(device, cache, start),
            sweeps: b.steps.each_ref().map(sweep),
            extrapolate: self.extrapolate.bind(device, cache, extrapolate),
        }
    }

    /// One solve, in order.
    pub fn jobs(&self, solve: &ScatteringJob) -> Vec<(&ComputePass, Job)> {
        let ScatteringJob { bind_groups: groups, rbf_count, rbf_capacity, coefficients, cycles } = solve;
        let job = |bind_group: &BindGroup, x| Job { bind_group: bind_group.clone(), workgroups: UVec3::new(x, 1, 1) };
        let sweep = if *coefficients == 1 { &self.sweep_isotropic } else { &self.sweep };
        let (last, cycle) = groups.sweeps.split_last().expect("there is a last sweep");
        let mut jobs = vec![(&self.start, job(&groups.start, (rbf_capacity * coefficients).div_ceil(64)))];
        for _ in 0..*cycles {
            jobs.extend(cycle.iter().map(|group| (sweep, job(group, *rbf_count))));
            jobs.push((&self.extrapolate, job(&groups.extrapolate, 1)));
        }
        jobs.push((sweep, job(last, *rbf_count)));
        jobs
    }
}

/// What a solve reads and writes.
pub(super) struct Bindings<'a> {
    pub frame: &'a GpuSmokeFrame,
    pub lighting: &'a Buffer,
    pub footprints: &'a Buffer,
    pub steps: &'a [Buffer; SWEEPS as usize + 1],
    pub probes: &'a Buffer,
    pub escapes: &'a Buffer,
    pub columns: &'a Buffer,
    pub matrix: &'a Buffer,
    pub rows: &'a Buffer,
    pub sources: &'a Buffer,
    pub states: &'a Buffer,
    pub gathered: &'a Buffer,
    pub control: &'a Buffer,
}

/// The bindings of a solve's dispatches.
pub(super) struct BindGroups {
    start: BindGroup,
    sweeps: [BindGroup; SWEEPS as usize + 1],
    extrapolate: BindGroup,
}

/// A solve of this frame.
pub(super) struct ScatteringJob {
    pub bind_groups: std::sync::Arc<BindGroups>,
    pub rbf_count: u32,
    /// RBFs that the list of solutions has room for.
    pub rbf_capacity: u32,
    /// 1 for isotropic smoke, up to 16 otherwise.
    pub coefficients: u32,
    /// Extrapolations at most.
    pub cycles: u32,
}

/// Solves for every volume whose light changed.
pub(super) fn scattering(
    work: Res<SmokeWork>,
    passes: Res<SmokePasses>,
    cache: Res<PipelineCache>,
    stats: Res<SmokeRenderStats>,
    mut ctx: RenderContext,
) {
    let pass = &passes.scattering;
    let jobs: Vec<_> = work.scattering.iter().flat_map(|job| pass.jobs(job)).collect();
    let jobs: Vec<_> = jobs.iter().map(|(pass, job)| (*pass, job)).collect();
    ComputePass::run_all(LABEL, &jobs, &cache, &DispatchCounter::default(), &mut ctx);
    // How many of a solve's dispatches find work is for the GPU to know: a solve counts as one.
    stats.scattering.add(work.scattering.len() as u32);
}
