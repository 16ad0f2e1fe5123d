//! Bevy's directional, point and spot lights as smoke sees them.

use bevy::camera::visibility::RenderLayers;
use bevy::math::{Affine3A, Vec3A};
use bevy::prelude::*;
use bevy::render::sync_world::MainEntity;

use super::lighting::{LampUniform, MAX_LAMPS};

/// A sun, a point light or a spot light of the scene.
pub(super) struct Lamp {
    entity: MainEntity,
    kind: Kind,
    /// Illuminance (lux) of a sun, luminous intensity (candela) of the others, RGB.
    color: Vec3,
    transform: Affine3A,
    layers: RenderLayers,
}

enum Kind {
    Sun,
    Point { range: f32 },
    Spot { range: f32, inner: f32, outer: f32 },
}

/// Bevy spreads the lumens of point and spot lights alike over the whole sphere.
const SPHERE: f32 = 4.0 * core::f32::consts::PI;

impl Lamp {
    pub fn sun(entity: Entity, light: &DirectionalLight, at: &GlobalTransform, layers: Option<&RenderLayers>) -> Self {
        Self::new(entity, Kind::Sun, light.color, light.illuminance, at, layers)
    }

    pub fn point(entity: Entity, light: &PointLight, at: &GlobalTransform, layers: Option<&RenderLayers>) -> Self {
        Self::new(entity, Kind::Point { range: light.range }, light.color, light.intensity / SPHERE, at, layers)
    }

    pub fn spot(entity: Entity, light: &SpotLight, at: &GlobalTransform, layers: Option<&RenderLayers>) -> Self {
        // As Bevy clamps them.
        let outer = light.outer_angle.clamp(0.0, core::f32::consts::FRAC_PI_2 - 1e-4);
        let kind = Kind::Spot { range: light.range, inner: light.inner_angle.min(outer), outer };
        Self::new(entity, kind, light.color, light.intensity / SPHERE, at, layers)
    }

    fn new(
        entity: Entity,
        kind: Kind,
        color: Color,
        power: f32,
        at: &GlobalTransform,
        layers: Option<&RenderLayers>,
    ) -> Self {
        let color = color.to_linear();
        let color = Vec3::new(color.red, color.green, color.blue) * power;
        let layers = layers.cloned().unwrap_or_default();
        Self { entity: entity.into(), kind, color, transform: at.affine(), layers }
    }

    pub fn is_sun(&self) -> bool {
        matches!(self.kind, Kind::Sun)
    }

    /// The lamp in a box's bundle space, and about how much light it sends there (lux); None where it sends none.
    ///
    /// `scale` is the world length of a bundle unit, `half_extent` the box's.
    fn place(&self, world_from_bundle: &Affine3A, scale: f32, half_extent: Vec3) -> Option<(LampUniform, f32)> {
        let axes = world_from_bundle.matrix3;
        let bundle_from_world = Mat3::from_cols(axes.x_axis.into(), axes.y_axis.into(), axes.z_axis.into()).transpose();
        // Directions turn, but do not stretch, with the box.
        let turn = |v: Vec3A| (bundle_from_world * Vec3::from(v)).normalize_or_zero();
        let toward = turn(self.transform.matrix3.z_axis);
        let mut lamp = LampUniform { axis: -toward, spot_offset: 1.0, ..default() };
        let (range, strength) = match self.kind {
            Kind::Sun => {
                lamp.position = toward;
                lamp.color = self.color;
                lamp.is_sun = 1;
                (f32::INFINITY, self.color.max_element())
            }
            Kind::Point { range } | Kind::Spot { range, .. } => {
                lamp.position = world_from_bundle.inverse().transform_point3a(self.transform.translation).into();
                lamp.color = self.color / (scale * scale);
                let middle = lamp.position.length_squared().max(0.25);
                (range / scale, lamp.color.max_element() / middle)
            }
        };
        if let Kind::Spot { inner, outer, .. } = self.kind {
            lamp.spot_scale = 1.0 / (inner.cos() - outer.cos()).max(1e-4);
            lamp.spot_offset = -outer.cos() * lamp.spot_scale;
        }
        lamp.inverse_range_squared = 1.0 / (range * range).max(1e-12);
        let numbers = [lamp.color, lamp.position, lamp.axis];
        if !(numbers.iter().all(|v| v.is_finite()) && lamp.inverse_range_squared.is_finite()) {
            warn_once!("light {:?} has values that are not finite: it does not light smoke (said once)", self.entity);
            return None;
        }
        let gap = (lamp.position.abs() - half_extent).max(Vec3::ZERO).length();
        let reaches = lamp.is_sun != 0 || gap < range;
        (reaches && strength > 0.0 && (lamp.is_sun == 0 || toward != Vec3::ZERO)).then_some((lamp, strength))
    }
}

/// The lamps that light a box, in units of lux and candela per square bundle unit, and the illuminance of the strongest.
pub(super) fn lamps_of(
    lamps: &[Lamp],
    layers: &RenderLayers,
    world_from_bundle: &Affine3A,
    scale: f32,
    half_extent: Vec3,
) -> (Vec<LampUniform>, f32) {
    let mut found: Vec<_> = lamps
        .iter()
        .filter(|lamp| lamp.layers.intersects(layers))
        .filter_map(|lamp| lamp.place(world_from_bundle, scale, half_extent))
        .collect();
    if found.len() > MAX_LAMPS {
        warn_once!(
            "{} lights reach a smoke volume, which sees {MAX_LAMPS} of them, the strongest: shorten the range of others, \
             or separate them by RenderLayers (said once)",
            found.len()
        );
        found.sort_by(|a, b| b.1.total_cmp(&a.1));
        found.truncate(MAX_LAMPS);
    }
    let strongest = found.iter().map(|(_, strength)| *strength).fold(0.0, f32::max);
    (found.into_iter().map(|(lamp, _)| lamp).collect(), strongest)
}

#[cfg(test)]
mod tests {
    use super::*;

    const HALF: Vec3 = Vec3::splat(0.5);

    fn volume() -> Affine3A {
        Affine3A::from_scale_rotation_translation(
            Vec3::splat(2.0),
            Quat::from_rotation_y(0.5),
            Vec3::new(1.0, 0.0, 0.0),
        )
    }

    fn place(lamp: &Lamp) -> Option<(LampUniform, f32)> {
        lamp.place(&volume(), 2.0, HALF)
    }

    #[test]
    fn point_lights_keep_their_illuminance() {
        let light = PointLight { color: Color::WHITE, intensity: 100.0, range: 9.0, ..default() };
        let at = Transform::from_xyz(1.0, 4.0, 0.0);
        let (lamp, _) = place(&Lamp::point(Entity::PLACEHOLDER, &light, &at.into(), None)).unwrap();
        assert!((lamp.position - Vec3::new(0.0, 2.0, 0.0)).length() < 1e-6);
        // At the box's centre, 4 m or 2 bundle units away: 100/(4π)/16 lux either way.
        let lux = lamp.color.x / lamp.position.length_squared();
        assert!((lux - 100.0 / SPHERE / 16.0).abs() < 1e-5);
        assert!((lamp.inverse_range_squared - 1.0 / 4.5f32.powi(2)).abs() < 1e-6);
    }

    #[test]
    fn suns_and_spots_turn_with_the_volume() {
        let sun = DirectionalLight { illuminance: 7.0, ..default() };
        // Shines along world −X: it stands at +X, which the volume, turned by 0.5, sees at −0.5 about Y.
        let at = Transform::default().looking_to(Vec3::NEG_X, Vec3::Y);
        let (lamp, strength) = place(&Lamp::sun(Entity::PLACEHOLDER, &sun, &at.into(), None)).unwrap();
        assert!((lamp.position - Quat::from_rotation_y(-0.5) * Vec3::X).length() < 1e-6);
        assert_eq!((lamp.is_sun, strength), (1, 7.0));
        let spot = SpotLight { inner_angle: 0.3, outer_angle: 0.6, intensity: 5.0, range: 50.0, ..default() };
        let (lamp, _) = place(&Lamp::spot(Entity::PLACEHOLDER, &spot, &at.into(), None)).unwrap();
        assert!((lamp.axis - Quat::from_rotation_y(-0.5) * Vec3::NEG_X).length() < 1e-6);
        let share = |angle: f32| (angle.cos() * lamp.spot_scale + lamp.spot_offset).clamp(0.0, 1.0);
        assert!(share(0.3) > 0.9999 && share(0.6) < 1e-5 && share(0.45) > 0.3);
    }

    #[test]
    fn lamps_that_do_not_reach_are_left_out() {
        let light = |range, intensity| PointLight { range, intensity, ..default() };
        let at = GlobalTransform::from(Transform::from_xyz(1.0, 4.0, 0.0));
        // 4 m above the centre of a box 2 m high.
        let lamp = |light: PointLight, at: &GlobalTransform| Lamp::point(Entity::PLACEHOLDER, &light, at, None);
        assert!(place(&lamp(light(2.9, 1.0), &at)).is_none() && place(&lamp(light(3.1, 1.0), &at)).is_some());
        assert!(place(&lamp(light(9.0, 0.0), &at)).is_none());
        let nowhere = GlobalTransform::from(Transform::from_xyz(f32::NAN, 0.0, 0.0));
        assert!(place(&lamp(light(9.0, 1.0), &nowhere)).is_none());
        let hidden = Lamp { layers: RenderLayers::layer(1), ..lamp(light(9.0, 1.0), &at) };
        assert!(lamps_of(&[hidden], &RenderLayers::default(), &volume(), 2.0, HALF).0.is_empty());
        let many: Vec<_> = (1..=10).map(|i| lamp(light(9.0, i as f32), &at)).collect();
        let (kept, strongest) = lamps_of(&many, &RenderLayers::default(), &volume(), 2.0, HALF);
        assert_eq!(kept.len(), MAX_LAMPS);
        assert!(kept.iter().all(|lamp| lamp.color.x > 2.9 / SPHERE / 4.0) && strongest > 0.0);
    }
}
