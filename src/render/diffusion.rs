//! Diffusion pass: light at the probes + coarse density → light that has scattered before, added to the light at the
//! probes. Runs in the place of the scattering pass where diffusion is the solver, when the light at the probes changed.
//!
//! The equation is solved on a grid of at most [`CELLS`] cells a side by at most [`STEPS`] steps of conjugate gradients,
//! from the solution before. No step waits for the CPU.

use std::sync::Arc;

use bevy::prelude::*;
use bevy::render::render_resource::binding_types::{
    sampler, storage_buffer_read_only_sized, storage_buffer_sized, texture_3d, uniform_buffer,
};
use bevy::render::render_resource::{
    BindGroup, BindGroupLayoutEntries, Buffer, PipelineCache, Sampler, SamplerBindingType, ShaderStages, ShaderType,
    TextureSampleType,
};
use bevy::render::renderer::{RenderContext, RenderDevice};

use super::frame::{FrameUniform, GpuSmokeFrame};
use super::incident_light::PROBES;
use super::lighting::LightingUniform;
use super::lit::storage_buffer;
use super::pass::{ComputePass, DispatchCounter, Job};
use super::scattering::CONTROL_BYTES;
use super::{SmokePasses, SmokeRenderStats, SmokeWork};
use crate::density::GridShape;
use crate::shaders::Shaders;

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_diffusion";

/// Cells a side of the grid, at most.
pub(super) const CELLS: u32 = 32;
/// Steps at most; those after the residual is small enough find nothing to do. From black they leave a residual of 1 to 3 %
/// of the right-hand side on the reference scenes, and 0.2 to 0.6 % of L⁰; the next solve goes on from there.
pub(super) const STEPS: u32 = 20;
/// Bytes an RBF takes in the list of fits: four of 112 bytes.
const FIT_BYTES: u64 = 4 * 112;
/// Threads of a workgroup; as in `diffusion_solve.wgsl`.
const THREADS: u32 = 256;

/// The `Diffusion` of `diffusion.wgsl`.
#[derive(ShaderType, Clone, Debug, PartialEq)]
pub(super) struct DiffusionUniform {
    dims: UVec3,
    cell: f32,
    cell_count: u32,
    tolerance: f32,
}

impl DiffusionUniform {
    /// For a box of cells; `tolerance` is the relative error at which the solver may stop.
    pub fn new(shape: GridShape, tolerance: f32) -> Self {
        let grid = shape.coarse().coarsened(CELLS);
        // The residual that leaves an error, by measurement: a fifth of it.
        Self { dims: grid.dims, cell: grid.cell_size(), cell_count: grid.len() as u32, tolerance: 0.2 * tolerance }
    }
}

/// The pass's pipelines.
pub(crate) struct DiffusionPass {
    fit: ComputePass,
    spread: ComputePass,
    begin: ComputePass,
    multiply: ComputePass,
    descend: ComputePass,
    turn: ComputePass,
    media: ComputePass,
    scatter: ComputePass,
}

impl DiffusionPass {
    pub fn new(shaders: &Shaders, cache: &PipelineCache) -> Self {
        let compute = ShaderStages::COMPUTE;
        let read = || storage_buffer_read_only_sized(false, None);
        let write = || storage_buffer_sized(false, None);
        let frame = || uniform_buffer::<FrameUniform>(false);
        let lighting = || uniform_buffer::<LightingUniform>(false);
        let diffusion = || uniform_buffer::<DiffusionUniform>(false);
        let source = BindGroupLayoutEntries::sequential(
            compute,
            (
                frame(),
                lighting(),
                diffusion(),
                read(),
                read(),
                read(),
                read(),
                read(),
                texture_3d(TextureSampleType::Float { filterable: true }),
                sampler(SamplerBindingType::Filtering),
                write(),
                write(),
            ),
        );
        let solve = BindGroupLayoutEntries::sequential(
            compute,
            (lighting(), diffusion(), read(), write(), write(), write(), write(), write(), write(), write()),
        );
        let scatter =
            BindGroupLayoutEntries::sequential(compute, (frame(), lighting(), diffusion(), read(), read(), write()));
        let pass = |label, entries: &[_], shader, entry_point| {
            ComputePass::new(label, entries, shader, entry_point, vec![], cache)
        };
        Self {
            fit: pass("smoke_diffusion_fit", &source, &shaders.diffusion_source, "fit"),
            spread: pass("smoke_diffusion_spread", &source, &shaders.diffusion_source, "spread"),
            begin: pass("smoke_diffusion_begin", &solve, &shaders.diffusion_solve, "begin"),
            multiply: pass("smoke_diffusion_multiply", &solve, &shaders.diffusion_solve, "multiply"),
            descend: pass("smoke_diffusion_descend", &solve, &shaders.diffusion_solve, "descend"),
            turn: pass("smoke_diffusion_turn", &solve, &shaders.diffusion_solve, "turn"),
            media: pass("smoke_diffusion_media", &solve, &shaders.diffusion_solve, "media"),
            scatter: pass("smoke_diffusion_scatter", &scatter, &shaders.diffusion_scatter, "scatter"),
        }
    }

    pub fn passes(&self) -> [&ComputePass; 8] {
        [&self.fit, &self.spread, &self.begin, &self.multiply, &self.descend, &self.turn, &self.media, &self.scatter]
    }

    /// One solve, in order.
    pub fn jobs(&self, solve: &DiffusionJob) -> Vec<(&ComputePass, Job)> {
        let DiffusionJob { bind_groups: groups, rbf_count } = solve;
        let job =
            |bind_group: &BindGroup, x: u32| Job { bind_group: bind_group.clone(), workgroups: UVec3::new(x, 1, 1) };
        let all = groups.cell_count.div_ceil(THREADS);
        let [even, odd] = &groups.solve;
        let mut jobs = vec![
            (&self.fit, job(&groups.source, (4 * rbf_count).div_ceil(64))),
            (&self.spread, job(&groups.source, groups.cell_count.div_ceil(64))),
            (&self.begin, job(even, all)),
        ];
        for step in 0..STEPS {
            let group = if step % 2 == 0 { even } else { odd };
            jobs.extend([&self.multiply, &self.descend, &self.turn].map(|pass| (pass, job(group, all))));
        }
        jobs.push((&self.media, job(even, all)));
        jobs.push((&self.scatter, job(&groups.scatter, (PROBES * rbf_count).div_ceil(64))));
        jobs
    }
}

/// What a solve reads and writes of its volume.
pub(super) struct Bindings<'a> {
    pub frame: &'a GpuSmokeFrame,
    pub lighting: &'a Buffer,
    pub diffusion: &'a Buffer,
    pub sampler: &'a Sampler,
    pub probes: &'a Buffer,
    pub columns: &'a Buffer,
    /// L⁰ of every cell, where the solver starts and ends: see [`solution_buffer`].
    pub solution: &'a Buffer,
    /// What the solver did, the `Control` of `diffusion_solve.wgsl`: see [`control_buffer`].
    pub control: &'a Buffer,
}

/// The bindings of a solve's dispatches.
pub(super) struct BindGroups {
    cell_count: u32,
    source: BindGroup,
    /// For the even and the odd steps: what one finds as the residual before, the other leaves as that after.
    solve: [BindGroup; 2],
    scatter: BindGroup,
}

/// L⁰ of the cells of a volume, zero.
pub(super) fn solution_buffer(shape: GridShape, device: &RenderDevice) -> Buffer {
    storage_buffer(device, "smoke_diffusion_solution", shape.coarse().coarsened(CELLS).len() as u64 * 16)
}

/// A report of nothing done.
pub(super) fn control_buffer(device: &RenderDevice) -> Buffer {
    storage_buffer(device, "smoke_diffusion_control", CONTROL_BYTES)
}

impl Bindings<'_> {
    pub fn bind(
        &self,
        shape: GridShape,
        pass: &DiffusionPass,
        device: &RenderDevice,
        cache: &PipelineCache,
    ) -> BindGroups {
        let cell_count = shape.coarse().coarsened(CELLS).len() as u32;
        let cell_buffer = |label, vectors: u64| storage_buffer(device, label, u64::from(cell_count) * vectors * 16);
        let fits = storage_buffer(device, "smoke_diffusion_fits", u64::from(self.frame.rbf_capacity) * FIT_BYTES);
        let cells = cell_buffer("smoke_diffusion_cells", 4);
        let vectors = cell_buffer("smoke_diffusion_vectors", 4);
        let shares = [(); 4]
            .map(|()| storage_buffer(device, "smoke_diffusion_shares", u64::from(cell_count.div_ceil(THREADS)) * 16));
        let [images, first, second, goal] = shares.each_ref().map(|buffer| buffer.as_entire_binding());
        let frame = || self.frame.uniform.as_entire_binding();
        let (lighting, diffusion) = (|| self.lighting.as_entire_binding(), || self.diffusion.as_entire_binding());
        let rbfs = || self.frame.rbfs.as_entire_binding();
        let source = (
            frame(),
            lighting(),
            diffusion(),
            rbfs(),
            self.frame.bin_offsets.as_entire_binding(),
            self.frame.bin_indices.as_entire_binding(),
            self.probes.as_entire_binding(),
            self.columns.as_entire_binding(),
            &self.frame.coarse,
            self.sampler,
            fits.as_entire_binding(),
            cells.as_entire_binding(),
        );
        let solve = [(first.clone(), second.clone()), (second, first)].map(|(before, after)| {
            let bindings = (
                lighting(),
                diffusion(),
                cells.as_entire_binding(),
                self.solution.as_entire_binding(),
                vectors.as_entire_binding(),
                images.clone(),
                before,
                after,
                goal.clone(),
                self.control.as_entire_binding(),
            );
            // The entry points share their layout.
            pass.begin.bind(device, cache, bindings)
        });
        let scatter =
            (frame(), lighting(), diffusion(), rbfs(), vectors.as_entire_binding(), self.probes.as_entire_binding());
        BindGroups {
            cell_count,
            source: pass.fit.bind(device, cache, source),
            solve,
            scatter: pass.scatter.bind(device, cache, scatter),
        }
    }
}

/// A solve of this frame.
pub(super) struct DiffusionJob {
    pub bind_groups: Arc<BindGroups>,
    pub rbf_count: u32,
}

/// Solves for every volume whose light changed.
pub(super) fn diffusion(
    work: Res<SmokeWork>,
    passes: Res<SmokePasses>,
    cache: Res<PipelineCache>,
    stats: Res<SmokeRenderStats>,
    mut ctx: RenderContext,
) {
    let jobs: Vec<_> = work.diffusion.iter().flat_map(|job| passes.diffusion.jobs(job)).collect();
    let jobs: Vec<_> = jobs.iter().map(|(pass, job)| (*pass, job)).collect();
    ComputePass::run_all(LABEL, &jobs, &cache, &DispatchCounter::default(), &mut ctx);
    // How many of a solve's dispatches find work is for the GPU to know: a solve counts as one.
    stats.diffusion.add(work.diffusion.len() as u32);
}
