//! The renderer's GPU passes once more, on the CPU and in f64: what tests and charts compare with.
//!
//! One file per pass, named like the pass, in the order they run. Each does what its pass is specified to do in the
//! most obvious way, and is itself tested against closed forms. Everything is in bundle space, in bundle axes; `sigma`
//! is extinction per bundle unit, σ_t times the world length of the box's longest side.
//!
//! Beside the passes: [`single`], single scattering without any of the method's approximations, [`voxel_single`], the same
//! fast enough for every frame of an animation, [`path`], a path tracer for any number of scattering events and any
//! light, [`paper`], the method of Zhou et al. 2008 as printed, [`constellation`], that of Navarro et al. 2008, [`diffusion`], its diffusion equation put right and solved
//! on a grid, [`sphere`], which tells the two apart, [`compare`], the error of an image, and [`flicker`], that of an
//! animation over time.

pub mod coarse;
pub mod compare;
pub mod constellation;
pub mod debug;
pub mod density;
pub mod diffusion;
pub mod environment;
pub mod flicker;
pub mod incident_light;
pub mod irradiance;
pub mod lamp;
pub mod lattice;
pub mod occlusion;
pub mod outgoing;
pub mod paper;
pub mod path;
pub mod shadow_probes;
pub mod single;
pub mod sphere;
pub mod surface;
pub mod surroundings;
pub mod taylor;
pub mod transport;
pub mod view;
pub mod volume;
pub mod voxel_single;

use glam::{DVec3, IVec3, UVec3, Vec3};

use crate::{density::GridShape, rbf::Rbf};

/// Directions in which a probe looks for light.
pub const DIRECTIONS: usize = 64;
/// Samples of the coarse density along each of them.
pub const MARCH_STEPS: usize = 20;

/// Probes of an RBF.
pub const PROBES: usize = 7;
/// From the centre of an RBF to its probes, in units of their [reach](incident_light::reach): the centre itself, and both
/// ways along each axis.
pub const PROBE_OFFSETS: [DVec3; PROBES] =
    [DVec3::ZERO, DVec3::X, DVec3::NEG_X, DVec3::Y, DVec3::NEG_Y, DVec3::Z, DVec3::NEG_Z];

/// What smoke does to light.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Medium {
    /// Extinction per bundle unit and unit of density, ≥ 0.
    pub sigma: f64,
    /// Scattered share of the extinction, per RGB channel, 0 to 1.
    pub albedo: DVec3,
    /// Mean cosine of the Henyey–Greenstein phase function, −1 < g < 1, positive forward.
    pub g: f64,
}

/// A value per cell of a box; trilinear between cell centres, zero outside.
#[derive(Clone, Debug, PartialEq)]
pub struct Grid {
    /// The cells.
    pub shape: GridShape,
    /// One value per cell, in flat index order.
    pub values: Vec<f64>,
}

impl Grid {
    /// The value at a point in bundle space.
    pub fn sample(&self, x: DVec3) -> f64 {
        let dims = self.shape.dims.as_dvec3();
        trilinear(x * f64::from(self.shape.longest()) + 0.5 * dims - 0.5)
            .filter(|(cell, _)| (cell.cmpge(IVec3::ZERO) & cell.cmplt(self.shape.dims.as_ivec3())).all())
            .map(|(cell, weight)| weight * self.values[self.shape.index(cell.as_uvec3())])
            .sum()
    }
}

/// The eight cells around `position`, measured in cells with cell centres at whole numbers, and their weights.
fn trilinear(position: DVec3) -> impl Iterator<Item = (IVec3, f64)> {
    let base = position.floor();
    let f = position - base;
    (0..8).map(move |corner| {
        let offset = IVec3::new(corner & 1, corner >> 1 & 1, corner >> 2);
        let weight = |axis: usize| if offset[axis] == 1 { f[axis] } else { 1.0 - f[axis] };
        (base.as_ivec3() + offset, weight(0) * weight(1) * weight(2))
    })
}

/// The centre of a cell in bundle space.
fn center(shape: GridShape, cell: UVec3) -> DVec3 {
    (cell.as_dvec3() + 0.5 - 0.5 * shape.dims.as_dvec3()) * cell_size(shape)
}

/// The side of a cell in bundle space.
fn cell_size(shape: GridShape) -> f64 {
    1.0 / f64::from(shape.longest())
}

/// The centre of an RBF, which is stored in f32.
fn rbf_center(rbf: &Rbf) -> DVec3 {
    Vec3::from(rbf.center).as_dvec3()
}

/// Half the sides of the box in bundle space.
fn half_extent(shape: GridShape) -> DVec3 {
    shape.dims.as_dvec3() * (0.5 * cell_size(shape))
}

/// A half-line in bundle space, cut at an opaque surface if there is one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Where it starts: the eye, or a point on the near plane.
    pub origin: DVec3,
    /// Unit vector along it.
    pub dir: DVec3,
    /// Distance to the first opaque surface; infinite if there is none.
    pub t_max: f64,
}

impl Ray {
    /// An unobstructed ray; `dir` is a unit vector.
    pub fn new(origin: DVec3, dir: DVec3) -> Self {
        Self { origin, dir, t_max: f64::INFINITY }
    }

    /// The point at distance `t`.
    pub fn at(&self, t: f64) -> DVec3 {
        self.origin + self.dir * t
    }

    /// The distances between which the ray is in the box of these half sides centred on the origin, in front of its
    /// start and of any opaque surface; `None` where it is not.
    pub fn clip(&self, half_extent: DVec3) -> Option<(f64, f64)> {
        let (mut start, mut end) = (0.0f64, self.t_max);
        for axis in 0..3 {
            let (origin, dir, half) = (self.origin[axis], self.dir[axis], half_extent[axis]);
            if dir == 0.0 {
                if origin.abs() > half {
                    return None;
                }
            } else {
                let (a, b) = ((-half - origin) / dir, (half - origin) / dir);
                start = start.max(a.min(b));
                end = end.min(a.max(b));
            }
        }
        (start < end).then_some((start, end))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sampling_is_trilinear_and_zero_outside() {
        let shape = GridShape::new(UVec3::new(5, 4, 3));
        let linear = |x: DVec3| 2.0 + x.x - 3.0 * x.y + 0.5 * x.z + 4.0 * x.x * x.y * x.z;
        let grid = Grid { shape, values: (0..60).map(|i| linear(center(shape, shape.cell(i)))).collect() };
        // Within the outermost centres (0.4, 0.3, 0.2) a trilinear function is reproduced.
        for x in [DVec3::ZERO, DVec3::new(0.39, -0.29, 0.05), DVec3::new(-0.4, 0.3, -0.2)] {
            assert!((grid.sample(x) - linear(x)).abs() < 1e-14);
        }
        // On the box's face, half a cell out, half is left; a cell out, nothing.
        let corner = DVec3::new(0.4, 0.0, 0.0);
        assert!((grid.sample(corner + DVec3::X * 0.1) - 0.5 * linear(corner)).abs() < 1e-14);
        assert_eq!(grid.sample(corner + DVec3::X * 0.2), 0.0);
        assert_eq!(grid.sample(DVec3::splat(7.0)), 0.0);
        // The f64 helpers agree with the shape's own f32.
        assert!((center(shape, UVec3::new(4, 0, 1)).as_vec3() - shape.center(UVec3::new(4, 0, 1))).length() < 1e-7);
        assert!((half_extent(shape).as_vec3() - shape.half_extent()).length() < 1e-7);
    }

    #[test]
    fn rays_are_clipped() {
        let half = DVec3::new(0.5, 0.25, 0.125);
        let ray = Ray::new(DVec3::new(-2.0, 0.0, 0.0), DVec3::X);
        assert_eq!(ray.clip(half), Some((1.5, 2.5)));
        assert_eq!(Ray { t_max: 2.0, ..ray }.clip(half), Some((1.5, 2.0)));
        assert_eq!(Ray { t_max: 1.0, ..ray }.clip(half), None);
        assert_eq!(Ray { t_max: 1.5, ..ray }.clip(half), None, "a point is no stretch to march");
        assert_eq!(Ray::new(DVec3::ZERO, -DVec3::Y).clip(half), Some((0.0, 0.25)));
        assert_eq!(Ray::new(DVec3::new(-2.0, 0.3, 0.0), DVec3::X).clip(half), None);
        assert_eq!(Ray::new(DVec3::new(2.0, 0.0, 0.0), DVec3::X).clip(half), None);
        let slanted = Ray::new(DVec3::new(0.5, 0.0, 0.0), DVec3::new(-0.6, 0.8, 0.0));
        let (start, end) = slanted.clip(half).unwrap();
        assert!(start == 0.0 && (end - 0.3125).abs() < 1e-15);
    }
}
