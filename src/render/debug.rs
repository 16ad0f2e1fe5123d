//! Debug passes: what [`SmokeDebugView`] shows in the place of a volume's picture, written to the 3D texture that the view
//! pass marches. They are made when a volume first asks for them, and run instead of the outgoing and the volume pass.

use bevy::prelude::*;
use bevy::render::render_resource::binding_types::{
    storage_buffer_read_only_sized, texture_3d, texture_storage_3d, uniform_buffer,
};
use bevy::render::render_resource::{
    BindGroup, BindGroupLayoutEntries, PipelineCache, ShaderStages, StorageTextureAccess, TextureSampleType,
    TextureView,
};
use bevy::render::renderer::{RenderContext, RenderDevice};

use super::extract::ExtractedSmoke;
use super::frame::{FILTERED_FORMAT, FrameUniform, GpuSmokeFrame};
use super::pass::{ComputePass, DispatchCounter};
use super::view::SmokeUniform;
use super::{SmokeWork, outgoing, volume};
use crate::debug::SmokeDebugView;
use crate::shaders::Shaders;

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_debug";

/// What makes the outgoing and the volume pass leave out light that has scattered once.
const SCATTERED_ONLY: &str = "SCATTERED_ONLY";

/// One of the passes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Step {
    Density,
    Rbfs,
    Residual,
    /// The outgoing and the volume pass, without light that has scattered once.
    Outgoing,
    Volume,
}

impl Step {
    /// Of a view that shows a field.
    pub fn of_field(view: SmokeDebugView) -> Option<Self> {
        match view {
            SmokeDebugView::Density => Some(Self::Density),
            SmokeDebugView::Rbfs => Some(Self::Rbfs),
            SmokeDebugView::Residual => Some(Self::Residual),
            _ => None,
        }
    }
}

/// All of them.
#[derive(Resource)]
pub(crate) struct DebugPasses {
    density: ComputePass,
    rbfs: ComputePass,
    residual: ComputePass,
    outgoing: ComputePass,
    volume: ComputePass,
}

impl DebugPasses {
    pub fn new(shaders: &Shaders, cache: &PipelineCache) -> Self {
        let storage = || storage_buffer_read_only_sized(false, None);
        let entries = BindGroupLayoutEntries::sequential(
            ShaderStages::COMPUTE,
            (
                uniform_buffer::<FrameUniform>(false),
                storage(),
                storage(),
                storage(),
                texture_3d(TextureSampleType::Float { filterable: false }),
                texture_storage_3d(FILTERED_FORMAT, StorageTextureAccess::WriteOnly),
            ),
        );
        let field = |entry_point| ComputePass::new(LABEL, &entries, &shaders.debug, entry_point, vec![], cache);
        Self {
            density: field("show_density"),
            rbfs: field("show_rbfs"),
            residual: field("show_residual"),
            outgoing: outgoing::pass_with(&shaders.outgoing, vec![SCATTERED_ONLY.into()], cache),
            volume: volume::pass_with(&shaders.volume, vec![SCATTERED_ONLY.into()], cache),
        }
    }

    pub fn get(&self, step: Step) -> &ComputePass {
        match step {
            Step::Density => &self.density,
            Step::Rbfs => &self.rbfs,
            Step::Residual => &self.residual,
            Step::Outgoing => &self.outgoing,
            Step::Volume => &self.volume,
        }
    }

    /// Whether every pipeline is there.
    pub fn are_ready(&self, cache: &PipelineCache) -> bool {
        [Step::Density, Step::Rbfs, Step::Residual, Step::Outgoing, Step::Volume]
            .into_iter()
            .all(|step| self.get(step).is_ready(cache))
    }

    /// What a field's dispatch reads and writes.
    pub fn bind_field(
        &self,
        step: Step,
        frame: &GpuSmokeFrame,
        texture: &TextureView,
        device: &RenderDevice,
        cache: &PipelineCache,
    ) -> BindGroup {
        self.get(step).bind(
            device,
            cache,
            (
                frame.uniform.as_entire_binding(),
                frame.rbfs.as_entire_binding(),
                frame.bin_offsets.as_entire_binding(),
                frame.bin_indices.as_entire_binding(),
                &frame.density,
                texture,
            ),
        )
    }
}

/// Makes the passes for the first volume that needs them.
pub(super) fn prepare_passes(
    mut commands: Commands,
    passes: Option<Res<DebugPasses>>,
    smoke: Res<ExtractedSmoke>,
    assets: Res<AssetServer>,
    cache: Res<PipelineCache>,
) {
    if passes.is_none() && smoke.volumes.values().any(|volume| volume.debug.has_passes()) {
        commands.insert_resource(DebugPasses::new(&Shaders::load(&assets), &cache));
    }
}

/// A volume's uniform as its debug view needs it: false colours are shown as they are, and a lamp's glow is light that has
/// scattered once.
pub(super) fn adapt(uniform: SmokeUniform, view: SmokeDebugView) -> SmokeUniform {
    match view {
        view if view.is_field() => SmokeUniform { radiance_scale: 1.0, glow_count: 0, ..uniform },
        SmokeDebugView::Multiple => SmokeUniform { glow_count: 0, ..uniform },
        _ => uniform,
    }
}

/// Writes what has changed.
pub(super) fn debug(work: Res<SmokeWork>, passes: Res<DebugPasses>, cache: Res<PipelineCache>, mut ctx: RenderContext) {
    let jobs: Vec<_> = work.debug.iter().map(|(step, job)| (passes.get(*step), job)).collect();
    ComputePass::run_all(LABEL, &jobs, &cache, &DispatchCounter::default(), &mut ctx);
}
