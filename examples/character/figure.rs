//! A figure of a person that walks: one smooth skinned mesh over sixteen joints, made of nothing but round cones.
//!
//! The body is the smooth union of the cones' distances (Quílez), polygonised by surface nets (Gibson 1998); a vertex follows
//! the joints of the cones near it. The walk is a few sines.

use bevy::asset::RenderAssetUsages;
use bevy::mesh::skinning::{SkinnedMesh, SkinnedMeshInverseBindposes};
use bevy::mesh::{Indices, PrimitiveTopology, VertexAttributeValues};
use bevy::prelude::*;

/// Joints: the parent of each, and where it is at rest, in metres. The figure stands on the ground and looks along +Z; its
/// left side is at +X.
const JOINTS: [(usize, Vec3); 16] = [
    (0, Vec3::new(0.0, 0.96, 0.0)),
    (0, Vec3::new(0.0, 1.12, 0.0)),
    (1, Vec3::new(0.0, 1.30, 0.0)),
    (2, Vec3::new(0.0, 1.52, 0.0)),
    (2, Vec3::new(0.18, 1.42, 0.0)),
    (4, Vec3::new(0.35, 1.20, 0.0)),
    (5, Vec3::new(0.51, 1.00, 0.0)),
    (2, Vec3::new(-0.18, 1.42, 0.0)),
    (7, Vec3::new(-0.35, 1.20, 0.0)),
    (8, Vec3::new(-0.51, 1.00, 0.0)),
    (0, Vec3::new(0.10, 0.92, 0.0)),
    (10, Vec3::new(0.11, 0.50, 0.0)),
    (11, Vec3::new(0.11, 0.09, 0.0)),
    (0, Vec3::new(-0.10, 0.92, 0.0)),
    (13, Vec3::new(-0.11, 0.50, 0.0)),
    (14, Vec3::new(-0.11, 0.09, 0.0)),
];

const SPINE: usize = 1;
const CHEST: usize = 2;
const HEAD: usize = 3;
/// Shoulder, elbow and wrist, left and right.
const ARMS: [[usize; 3]; 2] = [[4, 5, 6], [7, 8, 9]];
/// Hip, knee and ankle, left and right.
const LEGS: [[usize; 3]; 2] = [[10, 11, 12], [13, 14, 15]];

/// Between two spheres, a part of the body.
struct Cone {
    joint: usize,
    ends: [Vec3; 2],
    radii: [f32; 2],
}

fn cones() -> Vec<Cone> {
    let cone = |joint, from: [f32; 3], to: [f32; 3], radii| Cone { joint, ends: [from.into(), to.into()], radii };
    let mut cones = vec![
        cone(0, [-0.07, 0.95, -0.01], [0.07, 0.95, -0.01], [0.115; 2]),
        cone(SPINE, [0.0, 1.06, 0.0], [0.0, 1.18, 0.0], [0.118, 0.115]),
        cone(CHEST, [-0.07, 1.30, 0.0], [0.07, 1.30, 0.0], [0.122; 2]),
        cone(CHEST, [-0.14, 1.41, -0.01], [0.14, 1.41, -0.01], [0.068; 2]),
        cone(HEAD, [0.0, 1.46, -0.01], [0.0, 1.60, 0.01], [0.054, 0.05]),
        cone(HEAD, [0.0, 1.63, 0.03], [0.0, 1.70, 0.005], [0.078, 0.098]),
    ];
    for ([shoulder, elbow, wrist], [hip, knee, ankle]) in ARMS.into_iter().zip(LEGS) {
        let place = |joint: usize| JOINTS[joint].1;
        let mut limb = |joint, ends, radii| cones.push(Cone { joint, ends, radii });
        let hand = place(wrist) + 0.4 * (place(wrist) - place(elbow));
        limb(shoulder, [place(shoulder), place(elbow)], [0.056, 0.042]);
        limb(elbow, [place(elbow), place(wrist)], [0.042, 0.029]);
        limb(wrist, [place(wrist), hand], [0.029, 0.038]);
        let foot = place(ankle);
        limb(hip, [place(hip), place(knee)], [0.092, 0.058]);
        limb(knee, [place(knee), place(ankle)], [0.06, 0.038]);
        limb(ankle, [foot + Vec3::new(0.0, -0.04, -0.03), foot + Vec3::new(0.0, -0.055, 0.15)], [0.046, 0.034]);
    }
    cones
}

impl Cone {
    /// How far a point is from the surface, negative inside: that of the nearest sphere on the line, which is close enough
    /// for ends of similar size.
    fn distance(&self, point: Vec3) -> f32 {
        let along = self.ends[1] - self.ends[0];
        let share = ((point - self.ends[0]).dot(along) / along.length_squared()).clamp(0.0, 1.0);
        point.distance(self.ends[0] + share * along) - self.radii[0].lerp(self.radii[1], share)
    }
}

/// How far a point is from the surface of the body.
fn distance(cones: &[Cone], point: Vec3) -> f32 {
    // Cones blend over some centimetres.
    let sharpness = 60.0;
    -cones.iter().map(|cone| (-sharpness * cone.distance(point)).exp()).sum::<f32>().ln() / sharpness
}

/// The four joints that a point follows most, and how much.
fn weights(cones: &[Cone], point: Vec3) -> ([u16; 4], [f32; 4]) {
    let mut sums = [0.0; JOINTS.len()];
    let nearest = cones.iter().map(|cone| cone.distance(point)).fold(f32::INFINITY, f32::min);
    for cone in cones {
        sums[cone.joint] += (-40.0 * (cone.distance(point) - nearest)).exp();
    }
    let mut order: [usize; JOINTS.len()] = core::array::from_fn(|joint| joint);
    order.sort_by(|a, b| sums[*b].total_cmp(&sums[*a]));
    let most = [order[0], order[1], order[2], order[3]];
    let total: f32 = most.iter().map(|joint| sums[*joint]).sum();
    (most.map(|joint| joint as u16), most.map(|joint| sums[joint] / total))
}

/// The figure's mesh at rest, with joints and weights.
pub fn mesh() -> Mesh {
    let cones = cones();
    let cell = 0.022;
    let low = Vec3::new(-0.68, -0.05, -0.22);
    let dims: [usize; 3] = [62, 86, 22];
    let corner = |[x, y, z]: [usize; 3]| low + cell * Vec3::new(x as f32, y as f32, z as f32);
    let index = |[x, y, z]: [usize; 3]| x + dims[0] * (y + dims[1] * z);
    let places = || (0..dims[2]).flat_map(|z| (0..dims[1]).flat_map(move |y| (0..dims[0]).map(move |x| [x, y, z])));
    let values: Vec<f32> = places().map(|place| distance(&cones, corner(place))).collect();
    let gradient = |point: Vec3| {
        let step = |axis: Vec3| distance(&cones, point + 1e-3 * axis) - distance(&cones, point - 1e-3 * axis);
        Vec3::new(step(Vec3::X), step(Vec3::Y), step(Vec3::Z)).normalize()
    };

    // A vertex in every cell that the surface passes, and four cells around every edge that it crosses.
    let (mut positions, mut normals, mut joints, mut shares) = (vec![], vec![], vec![], vec![]);
    let mut vertices = vec![u32::MAX; values.len()];
    for place in places().filter(|place| place.iter().zip(dims).all(|(at, cells)| at + 1 < cells)) {
        let around: [[usize; 3]; 8] =
            core::array::from_fn(|bits| core::array::from_fn(|axis| place[axis] + (bits >> axis & 1)));
        let inside = around.iter().filter(|place| values[index(**place)] < 0.0).count();
        if inside == 0 || inside == 8 {
            continue;
        }
        let mut point = corner(place) + 0.5 * cell;
        for _ in 0..4 {
            point -= 0.8 * distance(&cones, point) * gradient(point);
        }
        let (joint, share) = weights(&cones, point);
        vertices[index(place)] = positions.len() as u32;
        positions.push(point.to_array());
        normals.push(gradient(point).to_array());
        joints.push(joint);
        shares.push(share);
    }
    let mut indices = Vec::new();
    for place in places().filter(|place| place.iter().all(|at| *at > 0)) {
        for axis in 0..3 {
            let mut next = place;
            next[axis] += 1;
            let is_past = next.iter().zip(dims).any(|(at, cells)| *at >= cells);
            if is_past || (values[index(place)] < 0.0) == (values[index(next)] < 0.0) {
                continue;
            }
            let back = |axes: &[usize]| {
                let mut cell = place;
                axes.iter().for_each(|axis| cell[*axis] -= 1);
                vertices[index(cell)]
            };
            let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
            let [a, b, c, d] = [back(&[u, v]), back(&[v]), back(&[]), back(&[u])];
            // Seen from outside, anticlockwise.
            let quad = if values[index(place)] < 0.0 { [a, b, c, a, c, d] } else { [a, c, b, a, d, c] };
            indices.extend(quad);
        }
    }
    Mesh::new(PrimitiveTopology::TriangleList, RenderAssetUsages::default())
        .with_inserted_attribute(Mesh::ATTRIBUTE_POSITION, positions)
        .with_inserted_attribute(Mesh::ATTRIBUTE_NORMAL, normals)
        .with_inserted_attribute(Mesh::ATTRIBUTE_JOINT_INDEX, VertexAttributeValues::Uint16x4(joints))
        .with_inserted_attribute(Mesh::ATTRIBUTE_JOINT_WEIGHT, shares)
        .with_inserted_indices(Indices::U32(indices))
}

/// From the mesh to every joint at rest.
pub fn inverse_bindposes() -> Vec<Mat4> {
    JOINTS.iter().map(|(_, rest)| Mat4::from_translation(-rest)).collect()
}

/// Where every joint is in its parent's space, the first in the figure's, at a phase of the walk: two steps are 2π. Feet
/// stay on the ground if the figure moves on by [`STRIDE`] in that time.
pub fn walk(phase: f32) -> [Transform; JOINTS.len()] {
    let mut joints = JOINTS.map(|(parent, rest)| Transform::from_translation(rest - JOINTS[parent].1));
    let turn = |joints: &mut [Transform], joint: usize, rotation: Quat| joints[joint].rotation = rotation;
    let mut lowest = f32::INFINITY;
    for (side, [hip, knee, ankle]) in LEGS.into_iter().enumerate() {
        let (sine, cosine) = (phase + std::f32::consts::PI * side as f32).sin_cos();
        // Forward is −X about the X axis. The knee gives way while the leg swings forward.
        let swing = -HIP_SWING * sine - 0.06;
        let bend = 0.12 + 0.95 * (0.5 + 0.5 * (cosine + 0.25 * sine)).clamp(0.0, 1.0).powi(3);
        turn(&mut joints, hip, Quat::from_rotation_x(swing));
        turn(&mut joints, knee, Quat::from_rotation_x(bend));
        let lift = 0.25 * (-sine).max(0.0).powi(2);
        turn(&mut joints, ankle, Quat::from_rotation_x(-0.85 * (swing + bend) + lift));
        let [thigh, shin] = [(hip, knee), (knee, ankle)].map(|(from, to)| JOINTS[from].1.y - JOINTS[to].1.y);
        lowest = lowest.min(thigh * (1.0 - swing.cos()) + shin * (1.0 - (swing + bend).cos()));
    }
    // The lower foot stays on the ground.
    joints[0].translation = JOINTS[0].1 - Vec3::Y * lowest;
    let sway = phase.sin();
    turn(&mut joints, 0, Quat::from_euler(EulerRot::YXZ, -0.10 * sway, 0.03, 0.03 * phase.cos()));
    turn(&mut joints, SPINE, Quat::from_euler(EulerRot::YXZ, 0.10 * sway, 0.02, -0.03 * phase.cos()));
    turn(&mut joints, CHEST, Quat::from_euler(EulerRot::YXZ, 0.12 * sway, 0.03, 0.0));
    turn(&mut joints, HEAD, Quat::from_euler(EulerRot::YXZ, -0.10 * sway, -0.06, 0.0));
    for (side, [shoulder, elbow, wrist]) in ARMS.into_iter().enumerate() {
        let outward = if side == 0 { 1.0 } else { -1.0 };
        let swing = outward * 0.5 * phase.sin();
        turn(&mut joints, shoulder, Quat::from_rotation_x(swing) * Quat::from_rotation_z(-0.50 * outward));
        turn(&mut joints, elbow, Quat::from_rotation_x(-0.35 + 0.25 * swing));
        turn(&mut joints, wrist, Quat::from_rotation_z(-0.1 * outward));
    }
    joints
}

/// Radians that legs swing to either side.
const HIP_SWING: f32 = 0.46;
/// Metres that two steps take the figure.
pub const STRIDE: f32 = 1.42;

/// The parent of every joint but the first.
pub fn parents() -> impl Iterator<Item = usize> {
    JOINTS.iter().map(|(parent, _)| *parent)
}

/// A joint of a figure, by its number.
#[derive(Component)]
pub struct Joint(pub usize);

/// Spawns a figure that stands at a place; its joints are children of the entity that has the mesh.
pub fn spawn(
    commands: &mut Commands,
    mesh: Handle<Mesh>,
    inverse_bindposes: Handle<SkinnedMeshInverseBindposes>,
    material: Handle<StandardMaterial>,
    transform: Transform,
) -> Entity {
    let figure = commands.spawn((Mesh3d(mesh), MeshMaterial3d(material), transform)).id();
    let mut joints: Vec<Entity> = Vec::new();
    for (number, (parent, place)) in parents().zip(walk(0.0)).enumerate() {
        let joint = commands.spawn((Joint(number), place)).id();
        let parent = if number == 0 { figure } else { joints[parent] };
        commands.entity(parent).add_child(joint);
        joints.push(joint);
    }
    commands.entity(figure).insert(SkinnedMesh { inverse_bindposes, joints });
    figure
}
