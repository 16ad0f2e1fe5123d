//! A volume lit by the method, and as an eye sees it: buffers, bindings and the work that brings them up to date.

use bevy::prelude::*;
use bevy::render::render_resource::{BindGroup, Buffer, TextureView};

use super::steps::{LightBindGroups, LightBindings, LookBindings, Step};
use super::tables::PaperUniform;
use crate::paper::SmokePaper;
use crate::render::SmokeWork;
use crate::render::frame::GpuSmokeFrame;
use crate::render::lit::{Cached, copy_start, storage_buffer};
use crate::render::pass::Job;
use crate::render::prepare::Gpu;
use crate::render::volume;

/// What outlives a frame.
pub(in crate::render) struct PaperLight {
    settings: SmokePaper,
    /// Whether light may scatter more than once.
    multiple: bool,
    uniform: Cached<PaperUniform>,
    source: Buffer,
    solution: Buffer,
    bind_groups: LightBindGroups,
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
        let count = u64::from(frame.rbf_capacity);
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
            matrix: &buffer("smoke_paper_matrix", Self::matrix_bytes(frame.rbf_capacity)),
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
            source,
            solution,
        }
    }

    /// Bytes of the matrix between so many RBFs.
    pub fn matrix_bytes(rbf_count: u32) -> u64 {
        12 * u64::from(rbf_count).pow(2)
    }

    /// Takes new settings; whether anything changed.
    pub fn set(&mut self, settings: SmokePaper, multiple: bool, environment_from_bundle: Mat3, gpu: &Gpu) -> bool {
        let changed = self.settings != settings || self.multiple != multiple;
        (self.settings, self.multiple) = (settings, multiple);
        self.uniform.set(PaperUniform::new(environment_from_bundle, settings.exponential), gpu) | changed
    }

    /// Lets another start solving where this has ended; RBFs are known by their place in the list.
    pub fn hand_on(&self, next: &Self, gpu: &Gpu) {
        copy_start(&self.solution, &next.solution, self.solution.size().min(next.solution.size()), gpu);
    }

    /// Lights the volume, by light that scatters once or any number of times.
    pub fn light(&mut self, frame: &GpuSmokeFrame, work: &mut SmokeWork) {
        let steps = self.multiple.then_some(self.settings.steps);
        work.paper.extend(jobs(&self.bind_groups, frame, steps));
    }
}

/// The steps of light that scatters once, or any number of times with `steps` steps of the solver.
pub(in crate::render) fn jobs(groups: &LightBindGroups, frame: &GpuSmokeFrame, steps: Option<u32>) -> Vec<(Step, Job)> {
    let all = |step, bind_group: &BindGroup| {
        (step, Job { bind_group: bind_group.clone(), workgroups: UVec3::new(frame.rbf_count, 1, 1) })
    };
    let one = |step| (step, Job { bind_group: groups.solve.clone(), workgroups: UVec3::ONE });
    let mut jobs = vec![all(Step::Single, &groups.single)];
    if let Some(steps) = steps {
        jobs.push(all(Step::System, &groups.system));
        let workgroups = UVec3::new(frame.rbf_capacity.div_ceil(64), 1, 1);
        jobs.push((Step::Start, Job { bind_group: groups.solve.clone(), workgroups }));
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
        let outgoing = storage_buffer(gpu.device, "smoke_paper_outgoing", u64::from(frame.rbf_capacity) * 16);
        let bindings = LookBindings { frame, look, source: &light.source, outgoing: &outgoing, volume };
        let [outgoing, volume] = bindings.bind(&gpu.passes.paper, gpu.device, gpu.cache);
        Self { outgoing, volume }
    }

    pub fn look(&self, frame: &GpuSmokeFrame, work: &mut SmokeWork) {
        let workgroups = UVec3::new(frame.rbf_count.div_ceil(64), 1, 1);
        work.paper.push((Step::Outgoing, Job { bind_group: self.outgoing.clone(), workgroups }));
        let workgroups = volume::workgroups(frame.shape);
        work.paper.push((Step::Volume, Job { bind_group: self.volume.clone(), workgroups }));
    }
}
