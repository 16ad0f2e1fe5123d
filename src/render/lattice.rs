//! Lattice pass: coarse density → RBFs and their bins, for live smoke. Runs after the coarse pass.

use bevy::prelude::*;
use bevy::render::render_resource::binding_types::{storage_buffer_sized, texture_3d, uniform_buffer};
use bevy::render::render_resource::{
    BindGroupLayoutEntries, Buffer, PipelineCache, ShaderStages, ShaderType, TextureSampleType,
};
use bevy::render::renderer::{RenderContext, RenderDevice, RenderQueue};
use bevy::shader::Shader;

use super::frame::{GpuSmokeFrame, uniform};
use super::lit::storage_buffer;
use super::pass::{ComputePass, Job};
use super::{SmokePasses, SmokeRenderStats, SmokeWork};
use crate::density::{COARSE_CELLS, GridShape};
use crate::rbf::{BIN_CELLS, SUPPORT, bin_shape};

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_lattice";

/// Radius of a Gaussian over its cell's side; as in `lattice.wgsl`.
const RADIUS: f32 = 0.45;

/// The `Lattice` of `lattice.wgsl`.
#[derive(ShaderType, Clone, Debug)]
struct LatticeUniform {
    dims: UVec3,
    side: f32,
    coarse_side: f32,
}

/// The dispatches of one run, in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Step {
    Gather,
    Place,
    Count,
    Offset,
    List,
}

impl Step {
    const ALL: [Self; 5] = [Self::Gather, Self::Place, Self::Count, Self::Offset, Self::List];

    fn entry_point(self) -> &'static str {
        match self {
            Self::Gather => "gather",
            Self::Place => "place",
            Self::Count => "count",
            Self::Offset => "offset",
            Self::List => "list",
        }
    }
}

/// The pipelines of all steps.
pub(crate) struct LatticePasses([ComputePass; 5]);

impl LatticePasses {
    pub fn new(shader: &Handle<Shader>, cache: &PipelineCache) -> Self {
        let storage = || storage_buffer_sized(false, None);
        let entries = BindGroupLayoutEntries::sequential(
            ShaderStages::COMPUTE,
            (
                storage(),
                uniform_buffer::<LatticeUniform>(false),
                texture_3d(TextureSampleType::Float { filterable: false }),
                storage(),
                storage(),
                storage(),
                storage(),
                storage(),
            ),
        );
        Self(Step::ALL.map(|step| ComputePass::new(LABEL, &entries, shader, step.entry_point(), vec![], cache)))
    }

    pub fn all(&self) -> impl Iterator<Item = &ComputePass> {
        self.0.iter()
    }

    pub fn of(&self, step: Step) -> &ComputePass {
        &self.0[step as usize]
    }
}

/// The lattice through a box, of so many cells along its longest side.
pub(super) fn lattice_shape(shape: GridShape, cells: u32) -> GridShape {
    shape.coarsened(cells)
}

/// RBFs there may be, and entries of their bins.
pub(super) fn room(shape: GridShape, lattice: u32) -> (u32, u64) {
    let cells = lattice_shape(shape, lattice).len() as u32;
    let side = side(shape, lattice) * shape.longest() as f32;
    // A bin's box, grown by a cell and a support on each side, and where it ends within lattice cells.
    let across = ((BIN_CELLS as f32 + 2.0) / side + 2.0 * SUPPORT * RADIUS).ceil() as u64 + 1;
    let dims = lattice_shape(shape, lattice).dims;
    let a_bin: u64 = dims.to_array().map(|cells| across.min(cells.into())).iter().product();
    let bins = bin_shape(shape).len() as u64;
    (cells, bins * a_bin)
}

/// Side of a lattice cell in bundle space.
fn side(shape: GridShape, lattice: u32) -> f32 {
    1.0 / (lattice as f32).min(shape.longest() as f32)
}

/// The work of one run, for a frame made with [`room`] for it.
pub(super) fn jobs(
    passes: &LatticePasses,
    frame: &GpuSmokeFrame,
    lattice: u32,
    device: &RenderDevice,
    queue: &RenderQueue,
    cache: &PipelineCache,
) -> Vec<(Step, Job)> {
    let cells = lattice_shape(frame.shape, lattice);
    let side = side(frame.shape, lattice);
    let coarse_side = side * (COARSE_CELLS as f32).min(frame.shape.longest() as f32);
    let value = LatticeUniform { dims: cells.dims, side, coarse_side };
    let uniform: Buffer = uniform(device, queue, "smoke_lattice", value);
    let masses = storage_buffer(device, "smoke_lattice_masses", 16 * cells.len() as u64);
    let slots = storage_buffer(device, "smoke_lattice_slots", 4 * cells.len() as u64);
    let bindings = (
        frame.uniform.as_entire_binding(),
        uniform.as_entire_binding(),
        &frame.coarse,
        masses.as_entire_binding(),
        slots.as_entire_binding(),
        frame.rbfs.as_entire_binding(),
        frame.bin_offsets.as_entire_binding(),
        frame.bin_indices.as_entire_binding(),
    );
    // All steps have one layout.
    let bind_group = passes.of(Step::Gather).bind(device, cache, bindings);
    let bins = bin_shape(frame.shape).len() as u32;
    let workgroups = |step| match step {
        Step::Gather => cells.len() as u32,
        Step::Place | Step::Offset => 1,
        Step::Count | Step::List => bins.div_ceil(64),
    };
    let job = |step| (step, Job { bind_group: bind_group.clone(), workgroups: UVec3::new(workgroups(step), 1, 1) });
    Step::ALL.map(job).to_vec()
}

/// Lays RBFs through all live smoke that changed.
pub(super) fn lattice(
    work: Res<SmokeWork>,
    passes: Res<SmokePasses>,
    cache: Res<PipelineCache>,
    stats: Res<SmokeRenderStats>,
    mut ctx: RenderContext,
) {
    let jobs: Vec<_> = work.lattice.iter().map(|(step, job)| (passes.lattice.of(*step), job)).collect();
    ComputePass::run_all(LABEL, &jobs, &cache, &stats.lattice, &mut ctx);
}
