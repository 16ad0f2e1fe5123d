//! Smoke and lights that have been set up, as a file that games load.
//!
//! The file is one of Bevy's own, a [`DynamicWorld`] in RON, with the extension `.scn.ron`: every volume with its medium,
//! environment, scattering, constellation, quality, playback and place, and every light of Bevy's with its place: those in the
//! world, whatever they were children of. A game with this crate's
//! [`SmokePlugin`](crate::SmokePlugin), Bevy's feature `bevy_world_serialization` and its `WorldSerializationPlugin` (one of
//! `DefaultPlugins`) loads it as any asset, without the feature `egui`:
//!
//! ```no_run
//! use bevy::prelude::*;
//!
//! fn spawn_smoke(mut commands: Commands, assets: Res<AssetServer>) {
//!     commands.spawn(DynamicWorldRoot(assets.load("smoke.scn.ron")));
//! }
//! ```
//!
//! Bundles and images are named by the path they were loaded from. What was made in memory has none, and cannot be saved.
//! Cameras, their environment maps and meshes stay the game's own.

use std::path::{Path, PathBuf};

use bevy::light::{CascadeShadowConfig, NotShadowCaster};
use bevy::prelude::*;

use super::SmokePanel;
use crate::constellation::SmokeConstellation;
use crate::lighting::SmokeEnvironment;
use crate::medium::SmokeMedium;
use crate::playback::SmokePlayback;
use crate::quality::SmokeQuality;
use crate::scattering::SmokeScattering;
use crate::volume::{SmokeDensity, SmokeVolume};

/// Why a scene cannot be saved.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// A component cannot be written.
    #[error("the scene cannot be written: {0}")]
    Serialize(String),
    /// A volume's bundle, or its image, was made in memory.
    #[error("smoke volume {0} shows what was made in memory: save that as a file first, and load it from there")]
    InMemory(Entity),
    /// Bevy would not load the file.
    #[error("{0}: the name of a scene ends in .scn.ron")]
    Name(PathBuf),
    /// The file cannot be written.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
}

/// The volumes and lights of a world, as the text of a `.scn.ron` file.
///
/// # Errors
///
/// [`SceneError::InMemory`] where a volume shows an asset that has no path, [`SceneError::Serialize`] where something cannot
/// be written.
pub fn scene_text(world: &World) -> Result<String, SceneError> {
    let mut saved: Vec<Entity> = Vec::new();
    for entity in world.iter_entities() {
        if let Some(volume) = entity.get::<SmokeVolume>() {
            let image = match entity.get::<SmokeEnvironment>() {
                Some(SmokeEnvironment::Equirect { image, .. }) => image.path().is_some(),
                _ => true,
            };
            let density = match &volume.density {
                SmokeDensity::Animation(animation) => animation.path().is_some(),
                SmokeDensity::Live(live) => live.image.path().is_some(),
            };
            if !(density && image) {
                return Err(SceneError::InMemory(entity.id()));
            }
        }
        let light =
            entity.contains::<DirectionalLight>() || entity.contains::<PointLight>() || entity.contains::<SpotLight>();
        if entity.contains::<SmokeVolume>() || light {
            saved.push(entity.id());
        }
    }
    // The same scene is the same file.
    saved.sort();
    let registry = world.resource::<AppTypeRegistry>().read();
    let mut scene = DynamicWorldBuilder::from_world(world, &registry)
        .deny_all()
        .allow_component::<SmokeVolume>()
        .allow_component::<SmokeMedium>()
        .allow_component::<SmokeEnvironment>()
        .allow_component::<SmokeScattering>()
        .allow_component::<SmokeConstellation>()
        .allow_component::<SmokeQuality>()
        .allow_component::<SmokePlayback>()
        .allow_component::<NotShadowCaster>()
        .allow_component::<Visibility>()
        .allow_component::<CascadeShadowConfig>()
        .allow_component::<DirectionalLight>()
        .allow_component::<PointLight>()
        .allow_component::<SpotLight>()
        .allow_component::<Transform>()
        .allow_component::<Name>()
        .extract_entities(saved.into_iter())
        .build();
    // Nobody is a child in the file.
    for saved in &mut scene.entities {
        let Some(at) = world.get::<ChildOf>(saved.entity).and(world.get::<GlobalTransform>(saved.entity)) else {
            continue;
        };
        for component in saved.components.iter_mut().filter(|component| component.represents::<Transform>()) {
            *component = Box::new(at.compute_transform());
        }
    }
    scene.serialize(&registry).map_err(|error| SceneError::Serialize(error.to_string()))
}

/// Writes [`scene_text`] to a file; what was there before is kept until all is written.
///
/// # Errors
///
/// Those of [`scene_text`], [`SceneError::Name`], and a file that cannot be written.
pub fn save_scene(world: &World, path: &Path) -> Result<(), SceneError> {
    if !path.to_string_lossy().ends_with(".scn.ron") {
        return Err(SceneError::Name(path.into()));
    }
    let text = scene_text(world)?;
    let io = |source| SceneError::Io { path: path.into(), source };
    let mut partial = path.as_os_str().to_owned();
    partial.push(".part");
    std::fs::write(&partial, text).map_err(io)?;
    std::fs::rename(&partial, path).map_err(io)
}

/// What the panel's button does.
pub(super) fn save_from_panel(world: &mut World) {
    let path = PathBuf::from(&world.resource::<SmokePanel>().scene);
    let notice = match save_scene(world, &path) {
        Ok(()) => format!("Saved {}.", path.display()),
        Err(error) => format!("Not saved: {error}"),
    };
    world.resource_mut::<SmokePanel>().notice = Some(notice);
}
