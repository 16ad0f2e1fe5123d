//! Which environment lights which volume, and its coefficients on the GPU.

use bevy::asset::AssetId;
use bevy::platform::collections::HashMap;
use bevy::prelude::*;
use bevy::render::render_asset::RenderAssets;
use bevy::render::render_resource::{
    Buffer, TextureDimension, TextureFormatFeatureFlags, TextureId, TextureSampleType, TextureUsages,
    TextureViewDimension,
};
use bevy::render::sync_world::MainEntity;
use bevy::render::texture::GpuImage;
use bevy::render::view::ExtractedView;

use super::SmokeWork;
use super::environment::{RadianceMap, coefficient_buffer};
use super::extract::{ExtractedSmoke, ExtractedVolume};
use super::prepare::Gpu;
use crate::lighting::{EnvironmentCoefficients, SmokeEnvironment, magnitude};
use crate::sun::{EnvironmentSuns, Sun};

/// What tells one light on a volume from another.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct LightKey {
    environment: EnvironmentKey,
    /// Cameras may see different light from all around: the first of those that see this. None for a volume's own.
    owner: Option<MainEntity>,
}

/// Which coefficients.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
enum EnvironmentKey {
    /// No light at all.
    Black,
    /// A radiance image.
    Image(AssetId<Image>),
    /// The coefficients that a volume carries.
    Coefficients(MainEntity),
}

/// Where a volume's light comes from.
pub(super) struct Light {
    key: LightKey,
    content: Content,
    environment_from_world: Mat3,
    intensity: f32,
    ambient: Vec3,
}

#[derive(Clone, Copy)]
enum Content {
    /// At most 1 in magnitude: what is above is in the intensity.
    Coefficients(EnvironmentCoefficients),
    Image {
        id: AssetId<Image>,
        cube: bool,
    },
}

/// An environment as a volume uses it.
pub(super) struct Lit<'a> {
    pub key: LightKey,
    pub coefficients: &'a Buffer,
    /// The image that they are of, if they are of one.
    pub map: Option<RadianceMap<'a>>,
    /// Counts the changes of the coefficients.
    pub version: u32,
    pub environment_from_world: Mat3,
    /// What the environment's values are to be multiplied by, to give cd/m².
    pub intensity: f32,
    /// Radiance from everywhere on top of it, cd/m².
    pub ambient: Vec3,
    /// The sun that the coefficients contain, in the environment's axes and units.
    pub sun: Option<Sun>,
}

impl Light {
    /// None, with one warning, where it makes no sense.
    pub fn of(
        entity: MainEntity,
        volume: &ExtractedVolume,
        view: &ExtractedView,
        smoke: &ExtractedSmoke,
    ) -> Option<Self> {
        let light = match &volume.environment {
            SmokeEnvironment::Camera => Self::of_camera(entity, view, smoke),
            SmokeEnvironment::Equirect { image, intensity, rotation } => {
                Self::image(image.id(), false, None, *intensity, *rotation)
            }
            SmokeEnvironment::Coefficients { coefficients, intensity } => {
                Some(Self::coefficients(EnvironmentKey::Coefficients(entity), coefficients, *intensity))
            }
        };
        let light = light.filter(Self::is_finite);
        if light.is_none() {
            warn_once!(
                "the environment of smoke volume {entity:?} has coefficients, an intensity or a rotation that are no \
                 usable numbers: the volume is not drawn (said once)"
            );
        }
        light
    }

    fn of_camera(entity: MainEntity, view: &ExtractedView, smoke: &ExtractedSmoke) -> Option<Self> {
        let environment = smoke.camera_environments.get(&view.retained_view_entity.main_entity)?;
        if environment.map.is_none() && environment.ambient == Vec3::ZERO && smoke.lamps.is_empty() {
            warn_once!(
                "smoke volume {entity:?} is lit by what lights the camera's scene, but a camera that sees it has \
                 no EnvironmentMapLight, no ambient light and no lights: the smoke is black there; add one, or \
                 give the volume a SmokeEnvironment (said once)"
            );
        }
        Self::of_view(view, smoke)
    }

    /// What lights the meshes that a view sees from all around.
    pub fn of_view(view: &ExtractedView, smoke: &ExtractedSmoke) -> Option<Self> {
        let environment = smoke.camera_environments.get(&view.retained_view_entity.main_entity)?;
        let same = smoke.camera_environments.iter().filter(|(_, other)| *other == environment);
        let owner = same.map(|(camera, _)| *camera).min();
        let light = match environment.map {
            Some(map) => Self::image(map.image, true, owner, map.intensity, map.rotation)?,
            None => {
                let black = Self::coefficients(EnvironmentKey::Black, &[Vec3::ZERO; 16], 1.0);
                Self { key: LightKey { owner, ..black.key }, ..black }
            }
        };
        Some(Self { ambient: environment.ambient, ..light })
    }

    fn image(
        id: AssetId<Image>,
        cube: bool,
        owner: Option<MainEntity>,
        intensity: f32,
        rotation: Quat,
    ) -> Option<Self> {
        // Not every four numbers are a rotation.
        let length = rotation.length();
        let rotation = (length.is_finite() && length > 1e-6).then(|| rotation / length)?;
        Some(Self {
            key: LightKey { environment: EnvironmentKey::Image(id), owner },
            content: Content::Image { id, cube },
            environment_from_world: Mat3::from_quat(rotation.inverse()),
            intensity,
            ambient: Vec3::ZERO,
        })
    }

    fn coefficients(key: EnvironmentKey, coefficients: &EnvironmentCoefficients, intensity: f32) -> Self {
        // The passes' textures are f16: let them see numbers near 1, whatever the unit.
        let scale = magnitude(coefficients);
        Self {
            key: LightKey { environment: key, owner: None },
            content: Content::Coefficients(coefficients.map(|c| c / scale)),
            environment_from_world: Mat3::IDENTITY,
            intensity: intensity * scale,
            ambient: Vec3::ZERO,
        }
    }

    fn is_finite(&self) -> bool {
        let content = match &self.content {
            Content::Coefficients(coefficients) => coefficients.iter().all(|c| c.is_finite()),
            Content::Image { .. } => true,
        };
        content && self.intensity.is_finite() && self.ambient.is_finite()
    }
}

/// The coefficients of every environment in use.
#[derive(Default)]
pub(super) struct Environments {
    now: u32,
    entries: HashMap<EnvironmentKey, Environment>,
}

struct Environment {
    coefficients: Buffer,
    /// What the coefficients are of; None asks for them anew.
    source: Option<Source>,
    last_used: u32,
    last_changed: u32,
    version: u32,
}

#[derive(Clone, Copy, PartialEq)]
enum Source {
    Coefficients(EnvironmentCoefficients),
    Texture(TextureId),
}

impl Environments {
    /// Starts a frame, in which the content of some images has changed.
    pub fn begin<'a>(&mut self, now: u32, changed: impl Iterator<Item = &'a AssetId<Image>>) {
        self.now = now;
        for id in changed {
            if let Some(environment) = self.entries.get_mut(&EnvironmentKey::Image(*id)) {
                environment.source = None;
            }
        }
    }

    pub fn retain(&mut self, in_use: impl Fn(u32) -> bool) {
        self.entries.retain(|_, environment| in_use(environment.last_used));
    }

    /// Makes sure that the coefficients are on the GPU. None while an image is still on its way, or cannot be used.
    pub fn light<'a>(
        &'a mut self,
        light: Light,
        images: &'a RenderAssets<GpuImage>,
        suns: &EnvironmentSuns,
        gpu: &Gpu,
        work: &mut SmokeWork,
    ) -> Option<Lit<'a>> {
        let sun = match light.content {
            Content::Image { id, .. } => suns.0.get(&id).copied().flatten(),
            Content::Coefficients(_) => None,
        };
        let content = Resolved::new(light.content, images, gpu)?;
        let (source, map) = (content.source(), content.map());
        let environment = self.entries.entry(light.key.environment).or_insert_with(|| Environment {
            coefficients: coefficient_buffer(gpu.device),
            source: None,
            last_used: self.now,
            last_changed: self.now.wrapping_sub(1),
            version: 0,
        });
        environment.last_used = self.now;
        let done = environment.last_changed == self.now;
        if !done && (content.is_live() || environment.source != Some(source)) {
            match content {
                Resolved::Coefficients(coefficients) => {
                    let padded = coefficients.map(|c| c.extend(0.0));
                    gpu.queue.write_buffer(&environment.coefficients, 0, bytemuck::cast_slice(&padded));
                }
                Resolved::Image(_, map) => {
                    let pass = &gpu.passes.environment;
                    work.environment.push(pass.job(map, &environment.coefficients, gpu.device, gpu.cache));
                }
            }
            environment.source = Some(source);
            environment.last_changed = self.now;
            environment.version += 1;
        }
        Some(Lit {
            key: light.key,
            coefficients: &environment.coefficients,
            map,
            version: environment.version,
            environment_from_world: light.environment_from_world,
            intensity: light.intensity,
            ambient: light.ambient,
            sun,
        })
    }
}

/// What a light is made of, at hand.
enum Resolved<'a> {
    Coefficients(EnvironmentCoefficients),
    Image(&'a GpuImage, RadianceMap<'a>),
}

impl<'a> Resolved<'a> {
    fn new(content: Content, images: &'a RenderAssets<GpuImage>, gpu: &Gpu) -> Option<Self> {
        Some(match content {
            Content::Coefficients(coefficients) => Self::Coefficients(coefficients),
            Content::Image { id, cube } => {
                let image = images.get(id)?;
                Self::Image(image, radiance_map(image, cube, gpu)?)
            }
        })
    }

    fn source(&self) -> Source {
        match self {
            Self::Coefficients(coefficients) => Source::Coefficients(*coefficients),
            Self::Image(image, _) => Source::Texture(image.texture.id()),
        }
    }

    fn map(&self) -> Option<RadianceMap<'a>> {
        match self {
            Self::Coefficients(_) => None,
            Self::Image(_, map) => Some(*map),
        }
    }

    /// Whether the GPU itself writes the image, as it does generated environment maps: then its content may change
    /// unseen, and is projected every frame.
    fn is_live(&self) -> bool {
        let written = TextureUsages::STORAGE_BINDING | TextureUsages::RENDER_ATTACHMENT;
        match self {
            Self::Coefficients(_) => false,
            Self::Image(image, _) => !image.had_data || image.texture_descriptor.usage.intersects(written),
        }
    }
}

/// An image as the environment pass reads it; None, with one warning, where its shape or format is wrong.
fn radiance_map<'a>(image: &'a GpuImage, cube: bool, gpu: &Gpu) -> Option<RadianceMap<'a>> {
    let descriptor = &image.texture_descriptor;
    let sampled_as = image.texture_view_descriptor.as_ref().and_then(|view| view.dimension);
    let is_cube = sampled_as == Some(TextureViewDimension::Cube);
    let is_flat = matches!(sampled_as, None | Some(TextureViewDimension::D2))
        && descriptor.dimension == TextureDimension::D2
        && descriptor.size.depth_or_array_layers == 1;
    let features = gpu.device.features();
    let is_float = matches!(descriptor.format.sample_type(None, Some(features)), Some(TextureSampleType::Float { .. }));
    let can_filter =
        descriptor.format.guaranteed_format_features(features).flags.contains(TextureFormatFeatureFlags::FILTERABLE);
    match cube {
        true if is_cube && is_float && can_filter => Some(RadianceMap::Cube(&image.texture_view, &image.sampler)),
        false if is_flat && is_float => Some(RadianceMap::Equirect(&image.texture_view)),
        _ => {
            let wanted =
                if cube { "a cube map that can be filtered" } else { "a 2D latitude-longitude image of floats" };
            let (size, format) = (descriptor.size, descriptor.format);
            warn_once!(
                "smoke needs {wanted} for its environment, but was given {format:?}, {size:?}, seen as \
                 {sampled_as:?}: the volumes it should light are not drawn (said once)"
            );
            None
        }
    }
}
