use bevy::camera::{Exposure, Hdr};
use bevy::core_pipeline::tonemapping::{DebandDither, Tonemapping};
use bevy::math::{DVec4, Mat4};
use bevy::prelude::*;

use super::*;
use crate::bundle::SmokeAnimation;
use crate::density::Placement;
use crate::prelude::*;
use crate::reference::Ray;
use crate::reference::view::march;
use crate::reference::volume::Volume;
use crate::render::prepare::SmokeCache;

const SIZE: UVec2 = UVec2::new(24, 18);

/// The picture of the fixture under a projection, and what the twin makes of the very texture that the pass read.
fn picture(projection: Projection, camera: Transform, volume: Transform) -> (Vec<[f32; 4]>, Vec<[f64; 4]>) {
    let mut headless = Headless::new(SIZE, TextureFormat::Rgba16Float).unwrap();
    let frame = fixture();
    let shape = frame.residual.shape();
    let animation = SmokeAnimation {
        shape,
        placement: Placement { center: DVec3::ZERO, voxel_size: 1.0 },
        frames_per_second: 30.0,
        max_density: MAX_DENSITY,
        frames: vec![std::sync::Arc::new(frame)],
    };
    let sigma_t = 3.0;
    let target = headless.target();
    let world = headless.app.world_mut();
    let animation = world.resource_mut::<Assets<SmokeAnimation>>().add(animation);
    world.spawn((
        SmokeVolume::new(animation),
        SmokeMedium { sigma_t, ..default() },
        SmokeEnvironment::constant(Vec3::new(2.0, 1.0, 0.5), 1.0),
        volume,
    ));
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
    // What is stored is relative to the environment's largest coefficient: red's, 2 times 2 sqrt(pi).
    let unit = 2.0 * (4.0 * std::f64::consts::PI).sqrt();
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
    let expected = (0..SIZE.y).flat_map(|y| (0..SIZE.x).map(move |x| (x, y))).map(|(x, y)| {
        let ndc = |at: u32, size: u32| 2.0 * (f64::from(at) + 0.5) / f64::from(size) - 1.0;
        let point = |depth: f64| {
            let p = bundle_from_clip * DVec4::new(ndc(x, SIZE.x), -ndc(y, SIZE.y), depth, 1.0);
            p.truncate() / p.w
        };
        // Two points on the ray, at depths between the near and the far plane.
        let (near, far) = (point(1.0), point(0.5));
        let ray = Ray::new(if orthographic { near } else { eye }, (far - near).normalize());
        let sigma = f64::from(sigma_t * volume.scale.x);
        let (radiance, transmittance) = march(&input, &ray, sigma);
        [radiance.x, radiance.y, radiance.z, 1.0 - transmittance]
    });
    (found, expected.collect())
}

fn check(what: &str, projection: Projection, camera: Transform, volume: Transform) {
    let (found, expected) = picture(projection, camera, volume);
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
    check("view, outside", perspective(), camera, placed());
}

#[test]
fn view_matches_its_twin_from_inside() {
    let camera = Transform::from_xyz(0.4, -0.1, 0.2).looking_at(Vec3::new(-1.0, 0.5, -2.0), Vec3::Y);
    check("view, inside", perspective(), camera, placed());
}

#[test]
fn view_matches_its_twin_under_parallel_rays() {
    let mut projection = OrthographicProjection::default_3d();
    projection.scaling_mode = bevy::camera::ScalingMode::FixedVertical { viewport_height: 3.0 };
    let camera = Transform::from_xyz(2.0, 1.5, 4.0).looking_at(Vec3::ZERO, Vec3::Y);
    check("view, orthographic", Projection::Orthographic(projection), camera, placed());
}
