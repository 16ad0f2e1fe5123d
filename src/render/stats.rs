//! What the passes did: for tools, tests and the curious.

use std::sync::{Arc, Mutex};

use bevy::ecs::entity::EntityHashMap;
use bevy::prelude::*;
use bevy::render::sync_world::MainEntity;

use super::pass::DispatchCounter;
use crate::quality::QualityChoice;
use crate::scattering::ScatteringChoice;

const PASS_COUNT: usize = 18 + cfg!(feature = "reference") as usize;

/// How many dispatches (and draws) each pass has made since the app started, in both worlds: the renderer counts, the
/// main world reads. The scattering and the diffusion pass count their solves, each of which is many dispatches. GPU times
/// are in Bevy's `DiagnosticsStore` under `render/<pass>/elapsed_gpu`, where the adapter has timestamps and
/// `RenderDiagnosticsPlugin` is added.
#[derive(Resource, Clone, Debug, Default)]
pub struct SmokeRenderStats {
    pub(crate) environment: DispatchCounter,
    pub(crate) density: DispatchCounter,
    pub(crate) live: DispatchCounter,
    pub(crate) coarse: DispatchCounter,
    pub(crate) lattice: DispatchCounter,
    pub(crate) pair_matrix: DispatchCounter,
    pub(crate) incident_light: DispatchCounter,
    pub(crate) scattering: DispatchCounter,
    pub(crate) diffusion: DispatchCounter,
    pub(crate) outgoing: DispatchCounter,
    pub(crate) volume: DispatchCounter,
    #[cfg(feature = "reference")]
    pub(crate) paper: DispatchCounter,
    pub(crate) constellation_lights: DispatchCounter,
    pub(crate) constellation_distance: DispatchCounter,
    pub(crate) constellation_mask: DispatchCounter,
    pub(crate) shadow_probes: DispatchCounter,
    pub(crate) shadow_mask: DispatchCounter,
    pub(crate) mesh_shadows: DispatchCounter,
    pub(crate) view: DispatchCounter,
    memory: Arc<Mutex<SmokeMemory>>,
    scattering_choices: Arc<Mutex<EntityHashMap<ScatteringChoice>>>,
    quality_choices: Arc<Mutex<EntityHashMap<QualityChoice>>>,
}

/// The moments of smoke on the GPU, which volumes that show the same one share, and the residuals of the baked frames that
/// they blend; live smoke counts as a moment. What lights a volume comes on top.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SmokeMemory {
    /// Moments there are now; those that nobody sees are let go after some seconds.
    pub moments: u32,
    /// Moments made since the app started, each with textures of its own; those that are rewritten do not count.
    pub moments_created: u32,
    /// Bytes of their buffers and textures, and of the residuals.
    pub bytes: u64,
}

impl SmokeRenderStats {
    /// The passes in the order they run, by the name of their GPU span.
    pub const PASSES: [&'static str; PASS_COUNT] = [
        super::environment::LABEL,
        super::density::LABEL,
        super::live::LABEL,
        super::coarse::LABEL,
        super::lattice::LABEL,
        super::pair_matrix::LABEL,
        super::incident_light::LABEL,
        super::scattering::LABEL,
        super::diffusion::LABEL,
        super::outgoing::LABEL,
        super::volume::LABEL,
        #[cfg(feature = "reference")]
        super::paper::LABEL,
        super::constellation::LIGHTS_LABEL,
        super::constellation::DISTANCE_LABEL,
        super::constellation::MASK_LABEL,
        super::shadow_probes::LABEL,
        super::shadow_mask::LABEL,
        super::mesh_shadows::LABEL,
        super::view::LABEL,
    ];

    /// What the moments of smoke take on the GPU.
    pub fn memory(&self) -> SmokeMemory {
        self.memory.lock().map_or(SmokeMemory::default(), |memory| *memory)
    }

    pub(super) fn set_memory(&self, memory: SmokeMemory) {
        if let Ok(mut current) = self.memory.lock() {
            *current = memory;
        }
    }

    /// Whether light that scatters more than once is drawn in a volume, and why; None before it is first seen.
    pub fn scattering(&self, volume: Entity) -> Option<ScatteringChoice> {
        self.scattering_choices.lock().ok()?.get(&volume).copied()
    }

    pub(super) fn set_scattering(&self, volume: MainEntity, choice: ScatteringChoice) {
        if let Ok(mut choices) = self.scattering_choices.lock() {
            choices.insert(volume.id(), choice);
        }
    }

    /// What model a volume is drawn with, what that is predicted to cost and how far off it is, and why; None before it is
    /// first seen.
    pub fn quality(&self, volume: Entity) -> Option<QualityChoice> {
        self.quality_choices.lock().ok()?.get(&volume).copied()
    }

    pub(super) fn set_quality(&self, volume: MainEntity, choice: QualityChoice) {
        if let Ok(mut choices) = self.quality_choices.lock() {
            choices.insert(volume.id(), choice);
        }
    }

    pub(super) fn retain_quality(&self, is_drawn: impl Fn(MainEntity) -> bool) {
        if let Ok(mut choices) = self.quality_choices.lock() {
            choices.retain(|volume, _| is_drawn((*volume).into()));
        }
    }

    pub(super) fn retain_scattering(&self, exists: impl Fn(MainEntity) -> bool) {
        if let Ok(mut choices) = self.scattering_choices.lock() {
            choices.retain(|volume, _| exists((*volume).into()));
        }
    }

    /// Dispatches so far, in the order of [`PASSES`](Self::PASSES).
    pub fn dispatches(&self) -> [u32; PASS_COUNT] {
        [
            &self.environment,
            &self.density,
            &self.live,
            &self.coarse,
            &self.lattice,
            &self.pair_matrix,
            &self.incident_light,
            &self.scattering,
            &self.diffusion,
            &self.outgoing,
            &self.volume,
            #[cfg(feature = "reference")]
            &self.paper,
            &self.constellation_lights,
            &self.constellation_distance,
            &self.constellation_mask,
            &self.shadow_probes,
            &self.shadow_mask,
            &self.mesh_shadows,
            &self.view,
        ]
        .map(DispatchCounter::get)
    }
}
