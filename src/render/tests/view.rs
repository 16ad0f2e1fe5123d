use bevy::camera::{Exposure, Hdr};
use bevy::core_pipeline::tonemapping::{DebandDither, Tonemapping};
use bevy::math::{DVec4, Mat4};
use bevy::prelude::*;

use super::*;
use crate::bundle::SmokeAnimation;
use crate::density::Placement;
use crate::prelude::*;
use crate::reference::Ray;
use crate::reference::lamp::{Cone, softening};
use crate::reference::view::{Footprint, Glow, march_with_glows};
use crate::reference::volume::Volume;
use crate::render::prepare::SmokeCache;

const SIZE: UVec2 = UVec2::new(24, 18);

/// A lamp in the smoke.
#[derive(Clone, Copy)]
struct Lit {
    light: SpotLight,
    at: Transform,
}

impl Lit {
    /// The spot light as it is, or the point light that it is the half of.
    fn spawn(&self, world: &mut World) {
        let SpotLight { color, intensity, range, .. } = self.light;
        match self.is_point() {
            true => world.spawn((PointLight { color, intensity, range, ..default() }, self.at)),
            false => world.spawn((self.light, self.at)),
        };
    }

    fn is_point(&self) -> bool {
        self.light.outer_angle >= std::f32::consts::PI
    }

    /// The glow in the box of a volume, and what the lamp sends there at most, in units of an illuminance.
    fn glow(&self, volume: Transform, medium: &SmokeMedium, shape: GridShape) -> (Glow, f64) {
        let bundle_from_world = volume.to_matrix().inverse();
        let scale = f64::from(volume.scale.x);
        let position = bundle_from_world.transform_point3(self.at.translation).as_dvec3();
        let color = LinearRgba::from(self.light.color);
        let intensity = f64::from(self.light.intensity) / (4.0 * std::f64::consts::PI * scale * scale);
        let intensity = DVec3::new(color.red.into(), color.green.into(), color.blue.into()) * intensity;
        let (inner, outer) = (f64::from(self.light.inner_angle).cos(), f64::from(self.light.outer_angle).cos());
        let axis = bundle_from_world.transform_vector3(self.at.forward().into()).normalize().as_dvec3();
        let cone = match self.is_point() {
            true => Cone::EVERYWHERE,
            false => Cone { axis, scale: 1.0 / (inner - outer), offset: -outer / (inner - outer) },
        };
        let color = twin_medium(medium, 1.0).albedo * intensity;
        let strength = intensity.max_element() / position.length_squared().max(0.25);
        (Glow { position, color, cone, softening: softening(shape), g: medium.g.into() }, strength)
    }
}

/// The picture of the fixture under a projection, and what the twin makes of the very texture that the pass read.
fn picture(
    projection: Projection,
    camera: Transform,
    volume: Transform,
    lit: Option<Lit>,
) -> (Vec<[f32; 4]>, Vec<[f64; 4]>) {
    let mut headless = Headless::new(SIZE, TextureFormat::Rgba16Float).unwrap();
    let frame = fixture();
    let shape = frame.residual.shape();
    let animation = SmokeAnimation {
        shape,
        placement: Placement { center: DVec3::ZERO, voxel_size: 1.0 },
        frames_per_second: 30.0,
        max_density: MAX_DENSITY,
        frames: vec![frame].into(),
    };
    let medium = SmokeMedium { sigma_t: 3.0, g: if lit.is_some() { 0.6 } else { 0.0 }, ..default() };
    let glow = lit.map(|lit| lit.glow(volume, &medium, shape));
    let target = headless.target();
    let world = headless.app.world_mut();
    let animation = world.resource_mut::<Assets<SmokeAnimation>>().add(animation);
    world.spawn((
        SmokeVolume::new(animation),
        medium,
        SmokeEnvironment::constant(Vec3::new(2.0, 1.0, 0.5), 1.0),
        volume,
    ));
    if let Some(lit) = lit {
        lit.spawn(world);
    }
    world.spawn((
        Camera3d::default(),
        Camera { clear_color: ClearColorConfig::Custom(Color::NONE), ..default() },
        (target, Hdr, Msaa::Off, Tonemapping::None, DebandDither::Disabled),
        Exposure { ev100: -(1.2_f32.log2()) },
        projection.clone(),
        camera,
    ));
    headless.settle().unwrap();

    let found = headless.float_pixels();
    let gpu = Gpu { headless };
    let texture = gpu.world().resource::<SmokeCache>().only_texture();
    let texels = gpu.read_texels(texture);
    // What is stored is relative to the strongest light: a lamp, or the environment's largest coefficient, red's, 2 times
    // 2 sqrt(pi).
    let unit = glow.map_or(0.0, |(_, strength)| strength).max(2.0 * (4.0 * std::f64::consts::PI).sqrt());
    let glows: Vec<Glow> = glow.iter().map(|&(glow, _)| glow).collect();
    let texels = texels.as_chunks::<4>().0;
    let input = Volume {
        shape,
        radiance: texels.iter().map(|t| unit * Vec3::new(t[0], t[1], t[2]).as_dvec3()).collect(),
        density: texels.iter().map(|t| f64::from(t[3] * MAX_DENSITY)).collect(),
    };

    let mut projection = projection;
    projection.update(SIZE.x as f32, SIZE.y as f32);
    let orthographic = matches!(projection, Projection::Orthographic(_));
    let bundle_from_clip = (volume.to_matrix().inverse() * camera.to_matrix()).as_dmat4()
        * Mat4::inverse(&projection.get_clip_from_view()).as_dmat4();
    let eye = (volume.to_matrix().inverse() * camera.translation.extend(1.0)).truncate().as_dvec3();
    // The ray through a point of the picture, in pixels.
    let ray = |x: f64, y: f64| {
        let ndc = |at: f64, size: u32| 2.0 * at / f64::from(size) - 1.0;
        let point = |depth: f64| {
            let p = bundle_from_clip * DVec4::new(ndc(x, SIZE.x), -ndc(y, SIZE.y), depth, 1.0);
            p.truncate() / p.w
        };
        // Two points on the ray, at depths between the near and the far plane.
        let (near, far) = (point(1.0), point(0.5));
        Ray::new(if orthographic { near } else { eye }, (far - near).normalize())
    };
    let sigma = f64::from(medium.sigma_t * volume.scale.x);
    let expected = (0..SIZE.y).flat_map(|y| (0..SIZE.x).map(move |x| (x, y))).map(|(x, y)| {
        let (x, y) = (f64::from(x) + 0.5, f64::from(y) + 0.5);
        let (here, right, below) = (ray(x, y), ray(x + 1.0, y), ray(x, y + 1.0));
        let far = |of: fn(&Ray) -> DVec3| (of(&right) - of(&here)).length().hypot((of(&below) - of(&here)).length());
        let footprint = Footprint { width: far(|ray| ray.origin), spread: far(|ray| ray.dir) };
        let (radiance, transmittance) = march_with_glows(&input, &here, sigma, &glows, footprint);
        [radiance.x, radiance.y, radiance.z, 1.0 - transmittance]
    });
    (found, expected.collect())
}

fn check(what: &str, projection: Projection, camera: Transform, volume: Transform, lit: Option<Lit>) {
    let (found, expected) = picture(projection, camera, volume, lit);
    let covered = expected.iter().filter(|pixel| pixel[3] > 0.02).count();
    assert!(covered > SIZE.element_product() as usize / 10, "{what}: only {covered} pixels show smoke");
    let flat_found = found.iter().flatten().map(|&v| f64::from(v));
    // The picture is f16; a ray along a face of the box may take one step more or less than the twin's.
    assert_close(what, HALF, flat_found, expected.into_iter().flatten());
}

fn perspective() -> Projection {
    Projection::Perspective(PerspectiveProjection { fov: 0.7, near: 1e-3, ..default() })
}

fn placed() -> Transform {
    Transform::from_xyz(0.3, -0.2, 0.1).with_rotation(Quat::from_rotation_y(0.6)).with_scale(Vec3::splat(2.5))
}

#[test]
fn view_matches_its_twin_from_outside() {
    let camera = Transform::from_xyz(2.0, 1.5, 4.0).looking_at(Vec3::ZERO, Vec3::Y);
    check("view, outside", perspective(), camera, placed(), None);
}

#[test]
fn view_matches_its_twin_from_inside() {
    let camera = Transform::from_xyz(0.4, -0.1, 0.2).looking_at(Vec3::new(-1.0, 0.5, -2.0), Vec3::Y);
    check("view, inside", perspective(), camera, placed(), None);
}

#[test]
fn view_matches_its_twin_under_parallel_rays() {
    let mut projection = OrthographicProjection::default_3d();
    projection.scaling_mode = bevy::camera::ScalingMode::FixedVertical { viewport_height: 3.0 };
    let camera = Transform::from_xyz(2.0, 1.5, 4.0).looking_at(Vec3::ZERO, Vec3::Y);
    check("view, orthographic", Projection::Orthographic(projection), camera, placed(), None);
}

/// A lamp where a pixel looks, and one that shines aside; the camera is rolled.
fn lamps_in_the_smoke() -> [Lit; 2] {
    let light = SpotLight {
        color: Color::linear_rgb(1.0, 0.7, 0.3),
        intensity: 30.0,
        range: 20.0,
        inner_angle: 0.3,
        outer_angle: 0.9,
        ..default()
    };
    let point = SpotLight { outer_angle: std::f32::consts::PI, ..light };
    let at = Transform::from_xyz(0.25, 0.12, 0.2);
    [Lit { light: point, at }, Lit { light, at: at.looking_to(Vec3::new(0.4, 1.0, 0.2), Vec3::X) }]
}

#[test]
fn glows_match_their_twin() {
    let [point, spot] = lamps_in_the_smoke();
    let camera = Transform::from_xyz(2.0, 1.5, 4.0).looking_at(point.at.translation, Vec3::new(1.0, 1.0, 0.0));
    check("glow of a point light", perspective(), camera, placed(), Some(point));
    check("glow of a spot light", perspective(), camera, placed(), Some(spot));
    let inside = Transform::from_xyz(0.4, -0.1, 0.4).looking_at(point.at.translation, Vec3::Y);
    check("glow, from inside", perspective(), inside, placed(), Some(point));
}

#[test]
fn glows_match_their_twin_under_parallel_rays() {
    let mut projection = OrthographicProjection::default_3d();
    projection.scaling_mode = bevy::camera::ScalingMode::FixedVertical { viewport_height: 3.0 };
    let [point, _] = lamps_in_the_smoke();
    // Half a pixel aside: the lamp is in the middle of one.
    let mut camera = Transform::from_xyz(2.0, 1.5, 4.0).looking_at(point.at.translation, Vec3::Y);
    camera.translation += (camera.right() * 0.5 + camera.up() * 0.5) * (3.0 / SIZE.y as f32);
    check("glow, orthographic", Projection::Orthographic(projection), camera, placed(), Some(point));
}
