//! What stands between a volume's smoke and its light: other volumes' smoke, and the spheres of occluders; the
//! `Surroundings` of `occluders.wgsl`, in the volume's bundle space, so that a scene that moves as a whole changes nothing.

use bevy::math::Affine3A;
use bevy::prelude::*;
use bevy::render::render_resource::{Buffer, BufferDescriptor, BufferUsages, ShaderType};
use bevy::render::sync_world::MainEntity;

use super::casters::{Caster, CasterUniform, MAX_CASTERS};
use super::lighting::{LampUniform, LightingUniform};
use super::lit::Cached;
use super::prepare::Gpu;

/// The `Surroundings` of `occluders.wgsl`.
#[derive(ShaderType, Clone, Debug, Default, PartialEq)]
pub(super) struct SurroundingsUniform {
    pub caster_count: u32,
    pub sphere_count: u32,
    pub casters: [CasterUniform; MAX_CASTERS],
}

/// Spheres that one volume sees, at most.
const MAX_SPHERES: usize = 1024;

/// A sphere whose radius is a smaller part of its distance hides less than 2 ‰ of a volume's sky.
const SMALL: f32 = 0.05;

/// What is around a volume in a frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Around {
    uniform: SurroundingsUniform,
    spheres: Vec<Vec4>,
    /// Changes with what the casters' slots hold.
    versions: u32,
}

impl Around {
    /// The other casters, and those of the world's spheres that matter to a volume with this light.
    pub fn new(
        entity: MainEntity,
        world_from_bundle: &Affine3A,
        half_extent: Vec3,
        lighting: &LightingUniform,
        casters: &[Caster],
        spheres: &[Vec4],
    ) -> Self {
        let mut around = Self::default();
        for caster in casters.iter().filter(|caster| caster.entity != entity) {
            let uniform = &mut around.uniform;
            uniform.casters[uniform.caster_count as usize] = caster.uniform.seen_from(Mat4::from(*world_from_bundle));
            uniform.caster_count += 1;
            around.versions = around.versions.wrapping_mul(31).wrapping_add(caster.version);
        }
        let bundle_from_world = world_from_bundle.inverse();
        let scale = bundle_from_world.matrix3.determinant().abs().cbrt();
        let lamps = &lighting.lamps[..lighting.lamp_count as usize];
        let mut near: Vec<(f32, Vec4)> = Vec::new();
        for sphere in spheres {
            let sphere = bundle_from_world.transform_point3(sphere.truncate()).extend(sphere.w * scale);
            let size = size(sphere, half_extent);
            if size > SMALL || lamps.iter().any(|lamp| shades(sphere, lamp, half_extent.length())) {
                near.push((size, sphere));
            }
        }
        if near.len() > MAX_SPHERES {
            warn_once!(
                "{} spheres of SmokeOccluders stand around smoke volume {entity:?}, which sees the largest {MAX_SPHERES} of \
                 them (said once)",
                near.len()
            );
            near.sort_by(|a, b| b.0.total_cmp(&a.0));
            near.truncate(MAX_SPHERES);
        }
        around.uniform.sphere_count = near.len() as u32;
        around.spheres = near.into_iter().map(|(_, sphere)| sphere).collect();
        around
    }
}

/// How large a sphere looks from the nearest point of a box: its radius over its distance.
fn size(sphere: Vec4, half_extent: Vec3) -> f32 {
    let gap = (sphere.truncate().abs() - half_extent).max(Vec3::ZERO).length();
    sphere.w / gap.max(sphere.w)
}

/// Whether a sphere may stand between a lamp and anything within a radius of the origin.
fn shades(sphere: Vec4, lamp: &LampUniform, radius: f32) -> bool {
    let (center, reach) = (sphere.truncate(), sphere.w + radius);
    let (toward, distance) = match lamp.is_sun {
        0 => (lamp.position.normalize_or_zero(), lamp.position.length()),
        _ => (lamp.position, f32::INFINITY),
    };
    let along = center.dot(toward).clamp(0.0, distance);
    center.distance(toward * along) < reach
}

/// What is around a volume, on the GPU.
pub(super) struct Surroundings {
    around: Around,
    pub uniform: Cached<SurroundingsUniform>,
    pub spheres: Buffer,
    /// Counts the changes.
    pub version: u32,
}

impl Surroundings {
    /// Nothing as yet.
    pub fn new(gpu: &Gpu) -> Self {
        let around = Around::default();
        let spheres = sphere_buffer(&around.spheres, gpu);
        Self { uniform: Cached::new(around.uniform.clone(), gpu), spheres, around, version: 0 }
    }

    /// Another frame's; the buffer of spheres is another where they had outgrown it.
    pub fn set(&mut self, around: Around, gpu: &Gpu) {
        if self.around == around {
            return;
        }
        self.uniform.set(around.uniform.clone(), gpu);
        if 16 * around.spheres.len() as u64 > self.spheres.size() {
            self.spheres = sphere_buffer(&around.spheres, gpu);
        } else if self.around.spheres != around.spheres {
            gpu.queue.write_buffer(&self.spheres, 0, bytemuck::cast_slice(&around.spheres));
        }
        self.around = around;
        self.version += 1;
    }
}

/// A buffer with these spheres and room for some more.
pub(super) fn sphere_buffer(spheres: &[Vec4], gpu: &Gpu) -> Buffer {
    let buffer = gpu.device.create_buffer(&BufferDescriptor {
        label: Some("smoke_spheres"),
        size: 16 * spheres.len().next_power_of_two().max(16) as u64,
        usage: BufferUsages::STORAGE | BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    gpu.queue.write_buffer(&buffer, 0, bytemuck::cast_slice(spheres));
    buffer
}

#[cfg(test)]
mod tests {
    use super::*;

    const HALF: Vec3 = Vec3::splat(0.5);

    fn around(lighting: &LightingUniform, spheres: &[Vec4]) -> Around {
        let at = Affine3A::from_scale_rotation_translation(Vec3::splat(2.0), Quat::IDENTITY, Vec3::Y);
        Around::new(MainEntity::from(Entity::PLACEHOLDER), &at, HALF, lighting, &[], spheres)
    }

    #[test]
    fn spheres_are_seen_in_bundle_space() {
        let seen = around(&LightingUniform::default(), &[Vec4::new(0.0, 4.0, 0.0, 1.0)]);
        assert_eq!((seen.spheres, seen.uniform.sphere_count), (vec![Vec4::new(0.0, 1.5, 0.0, 0.5)], 1));
    }

    #[test]
    fn small_spheres_count_where_they_hide_a_lamp() {
        let far = Vec4::new(0.0, 101.0, 0.0, 1.0);
        assert_eq!(around(&LightingUniform::default(), &[far]).uniform.sphere_count, 0);
        let mut lighting = LightingUniform { lamp_count: 1, ..default() };
        lighting.lamps[0] = LampUniform { position: Vec3::Y, is_sun: 1, ..default() };
        assert_eq!(around(&lighting, &[far]).uniform.sphere_count, 1);
        // Not behind the volume, nor beyond a lamp.
        assert_eq!(around(&lighting, &[Vec4::new(0.0, -99.0, 0.0, 1.0)]).uniform.sphere_count, 0);
        lighting.lamps[0] = LampUniform { position: 20.0 * Vec3::Y, ..default() };
        assert_eq!(around(&lighting, &[far]).uniform.sphere_count, 0);
    }
}
