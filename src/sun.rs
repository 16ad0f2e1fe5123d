//! The sun in an environment image: too sharp for four bands of spherical harmonics, it is lit as a light of its own.

use bevy::asset::{AssetEvent, AssetId, Assets};
use bevy::image::Image;
use bevy::math::{DVec3, Vec3};
use bevy::platform::collections::HashMap;
use bevy::prelude::*;
use bevy::render::render_resource::{TextureDimension, TextureViewDimension};

use crate::lighting::SmokeEnvironment;
use crate::volume::SmokeVolume;

/// A small, bright part of an environment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Sun {
    /// Unit vector toward it, in the image's own axes.
    pub direction: Vec3,
    /// RGB irradiance on a surface that faces it, in units of the image's values, above what shines around it.
    pub irradiance: Vec3,
}

/// A texel: the direction it is seen in, its radiance and its solid angle.
type Texel = (DVec3, DVec3, f64);

/// What counts as a sun: a peak so many times as bright as the mean,
const PEAK: f64 = 50.0;
/// its texels, within so many degrees of it, that are at least this share as bright,
const RADIUS_DEGREES: f64 = 6.0;
const EDGE: f64 = 0.02;
/// and that give at least this share of all light.
const SHARE: f64 = 0.05;
/// As in `environment.wgsl`: what a damaged file may hold must not count.
const BRIGHTEST: f64 = 1e6;

impl Sun {
    /// The sun among texels that cover the sphere, if there is one.
    fn among(texels: impl Iterator<Item = Texel> + Clone) -> Option<Self> {
        let luminance = |rgb: DVec3| rgb.dot(DVec3::new(0.2126, 0.7152, 0.0722));
        let (mut flux, mut solid_angle, mut peak, mut toward) = (DVec3::ZERO, 0.0, 0.0, DVec3::Y);
        for (direction, radiance, size) in texels.clone() {
            flux += radiance * size;
            solid_angle += size;
            if luminance(radiance) > peak {
                (peak, toward) = (luminance(radiance), direction);
            }
        }
        let mean = flux / solid_angle;
        // Nor where there is no light at all.
        if peak <= PEAK * luminance(mean) {
            return None;
        }
        let (mut irradiance, mut direction) = (DVec3::ZERO, DVec3::ZERO);
        for (texel, radiance, size) in texels {
            if texel.dot(toward) > RADIUS_DEGREES.to_radians().cos() && luminance(radiance) > EDGE * peak {
                let above = (radiance - mean).max(DVec3::ZERO) * size;
                irradiance += above;
                direction += texel * luminance(above);
            }
        }
        let seen = luminance(irradiance) > SHARE * luminance(flux);
        seen.then(|| Self { direction: direction.normalize().as_vec3(), irradiance: irradiance.as_vec3() })
    }

    /// The sun of a latitude-longitude image or a cube map whose values the main world has; None where it does not, where
    /// the format is compressed, or where there is no sun.
    pub fn of_image(image: &Image) -> Option<Self> {
        image.data.as_ref()?;
        let size = image.texture_descriptor.size;
        let sampled_as = image.texture_view_descriptor.as_ref().and_then(|view| view.dimension);
        let is_cube = sampled_as == Some(TextureViewDimension::Cube) && size.depth_or_array_layers == 6;
        let is_flat = size.depth_or_array_layers == 1 && image.texture_descriptor.dimension == TextureDimension::D2;
        let radiance = |x: u32, y: u32, layer: u32| {
            let color = if is_cube { image.get_color_at_3d(x, y, layer) } else { image.get_color_at(x, y) };
            let color = color.ok()?.to_linear();
            let rgb = DVec3::new(color.red.into(), color.green.into(), color.blue.into());
            Some(if rgb.is_finite() { rgb.clamp(DVec3::ZERO, DVec3::splat(BRIGHTEST)) } else { DVec3::ZERO })
        };
        // Formats that cannot be read here are so everywhere.
        radiance(0, 0, 0)?;
        let (width, height) = (size.width, size.height);
        let places = move |layers: u32| {
            (0..layers).flat_map(move |layer| (0..height).flat_map(move |y| (0..width).map(move |x| (x, y, layer))))
        };
        if is_cube {
            Self::among(places(6).filter_map(|(x, y, layer)| {
                let (direction, size) = cube_texel(x, y, layer, width);
                Some((direction, radiance(x, y, layer)?, size))
            }))
        } else if is_flat {
            Self::among(places(1).filter_map(|(x, y, _)| {
                let (direction, size) = equirect_texel(x, y, width, height);
                Some((direction, radiance(x, y, 0)?, size))
            }))
        } else {
            None
        }
    }
}

/// Direction and solid angle of a texel of a latitude-longitude image: see [`SmokeEnvironment::Equirect`].
fn equirect_texel(x: u32, y: u32, width: u32, height: u32) -> (DVec3, f64) {
    use core::f64::consts::PI;
    let (step_phi, step_theta) = (2.0 * PI / f64::from(width), PI / f64::from(height));
    let (phi, theta) = ((f64::from(x) + 0.5) * step_phi, (f64::from(y) + 0.5) * step_theta);
    let direction = DVec3::new(phi.sin() * theta.sin(), theta.cos(), -phi.cos() * theta.sin());
    (direction, step_phi * 2.0 * theta.sin() * (0.5 * step_theta).sin())
}

/// The same of a cube map, which is left-handed: Bevy negates z when it samples one.
fn cube_texel(x: u32, y: u32, face: u32, side: u32) -> (DVec3, f64) {
    let at = |i: u32| 2.0 * (f64::from(i) + 0.5) / f64::from(side) - 1.0;
    let (u, v) = (at(x), at(y));
    let place = match face {
        0 => DVec3::new(1.0, -v, -u),
        1 => DVec3::new(-1.0, -v, u),
        2 => DVec3::new(u, 1.0, v),
        3 => DVec3::new(u, -1.0, -v),
        4 => DVec3::new(u, -v, 1.0),
        _ => DVec3::new(-u, -v, -1.0),
    };
    let solid_angle = 4.0 / f64::from(side).powi(2) * place.length_squared().powf(-1.5);
    (DVec3::new(place.x, place.y, -place.z).normalize(), solid_angle)
}

/// The suns of the images that light smoke.
#[derive(Resource, Clone, Debug, Default)]
pub(crate) struct EnvironmentSuns(pub HashMap<AssetId<Image>, Option<Sun>>);

/// Looks for the sun in every image that lights smoke, when it arrives and when it changes.
pub(crate) fn find_suns(
    mut suns: ResMut<EnvironmentSuns>,
    images: Res<Assets<Image>>,
    mut events: MessageReader<AssetEvent<Image>>,
    volumes: Query<&SmokeEnvironment, With<SmokeVolume>>,
    cameras: Query<&EnvironmentMapLight, With<Camera3d>>,
) {
    for event in events.read() {
        if let AssetEvent::Modified { id } | AssetEvent::Removed { id } = event {
            suns.0.remove(id);
        }
    }
    let mut wanted = Vec::new();
    for environment in &volumes {
        match environment {
            SmokeEnvironment::Camera => wanted.extend(cameras.iter().map(|light| light.specular_map.id())),
            SmokeEnvironment::Equirect { image, .. } => wanted.push(image.id()),
            SmokeEnvironment::Coefficients { .. } => {}
        }
    }
    for id in wanted {
        if !suns.0.contains_key(&id)
            && let Some(image) = images.get(id)
        {
            suns.0.insert(id, Sun::of_image(image));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bevy::asset::RenderAssetUsages;
    use bevy::render::render_resource::{Extent3d, TextureFormat, TextureViewDescriptor};

    fn image(width: u32, height: u32, layers: u32, texel: impl Fn(u32, u32, u32) -> [f32; 3]) -> Image {
        let at = |i: u32| texel(i % width, i / width % height, i / width / height);
        let data = (0..width * height * layers).map(at).flat_map(|[r, g, b]| [r, g, b, 1.0]).flat_map(f32::to_le_bytes);
        let size = Extent3d { width, height, depth_or_array_layers: layers };
        let (format, usage) = (TextureFormat::Rgba32Float, RenderAssetUsages::default());
        let mut image = Image::new(size, TextureDimension::D2, data.collect(), format, usage);
        if layers == 6 {
            let dimension = Some(TextureViewDimension::Cube);
            image.texture_view_descriptor = Some(TextureViewDescriptor { dimension, ..default() });
        }
        image
    }

    #[test]
    fn a_bright_texel_is_a_sun() {
        let sky = [0.5, 0.6, 0.8];
        let sun = |x, y, _| if (x, y) == (20, 5) { [900.0, 800.0, 700.0] } else { sky };
        let found = Sun::of_image(&image(32, 16, 1, sun)).unwrap();
        let (direction, size) = equirect_texel(20, 5, 32, 16);
        assert!((found.direction.as_dvec3() - direction).length() < 1e-6);
        // Less the mean, which the sun itself raises by its share of the sphere.
        assert!((f64::from(found.irradiance.x) / (900.0 * size) - 1.0).abs() < 0.02, "{found:?}");
        // In a cube map: face 4 is -Z in Bevy.
        let sun = |x, y, face| if (x, y, face) == (8, 8, 4) { [900.0, 800.0, 700.0] } else { sky };
        let found = Sun::of_image(&image(16, 16, 6, sun)).unwrap();
        assert!((found.direction - Vec3::NEG_Z).length() < 0.1, "{found:?}");
        // The texels' solid angles cover the sphere, within what the approximation of a cube's is.
        let whole: f64 = (0..6 * 256).map(|i| cube_texel(i % 16, i / 16 % 16, i / 256, 16).1).sum();
        assert!((whole / (4.0 * core::f64::consts::PI) - 1.0).abs() < 3e-3, "{whole}");
    }

    #[test]
    fn soft_light_has_no_sun() {
        assert_eq!(Sun::of_image(&image(32, 16, 1, |_, _, _| [1.0; 3])), None);
        assert_eq!(Sun::of_image(&image(32, 16, 1, |_, _, _| [0.0; 3])), None);
        assert_eq!(Sun::of_image(&image(32, 16, 1, |x, _, _| if x < 8 { [30.0; 3] } else { [0.1; 3] })), None);
        // A spark that gives next to no light.
        let spark = |x, y, _| if (x, y) == (20, 5) { [60.0; 3] } else { [1.0; 3] };
        assert_eq!(Sun::of_image(&image(512, 256, 1, spark)), None);
        // Values that are no numbers are no light.
        assert_eq!(Sun::of_image(&image(32, 16, 1, |x, _, _| [if x == 3 { f32::NAN } else { 1.0 }; 3])), None);
    }
}
