//! Shadows of smoke on meshes: what a camera sees of them.

use bevy::prelude::*;

/// The soft shadows that a camera sees on opaque meshes. A camera without it sees the shadows of smoke, and meshes do not
/// shade each other: the default.
#[derive(Component, Clone, Copy, Debug, PartialEq, Reflect)]
#[reflect(Component, Default, Debug, Clone, PartialEq)]
pub struct SmokeShadows {
    /// Whether smoke darkens the meshes under it.
    pub smoke: bool,
    /// Whether the spheres of [`SmokeOccluder`](crate::occluder::SmokeOccluder)s block light from all around on its way to
    /// meshes (Ren et al. 2006). It costs every pixel a look at every sphere near it.
    pub occluders: bool,
}

impl Default for SmokeShadows {
    fn default() -> Self {
        Self { smoke: true, occluders: false }
    }
}

/// Put beside a mesh, keeps the shadows of [`SmokeShadows`] off it: for what shines by itself.
///
/// Meshes with Bevy's own [`NotShadowReceiver`](bevy::light::NotShadowReceiver) are spared as well, and those whose
/// [`StandardMaterial`] is `unlit`, as skies are; other materials that shine by themselves need this component. A view that
/// sees such meshes draws them once more, into a mask of a byte a sample. Transparent meshes are never shaded.
///
/// A volume with [`NotShadowCaster`](bevy::light::NotShadowCaster) shades no mesh and no other smoke.
#[derive(Component, Clone, Copy, Debug, Default, PartialEq, Reflect)]
#[reflect(Component, Default, Debug, Clone, PartialEq)]
pub struct NoSmokeShadow;
