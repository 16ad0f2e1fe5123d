//! What a shadow sees of spheres: their outline, against that of the mesh they stand for.

use glam::{Vec2, Vec3};

use super::solid::TriangleMesh;

/// Directions from which outlines are compared.
const DIRECTIONS: usize = 24;
/// Pixels along the longer side of an outline.
const PIXELS: f32 = 160.0;

/// The area in which the outlines of a mesh and of spheres (centres and, in the second place, radii) differ, over the area of
/// the mesh's: means over directions spread evenly over the sphere of them. None for a mesh without any outline.
pub fn silhouette_error(mesh: &TriangleMesh, spheres: &[(Vec3, f32)]) -> Option<f32> {
    let [mut differ, mut area] = [0.0_f64; 2];
    for direction in 0..DIRECTIONS {
        // A Fibonacci spiral on half the sphere: the other half sees the same outlines mirrored.
        let z = (direction as f32 + 0.5) / DIRECTIONS as f32;
        let turn = direction as f32 * 2.399_963_2;
        let (sine, cosine) = turn.sin_cos();
        let normal = Vec3::new((1.0 - z * z).sqrt() * cosine, (1.0 - z * z).sqrt() * sine, z);
        let [pixels, mesh, xor] = compare(mesh, spheres, normal)?;
        differ += f64::from(xor * pixels);
        area += f64::from(mesh * pixels);
    }
    (area > 0.0).then(|| (differ / area) as f32)
}

/// The area of a pixel, the mesh's pixels, and the pixels of either but not both, seen along a direction.
fn compare(mesh: &TriangleMesh, spheres: &[(Vec3, f32)], direction: Vec3) -> Option<[f32; 3]> {
    let (u, v) = direction.any_orthonormal_pair();
    let flat = |point: Vec3| Vec2::new(point.dot(u), point.dot(v));
    let corners: Vec<[Vec2; 3]> = mesh.corners().map(|corners| corners.map(flat)).collect();
    let discs: Vec<(Vec2, f32)> = spheres.iter().map(|(center, radius)| (flat(*center), *radius)).collect();
    let [low, high] = corners
        .iter()
        .flatten()
        .map(|point| (*point, 0.0))
        .chain(discs.iter().copied())
        .fold([Vec2::INFINITY, Vec2::NEG_INFINITY], |[low, high], (point, radius)| {
            [low.min(point - radius), high.max(point + radius)]
        });
    let pixel = (high - low).max_element() / PIXELS;
    if !(pixel > 0.0 && pixel.is_finite()) {
        return None;
    }
    let [width, height] = ((high - low) / pixel).ceil().max(Vec2::ONE).to_array().map(|side| side as usize);
    let mut seen = vec![0_u8; width * height];
    let mut mark = |low_mark: Vec2, high_mark: Vec2, bit: u8, covers: &dyn Fn(Vec2) -> bool| {
        let [first, last] = [low_mark, high_mark].map(|point| (point - low) / pixel - 0.5);
        let first = first.ceil().max(Vec2::ZERO);
        for y in first.y as usize..((last.y.floor() + 1.0).max(0.0) as usize).min(height) {
            for x in first.x as usize..((last.x.floor() + 1.0).max(0.0) as usize).min(width) {
                if covers(low + (Vec2::new(x as f32, y as f32) + 0.5) * pixel) {
                    seen[x + y * width] |= bit;
                }
            }
        }
    };
    for [a, b, c] in corners {
        let covers = |point: Vec2| {
            let sides = [(a, b), (b, c), (c, a)].map(|(from, to)| (to - from).perp_dot(point - from));
            sides.iter().all(|side| *side >= 0.0) || sides.iter().all(|side| *side <= 0.0)
        };
        mark(a.min(b).min(c), a.max(b).max(c), 1, &covers);
    }
    for (center, radius) in discs {
        let covers = |point: Vec2| point.distance_squared(center) <= radius * radius;
        mark(center - radius, center + radius, 2, &covers);
    }
    let count = |is: &dyn Fn(u8) -> bool| seen.iter().filter(|bits| is(**bits)).count() as f32;
    Some([pixel * pixel, count(&|bits| bits & 1 != 0), count(&|bits| bits == 1 || bits == 2)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::occluder::shapes;

    #[test]
    fn nothing_is_wholly_wrong_and_a_sphere_is_right() {
        let cube = shapes::box_grid(Vec3::ONE, [2; 3]);
        assert_eq!(silhouette_error(&cube, &[]), Some(1.0));
        // Its outlines have a mean area of a quarter of its surface, 1.5; a sphere of radius 2 covers 4π.
        let error = silhouette_error(&cube, &[(Vec3::ZERO, 2.0)]).unwrap();
        // 24 directions and 160 pixels across are exact to about a per cent.
        assert!((error - (4.0 * core::f32::consts::PI / 1.5 - 1.0)).abs() < 0.1, "{error}");
        assert_eq!(silhouette_error(&TriangleMesh::default(), &[]), None);

        let thin = shapes::torus(1.0, 0.5, 64, 32);
        let beads: Vec<_> = (0..64)
            .map(|bead| {
                let (sine, cosine) = (core::f32::consts::TAU * bead as f32 / 64.0).sin_cos();
                (Vec3::new(cosine, 0.0, sine), 0.5)
            })
            .collect();
        // Pixels at the edge are all that is left, and the torus' facets.
        let error = silhouette_error(&thin, &beads).unwrap();
        assert!(error < 0.02, "{error}");
    }
}
