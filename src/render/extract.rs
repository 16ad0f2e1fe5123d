//! What the render world takes of smoke from the main world, every frame.

use bevy::asset::AssetId;
use bevy::math::Affine3A;
use bevy::platform::collections::HashMap;
use bevy::prelude::*;
use bevy::render::Extract;
use bevy::render::sync_world::MainEntity;

use crate::bundle::SmokeAnimation;
use crate::lighting::SmokeEnvironment;
use crate::medium::SmokeMedium;
use crate::volume::SmokeVolume;

/// The smoke in the scene, and the environment maps of its cameras.
#[derive(Resource, Default)]
pub(super) struct ExtractedSmoke {
    pub volumes: HashMap<MainEntity, ExtractedVolume>,
    pub camera_environments: HashMap<MainEntity, CameraEnvironment>,
}

/// A volume as the render world sees it.
pub(super) struct ExtractedVolume {
    pub animation: AssetId<SmokeAnimation>,
    pub frame: u32,
    pub world_from_bundle: Affine3A,
    pub medium: SmokeMedium,
    pub environment: SmokeEnvironment,
}

/// A camera's environment map.
#[derive(Clone)]
pub(super) struct CameraEnvironment {
    pub image: AssetId<Image>,
    pub intensity: f32,
    pub rotation: Quat,
}

pub(super) fn extract_smoke(
    mut smoke: ResMut<ExtractedSmoke>,
    volumes: Extract<Query<(Entity, &SmokeVolume, &SmokeMedium, &SmokeEnvironment, &GlobalTransform)>>,
    cameras: Extract<Query<(Entity, &EnvironmentMapLight), With<Camera3d>>>,
) {
    smoke.volumes.clear();
    for (entity, volume, medium, environment, transform) in &volumes {
        let clamped = medium.clamped();
        if clamped != *medium {
            warn_once!("{medium:?} of smoke volume {entity} is out of range: it is drawn as {clamped:?} (said once)");
        }
        let extracted = ExtractedVolume {
            animation: volume.animation.id(),
            frame: volume.frame,
            world_from_bundle: transform.affine(),
            medium: clamped,
            environment: environment.clone(),
        };
        smoke.volumes.insert(entity.into(), extracted);
    }
    smoke.camera_environments.clear();
    for (entity, light) in &cameras {
        let environment =
            CameraEnvironment { image: light.specular_map.id(), intensity: light.intensity, rotation: light.rotation };
        smoke.camera_environments.insert(entity.into(), environment);
    }
}
