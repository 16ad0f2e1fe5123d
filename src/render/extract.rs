//! What the render world takes of smoke from the main world, every frame.

use bevy::asset::AssetId;
use bevy::camera::visibility::RenderLayers;
use bevy::diagnostic::DiagnosticsStore;
use bevy::light::{NotShadowCaster, RectLight};
use bevy::math::Affine3A;
use bevy::mesh::skinning::SkinnedMesh;
use bevy::platform::collections::HashMap;
use bevy::prelude::*;
use bevy::render::Extract;
use bevy::render::render_asset::RenderAssets;
use bevy::render::sync_world::MainEntity;
use bevy::render::texture::GpuImage;

use super::lamp::Lamp;
use super::live::Live;
use super::quality;
use super::view::Emission;
use crate::constellation::SmokeConstellation;
use crate::debug::SmokeDebugView;
use crate::density::GridShape;
use crate::lighting::SmokeEnvironment;
use crate::medium::SmokeMedium;
use crate::occluder::SmokeOccluder;
#[cfg(feature = "reference")]
use crate::paper::SmokePaper;
use crate::playback::{Moment, SmokeMoment};
use crate::quality::{SmokeModel, SmokeQuality};
use crate::scattering::SmokeScattering;
use crate::shadows::SmokeShadows;
use crate::sun::EnvironmentSuns;
use crate::volume::{SmokeDensity, SmokeVolume, shape_of};

/// The smoke in the scene, and what lights it.
#[derive(Resource, Default)]
pub(super) struct ExtractedSmoke {
    pub volumes: HashMap<MainEntity, ExtractedVolume>,
    pub camera_environments: HashMap<MainEntity, CameraEnvironment>,
    pub camera_shadows: HashMap<MainEntity, CameraShadows>,
    pub lamps: Vec<Lamp>,
    /// The spheres of all occluders: centres in the world, and radii.
    pub spheres: Vec<Vec4>,
    /// Whether a camera sees the shadows of spheres on meshes, smoke or no smoke.
    pub meshes_shade_meshes: bool,
    pub suns: EnvironmentSuns,
    /// Milliseconds that the passes have taken of late, where that is measured.
    pub measured: Option<f32>,
}

impl ExtractedSmoke {
    /// Whether there is nothing to do.
    pub fn is_empty(&self) -> bool {
        self.volumes.is_empty() && !self.meshes_shade_meshes
    }
}

/// A volume as the render world sees it.
pub(super) struct ExtractedVolume {
    pub content: Content,
    pub world_from_bundle: Affine3A,
    pub medium: SmokeMedium,
    pub environment: SmokeEnvironment,
    pub scattering: SmokeScattering,
    pub debug: SmokeDebugView,
    pub quality: SmokeQuality,
    pub constellation: Option<SmokeConstellation>,
    #[cfg(feature = "reference")]
    pub paper: Option<SmokePaper>,
    pub layers: RenderLayers,
    /// Whether it shades meshes and other smoke.
    pub casts: bool,
}

/// What a volume shows.
pub(super) enum Content {
    /// A moment of an animation.
    Baked(Moment),
    /// A texture.
    Live(Live),
}

impl Content {
    /// Its cells; None while they are not known.
    pub fn shape(&self, images: &RenderAssets<GpuImage>) -> Option<GridShape> {
        match self {
            Self::Baked(moment) => Some(moment.shape()),
            Self::Live(live) => Some(shape_of(images.get(live.image)?.texture_descriptor.size)),
        }
    }

    /// The density that the renderer's scaled density is 1 at; above 0.
    pub fn density_scale(&self) -> f32 {
        match self {
            Self::Baked(moment) => moment.density_scale(),
            Self::Live(live) => live.max_density,
        }
    }
}

impl ExtractedVolume {
    /// Whether it may be drawn at half resolution.
    pub fn may_draw_half(&self) -> bool {
        !matches!(self.quality, SmokeQuality::Model(SmokeModel { half_resolution: false, .. }))
            && self.emission() == Emission::Exact
    }

    /// What the view pass is to make of its 3D texture.
    pub fn emission(&self) -> Emission {
        if self.constellation.is_some() {
            return Emission::Constellation;
        }
        #[cfg(feature = "reference")]
        if self.paper.is_some() {
            return Emission::Printed;
        }
        Emission::Exact
    }
}

/// The light from all around that a camera sees.
#[derive(Clone, Copy, PartialEq)]
pub(super) struct CameraEnvironment {
    pub map: Option<CameraMap>,
    /// Bevy's ambient light, cd/m².
    pub ambient: Vec3,
}

/// What a camera wants of shadows, and what it sees.
pub(super) struct CameraShadows {
    pub shadows: SmokeShadows,
    pub layers: RenderLayers,
}

/// A camera's environment map.
#[derive(Clone, Copy, PartialEq)]
pub(super) struct CameraMap {
    pub image: AssetId<Image>,
    pub intensity: f32,
    pub rotation: Quat,
}

type LampQuery<'w, 's, L> = Query<
    'w,
    's,
    (Entity, &'static L, &'static GlobalTransform, &'static InheritedVisibility, Option<&'static RenderLayers>),
>;

pub(super) fn extract_smoke(
    mut smoke: ResMut<ExtractedSmoke>,
    volumes: Extract<
        Query<(
            Entity,
            &SmokeVolume,
            &SmokeMoment,
            &SmokeMedium,
            &SmokeEnvironment,
            &SmokeScattering,
            &SmokeQuality,
            &GlobalTransform,
            Option<&RenderLayers>,
            &InheritedVisibility,
            Has<NotShadowCaster>,
            Option<&SmokeDebugView>,
        )>,
    >,
    constellations: Extract<Query<&SmokeConstellation>>,
    #[cfg(feature = "reference")] papers: Extract<Query<&SmokePaper>>,
    cameras: Extract<
        Query<
            (Entity, Option<&EnvironmentMapLight>, Option<&AmbientLight>, Option<&SmokeShadows>, Option<&RenderLayers>),
            With<Camera3d>,
        >,
    >,
    ambient: Extract<Option<Res<GlobalAmbientLight>>>,
    suns: Extract<LampQuery<DirectionalLight>>,
    points: Extract<LampQuery<PointLight>>,
    spots: Extract<LampQuery<SpotLight>>,
    areas: Extract<Query<(), With<RectLight>>>,
    environment_suns: Extract<Res<EnvironmentSuns>>,
    diagnostics: Extract<Option<Res<DiagnosticsStore>>>,
    (occluders, transforms): (
        Extract<Query<(&SmokeOccluder, &GlobalTransform, Option<&SkinnedMesh>, Option<&InheritedVisibility>)>>,
        Extract<Query<&GlobalTransform>>,
    ),
) {
    smoke.volumes.clear();
    smoke.measured = diagnostics.as_ref().and_then(|diagnostics| quality::measured(diagnostics));
    for (
        entity,
        volume,
        moment,
        medium,
        environment,
        scattering,
        quality,
        transform,
        layers,
        visibility,
        no_caster,
        debug,
    ) in &volumes
    {
        let debug = debug.copied().unwrap_or_default();
        let content = match (&volume.density, &moment.0) {
            (SmokeDensity::Animation(_), Some(moment)) => Content::Baked(moment.clone()),
            // Nothing has come yet.
            (SmokeDensity::Animation(_), None) => continue,
            (SmokeDensity::Live(live), _) => Content::Live(Live::extract(entity, live)),
        };
        let clamped = medium.clamped();
        if clamped != *medium {
            warn_once!("{medium:?} of smoke volume {entity} is out of range: it is drawn as {clamped:?} (said once)");
        }
        let asked_quality = *quality;
        let quality = asked_quality.clamped();
        if quality != asked_quality {
            warn_once!(
                "{asked_quality:?} of smoke volume {entity} is out of range: it is drawn with {quality:?} (said once)"
            );
        }
        let extracted = ExtractedVolume {
            content,
            world_from_bundle: transform.affine(),
            medium: clamped,
            environment: environment.clone(),
            scattering: debug.scattering(*scattering),
            debug,
            quality,
            constellation: constellations.get(entity).ok().filter(|_| debug.is_of_picture()).map(|asked| {
                let drawn = asked.clamped();
                if drawn != *asked {
                    warn_once!("{asked:?} of smoke volume {entity} is out of range: drawn with {drawn:?} (said once)");
                }
                if asked_quality != default() {
                    warn_once!(
                        "smoke volume {entity} has SmokeConstellation, which SmokeQuality is not for (said once)"
                    );
                }
                drawn
            }),
            #[cfg(feature = "reference")]
            paper: papers.get(entity).ok().copied(),
            layers: layers.cloned().unwrap_or_default(),
            casts: visibility.get() && !no_caster,
        };
        smoke.volumes.insert(entity.into(), extracted);
    }
    smoke.camera_environments.clear();
    smoke.camera_shadows.clear();
    smoke.lamps.clear();
    smoke.spheres.clear();
    let shades_meshes =
        |(_, _, _, shadows, _): (_, _, _, Option<&SmokeShadows>, _)| shadows.is_some_and(|s| s.occluders);
    smoke.meshes_shade_meshes = !occluders.is_empty() && cameras.iter().any(shades_meshes);
    if smoke.is_empty() {
        return;
    }
    if environment_suns.is_changed() {
        smoke.suns = environment_suns.clone();
    }
    let global = ambient.as_ref().map_or(Vec3::ZERO, |light| radiance(light.color, light.brightness));
    for (entity, map, ambient, shadows, layers) in &cameras {
        let map = map.map(|light| CameraMap {
            image: light.specular_map.id(),
            intensity: light.intensity,
            rotation: light.rotation,
        });
        let ambient = ambient.map_or(global, |light| radiance(light.color, light.brightness));
        smoke.camera_environments.insert(entity.into(), CameraEnvironment { map, ambient });
        let (shadows, layers) = (shadows.copied().unwrap_or_default(), layers.cloned().unwrap_or_default());
        smoke.camera_shadows.insert(entity.into(), CameraShadows { shadows, layers });
    }
    let seen = |visibility: &InheritedVisibility| visibility.get();
    let suns = suns.iter().filter(|lamp| seen(lamp.3)).map(|(e, l, at, _, layers)| Lamp::sun(e, l, at, layers));
    let points = points.iter().filter(|lamp| seen(lamp.3)).map(|(e, l, at, _, layers)| Lamp::point(e, l, at, layers));
    let spots = spots.iter().filter(|lamp| seen(lamp.3)).map(|(e, l, at, _, layers)| Lamp::spot(e, l, at, layers));
    smoke.lamps.extend(suns.chain(points).chain(spots));
    for (occluder, at, skin, visibility) in &occluders {
        if visibility.is_none_or(|visibility| visibility.get()) {
            let transform_of = |joint| transforms.get(joint).ok().map(GlobalTransform::affine);
            smoke.spheres.extend(occluder.place(at, skin, transform_of));
        }
    }
    if !areas.is_empty() {
        warn_once!("smoke is not lit by RectLights: put a PointLight or SpotLight beside them (said once)");
    }
}

fn radiance(color: Color, brightness: f32) -> Vec3 {
    let color = color.to_linear();
    Vec3::new(color.red, color.green, color.blue) * brightness
}
