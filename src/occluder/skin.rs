//! Spheres that follow the joints of a skinned mesh.

use glam::{Mat4, Vec3};

use super::OccluderSphere;
use super::fit::{FitFailure, SphereFit, fit_parts};
use super::solid::TriangleMesh;

/// How a mesh follows joints.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Skin {
    /// Four joints for every vertex.
    pub joints: Vec<[u16; 4]>,
    /// How much the vertex follows each of them.
    pub weights: Vec<[f32; 4]>,
    /// For every joint, from the mesh's space in its bind pose to the joint's.
    pub inverse_bindposes: Vec<Mat4>,
}

/// Places on the surface that get a joint, along the longest side of the mesh's box, at least.
const PLACES: f32 = 96.0;

/// Fits at most so many spheres to the inside of a skinned mesh in its bind pose, as
/// [`fit_solid`](super::fit_solid) does. The inside belongs to the joint that the surface nearest to it follows most, a sphere
/// stands for that of one joint only and follows it; centres and radii are in the joints' spaces. Joints share the spheres
/// by what these bring.
///
/// # Errors
///
/// Those of `fit_solid`, and [`FitFailure::BadSkin`].
pub fn fit_skinned(mesh: &TriangleMesh, skin: &Skin, spheres: usize) -> Result<SphereFit, FitFailure> {
    let joints = skin.inverse_bindposes.len();
    let is_good = skin.joints.len() == mesh.positions.len()
        && skin.weights.len() == mesh.positions.len()
        && skin.weights.as_flattened().iter().all(|weight| weight.is_finite())
        && skin.joints.as_flattened().iter().all(|joint| usize::from(*joint) < joints)
        && skin.inverse_bindposes.iter().all(|pose| pose.is_finite());
    if !is_good {
        return Err(FitFailure::BadSkin);
    }
    let (balls, error) = fit_parts(mesh, |mesh| places(mesh, skin), spheres)?;
    let spheres = balls.iter().map(|ball| {
        let joint_from_mesh = skin.inverse_bindposes[usize::from(ball.part)];
        OccluderSphere {
            center: joint_from_mesh.transform_point3(ball.center),
            radius: ball.radius * joint_from_mesh.determinant().abs().cbrt(),
            joint: Some(ball.part),
        }
    });
    Ok(SphereFit { spheres: spheres.collect(), error })
}

/// Places all over the surface, and the joint that each follows most.
fn places(mesh: &TriangleMesh, skin: &Skin) -> Vec<(Vec3, u16)> {
    let [low, high] = mesh.bounds();
    let spacing = (high - low).max_element() / PLACES;
    let mut places = Vec::new();
    for (triangle, [a, b, c]) in mesh.triangles.iter().zip(mesh.corners()) {
        let longest = a.distance(b).max(b.distance(c)).max(c.distance(a));
        let steps = (longest / spacing).ceil().clamp(1.0, 2.0 * PLACES) as u32;
        // The middles of small triangles that it is cut into, those that point the same way.
        for i in 0..steps {
            for j in 0..steps - i {
                let [second, third] = [i, j].map(|step| (step as f32 + 1.0 / 3.0) / steps as f32);
                let shares = [1.0 - second - third, second, third];
                let place = shares[0] * a + shares[1] * b + shares[2] * c;
                places.push((place, dominant(triangle, shares, skin)));
            }
        }
    }
    places
}

/// The joint that a place on a triangle follows most.
fn dominant(triangle: &[u32; 3], shares: [f32; 3], skin: &Skin) -> u16 {
    let mut sums: [(u16, f32); 12] = [(u16::MAX, 0.0); 12];
    for (vertex, share) in triangle.iter().zip(shares) {
        let vertex = *vertex as usize;
        for (joint, weight) in skin.joints[vertex].iter().zip(skin.weights[vertex]) {
            // Three vertices have twelve joints at most.
            if let Some(sum) = sums.iter_mut().find(|sum| sum.0 == *joint || sum.0 == u16::MAX) {
                *sum = (*joint, sum.1 + share * weight);
            }
        }
    }
    sums.iter().max_by(|a, b| a.1.total_cmp(&b.1)).map_or(0, |sum| sum.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::occluder::shapes;
    use glam::{Affine3A, Quat, vec3};

    /// An arm of two joints along X, 2 long and 0.4 thick, that bends at the origin.
    fn arm() -> (TriangleMesh, Skin) {
        let mesh = shapes::box_grid(vec3(2.0, 0.4, 0.4), [16, 2, 2]);
        let weight = |position: &Vec3| (2.0 * position.x + 0.5).clamp(0.0, 1.0);
        let weights = mesh.positions.iter().map(|p| [1.0 - weight(p), weight(p), 0.0, 0.0]).collect();
        let inverse_bindposes = vec![Mat4::from_translation(Vec3::X), Mat4::from_scale(Vec3::splat(2.0))];
        let joints = vec![[0, 1, 0, 0]; mesh.positions.len()];
        (mesh, Skin { joints, weights, inverse_bindposes })
    }

    #[test]
    fn spheres_are_in_the_spaces_of_the_joints_they_lie_at() {
        let (mesh, skin) = arm();
        let fit = fit_skinned(&mesh, &skin, 16).unwrap();
        assert!(fit.error.difference < 0.35, "{:?}", fit.error);
        let mut count = [0; 2];
        for sphere in &fit.spheres {
            let joint = usize::from(sphere.joint.unwrap());
            count[joint] += 1;
            let mesh_from_joint = skin.inverse_bindposes[joint].inverse();
            let center = mesh_from_joint.transform_point3(sphere.center);
            assert!(if joint == 0 { center.x < 0.05 } else { center.x > -0.05 }, "{center}");
            let radius = sphere.radius * if joint == 0 { 1.0 } else { 0.5 };
            assert!((0.05..0.35).contains(&radius), "{radius}");
        }
        assert!(count.iter().all(|count| *count >= 5), "halves are alike: {count:?}");
    }

    /// The volume that spheres leave out in a bent pose may be larger than in the bind pose, but not by much, as long as
    /// every joint's own inside is covered by its own spheres.
    #[test]
    fn a_bent_arm_stays_covered() {
        let (mesh, skin) = arm();
        let spheres = fit_skinned(&mesh, &skin, 16).unwrap().spheres;
        let bend = Affine3A::from_quat(Quat::from_rotation_z(1.2));
        let joints = [Affine3A::from_translation(Vec3::NEG_X), bend * Affine3A::from_scale(Vec3::splat(0.5))];
        let placed: Vec<_> = spheres
            .iter()
            .map(|sphere| {
                let joint = joints[usize::from(sphere.joint.unwrap())];
                let scale = joint.matrix3.determinant().abs().cbrt();
                (joint.transform_point3(sphere.center), sphere.radius * scale)
            })
            .collect();
        let posed = shapes::posed(&mesh, &skin, &joints);
        let error = crate::occluder::silhouette_error(&posed, &placed).unwrap();
        assert!(error < 0.2, "{error}");
    }

    #[test]
    fn incomplete_skins_are_refused() {
        let (mesh, skin) = arm();
        let refused = |skin: Skin| assert_eq!(fit_skinned(&mesh, &skin, 8), Err(FitFailure::BadSkin));
        refused(Skin::default());
        refused(Skin { inverse_bindposes: skin.inverse_bindposes[..1].to_vec(), ..skin.clone() });
        refused(Skin { joints: skin.joints[1..].to_vec(), ..skin });
    }
}
