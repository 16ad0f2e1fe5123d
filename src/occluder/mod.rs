//! What stands in smoke's light: sets of spheres in the place of meshes.
//!
//! A sphere's soft shadow has a closed form that a triangle's has not, and a few dozen of them follow a character or a
//! hillside closely enough for the light that reaches smoke, which is smooth (Ren et al. 2006, *Real-Time Soft Shadows in
//! Dynamic Scenes using Spherical Harmonic Exponentiation*).
//!
//! A [`SmokeOccluder`] holds spheres. They come from the game, or are fitted to a mesh: by a [`SmokeOccluderFit`] beside it
//! while the game runs, by [`fit_mesh`] beforehand. [`fit_solid`], [`fit_skinned`] and [`fit_ground`] work on plain triangles
//! and heights and tell how close the spheres are.

mod component;
mod cover;
mod fit;
mod mesh;
#[cfg(any(test, feature = "cli"))]
pub(crate) mod shapes;
mod silhouette;
mod skin;
mod solid;
mod terrain;

pub use component::SmokeOccluderFit;
pub(crate) use component::SmokeOccluderPlugin;
pub use fit::{FitError, FitFailure, SphereFit, fit_solid};
pub use mesh::{OccluderShape, fit_mesh};
#[cfg(feature = "cli")]
pub(crate) use mesh::{mesh_skin, mesh_triangles};
pub use silhouette::silhouette_error;
pub use skin::{Skin, fit_skinned};
pub use solid::TriangleMesh;
pub use terrain::{GroundFit, HeightField, fit_ground};

use bevy::math::Affine3A;
use bevy::mesh::skinning::SkinnedMesh;
use bevy::prelude::*;

/// Spheres that block light on its way to smoke, and, where a camera's [`SmokeShadows`](crate::shadows::SmokeShadows) ask
/// for it, light from all around on its way to meshes.
///
/// On any entity; spheres are in its local space, or in that of the joints of the [`SkinnedMesh`] beside it, and follow
/// either.
#[derive(Component, Clone, Debug, Default, PartialEq, Reflect)]
#[reflect(Component, Default, Debug, Clone, PartialEq)]
pub struct SmokeOccluder {
    /// The spheres; together they should fill what they stand for.
    pub spheres: Vec<OccluderSphere>,
}

/// A sphere of a [`SmokeOccluder`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Reflect)]
#[reflect(Default, Debug, Clone, PartialEq)]
pub struct OccluderSphere {
    /// Its centre, in the entity's or the joint's local space.
    pub center: Vec3,
    /// Its radius in the same space, above 0. Where that is scaled unevenly it grows with the cube root of the volume.
    pub radius: f32,
    /// The joint that it follows, by its place in [`SkinnedMesh::joints`]; None follows the entity.
    pub joint: Option<u16>,
}

impl OccluderSphere {
    /// A sphere that follows its entity.
    pub fn new(center: Vec3, radius: f32) -> Self {
        Self { center, radius, joint: None }
    }
}

impl SmokeOccluder {
    /// Spheres that follow their entity.
    pub fn new(spheres: impl IntoIterator<Item = (Vec3, f32)>) -> Self {
        Self { spheres: spheres.into_iter().map(|(center, radius)| OccluderSphere::new(center, radius)).collect() }
    }

    /// The spheres in the world: centres and, in w, radii. Those are left out whose joint is missing and those that are not
    /// finite or have no size.
    pub fn place<'a>(
        &'a self,
        entity: &'a GlobalTransform,
        skin: Option<&'a SkinnedMesh>,
        transform_of: impl Fn(Entity) -> Option<Affine3A> + 'a,
    ) -> impl Iterator<Item = Vec4> + 'a {
        self.spheres.iter().filter_map(move |sphere| {
            let world_from_local = match sphere.joint {
                None => entity.affine(),
                Some(joint) => transform_of(*skin?.joints.get(usize::from(joint))?)?,
            };
            let scale = world_from_local.matrix3.determinant().abs().cbrt();
            let placed = world_from_local.transform_point3(sphere.center).extend(sphere.radius * scale);
            (placed.is_finite() && placed.w > 0.0).then_some(placed)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spheres_follow_their_entity_or_their_joint() {
        let joint = Affine3A::from_scale_rotation_translation(
            Vec3::splat(0.5),
            Quat::from_rotation_z(core::f32::consts::FRAC_PI_2),
            Vec3::new(0.0, 3.0, 0.0),
        );
        let skin = SkinnedMesh { joints: vec![Entity::PLACEHOLDER], ..default() };
        let sphere = |joint| OccluderSphere { center: Vec3::X, radius: 2.0, joint };
        let occluder = SmokeOccluder { spheres: [None, Some(0), Some(1)].map(sphere).into() };
        let entity = GlobalTransform::from(Transform::from_xyz(0.0, 0.0, 1.0));
        // The third follows a joint that is not there.
        let placed: Vec<_> = occluder.place(&entity, Some(&skin), |_| Some(joint)).collect();
        let expected = [Vec4::new(1.0, 0.0, 1.0, 2.0), Vec4::new(0.0, 3.5, 0.0, 1.0)];
        assert_eq!(placed.len(), 2);
        assert!(placed.iter().zip(expected).all(|(a, b)| a.abs_diff_eq(b, 1e-6)), "{placed:?}");
        // Without a skin only what follows the entity is left.
        assert_eq!(occluder.place(&entity, None, |_| None).count(), 1);
    }
}
