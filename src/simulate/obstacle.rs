//! A solid sphere in the flow.

use glam::{UVec3, Vec3};

use super::lattice::{Lattice, fill_planes, unit};
use crate::density::GridShape;

/// Points a side of a face at which it is looked for inside the sphere.
const FACE_SAMPLES: u32 = 8;
/// Layers of points inside the sphere that get values from outside: what a look-up of a point outside can reach.
const LAYERS: usize = 3;

/// A solid sphere, in bundle space: the box is centred on the origin, its longest side is 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sphere {
    /// The centre.
    pub center: Vec3,
    /// The radius, above 0.
    pub radius: f32,
}

impl Sphere {
    /// A sphere in the middle of a box, a third of its shortest side across.
    pub fn in_the_middle(shape: GridShape) -> Self {
        Self { center: Vec3::ZERO, radius: shape.half_extent().min_element() / 3.0 }
    }

    /// Signed distance of a position, in bundle space, from the surface; negative inside.
    pub fn distance(&self, position: Vec3) -> f32 {
        position.distance(self.center) - self.radius
    }

    /// The same sphere in cells from the box's lowest corner.
    pub(super) fn in_cells(&self, shape: GridShape) -> Sphere {
        let cells = shape.longest() as f32;
        Sphere { center: self.center * cells + 0.5 * shape.dims.as_vec3(), radius: self.radius * cells }
    }
}

/// The open fraction of every face of a box: all of it, nothing on the floor and inside the sphere (given in cells), a
/// part where the sphere's surface cuts it.
pub fn open_faces(dims: UVec3, sphere: Option<Sphere>) -> [Lattice; 3] {
    std::array::from_fn(|axis| {
        let faces = Lattice::faces(dims, axis);
        faces.map(|face, _| {
            if axis == 1 && face.y == 0 {
                return 0.0;
            }
            let Some(sphere) = sphere else { return 1.0 };
            let center = faces.position(face);
            match sphere.distance(center) {
                far if far > 1.0 => 1.0,
                far if far < -1.0 => 0.0,
                _ => {
                    let [b, c] = [(axis + 1) % 3, (axis + 2) % 3].map(|axis| unit(axis).as_vec3());
                    let at = |i: u32| (i as f32 + 0.5) / FACE_SAMPLES as f32 - 0.5;
                    let samples = (0..FACE_SAMPLES.pow(2)).map(|i| (at(i % FACE_SAMPLES), at(i / FACE_SAMPLES)));
                    let outside = samples.filter(|&(i, j)| sphere.distance(center + i * b + j * c) > 0.0).count();
                    outside as f32 / FACE_SAMPLES.pow(2) as f32
                }
            }
        })
    })
}

/// Where values inside a solid come from: points near its surface get the mean of their neighbours farther out, layer by
/// layer, so that looking a value up next to the surface neither mixes in emptiness nor brakes the flow.
#[derive(Clone, Debug, Default)]
pub struct Extension {
    /// Points of a layer, with the points whose mean they get.
    layers: Vec<Vec<(usize, Vec<usize>)>>,
}

impl Extension {
    /// For the points of a shape that are `solid`.
    pub fn new(shape: GridShape, solid: impl Fn(UVec3, usize) -> bool + Sync) -> Self {
        let mut known = vec![false; shape.len()];
        fill_planes(shape, &mut known, |point, index, known| *known = !solid(point, index));
        let mut layers = Vec::new();
        for _ in 0..LAYERS {
            let layer: Vec<_> = (0..shape.len())
                .filter(|&index| !known[index])
                .map(|index| (index, neighbours(shape, index).filter(|&other| known[other]).collect::<Vec<_>>()))
                .filter(|(_, sources)| !sources.is_empty())
                .collect();
            layer.iter().for_each(|&(index, _)| known[index] = true);
            layers.push(layer);
        }
        Self { layers }
    }

    /// Gives the points inside their values.
    pub fn apply(&self, values: &mut [f32]) {
        for (index, sources) in self.layers.iter().flatten() {
            values[*index] = sources.iter().map(|&source| values[source]).sum::<f32>() / sources.len() as f32;
        }
    }
}

/// The up to six points next to a point.
fn neighbours(shape: GridShape, index: usize) -> impl Iterator<Item = usize> {
    let point = shape.cell(index).as_ivec3();
    let steps = (0..3).flat_map(|axis| [unit(axis).as_ivec3(), -unit(axis).as_ivec3()]);
    let points = steps.map(move |step| (point + step).as_uvec3());
    // A step below 0 wraps to a number above any side.
    points.filter(move |point| point.cmplt(shape.dims).all()).map(move |point| shape.index(point))
}
