//! The steps: their pipelines, and what they bind.

use bevy::prelude::*;
use bevy::render::render_resource::binding_types::{
    storage_buffer_read_only_sized, storage_buffer_sized, texture_3d, texture_storage_3d, uniform_buffer,
};
use bevy::render::render_resource::{
    BindGroup, BindGroupLayoutEntries, Buffer, PipelineCache, ShaderStages, StorageTextureAccess, TextureSampleType,
    TextureView,
};
use bevy::render::renderer::RenderDevice;

use super::tables::{PaperUniform, Tables};
use crate::render::frame::{FILTERED_FORMAT, FrameUniform, GpuSmokeFrame};
use crate::render::lighting::LightingUniform;
use crate::render::outgoing::LookUniform;
use crate::render::pass::ComputePass;
use crate::shaders::PaperShaders;

/// A step of the method.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Step {
    Single,
    System,
    Start,
    Residual,
    Multiply,
    Transpose,
    Begin,
    Advance,
    Media,
    Outgoing,
    Volume,
}

/// The pipelines of all steps.
pub(crate) struct PaperPasses([ComputePass; 11]);

impl PaperPasses {
    pub fn new(shaders: &PaperShaders, cache: &PipelineCache) -> Self {
        let compute = ShaderStages::COMPUTE;
        let read = || storage_buffer_read_only_sized(false, None);
        let write = || storage_buffer_sized(false, None);
        let frame = || uniform_buffer::<FrameUniform>(false);
        let lighting = || uniform_buffer::<LightingUniform>(false);
        let look = uniform_buffer::<LookUniform>(false);
        let (paper, tables) = (uniform_buffer::<PaperUniform>(false), uniform_buffer::<Tables>(false));
        let single =
            BindGroupLayoutEntries::sequential(compute, (frame(), lighting(), paper, tables, read(), read(), write()));
        let system =
            BindGroupLayoutEntries::sequential(compute, (frame(), lighting(), read(), read(), write(), write()));
        let solve = BindGroupLayoutEntries::sequential(compute, (frame(), read(), read(), write(), write(), write()));
        let media = BindGroupLayoutEntries::sequential(compute, (frame(), lighting(), read(), read(), write()));
        let outgoing = BindGroupLayoutEntries::sequential(compute, (frame(), look, read(), read(), write()));
        let volume = BindGroupLayoutEntries::sequential(
            compute,
            (
                frame(),
                read(),
                read(),
                read(),
                read(),
                texture_3d(TextureSampleType::Float { filterable: false }),
                texture_storage_3d(FILTERED_FORMAT, StorageTextureAccess::WriteOnly),
            ),
        );
        let pass = |label, entries: &[_], shader, entry_point| {
            ComputePass::new(label, entries, shader, entry_point, vec![], cache)
        };
        // In the order of `Step`.
        Self([
            pass("smoke_paper_single", &single, &shaders.single, "single"),
            pass("smoke_paper_system", &system, &shaders.system, "assemble"),
            pass("smoke_paper_start", &solve, &shaders.solve, "start"),
            pass("smoke_paper_residual", &solve, &shaders.solve, "residual"),
            pass("smoke_paper_multiply", &solve, &shaders.solve, "multiply"),
            pass("smoke_paper_transpose", &solve, &shaders.solve, "transpose_multiply"),
            pass("smoke_paper_begin", &solve, &shaders.solve, "begin"),
            pass("smoke_paper_advance", &solve, &shaders.solve, "advance"),
            pass("smoke_paper_media", &media, &shaders.media, "scatter"),
            pass("smoke_paper_outgoing", &outgoing, &shaders.outgoing, "leave"),
            pass("smoke_paper_volume", &volume, &shaders.volume, "reconstruct"),
        ])
    }

    pub fn all(&self) -> &[ComputePass] {
        &self.0
    }

    pub fn of(&self, step: Step) -> &ComputePass {
        &self.0[step as usize]
    }
}

/// What the steps that light a volume read and write.
pub(in crate::render) struct LightBindings<'a> {
    pub frame: &'a GpuSmokeFrame,
    pub lighting: &'a Buffer,
    pub paper: &'a Buffer,
    pub tables: &'a Buffer,
    pub environment: &'a Buffer,
    pub source: &'a Buffer,
    pub matrix: &'a Buffer,
    pub rhs: &'a Buffer,
    pub solution: &'a Buffer,
    pub vectors: &'a Buffer,
    pub power: &'a Buffer,
}

/// The bindings of these steps; the solver's steps share theirs.
pub(in crate::render) struct LightBindGroups {
    pub single: BindGroup,
    pub system: BindGroup,
    pub solve: BindGroup,
    pub media: BindGroup,
}

impl LightBindings<'_> {
    pub fn bind(&self, passes: &PaperPasses, device: &RenderDevice, cache: &PipelineCache) -> LightBindGroups {
        let (frame, rbfs) = (self.frame.uniform.as_entire_binding(), self.frame.rbfs.as_entire_binding());
        let (lighting, source) = (self.lighting.as_entire_binding(), self.source.as_entire_binding());
        let (matrix, rhs) = (self.matrix.as_entire_binding(), self.rhs.as_entire_binding());
        let solution = self.solution.as_entire_binding();
        let single = (
            frame.clone(),
            lighting.clone(),
            self.paper.as_entire_binding(),
            self.tables.as_entire_binding(),
            rbfs.clone(),
            self.environment.as_entire_binding(),
            source.clone(),
        );
        let system = (frame.clone(), lighting.clone(), rbfs.clone(), source.clone(), matrix.clone(), rhs.clone());
        let vectors = (self.vectors.as_entire_binding(), self.power.as_entire_binding());
        let solve = (frame.clone(), matrix, rhs, solution.clone(), vectors.0, vectors.1);
        let media = (frame, lighting, rbfs, solution, source);
        LightBindGroups {
            single: passes.of(Step::Single).bind(device, cache, single),
            system: passes.of(Step::System).bind(device, cache, system),
            solve: passes.of(Step::Multiply).bind(device, cache, solve),
            media: passes.of(Step::Media).bind(device, cache, media),
        }
    }
}

/// What the steps toward an eye read and write.
pub(in crate::render) struct LookBindings<'a> {
    pub frame: &'a GpuSmokeFrame,
    pub look: &'a Buffer,
    pub source: &'a Buffer,
    pub outgoing: &'a Buffer,
    pub volume: &'a TextureView,
}

impl LookBindings<'_> {
    /// The bindings of `outgoing` and of `volume`.
    pub fn bind(&self, passes: &PaperPasses, device: &RenderDevice, cache: &PipelineCache) -> [BindGroup; 2] {
        let (frame, rbfs) = (self.frame.uniform.as_entire_binding(), self.frame.rbfs.as_entire_binding());
        let outgoing = (
            frame.clone(),
            self.look.as_entire_binding(),
            rbfs.clone(),
            self.source.as_entire_binding(),
            self.outgoing.as_entire_binding(),
        );
        let volume = (
            frame,
            rbfs,
            self.frame.bin_offsets.as_entire_binding(),
            self.frame.bin_indices.as_entire_binding(),
            self.outgoing.as_entire_binding(),
            &self.frame.density,
            self.volume,
        );
        [passes.of(Step::Outgoing).bind(device, cache, outgoing), passes.of(Step::Volume).bind(device, cache, volume)]
    }
}
