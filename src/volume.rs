//! The component that puts smoke into a scene, and where its density comes from.

use bevy::asset::RenderAssetUsages;
use bevy::camera::primitives::Aabb;
use bevy::camera::visibility::{self, Visibility, VisibilityClass, VisibilitySystems};
use bevy::prelude::*;
use bevy::render::render_resource::{Extent3d, TextureDimension, TextureFormat};

use crate::bundle::SmokeAnimation;
use crate::density::{DensityGrid, GridShape};
use crate::lighting::SmokeEnvironment;
use crate::medium::SmokeMedium;
use crate::playback::{Shown, SmokeMoment, SmokePlayback};
use crate::quality::SmokeQuality;
use crate::scattering::SmokeScattering;

/// A volume of smoke: baked, or live in a texture.
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
    /// Where its density comes from.
    pub density: SmokeDensity,
}

impl SmokeVolume {
    /// Smoke that plays an animation: how is up to its [`SmokePlayback`].
    pub fn new(animation: Handle<SmokeAnimation>) -> Self {
        Self { density: SmokeDensity::Animation(animation) }
    }

    /// Smoke whose density a 3D texture holds: see [`LiveDensity`].
    pub fn live(image: Handle<Image>) -> Self {
        Self { density: SmokeDensity::Live(LiveDensity::new(image)) }
    }

    /// The animation it plays, if it does.
    pub fn animation(&self) -> Option<&Handle<SmokeAnimation>> {
        match &self.density {
            SmokeDensity::Animation(animation) => Some(animation),
            SmokeDensity::Live(_) => None,
        }
    }
}

/// Where a volume's density comes from.
#[derive(Clone, Debug, PartialEq, Reflect)]
#[reflect(Default, Debug, Clone, PartialEq)]
pub enum SmokeDensity {
    /// A baked animation.
    Animation(Handle<SmokeAnimation>),
    /// A texture.
    Live(LiveDensity),
}

impl Default for SmokeDensity {
    /// An animation that is not there: nothing is drawn.
    fn default() -> Self {
        Self::Animation(Handle::default())
    }
}

/// Density from a 3D texture: that of a game's own simulation, which writes it on the GPU as often as it likes, or one that
/// was filled on the CPU.
///
/// The texture's first channel is the density at the cells' centres; what is below 0 or no number is taken for 0. Its format
/// is any that shaders read as floats (`R8Unorm`, `R16Float`, `R32Float`, …), its usage must have `TEXTURE_BINDING`. A
/// compute shader that writes it belongs into Bevy's `RenderGraph` schedule, before
/// [`SmokeSystems::Light`](crate::render::SmokeSystems::Light).
///
/// Nothing is precomputed: where baked smoke has fitted Gaussians, a lattice of them is laid through the density on the
/// GPU whenever it changes, and lit like those; the density that is marched is the texture's own. On the reference scenes
/// that is as accurate as a bundle of as many Gaussians.
#[derive(Clone, Debug, PartialEq, Reflect)]
#[reflect(Debug, Clone, PartialEq)]
pub struct LiveDensity {
    /// The texture.
    pub image: Handle<Image>,
    /// Whether it is written on the GPU, so that it is looked at anew in every frame. If not, only when the asset changes.
    pub changes: bool,
    /// The density that counts as large, above 0: densities are kept in half precision as shares of it, which ends at
    /// 65504.
    pub max_density: f32,
    /// Cells of the lattice along the box's longest side, 4 to 16: at most one Gaussian each, where there is smoke. Light
    /// is as detailed as they are; its cost grows with the square of their number.
    pub lattice: u32,
}

impl LiveDensity {
    /// Cells of the lattice unless told otherwise.
    pub const LATTICE: u32 = 12;

    /// A texture that changes, with densities of about 1.
    pub fn new(image: Handle<Image>) -> Self {
        Self { image, changes: true, max_density: 1.0, lattice: Self::LATTICE }
    }

    /// A texture that holds a grid, at full precision: see [`still`](Self::still).
    pub fn image_of(grid: &DensityGrid) -> Image {
        let dims = grid.shape.dims;
        Image::new(
            Extent3d { width: dims.x, height: dims.y, depth_or_array_layers: dims.z },
            TextureDimension::D3,
            bytemuck::cast_slice(&grid.values).to_vec(),
            TextureFormat::R32Float,
            RenderAssetUsages::RENDER_WORLD,
        )
    }

    /// The same of one that changes only as an asset.
    pub fn still(self) -> Self {
        Self { changes: false, ..self }
    }

    /// Values inside their range; what is not a number becomes the default's value.
    pub(crate) fn clamped(&self) -> Self {
        let usable = self.max_density.is_finite() && self.max_density > 0.0;
        Self {
            max_density: if usable { self.max_density } else { 1.0 },
            lattice: self.lattice.clamp(4, 16),
            ..self.clone()
        }
    }
}

/// Keeps every volume's bounds, and warns of transforms that smoke cannot follow.
pub(crate) struct SmokeVolumePlugin;

impl Plugin for SmokeVolumePlugin {
    fn build(&self, app: &mut App) {
        // Apps without pictures, such as those that only process assets, have no images.
        if !app.world().contains_resource::<Assets<Image>>() {
            app.init_asset::<Image>();
        }
        app.add_systems(
            PostUpdate,
            (
                update_bounds.before(VisibilitySystems::CheckVisibility),
                warn_of_non_uniform_scale.after(TransformSystems::Propagate),
            ),
        );
    }
}

/// Bounds of the box in local units, for culling; set when the density has loaded or changed.
fn update_bounds(
    mut commands: Commands,
    animations: Res<Assets<SmokeAnimation>>,
    images: Res<Assets<Image>>,
    mut animation_events: MessageReader<AssetEvent<SmokeAnimation>>,
    mut image_events: MessageReader<AssetEvent<Image>>,
    volumes: Query<(Entity, Ref<SmokeVolume>, Option<&Aabb>)>,
) {
    let touched_animations: Vec<_> = animation_events.read().filter_map(touched).collect();
    let touched_images: Vec<_> = image_events.read().filter_map(touched).collect();
    for (entity, volume, bounds) in &volumes {
        let is_touched = match &volume.density {
            SmokeDensity::Animation(animation) => touched_animations.contains(&animation.id()),
            SmokeDensity::Live(live) => touched_images.contains(&live.image.id()),
        };
        if !(volume.is_changed() || bounds.is_none() || is_touched) {
            continue;
        }
        let shape = match &volume.density {
            SmokeDensity::Animation(animation) => animations.get(animation).map(|animation| animation.shape),
            SmokeDensity::Live(live) => images.get(&live.image).map(|image| shape_of(image.texture_descriptor.size)),
        };
        if let Some(shape) = shape {
            let half_extents = shape.half_extent().into();
            commands.entity(entity).try_insert(Aabb { center: Vec3::ZERO.into(), half_extents });
        }
    }
}

fn touched<A: Asset>(event: &AssetEvent<A>) -> Option<AssetId<A>> {
    match event {
        AssetEvent::Added { id } | AssetEvent::Modified { id } => Some(*id),
        _ => None,
    }
}

/// The cells of a 3D texture.
pub(crate) fn shape_of(size: Extent3d) -> GridShape {
    GridShape::new(UVec3::new(size.width, size.height, size.depth_or_array_layers).max(UVec3::ONE))
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
