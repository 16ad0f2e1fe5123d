//! Spheres for Bevy's meshes.

use bevy::log::debug;
use bevy::math::Mat4;
use bevy::mesh::{Mesh, MeshAccessError, PrimitiveTopology, VertexAttributeValues};
use bevy::reflect::{Reflect, std_traits::ReflectDefault};

use super::fit::{FitFailure, fit_solid};
use super::skin::{Skin, fit_skinned};
use super::solid::TriangleMesh;
use super::terrain::{HeightField, fit_ground};
use super::{OccluderSphere, SmokeOccluder};

/// What a mesh is to be taken for when spheres are fitted to it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Reflect)]
#[reflect(Default, Debug, Clone, PartialEq, Hash)]
pub enum OccluderShape {
    /// The surface of something solid: closed or nearly so, in one piece or several.
    #[default]
    Solid,
    /// Ground, Y up in the mesh's space: what is under the surface is filled.
    Ground,
}

/// Points along the longer side of ground.
const GROUND_POINTS: usize = 128;

/// Fits at most so many spheres to a mesh, and to the joints of its skin if inverse bind poses are given. This is what
/// [`SmokeOccluderFit`](super::SmokeOccluderFit) does, for tools that do it beforehand. Takes some tenths of a second; tells
/// how close the spheres are in the log, at debug level.
///
/// # Errors
///
/// [`FitFailure`], which says what to do.
pub fn fit_mesh(
    mesh: &Mesh,
    inverse_bindposes: Option<&[Mat4]>,
    shape: OccluderShape,
    spheres: usize,
) -> Result<SmokeOccluder, FitFailure> {
    FitJob::new(mesh, inverse_bindposes, shape, spheres)?.run()
}

/// All that a fit needs: what is read of a mesh, and what is wanted.
pub(super) struct FitJob {
    mesh: TriangleMesh,
    skin: Option<Skin>,
    shape: OccluderShape,
    spheres: usize,
}

impl FitJob {
    pub fn new(
        mesh: &Mesh,
        inverse_bindposes: Option<&[Mat4]>,
        shape: OccluderShape,
        spheres: usize,
    ) -> Result<Self, FitFailure> {
        let skin = match inverse_bindposes {
            Some(poses) if shape == OccluderShape::Solid => Some(mesh_skin(mesh, poses)?),
            _ => None,
        };
        Ok(Self { mesh: mesh_triangles(mesh)?, skin, shape, spheres })
    }

    pub fn run(self) -> Result<SmokeOccluder, FitFailure> {
        let triangles = self.mesh.triangles.len();
        let spheres = if self.shape == OccluderShape::Ground {
            let (field, middle) = HeightField::of_mesh(&self.mesh, GROUND_POINTS)?;
            let fit = fit_ground(&field, self.spheres)?;
            debug!(
                "{} spheres for ground of {triangles} triangles: off by {:.3} RMS, at most {:.3} above it",
                fit.spheres.len(),
                fit.height_rms,
                fit.highest
            );
            let moved = |sphere: &OccluderSphere| OccluderSphere { center: sphere.center + middle, ..*sphere };
            fit.spheres.iter().map(moved).collect()
        } else {
            let fit = match &self.skin {
                Some(skin) => fit_skinned(&self.mesh, skin, self.spheres)?,
                None => fit_solid(&self.mesh, self.spheres)?,
            };
            debug!(
                "{} spheres for a mesh of {triangles} triangles: {:.1} % off its volume, {:.1} % off its outlines",
                fit.spheres.len(),
                100.0 * fit.error.difference,
                100.0 * fit.error.silhouette
            );
            fit.spheres
        };
        Ok(SmokeOccluder { spheres })
    }
}

impl From<MeshAccessError> for FitFailure {
    fn from(_: MeshAccessError) -> Self {
        // What is not there is asked for as an option.
        Self::NotInMainWorld
    }
}

/// The triangles of a mesh.
pub(crate) fn mesh_triangles(mesh: &Mesh) -> Result<TriangleMesh, FitFailure> {
    let positions = match mesh.try_attribute_option(Mesh::ATTRIBUTE_POSITION)? {
        Some(VertexAttributeValues::Float32x3(positions)) => positions.iter().copied().map(Into::into).collect(),
        _ => return Err(FitFailure::NoPositions),
    };
    let indices: Vec<u32> = match mesh.try_indices_option()? {
        Some(indices) => indices.iter().map(|index| index as u32).collect(),
        None => (0..Vec::len(&positions) as u32).collect(),
    };
    let triangles: Vec<[u32; 3]> = match mesh.primitive_topology() {
        PrimitiveTopology::TriangleList => indices.as_chunks().0.to_vec(),
        PrimitiveTopology::TriangleStrip => {
            let turned = |(index, corners): (usize, &[u32])| match index % 2 {
                0 => [corners[0], corners[1], corners[2]],
                _ => [corners[1], corners[0], corners[2]],
            };
            indices.windows(3).enumerate().map(turned).collect()
        }
        _ => return Err(FitFailure::NoTriangles),
    };
    if triangles.is_empty() {
        return Err(FitFailure::NoTriangles);
    }
    Ok(TriangleMesh { positions, triangles })
}

/// How a mesh follows joints.
pub(crate) fn mesh_skin(mesh: &Mesh, inverse_bindposes: &[Mat4]) -> Result<Skin, FitFailure> {
    let joints = match mesh.try_attribute_option(Mesh::ATTRIBUTE_JOINT_INDEX)? {
        Some(VertexAttributeValues::Uint16x4(joints)) => joints.clone(),
        _ => return Err(FitFailure::BadSkin),
    };
    let weights = match mesh.try_attribute_option(Mesh::ATTRIBUTE_JOINT_WEIGHT)? {
        Some(VertexAttributeValues::Float32x4(weights)) => weights.clone(),
        _ => return Err(FitFailure::BadSkin),
    };
    Ok(Skin { joints, weights, inverse_bindposes: inverse_bindposes.to_vec() })
}
