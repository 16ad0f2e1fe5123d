//! Probes and spheres, as meshes.

use bevy::asset::RenderAssetUsages;
use bevy::camera::visibility::NoFrustumCulling;
use bevy::light::{NotShadowCaster, NotShadowReceiver};
use bevy::mesh::skinning::SkinnedMesh;
use bevy::mesh::{Indices, PrimitiveTopology};
use bevy::prelude::*;

use super::SmokeDebugView;
use crate::medium::SmokeMedium;
use crate::occluder::SmokeOccluder;
use crate::playback::SmokeMoment;
use crate::rbf::Rbf;
use crate::shadows::NoSmokeShadow;

/// The mesh that marks what a volume's view shows; in world space.
#[derive(Component)]
pub(super) struct Markers {
    volume: Entity,
}

/// Radius of a probe's marker, in radii of its RBF.
const PROBE_SIZE: f32 = 0.1;
const CENTER: LinearRgba = LinearRgba::WHITE;
const AROUND: LinearRgba = LinearRgba::rgb(1.0, 0.7, 0.0);
const SPHERE: LinearRgba = LinearRgba::rgb(1.0, 0.0, 1.0);

/// Makes, moves and takes away the markers of all volumes.
pub(super) fn mark(
    mut commands: Commands,
    mut meshes: ResMut<Assets<Mesh>>,
    mut materials: ResMut<Assets<StandardMaterial>>,
    volumes: Query<(Entity, &SmokeDebugView, &SmokeMoment, &SmokeMedium, &GlobalTransform)>,
    occluders: Query<(&SmokeOccluder, &GlobalTransform, Option<&SkinnedMesh>, Option<&InheritedVisibility>)>,
    transforms: Query<&GlobalTransform>,
    markers: Query<(Entity, &Markers, &Mesh3d)>,
) {
    for (marker, of, _) in &markers {
        let wanted = volumes.get(of.volume).is_ok_and(|(_, view, ..)| has_markers(*view));
        if !wanted {
            commands.entity(marker).despawn();
        }
    }
    for (volume, view, moment, medium, at) in volumes.iter().filter(|(_, view, ..)| has_markers(**view)) {
        let mut drawn = Drawn::default();
        if *view == SmokeDebugView::Probes {
            let rbfs = moment.0.as_ref().map(|moment| moment.rbfs().rbfs).unwrap_or_default();
            let scale = at.affine().matrix3.determinant().abs().cbrt();
            for (rbf, probe) in rbfs.iter().flat_map(|rbf| (0..7).map(move |probe| (rbf, probe))) {
                let center = at.transform_point(probe_position(rbf, probe, medium.clamped().sigma_t * scale));
                drawn.octahedron(center, PROBE_SIZE * rbf.radius * scale, if probe == 0 { CENTER } else { AROUND });
            }
        } else {
            for (occluder, at, skin, visibility) in &occluders {
                if visibility.is_none_or(|visibility| visibility.get()) {
                    let transform_of = |joint| transforms.get(joint).ok().map(GlobalTransform::affine);
                    occluder.place(at, skin, transform_of).for_each(|sphere| drawn.sphere(sphere));
                }
            }
        }
        let mesh = drawn.mesh();
        match markers.iter().find(|(_, of, _)| of.volume == volume) {
            Some((.., there)) => {
                // It is alive: the marker holds it.
                let _ = meshes.insert(there.id(), mesh);
            }
            None => {
                let material = materials.add(StandardMaterial { unlit: true, ..default() });
                commands.spawn((
                    Markers { volume },
                    Mesh3d(meshes.add(mesh)),
                    MeshMaterial3d(material),
                    (NotShadowCaster, NotShadowReceiver, NoSmokeShadow, NoFrustumCulling),
                ));
            }
        }
    }
}

fn has_markers(view: SmokeDebugView) -> bool {
    matches!(view, SmokeDebugView::Probes | SmokeDebugView::Spheres)
}

/// Where an RBF's probes are, in bundle space, as `lighting.wgsl` has it; `sigma` is the extinction a bundle unit and unit of
/// density.
fn probe_position(rbf: &Rbf, probe: usize, sigma: f32) -> Vec3 {
    let depth = sigma * rbf.weight * rbf.radius;
    let reach = rbf.radius * (3.0 * depth).max(1e-30).ln().clamp(1.0, 6.0).sqrt();
    let side = if probe % 2 == 1 { reach } else { -reach };
    let axis = [Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z][probe.div_ceil(2)];
    Vec3::from(rbf.center) + side * axis
}

/// Triangles.
#[derive(Default)]
struct Drawn {
    positions: Vec<Vec3>,
    colors: Vec<[f32; 4]>,
    indices: Vec<u32>,
}

impl Drawn {
    fn octahedron(&mut self, center: Vec3, radius: f32, color: LinearRgba) {
        let first = self.positions.len() as u32;
        let corners = [Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z];
        self.positions.extend(corners.map(|corner| center + radius * corner));
        self.colors.extend([color.to_f32_array(); 6]);
        // Counterclockwise from outside.
        let faces = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]];
        self.indices.extend(faces.into_iter().flatten().map(|corner: u32| first + corner));
    }

    fn sphere(&mut self, sphere: Vec4) {
        let first = self.positions.len() as u32;
        let ball = Sphere::new(1.0).mesh().uv(24, 16);
        let corners =
            ball.attribute(Mesh::ATTRIBUTE_POSITION).and_then(|values| values.as_float3()).unwrap_or_default();
        self.positions.extend(corners.iter().map(|corner| sphere.truncate() + sphere.w * Vec3::from(*corner)));
        self.colors.resize(self.positions.len(), SPHERE.to_f32_array());
        self.indices.extend(ball.indices().into_iter().flat_map(Indices::iter).map(|corner| first + corner as u32));
    }

    fn mesh(self) -> Mesh {
        Mesh::new(PrimitiveTopology::TriangleList, RenderAssetUsages::default())
            .with_inserted_attribute(Mesh::ATTRIBUTE_NORMAL, vec![[0.0, 1.0, 0.0]; self.positions.len()])
            .with_inserted_attribute(Mesh::ATTRIBUTE_POSITION, self.positions)
            .with_inserted_attribute(Mesh::ATTRIBUTE_COLOR, self.colors)
            .with_inserted_indices(Indices::U32(self.indices))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn probes_are_where_light_is_looked_for() {
        let rbf = Rbf { center: [0.1, 0.2, 0.3], radius: 0.05, weight: 2.0 };
        // Thin: a radius. Thick: the square root of the logarithm of thrice the depth, σ w r = 20, that is 2.02 radii.
        for (sigma, reach) in [(0.1, 0.05), (200.0, 0.05 * 60.0_f32.ln().sqrt())] {
            let probes: Vec<Vec3> = (0..7).map(|probe| probe_position(&rbf, probe, sigma)).collect();
            let center = Vec3::new(0.1, 0.2, 0.3);
            assert_eq!(probes[0], center);
            let around = [Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z];
            for (probe, axis) in probes[1..].iter().zip(around) {
                assert!(probe.distance(center + reach * axis) < 1e-6, "{probe} at {sigma}");
            }
        }
    }

    #[test]
    fn octahedra_face_outward() {
        let mut drawn = Drawn::default();
        drawn.octahedron(Vec3::ZERO, 1.0, CENTER);
        assert_eq!(drawn.indices.len(), 24);
        for face in drawn.indices.chunks(3) {
            let [a, b, c] = [0, 1, 2].map(|i| drawn.positions[face[i] as usize]);
            assert!((b - a).cross(c - a).dot(a + b + c) > 0.0, "{face:?}");
        }
    }
}
