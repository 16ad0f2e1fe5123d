//! A volume lit by the method, and as an eye sees it: buffers, bindings and the work that brings them up to date.

use bevy::prelude::*;
use bevy::render::render_resource::{BindGroup, Buffer, TextureView};

use super::steps::{CarryBindings, LightBindGroups, LightBindings, LookBindings, Step};
use super::tables::PaperUniform;
use crate::density::GridShape;
use crate::paper::SmokePaper;
use crate::render::SmokeWork;
use crate::render::frame::GpuSmokeFrame;
use crate::render::lit::{Cached, storage_buffer};
use crate::render::pass::Job;
use crate::render::prepare::Gpu;
use crate::render::volume;

/// What outlives a frame.
pub(in crate::render) struct PaperLight {
    settings: SmokePaper,
    /// Whether light may scatter more than once.
    multiple: bool,
    uniform: Cached<PaperUniform>,
    rbf_count: u32,
    /// The frame's own, to carry its solution to the next.
    frame: Buffer,
    rbfs: Buffer,
    source: Buffer,
    solution: Buffer,
    bind_groups: LightBindGroups,
    /// Whether anything has been solved.
    is_solved: bool,
}

impl PaperLight {
    pub fn new(
        settings: SmokePaper,
        frame: &GpuSmokeFrame,
        lighting: &Buffer,
        environment_from_bundle: Mat3,
        environment: &Buffer,
        gpu: &Gpu,
    ) -> Self {
        let count = u64::from(frame.rbf_count.max(1));
        let buffer = |label, bytes| storage_buffer(gpu.device, label, bytes);
        let source = buffer("smoke_paper_source", count * 16 * 16);
        let solution = buffer("smoke_paper_solution", count * 16);
        let uniform = Cached::new(PaperUniform::new(environment_from_bundle, settings.exponential), gpu);
        let bindings = LightBindings {
            frame,
            lighting,
            paper: uniform.buffer(),
            tables: gpu.paper_tables,
            environment,
            source: &source,
            matrix: &buffer("smoke_paper_matrix", Self::matrix_bytes(frame.rbf_count)),
            rhs: &buffer("smoke_paper_rhs", count * 16),
            solution: &solution,
            vectors: &buffer("smoke_paper_vectors", 4 * count * 16),
            power: &buffer("smoke_paper_power", 16),
        };
        Self {
            bind_groups: bindings.bind(&gpu.passes.paper, gpu.device, gpu.cache),
            settings,
            multiple: false,
            uniform,
            rbf_count: frame.rbf_count,
            frame: frame.uniform.clone(),
            rbfs: frame.rbfs.clone(),
            source,
            solution,
            is_solved: false,
        }
    }

    /// Bytes of the matrix between so many RBFs.
    pub fn matrix_bytes(rbf_count: u32) -> u64 {
        12 * u64::from(rbf_count.max(1)).pow(2)
    }

    /// Takes new settings; whether anything changed.
    pub fn set(&mut self, settings: SmokePaper, multiple: bool, environment_from_bundle: Mat3, gpu: &Gpu) -> bool {
        let changed = self.settings != settings || self.multiple != multiple;
        (self.settings, self.multiple) = (settings, multiple);
        self.uniform.set(PaperUniform::new(environment_from_bundle, settings.exponential), gpu) | changed
    }

    /// Starts where the frame before has ended.
    pub fn follow(&self, before: &Self, frame: &GpuSmokeFrame, gpu: &Gpu, work: &mut SmokeWork) {
        if before.is_solved {
            let bindings = CarryBindings {
                old_frame: &before.frame,
                old_rbfs: &before.rbfs,
                old_solution: &before.solution,
                frame,
                solution: &self.solution,
            };
            let bind_group = bindings.bind(&gpu.passes.paper, gpu.device, gpu.cache);
            let workgroups = UVec3::new(self.rbf_count.div_ceil(64), 1, 1);
            work.paper.push((Step::CarryOver, Job { bind_group, workgroups }));
        }
    }

    /// Lights the volume, by light that scatters once or any number of times.
    pub fn light(&mut self, work: &mut SmokeWork) {
        let steps = self.multiple.then_some(self.settings.steps);
        work.paper.extend(jobs(&self.bind_groups, self.rbf_count, steps));
        self.is_solved |= self.multiple;
    }
}

/// The steps of light that scatters once, or any number of times with `steps` steps of the solver.
pub(in crate::render) fn jobs(groups: &LightBindGroups, rbf_count: u32, steps: Option<u32>) -> Vec<(Step, Job)> {
    let all = |step, bind_group: &BindGroup| {
        (step, Job { bind_group: bind_group.clone(), workgroups: UVec3::new(rbf_count, 1, 1) })
    };
    let one = |step| (step, Job { bind_group: groups.solve.clone(), workgroups: UVec3::ONE });
    let mut jobs = vec![all(Step::Single, &groups.single)];
    if let Some(steps) = steps {
        jobs.push(all(Step::System, &groups.system));
        jobs.extend([all(Step::Residual, &groups.solve), all(Step::Transpose, &groups.solve), one(Step::Begin)]);
        for _ in 0..steps {
            jobs.extend([all(Step::Multiply, &groups.solve), all(Step::Transpose, &groups.solve), one(Step::Advance)]);
        }
        jobs.push(all(Step::Media, &groups.media));
    }
    jobs
}

/// A volume lit by the method, as an eye sees it.
pub(in crate::render) struct PaperSlice {
    outgoing: BindGroup,
    volume: BindGroup,
}

impl PaperSlice {
    pub fn new(frame: &GpuSmokeFrame, look: &Buffer, light: &PaperLight, volume: &TextureView, gpu: &Gpu) -> Self {
        let outgoing = storage_buffer(gpu.device, "smoke_paper_outgoing", u64::from(frame.rbf_count.max(1)) * 16);
        let bindings = LookBindings { frame, look, source: &light.source, outgoing: &outgoing, volume };
        let [outgoing, volume] = bindings.bind(&gpu.passes.paper, gpu.device, gpu.cache);
        Self { outgoing, volume }
    }

    pub fn look(&self, frame: &GpuSmokeFrame, shape: GridShape, work: &mut SmokeWork) {
        let workgroups = UVec3::new(frame.rbf_count.div_ceil(64), 1, 1);
        work.paper.push((Step::Outgoing, Job { bind_group: self.outgoing.clone(), workgroups }));
        let workgroups = volume::workgroups(shape);
        work.paper.push((Step::Volume, Job { bind_group: self.volume.clone(), workgroups }));
    }
}
