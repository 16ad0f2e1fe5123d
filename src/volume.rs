//! The component that puts smoke into a scene.

use bevy::camera::primitives::Aabb;
use bevy::camera::visibility::{self, Visibility, VisibilityClass, VisibilitySystems};
use bevy::prelude::*;

use crate::bundle::SmokeAnimation;
use crate::lighting::SmokeEnvironment;
use crate::medium::SmokeMedium;
use crate::playback::{Shown, SmokeMoment, SmokePlayback};
use crate::quality::SmokeQuality;
use crate::scattering::SmokeScattering;

/// A volume of smoke.
///
/// Its box is centred on the entity's origin and has its longest side 1 in local units: a scale of 3 gives smoke
/// 3 metres tall (or wide). Move and turn it by its [`Transform`] like any entity; `Visibility`, `RenderLayers` and
/// frustum culling work as for a mesh. Scale uniformly: under a non-uniform scale the smoke is stretched with the box
/// but its extinction per metre follows the cube root of the box's change of volume, and a warning says so once.
///
/// Smoke is drawn after opaque meshes and before transparent ones. Where volumes overlap each is composited as a
/// whole, the one whose centre is farther from the camera first.
///
/// It shades opaque meshes and other smoke, in view or not, unless Bevy's [`NotShadowCaster`](bevy::light::NotShadowCaster) is
/// beside it: see [`crate::shadows`].
#[derive(Component, Clone, Debug, Default, PartialEq, Reflect)]
#[reflect(Component, Default, Debug, Clone, PartialEq)]
#[require(
    SmokePlayback,
    SmokeMoment,
    Shown,
    SmokeMedium,
    SmokeEnvironment,
    SmokeScattering,
    SmokeQuality,
    Transform,
    Visibility,
    VisibilityClass
)]
#[component(on_add = visibility::add_visibility_class::<SmokeVolume>)]
pub struct SmokeVolume {
    /// The baked smoke.
    pub animation: Handle<SmokeAnimation>,
}

impl SmokeVolume {
    /// Smoke that plays an animation: how is up to its [`SmokePlayback`].
    pub fn new(animation: Handle<SmokeAnimation>) -> Self {
        Self { animation }
    }
}

/// Keeps every volume's bounds, and warns of transforms that smoke cannot follow.
pub(crate) struct SmokeVolumePlugin;

impl Plugin for SmokeVolumePlugin {
    fn build(&self, app: &mut App) {
        app.add_systems(
            PostUpdate,
            (
                update_bounds.before(VisibilitySystems::CheckVisibility),
                warn_of_non_uniform_scale.after(TransformSystems::Propagate),
            ),
        );
    }
}

/// Bounds of the box in local units, for culling; set when the animation has loaded or changed.
fn update_bounds(
    mut commands: Commands,
    animations: Res<Assets<SmokeAnimation>>,
    mut events: MessageReader<AssetEvent<SmokeAnimation>>,
    volumes: Query<(Entity, Ref<SmokeVolume>, Option<&Aabb>)>,
) {
    let touched: Vec<AssetId<SmokeAnimation>> = events
        .read()
        .filter_map(|event| match event {
            AssetEvent::Added { id } | AssetEvent::Modified { id } => Some(*id),
            _ => None,
        })
        .collect();
    for (entity, volume, bounds) in &volumes {
        if !(volume.is_changed() || bounds.is_none() || touched.contains(&volume.animation.id())) {
            continue;
        }
        if let Some(animation) = animations.get(&volume.animation) {
            let half_extents = animation.shape.half_extent().into();
            commands.entity(entity).try_insert(Aabb { center: Vec3::ZERO.into(), half_extents });
        }
    }
}

/// Largest ratio of a volume's longest to its shortest axis that still counts as a uniform scale.
const UNIFORM: f32 = 1.001;

fn warn_of_non_uniform_scale(
    volumes: Query<(Entity, &GlobalTransform), (With<SmokeVolume>, Changed<GlobalTransform>)>,
    mut warned: Local<bool>,
) {
    if *warned {
        return;
    }
    for (entity, transform) in &volumes {
        let scale = transform.scale().abs();
        if scale.max_element() > UNIFORM * scale.min_element() {
            *warned = true;
            warn!(
                "smoke volume {entity} has the non-uniform scale {scale}: its smoke is stretched, and its extinction \
                 per metre follows the cube root of the volume's change; scale smoke uniformly (said once)"
            );
        }
    }
}
