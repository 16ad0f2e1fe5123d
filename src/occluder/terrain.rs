//! Spheres that stand for ground.
//!
//! Ground is a height field, and spheres under it touch it from below: large ones with their centres deep down where it is
//! flat or hollow, for a sphere's top is nearly a plane, small ones where it bulges. Fields are cut into tiles, the one that
//! is followed worst first, each tile gets the sphere that fits it, and then all are moved and sized in turn until the upper
//! envelope of their union is as close to the field as it gets, where what rises above it counts twice.

use glam::{Vec2, Vec3, vec2, vec3};

use super::OccluderSphere;
use super::fit::FitFailure;
use super::solid::{TriangleMesh, cross_columns};

/// Heights on a grid over a rectangle about the origin, Y up.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct HeightField {
    /// How long the rectangle is along X and along Z.
    pub size: Vec2,
    /// Heights along X: the first of a row lies at `-size.x / 2`, the last at `size.x / 2`.
    pub columns: usize,
    /// Heights, row after row from `-size.y / 2` to `size.y / 2` along Z: at least two rows of two.
    pub heights: Vec<f32>,
}

/// Spheres fitted to ground.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GroundFit {
    /// The spheres.
    pub spheres: Vec<OccluderSphere>,
    /// Root mean square of the height of the spheres' upper envelope above the ground, in the field's unit.
    pub height_rms: f32,
    /// How far the envelope rises above the ground at most.
    pub highest: f32,
}

/// Heights that are looked at along the longer side while spheres are moved.
const SAMPLES: f32 = 48.0;
/// The largest radius, over the longer side. Larger spheres would follow flat ground still closer and bulge out farther
/// beyond its edges, deep below.
const LARGEST: f32 = 2.0;
/// Rounds over all spheres.
const ROUNDS: usize = 24;

/// Fits at most so many spheres to ground from below. They fill it to a depth of about the size of a tile, the field's area
/// over their number, and more where it is not sharply curved.
///
/// # Errors
///
/// [`FitFailure::BadGround`].
pub fn fit_ground(field: &HeightField, spheres: usize) -> Result<GroundFit, FitFailure> {
    let rows = field.heights.len() / field.columns.max(1);
    let is_good = field.columns >= 2
        && rows >= 2
        && field.heights.len() == rows * field.columns
        && field.size.is_finite()
        && field.size.min_element() > 0.0
        && field.heights.iter().all(|height| height.is_finite());
    if !is_good {
        return Err(FitFailure::BadGround);
    }
    let samples = samples(field);
    let largest = LARGEST * field.size.max_element();
    let mut caps: Vec<Cap> = tiles(&samples, spheres).iter().map(|tile| Cap::of_tile(tile, largest)).collect();
    settle(&mut caps, &samples, largest);
    let spheres: Vec<_> = caps.iter().map(|cap| OccluderSphere::new(cap.center(), cap.radius)).collect();
    let above: Vec<f32> = (0..field.heights.len())
        .map(|index| {
            let point = field.point(index);
            let top = caps.iter().map(|cap| cap.height(vec2(point.x, point.z))).fold(f32::NEG_INFINITY, f32::max);
            // Where there is no sphere at all, the ground is missing to the depth that any of them has.
            top.max(point.y - largest) - point.y
        })
        .collect();
    Ok(GroundFit {
        spheres,
        height_rms: (above.iter().map(|above| above * above).sum::<f32>() / above.len() as f32).sqrt(),
        highest: above.iter().copied().fold(0.0, f32::max),
    })
}

impl HeightField {
    /// The ground that a mesh shows from above, Y up, on a grid of about so many points along its longer side, and where its
    /// middle is. Where there is nothing to see it is as low as the mesh gets.
    pub(super) fn of_mesh(mesh: &TriangleMesh, points: usize) -> Result<(Self, Vec3), FitFailure> {
        let [low, high] = mesh.bounds();
        let size = vec2(high.x - low.x, high.z - low.z);
        if !(size.min_element() > 0.0 && (high - low).is_finite()) {
            return Err(FitFailure::BadGround);
        }
        let spacing = size.max_element() / points as f32;
        let [columns, rows] = size.to_array().map(|length| (length / spacing) as usize + 2);
        let middle = vec3(0.5 * (low.x + high.x), 0.0, 0.5 * (low.z + high.z));
        let mut heights = vec![low.y; columns * rows];
        // The outermost points are just within the mesh.
        let cells = vec2(columns as f32 - 1.0, rows as f32 - 1.0);
        let scale = 1.0001 * cells / size;
        for corners in mesh.corners() {
            let corners = corners.map(|corner| {
                let at = vec2(corner.x - middle.x, corner.z - middle.z) * scale + 0.5 * cells;
                vec3(at.x, corner.y, at.y)
            });
            cross_columns(corners, [1, 0, 2], [columns, 1, rows], |place, height, _| {
                heights[place] = heights[place].max(height);
            });
        }
        Ok((Self { size, columns, heights }, middle))
    }

    /// Where a height is in space.
    fn point(&self, index: usize) -> Vec3 {
        let rows = self.heights.len() / self.columns;
        let place = vec2((index % self.columns) as f32, (index / self.columns) as f32);
        let at = (place / vec2(self.columns as f32 - 1.0, rows as f32 - 1.0) - 0.5) * self.size;
        vec3(at.x, self.heights[index], at.y)
    }
}

/// Points of a field, about [`SAMPLES`] along its longer side.
fn samples(field: &HeightField) -> Vec<Vec3> {
    let rows = field.heights.len() / field.columns;
    let spacing = field.size.max_element() / SAMPLES;
    let [columns, rows] = [(field.size.x, field.columns), (field.size.y, rows)].map(|(length, there)| {
        let wanted = ((length / spacing) as usize).clamp(2, there);
        (0..wanted).map(move |index| index * (there - 1) / (wanted - 1))
    });
    rows.flat_map(|row| columns.clone().map(move |column| field.point(row * field.columns + column))).collect()
}

/// Cuts points into at most so many tiles, rectangles each. That which a sphere fits worst is cut first, across its longer
/// side.
fn tiles(samples: &[Vec3], count: usize) -> Vec<Vec<Vec3>> {
    let error = |tile: &[Vec3]| {
        let cap = Cap::of_tile(tile, f32::INFINITY);
        // Tiles that are followed exactly are cut by size.
        let extent = extent(tile).length();
        tile.iter()
            .map(|point| (cap.height(vec2(point.x, point.z)).max(point.y - extent) - point.y).powi(2))
            .sum::<f32>()
            + 1e-4 * extent * extent * tile.len() as f32
    };
    let mut tiles = vec![(error(samples), samples.to_vec())];
    while tiles.len() < count {
        let worst = (0..tiles.len())
            .filter(|tile| tiles[*tile].1.len() >= 8)
            .max_by(|a, b| tiles[*a].0.total_cmp(&tiles[*b].0));
        let Some(worst) = worst else { break };
        let (_, tile) = tiles.swap_remove(worst);
        let extent = extent(&tile);
        let along = |point: &Vec3| if extent.x >= extent.y { point.x } else { point.z };
        let (low, high) = tile
            .iter()
            .map(along)
            .fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), at| (low.min(at), high.max(at)));
        let (first, second): (Vec<Vec3>, Vec<Vec3>) = tile.iter().partition(|point| along(point) < 0.5 * (low + high));
        tiles.extend([first, second].map(|half| (error(&half), half)));
    }
    tiles.truncate(count);
    tiles.into_iter().map(|(_, tile)| tile).collect()
}

/// How long points are along X and Z.
fn extent(points: &[Vec3]) -> Vec2 {
    let [low, high] = points
        .iter()
        .fold([Vec3::INFINITY, Vec3::NEG_INFINITY], |[low, high], point| [low.min(*point), high.max(*point)]);
    vec2(high.x - low.x, high.z - low.z)
}

/// A sphere through a point of the ground, near which it is tangent to a slope.
#[derive(Clone, Copy, Debug)]
struct Cap {
    point: Vec3,
    /// Rise along X and Z.
    slope: Vec2,
    radius: f32,
}

impl Cap {
    /// The sphere that is tangent to a tile's mean slope and bends as the tile does, if that bulges.
    fn of_tile(tile: &[Vec3], largest: f32) -> Self {
        let count = tile.len() as f32;
        let middle = tile.iter().sum::<Vec3>() / count;
        // Least squares of y = h + slope · d + bend (d² − mean d²). On the grid's rectangles the terms hardly correlate.
        let [mut rise, mut spread] = [Vec2::ZERO; 2];
        for point in tile {
            let away = vec2(point.x - middle.x, point.z - middle.z);
            rise += away * (point.y - middle.y);
            spread += away * away;
        }
        let slope = rise / spread.max(Vec2::splat(f32::MIN_POSITIVE));
        let mean = spread.element_sum() / count;
        let [mut bent, mut bends] = [0.0; 2];
        for point in tile {
            let away = vec2(point.x - middle.x, point.z - middle.z);
            let term = away.length_squared() - mean;
            bent += term * (point.y - middle.y - slope.dot(away));
            bends += term * term;
        }
        let bend = bent / f32::max(bends, f32::MIN_POSITIVE);
        // y = −d²/2R on flat ground; a slope stretches it.
        let stretch = (1.0 + slope.length_squared()).powf(1.5);
        let radius = if bend < 0.0 { (-0.5 * stretch / bend).min(largest) } else { largest };
        let radius = radius.min(1e6 * mean.sqrt()).max(0.5 * mean.sqrt());
        let point = vec3(middle.x, middle.y + mean / (2.0 * radius), middle.z);
        Self { point, slope, radius }
    }

    fn center(&self) -> Vec3 {
        self.point - vec3(-self.slope.x, 1.0, -self.slope.y).normalize() * self.radius
    }

    /// How high its top is above a point; −∞ beside it.
    fn height(&self, at: Vec2) -> f32 {
        let center = self.center();
        let under = self.radius * self.radius - at.distance_squared(vec2(center.x, center.z));
        if under < 0.0 { f32::NEG_INFINITY } else { center.y + under.sqrt() }
    }
}

/// Moves and sizes every sphere in turn, by steps that grow with success and shrink without, so that the envelope of all
/// follows the samples.
fn settle(caps: &mut [Cap], samples: &[Vec3], largest: f32) {
    let spacing = extent(samples).max_element() / SAMPLES;
    let places: Vec<Vec2> = samples.iter().map(|point| vec2(point.x, point.z)).collect();
    let tops = |cap: &Cap| -> Vec<f32> { places.iter().map(|at| cap.height(*at)).collect() };
    let mut heights: Vec<Vec<f32>> = caps.iter().map(tops).collect();
    let mut steps = vec![1.0_f32; caps.len()];
    for _ in 0..ROUNDS {
        for index in 0..caps.len() {
            let mut others = vec![f32::NEG_INFINITY; samples.len()];
            for (_, heights) in heights.iter().enumerate().filter(|(other, _)| *other != index) {
                others.iter_mut().zip(heights).for_each(|(top, height)| *top = top.max(*height));
            }
            let error = |cap: &Cap| -> f32 {
                let center = cap.center();
                let (middle, squared) = (vec2(center.x, center.z), cap.radius * cap.radius);
                samples
                    .iter()
                    .zip(&places)
                    .zip(&others)
                    .map(|((sample, at), others)| {
                        let under = squared - at.distance_squared(middle);
                        let top = if under < 0.0 { *others } else { (center.y + under.sqrt()).max(*others) };
                        let above = top.max(sample.y - largest) - sample.y;
                        // Smoke in what rises above the ground would be dark.
                        (if above > 0.0 { 2.0 * above } else { above }).powi(2)
                    })
                    .sum()
            };
            let step = steps[index];
            let old = caps[index];
            let moved = [
                Cap { point: old.point + 0.2 * step * spacing * Vec3::Y, ..old },
                Cap { point: old.point - 0.2 * step * spacing * Vec3::Y, ..old },
                Cap { slope: old.slope + vec2(0.1 * step, 0.0), ..old },
                Cap { slope: old.slope - vec2(0.1 * step, 0.0), ..old },
                Cap { slope: old.slope + vec2(0.0, 0.1 * step), ..old },
                Cap { slope: old.slope - vec2(0.0, 0.1 * step), ..old },
                Cap { radius: (old.radius * (1.0 + 0.5 * step)).min(largest), ..old },
                Cap { radius: old.radius / (1.0 + 0.5 * step), ..old },
            ];
            let best = moved.iter().map(|cap| (error(cap), cap)).min_by(|a, b| a.0.total_cmp(&b.0));
            match best {
                Some((new, cap)) if new < error(&old) => {
                    caps[index] = *cap;
                    heights[index] = tops(cap);
                    steps[index] = (1.5 * step).min(1.0);
                }
                _ => steps[index] *= 0.5,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn field(height: impl Fn(f32, f32) -> f32) -> HeightField {
        let (columns, rows, size) = (33, 25, vec2(40.0, 30.0));
        let at = |index: usize, count: usize, length: f32| (index as f32 / (count - 1) as f32 - 0.5) * length;
        let heights = (0..rows * columns)
            .map(|index| height(at(index % columns, columns, size.x), at(index / columns, rows, size.y)))
            .collect();
        HeightField { size, columns, heights }
    }

    #[test]
    fn spheres_follow_ground() {
        // (what, spheres, error that is allowed, as measured and a third)
        let hill = |x: f32, z: f32| 4.0 * (-(x * x + z * z) / 100.0).exp();
        for (name, field, most) in [
            ("flat", field(|_, _| 2.0), 0.1),
            ("slope", field(|x, z| 0.4 * x - 0.2 * z), 0.15),
            ("hill", field(hill), 0.15),
            ("hollow", field(|x, z| -hill(x, z)), 0.25),
        ] {
            let fit = fit_ground(&field, 20).unwrap();
            assert_eq!(fit.spheres.len(), 20);
            assert!(fit.height_rms < most, "{name}: {fit:?}");
            let few = fit_ground(&field, 5).unwrap();
            assert!(fit.height_rms < 0.6 * few.height_rms, "{name}: {} and {}", fit.height_rms, few.height_rms);
            // The error is that of the spheres as they are handed out.
            let above = |index: usize| {
                let point = field.point(index);
                let tops = fit.spheres.iter().filter_map(|sphere| {
                    let flat = vec2(point.x - sphere.center.x, point.z - sphere.center.z);
                    let under = sphere.radius * sphere.radius - flat.length_squared();
                    (under >= 0.0).then(|| sphere.center.y + under.sqrt())
                });
                tops.fold(f32::NEG_INFINITY, f32::max) - point.y
            };
            let squares: f32 = (0..field.heights.len()).map(|index| above(index).powi(2)).sum();
            assert!(((squares / field.heights.len() as f32).sqrt() / fit.height_rms - 1.0).abs() < 1e-3, "{name}");
        }
    }

    #[test]
    fn a_mesh_is_seen_from_above() {
        let corner = |x: f32, z: f32| vec3(10.0 + x, 0.25 * x, -5.0 + z);
        let mut mesh = TriangleMesh {
            positions: vec![corner(-4.0, -2.0), corner(-4.0, 2.0), corner(4.0, 2.0), corner(4.0, -2.0)],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
        };
        let (field, middle) = HeightField::of_mesh(&mesh, 16).unwrap();
        assert_eq!((field.size, middle), (vec2(8.0, 4.0), vec3(10.0, 0.0, -5.0)));
        for index in 0..field.heights.len() {
            let point = field.point(index);
            // Points at the edge are looked at a hair within it.
            assert!((point.y - 0.25 * point.x).abs() < 1e-3, "{point}");
        }
        assert!(fit_ground(&field, 6).unwrap().height_rms < 0.05);
        mesh.positions.iter_mut().for_each(|point| point.z = 1.0);
        assert_eq!(HeightField::of_mesh(&mesh, 16), Err(FitFailure::BadGround));
    }

    #[test]
    fn bad_fields_are_refused() {
        let good = field(|x, _| x);
        assert!(fit_ground(&good, 3).is_ok());
        assert_eq!(fit_ground(&good, 0).unwrap().spheres, []);
        for bad in [
            HeightField::default(),
            HeightField { size: vec2(0.0, 1.0), ..good.clone() },
            HeightField { columns: 34, ..good.clone() },
            HeightField { columns: good.heights.len(), ..good.clone() },
            HeightField { heights: vec![f32::NAN; good.heights.len()], ..good.clone() },
        ] {
            assert_eq!(fit_ground(&bad, 3), Err(FitFailure::BadGround));
        }
    }
}
