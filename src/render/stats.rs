//! What the passes did: for tools, tests and the curious.

use bevy::prelude::*;

use super::pass::DispatchCounter;

/// How many dispatches (and draws) each pass has made since the app started, in both worlds: the renderer counts, the
/// main world reads. GPU times are in Bevy's `DiagnosticsStore` under `render/<pass>/elapsed_gpu`, where the adapter has
/// timestamps and `RenderDiagnosticsPlugin` is added.
#[derive(Resource, Clone, Debug, Default)]
pub struct SmokeRenderStats {
    pub(crate) environment: DispatchCounter,
    pub(crate) density: DispatchCounter,
    pub(crate) coarse: DispatchCounter,
    pub(crate) source_radiance: DispatchCounter,
    pub(crate) outgoing: DispatchCounter,
    pub(crate) volume: DispatchCounter,
    pub(crate) view: DispatchCounter,
}

impl SmokeRenderStats {
    /// The passes in the order they run, by the name of their GPU span.
    pub const PASSES: [&'static str; 7] = [
        super::environment::LABEL,
        super::density::LABEL,
        super::coarse::LABEL,
        super::source_radiance::LABEL,
        super::outgoing::LABEL,
        super::volume::LABEL,
        super::view::LABEL,
    ];

    /// Dispatches so far, in the order of [`PASSES`](Self::PASSES).
    pub fn dispatches(&self) -> [u32; 7] {
        [
            &self.environment,
            &self.density,
            &self.coarse,
            &self.source_radiance,
            &self.outgoing,
            &self.volume,
            &self.view,
        ]
        .map(DispatchCounter::get)
    }
}
