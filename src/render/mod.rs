//! The renderer: which passes there are, what each reads and writes, and when it runs.
//!
//! | pass | reads | writes | once per |
//! |---|---|---|---|
//! | `environment` | a radiance image | 16 SH coefficients | environment |
//! | `density` | RBFs, bins, two hashed residuals | density of every cell | moment of smoke |
//! | `live` | a game's 3D texture | density of every cell | frame, of live smoke |
//! | `coarse` | density | density of a 64³ grid | moment of smoke |
//! | `lattice` | coarse density | RBFs, bins | frame, of live smoke |
//! | `pair_matrix` | RBFs, coarse density | how much each RBF sees of each other | volume, moment of smoke and extinction |
//! | `incident_light` | coefficients, lamps, RBFs, coarse densities, spheres | SH light and columns to the lamps at the probes of every RBF | volume, light and what stands in it |
//! | `scattering` | pair matrix, light at the probes | SH light that each RBF sees of the others | the same |
//! | `diffusion` | light at the probes, coarse density | SH light at the probes, added; in the place of `pair_matrix` and `scattering` | the same |
//! | `outgoing` | light at the probes, scattered light | quadratic fit of the radiance toward the eye, an RBF | the same, × view if g ≠ 0 |
//! | `volume` | those, lamps, RBFs, bins, density | 3D texture of source radiance and density | the same |
//! | `shadow_probes` | coarse density, sky | what smoke takes of the sky, at 24³ points around it | volume and sky |
//! | `shadow_mask` | the meshes that are not shaded, depth | where the view shows them | view that sees any |
//! | `mesh_shadows` | both, coarse densities, spheres, depth, Bevy's lights and shadow maps | the view's meshes, shaded | view |
//! | `view` | the 3D texture, the view's depth | the view's colours | view |
//!
//! Volumes with [`SmokeConstellation`](crate::constellation::SmokeConstellation) take three passes of their own, in
//! `constellation`, in the place of those from pair matrix to volume.
//!
//! All but the last three are compute passes in Bevy's `RenderGraph` schedule, before the cameras' own, and run only when
//! something they read has changed: a static scene dispatches none of them. The view pass runs in `Core3d` after the opaque
//! pass and before the transparent one; where transparent meshes are behind smoke or in it, it is drawn among them
//! (`slabs.rs`). It can march at half resolution (`half_resolution.rs`). Each is a GPU span of its own; games can order against [`SmokeSystems`].
//!
//! A moment is a blend of two baked frames. On the GPU there are those moments that volumes show, each in buffers and textures
//! of its own that are rewritten as time goes on, and the residuals of the baked frames that they blend: memory does not
//! grow with the length of animations ([`SmokeRenderStats::memory`]). Solvers go on from one moment to the next.
//!
//! Where a volume has a [`SmokeDebugView`](crate::debug::SmokeDebugView), debug passes (`debug.rs`) run in the place of `outgoing`
//! and `volume`.
//!
//! Radiance is linear in the light, so everything before the view pass works on the environment's own values; intensity
//! and the camera's exposure are applied as the view is drawn, and change at no cost.

mod baked;
mod casters;
mod coarse;
mod constellation;
mod debug;
mod density;
mod diffusion;
mod environment;
mod extract;
mod footprint;
mod frame;
mod half_resolution;
mod incident_light;
mod lamp;
mod lattice;
mod level;
mod light;
mod lighting;
mod lit;
mod live;
mod mesh_shadows;
mod moments;
mod outgoing;
mod pair_matrix;
#[cfg(feature = "reference")]
mod paper;
mod pass;
mod placed;
mod prepare;
mod quality;
mod scattering;
mod shading;
mod shadow_mask;
mod shadow_probes;
mod sky;
mod slabs;
mod stats;
mod surroundings;
#[cfg(all(test, feature = "cli"))]
mod tests;
mod view;
mod volume;

use bevy::core_pipeline::core_3d::{
    Transparent3d, main_opaque_pass_3d, main_transparent_pass_3d, prepare_core_3d_depth_textures,
};
use bevy::core_pipeline::schedule::{Core3d, Core3dSystems, camera_driver};
use bevy::pbr::{MeshPipeline, MeshPipelineSystems, main_transmissive_pass_3d};
use bevy::prelude::*;
use bevy::render::render_phase::{DrawFunctions, sort_phase_system};
use bevy::render::render_resource::{DownlevelFlags, PipelineCache, SpecializedRenderPipelines};
use bevy::render::renderer::{RenderAdapter, RenderDevice, RenderGraph, RenderGraphSystems};
use bevy::render::sync_world::SyncToRenderWorld;
use bevy::render::{ExtractSchedule, GpuResourceAppExt, Render, RenderApp, RenderStartup, RenderSystems};

use self::diffusion::{DiffusionJob, DiffusionPass};
use self::environment::{EnvironmentJob, EnvironmentPass};
use self::incident_light::{IncidentLightJob, IncidentLightPass};
use self::pass::{ComputePass, Job};
pub use self::scattering::SolverReport;
use self::scattering::{ScatteringJob, ScatteringPass};
pub use self::stats::{SmokeMemory, SmokeRenderStats};
use crate::shaders::{self, Shaders};
use crate::sun::{EnvironmentSuns, find_suns};
use crate::volume::SmokeVolume;

/// Where smoke runs in Bevy's render schedules.
#[derive(SystemSet, Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum SmokeSystems {
    /// In `Render`, inside `RenderSystems::PrepareBindGroups`: lists the work of the frame.
    Prepare,
    /// In `RenderGraph`, before the cameras: unpacks density and lights the smoke.
    Light,
    /// In `Core3d`, between the opaque and the transparent pass: draws the view's smoke.
    Draw,
}

/// Draws smoke, where the app has a renderer; part of [`SmokePlugin`](crate::SmokePlugin).
pub(crate) struct SmokeRenderPlugin;

impl Plugin for SmokeRenderPlugin {
    fn build(&self, app: &mut App) {
        if app.get_sub_app(RenderApp).is_none() {
            return;
        }
        shaders::embed(app);
        let stats = SmokeRenderStats::default();
        app.insert_resource(stats.clone())
            .init_resource::<EnvironmentSuns>()
            .add_systems(PostUpdate, find_suns)
            .register_required_components::<SmokeVolume, SyncToRenderWorld>()
            .add_plugins((shadow_mask::ShadowMaskPlugin, constellation::ConstellationPlugin));

        let render_app = app.sub_app_mut(RenderApp);
        render_app
            .insert_resource(stats)
            .init_resource::<extract::ExtractedSmoke>()
            .init_resource::<SmokeWork>()
            .init_gpu_resource::<prepare::SmokeCache>()
            .init_gpu_resource::<SpecializedRenderPipelines<view::ViewPass>>()
            .init_gpu_resource::<SpecializedRenderPipelines<mesh_shadows::MeshShadowPass>>()
            .add_systems(RenderStartup, init_passes.after(MeshPipelineSystems))
            .add_systems(ExtractSchedule, extract::extract_smoke)
            .add_systems(
                Render,
                (
                    view::prepare_depth_usages
                        .in_set(RenderSystems::PrepareResources)
                        .before(prepare_core_3d_depth_textures),
                    (view::prepare_view_pipelines, slabs::cut_at_transparent_meshes)
                        .chain()
                        .after(sort_phase_system::<Transparent3d>)
                        .in_set(RenderSystems::PhaseSort),
                    debug::prepare_passes.before(prepare::prepare_smoke).in_set(RenderSystems::PrepareBindGroups),
                    prepare::prepare_smoke.in_set(RenderSystems::PrepareBindGroups).in_set(SmokeSystems::Prepare),
                    slabs::prepare_slabs.in_set(RenderSystems::PrepareBindGroups),
                    half_resolution::prepare_half_resolution
                        .in_set(RenderSystems::PrepareBindGroups)
                        .after(prepare::prepare_smoke),
                )
                    .run_if(resource_exists::<SmokePasses>),
            )
            .add_systems(
                Render,
                (shadow_mask::prepare_shadow_masks, mesh_shadows::prepare_mesh_shadow_pipelines)
                    .chain()
                    .in_set(RenderSystems::PrepareBindGroups)
                    .after(prepare::prepare_smoke)
                    .run_if(resource_exists::<mesh_shadows::MeshShadowPass>),
            )
            .add_systems(
                RenderGraph,
                (
                    environment::environment,
                    density::density,
                    live::live,
                    coarse::coarse,
                    lattice::lattice,
                    casters::copy_casters,
                    pair_matrix::pair_matrix,
                    incident_light::incident_light,
                    scattering::scattering,
                    diffusion::diffusion,
                    outgoing::outgoing,
                    volume::volume,
                    shadow_probes::shadow_probes,
                )
                    .chain()
                    .in_set(RenderGraphSystems::Render)
                    .in_set(SmokeSystems::Light)
                    .before(camera_driver)
                    .run_if(resource_exists::<SmokePasses>),
            )
            .add_systems(
                Core3d,
                (shadow_mask::shadow_mask, mesh_shadows::mesh_shadows, view::view)
                    .chain()
                    .after(main_opaque_pass_3d)
                    // What is behind glass is seen through it.
                    .before(main_transmissive_pass_3d)
                    .before(main_transparent_pass_3d)
                    .in_set(Core3dSystems::MainPass)
                    .in_set(SmokeSystems::Draw),
            );
        render_app.add_systems(
            RenderGraph,
            debug::debug
                .after(volume::volume)
                .in_set(RenderGraphSystems::Render)
                .in_set(SmokeSystems::Light)
                .before(camera_driver)
                .run_if(resource_exists::<debug::DebugPasses>),
        );
        #[cfg(feature = "reference")]
        render_app.add_systems(
            RenderGraph,
            paper::paper
                .after(volume::volume)
                .in_set(RenderGraphSystems::Render)
                .in_set(SmokeSystems::Light)
                .before(camera_driver)
                .run_if(resource_exists::<SmokePasses>),
        );
    }
}

/// The compute passes.
#[derive(Resource)]
pub(crate) struct SmokePasses {
    environment: EnvironmentPass,
    density: ComputePass,
    live: ComputePass,
    coarse: ComputePass,
    lattice: lattice::LatticePasses,
    pair_matrix: ComputePass,
    incident_light: IncidentLightPass,
    scattering: ScatteringPass,
    diffusion: DiffusionPass,
    outgoing: ComputePass,
    volume: ComputePass,
    shadow_probes: ComputePass,
    #[cfg(feature = "reference")]
    paper: paper::PaperPasses,
}

impl SmokePasses {
    fn all(&self) -> impl Iterator<Item = &ComputePass> {
        let others = [
            &self.density,
            &self.live,
            &self.coarse,
            &self.pair_matrix,
            &self.outgoing,
            &self.volume,
            &self.shadow_probes,
        ];
        let all = self
            .environment
            .passes()
            .into_iter()
            .chain(self.lattice.all())
            .chain(self.scattering.passes())
            .chain(self.diffusion.passes())
            .chain(self.incident_light.passes())
            .chain(others);
        #[cfg(feature = "reference")]
        let all = all.chain(self.paper.all());
        all
    }

    /// Whether every pipeline is there.
    fn are_ready(&self, cache: &PipelineCache) -> bool {
        self.all().all(|pass| pass.is_ready(cache))
    }
}

fn init_passes(
    mut commands: Commands,
    cache: Res<PipelineCache>,
    assets: Res<AssetServer>,
    device: Res<RenderDevice>,
    adapter: Res<RenderAdapter>,
    draw_functions: Res<DrawFunctions<Transparent3d>>,
    mesh_pipeline: Option<Res<MeshPipeline>>,
) {
    if let Err(missing) = check_device(&device, &adapter) {
        error!("this graphics adapter cannot draw smoke: it lacks {missing}; the rest of the app goes on without");
        return;
    }
    let shaders = Shaders::load(&assets);
    commands.insert_resource(SmokePasses {
        environment: EnvironmentPass::new(&shaders.environment, &cache),
        density: density::pass(&shaders.density, &cache),
        live: live::pass(&shaders.live, &cache),
        coarse: coarse::pass(&shaders.coarse, &cache),
        lattice: lattice::LatticePasses::new(&shaders.lattice, &cache),
        pair_matrix: pair_matrix::pass(&shaders.pair_matrix, &cache),
        incident_light: IncidentLightPass::new(&shaders.incident_light, &cache),
        scattering: ScatteringPass::new(&shaders, &cache),
        diffusion: DiffusionPass::new(&shaders, &cache),
        outgoing: outgoing::pass(&shaders.outgoing, &cache),
        volume: volume::pass(&shaders.volume, &cache),
        shadow_probes: shadow_probes::pass(&shaders.shadow_probes, &cache),
        #[cfg(feature = "reference")]
        paper: paper::PaperPasses::new(&shaders.paper, &cache),
    });
    commands.insert_resource(constellation::ConstellationPasses::new(&shaders.constellation, &cache));
    commands.insert_resource(view::ViewPass::new(&shaders.view));
    draw_functions.write().add(slabs::DrawSlab);
    if let Some(pass) = mesh_shadows::MeshShadowPass::new(mesh_pipeline.as_deref(), &shaders.mesh_shadows) {
        commands.insert_resource(pass);
        commands.insert_resource(shadow_mask::ShadowMaskPass::new(&shaders.shadow_mask));
    }
}

/// What the solvers did last, read back from the GPU.
#[cfg(feature = "cli")]
pub(crate) fn read_solver_reports(render_world: &World) -> Vec<SolverReport> {
    let (device, queue) = (render_world.resource::<RenderDevice>(), render_world.resource());
    let controls = render_world.resource::<prepare::SmokeCache>().solver_controls();
    controls
        .filter_map(|buffer| SolverReport::from_bytes(&crate::headless::read_buffer(device, queue, buffer)))
        .collect()
}

/// What the passes need beyond what every device has; on failure, what is missing.
fn check_device(device: &RenderDevice, adapter: &RenderAdapter) -> Result<(), &'static str> {
    let limits = device.limits();
    let flags = adapter.get_downlevel_capabilities().flags;
    let needs = [
        (flags.contains(DownlevelFlags::COMPUTE_SHADERS), "compute shaders"),
        (limits.max_storage_buffers_per_shader_stage >= 8, "8 storage buffers a shader"),
        (limits.max_storage_textures_per_shader_stage >= 1, "storage textures"),
        (limits.max_compute_workgroup_storage_size >= 16_384, "16 KiB of memory a workgroup"),
        (limits.max_compute_invocations_per_workgroup >= 256, "256 threads a workgroup"),
    ];
    needs.iter().find(|(there, _)| !there).map_or(Ok(()), |(_, what)| Err(what))
}

/// The dispatches of this frame.
#[derive(Resource, Default)]
pub(crate) struct SmokeWork {
    environment: Vec<EnvironmentJob>,
    density: Vec<Job>,
    live: Vec<Job>,
    coarse: Vec<Job>,
    lattice: Vec<(lattice::Step, Job)>,
    copies: Vec<casters::Copy>,
    pair_matrix: Vec<Job>,
    incident_light: Vec<IncidentLightJob>,
    scattering: Vec<ScatteringJob>,
    diffusion: Vec<DiffusionJob>,
    outgoing: Vec<Job>,
    volume: Vec<Job>,
    shadow_probes: Vec<Job>,
    debug: Vec<(debug::Step, Job)>,
    #[cfg(feature = "reference")]
    paper: Vec<(paper::Step, Job)>,
}

impl SmokeWork {
    fn clear(&mut self) {
        *self = Self::default();
    }
}
