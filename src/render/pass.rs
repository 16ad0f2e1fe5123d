//! A compute pass: its layout, its pipeline, and how a list of jobs is dispatched and counted.

use std::borrow::Cow;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use bevy::prelude::*;
use bevy::render::diagnostic::RecordDiagnostics;
use bevy::render::render_resource::{
    BindGroup, BindGroupEntry, BindGroupLayoutDescriptor, BindGroupLayoutEntry, CachedComputePipelineId,
    ComputePass as RawComputePass, ComputePassDescriptor, ComputePipelineDescriptor, IntoBindingArray, PipelineCache,
};
use bevy::render::renderer::{RenderContext, RenderDevice};
use bevy::shader::{Shader, ShaderDefVal};

/// A compute shader's entry point and the layout of its one bind group.
pub(crate) struct ComputePass {
    label: &'static str,
    layout: BindGroupLayoutDescriptor,
    pipeline: CachedComputePipelineId,
}

impl ComputePass {
    pub fn new(
        label: &'static str,
        entries: &[BindGroupLayoutEntry],
        shader: &Handle<Shader>,
        entry_point: &'static str,
        shader_defs: Vec<ShaderDefVal>,
        cache: &PipelineCache,
    ) -> Self {
        let layout = BindGroupLayoutDescriptor::new(label, entries);
        let pipeline = cache.queue_compute_pipeline(ComputePipelineDescriptor {
            label: Some(label.into()),
            layout: vec![layout.clone()],
            shader: shader.clone(),
            shader_defs,
            entry_point: Some(Cow::Borrowed(entry_point)),
            ..default()
        });
        Self { label, layout, pipeline }
    }

    pub fn bind<'b, const N: usize>(
        &self,
        device: &RenderDevice,
        cache: &PipelineCache,
        bindings: impl IntoBindingArray<'b, N>,
    ) -> BindGroup {
        let mut entries = Vec::with_capacity(N);
        for (binding, resource) in (0..).zip(bindings.into_array()) {
            entries.push(BindGroupEntry { binding, resource });
        }
        device.create_bind_group(self.label, &cache.get_bind_group_layout(&self.layout), &entries)
    }

    pub fn is_ready(&self, cache: &PipelineCache) -> bool {
        cache.get_compute_pipeline(self.pipeline).is_some()
    }

    /// Why the pipeline could not be made, if it could not.
    #[cfg(test)]
    pub fn failure(&self, cache: &PipelineCache) -> Option<String> {
        use bevy::render::render_resource::CachedPipelineState;
        match cache.get_compute_pipeline_state(self.pipeline) {
            CachedPipelineState::Err(error) => Some(format!("{}: {error}", self.label)),
            _ => None,
        }
    }

    /// Dispatches the jobs as one GPU span of the pass's name; no jobs, no span.
    pub fn run(&self, jobs: &[Job], cache: &PipelineCache, counter: &DispatchCounter, ctx: &mut RenderContext) {
        let jobs: Vec<_> = jobs.iter().map(|job| (self, job)).collect();
        Self::run_all(self.label, &jobs, cache, counter, ctx);
    }

    /// The same for jobs of several passes, in order.
    pub fn run_all(
        label: &'static str,
        jobs: &[(&Self, &Job)],
        cache: &PipelineCache,
        counter: &DispatchCounter,
        ctx: &mut RenderContext,
    ) {
        if jobs.is_empty() {
            return;
        }
        let recorder = ctx.diagnostic_recorder();
        let recorder = recorder.as_deref();
        let mut pass = ctx
            .command_encoder()
            .begin_compute_pass(&ComputePassDescriptor { label: Some(label), timestamp_writes: None });
        let span = recorder.pass_span(&mut pass, label);
        for (compute_pass, job) in jobs {
            if compute_pass.record(&mut pass, job, cache) {
                counter.add(1);
            }
        }
        span.end(&mut pass);
    }

    /// Records a job; false, and nothing recorded, where the pipeline is not there.
    pub fn record(&self, pass: &mut RawComputePass, job: &Job, cache: &PipelineCache) -> bool {
        let Some(pipeline) = cache.get_compute_pipeline(self.pipeline) else {
            return false;
        };
        pass.set_pipeline(pipeline);
        pass.set_bind_group(0, &job.bind_group, &[]);
        pass.dispatch_workgroups(job.workgroups.x, job.workgroups.y, job.workgroups.z);
        true
    }
}

/// One dispatch.
#[derive(Clone)]
pub(crate) struct Job {
    pub bind_group: BindGroup,
    pub workgroups: UVec3,
}

/// Counts a pass's dispatches or draws; shared by the render world, which adds, and the main world, which reads.
#[derive(Clone, Debug, Default)]
pub(crate) struct DispatchCounter(Arc<AtomicU32>);

impl DispatchCounter {
    pub fn add(&self, dispatches: u32) {
        self.0.fetch_add(dispatches, Ordering::Relaxed);
    }

    pub fn get(&self) -> u32 {
        self.0.load(Ordering::Relaxed)
    }
}

/// Workgroups of `size` threads that cover `threads`.
pub(crate) fn workgroups(threads: UVec3, size: UVec3) -> UVec3 {
    UVec3::new(threads.x.div_ceil(size.x), threads.y.div_ceil(size.y), threads.z.div_ceil(size.z))
}
