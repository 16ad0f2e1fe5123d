//! Spheres that stand for the inside of a mesh.
//!
//! The mesh becomes cells, and spheres are chosen whose union differs from the cells inside by as little volume as possible,
//! on both sides of the surface, where volume outside counts half: greedily at first, each sphere where it brings the most,
//! then one after another is moved and sized for the best, and those that bring least go to where they bring most. Wang et
//! al. 2006, *Variational Sphere Set Approximation for Solid Objects*, minimise the volume outside of spheres that cover
//! everything; spheres that may leave out some make the better shadow where they are few.

use glam::Vec3;

use super::OccluderSphere;
use super::cover::{Ball, Cover, OUTSIDE, Solid};
use super::silhouette::silhouette_error;
use super::solid::{Lattice, TriangleMesh, inside};

/// Cells inside a mesh where spheres are first placed, and where they are then fitted. Weighing cells by the inverse of the
/// thickness about them, so that sums are areas of outlines, was tried and brought nothing.
const CELLS: [usize; 2] = [6_000, 30_000];
/// Centres that are tried for each sphere as it is placed.
const CANDIDATES: usize = 3_000;
/// Rounds over all spheres with steps of one size.
const ROUNDS: usize = 10;

/// Spheres fitted to a mesh.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SphereFit {
    /// The spheres, as many as were asked for or fewer where more would bring nothing.
    pub spheres: Vec<OccluderSphere>,
    /// How close they are; that of a skinned mesh in its bind pose.
    pub error: FitError,
}

/// How close spheres are to the mesh they stand for.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FitError {
    /// Volume of the mesh, in units of its positions.
    pub volume: f32,
    /// Volume in the spheres or in the mesh but not in both, over that of the mesh.
    pub difference: f32,
    /// Volume in the spheres but not in the mesh, over that of the mesh: a part of `difference`.
    pub outside: f32,
    /// Area in which outlines differ, over that of the mesh's: means over directions. What a shadow sees.
    pub silhouette: f32,
}

/// Why no spheres can be fitted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FitFailure {
    /// The mesh is only in the render world.
    #[error("its vertices are on the GPU only: load it with RenderAssetUsages::MAIN_WORLD too, or fit it beforehand")]
    NotInMainWorld,
    /// The mesh has no positions of three floats.
    #[error("it has no positions")]
    NoPositions,
    /// The mesh has no triangles.
    #[error("it has no triangles: only triangle lists and strips can be fitted")]
    NoTriangles,
    /// Not all positions are finite, or a triangle has a corner that is not there.
    #[error("a triangle has a corner that is missing or not finite")]
    BadCorner,
    /// The mesh is flat, or open on most sides.
    #[error("it encloses no volume: close it, or fit it as OccluderShape::Ground if it is ground")]
    NoInside,
    /// Joints, weights or inverse bind poses are missing, or a joint has none.
    #[error("its skin is incomplete: every vertex needs joints and weights, and every joint an inverse bind pose")]
    BadSkin,
    /// Ground has no area, not two rows of two heights, or heights that are not finite.
    #[error("it is no ground: that needs an area seen from above, and finite heights")]
    BadGround,
}

/// Fits at most so many spheres to the inside of a mesh, which has to be closed or nearly so; it may overlap itself. Takes
/// some tenths of a second. Flat things need many spheres, for none is thicker than they are.
///
/// # Errors
///
/// [`FitFailure::NoTriangles`], [`FitFailure::BadCorner`], [`FitFailure::NoInside`].
pub fn fit_solid(mesh: &TriangleMesh, spheres: usize) -> Result<SphereFit, FitFailure> {
    let (balls, error) = fit_parts(mesh, |_| Vec::new(), spheres)?;
    let spheres = balls.iter().map(|ball| OccluderSphere::new(ball.center, ball.radius)).collect();
    Ok(SphereFit { spheres, error })
}

/// Fits balls, in the mesh's units, to a mesh of parts: each stands for the inside that is nearest to the places on the
/// surface that are of its part. With no places at all everything is part 0. Places are asked for once the mesh is known to be
/// sound.
pub(super) fn fit_parts(
    mesh: &TriangleMesh,
    places: impl FnOnce(&TriangleMesh) -> Vec<(Vec3, u16)>,
    spheres: usize,
) -> Result<(Vec<Ball>, FitError), FitFailure> {
    if mesh.triangles.is_empty() {
        return Err(FitFailure::NoTriangles);
    }
    let corner_is_good = |corner: &u32| mesh.positions.get(*corner as usize).is_some_and(|corner| corner.is_finite());
    if !mesh.triangles.as_flattened().iter().all(corner_is_good) {
        return Err(FitFailure::BadCorner);
    }
    let places = &places(mesh);
    let [coarse, fine] = CELLS;
    let coarse = solid(mesh, places, coarse)?;
    let mut cover = Cover::new(&coarse);
    place(&mut cover, &coarse, spheres);
    let to_space = |solid: &Solid, ball: &Ball| Ball {
        center: solid.lattice.in_space(ball.center),
        radius: ball.radius * solid.lattice.cell,
        part: ball.part,
    };
    let balls = cover.balls.iter().map(|ball| to_space(&coarse, ball));

    let fine = solid(mesh, places, fine)?;
    let mut cover = Cover::new(&fine);
    for ball in balls {
        cover.add(Ball {
            center: fine.lattice.in_cells(ball.center),
            radius: ball.radius / fine.lattice.cell,
            part: ball.part,
        });
    }
    cover.refine(1.0, 2, ROUNDS);
    let balls: Vec<Ball> = cover.balls.iter().map(|ball| to_space(&fine, ball)).collect();

    let cells = fine.cells_inside().count() as f32;
    let [missing, extra] = cover.errors().map(|cells| cells as f32);
    let discs: Vec<_> = balls.iter().map(|ball| (ball.center, ball.radius)).collect();
    let error = FitError {
        volume: cells * fine.lattice.cell.powi(3),
        difference: (missing + extra) / cells,
        outside: extra / cells,
        silhouette: silhouette_error(mesh, &discs).unwrap_or(0.0),
    };
    Ok((balls, error))
}

/// Places balls where there are none yet.
fn place(cover: &mut Cover, solid: &Solid, balls: usize) {
    let lattice = &solid.lattice;
    let shore: Vec<usize> = (0..lattice.len())
        .filter(|cell| solid.part[*cell] == OUTSIDE && lattice.neighbors(*cell).any(|next| solid.part[next] != OUTSIDE))
        .collect();
    let nearest = lattice.flood(&shore);
    // Larger balls would stick out by more than half their radius.
    let reach = |cell: usize| {
        let depth = lattice.center(cell).distance(lattice.center(shore[nearest[cell] as usize]));
        1.5 * depth + 2.0
    };
    let centers: Vec<usize> = solid.cells_inside().collect();
    let some: Vec<usize> = centers.iter().copied().step_by(centers.len() / CANDIDATES + 1).collect();
    cover.grow(balls, &some, reach);
    cover.refine(1.0, 1, ROUNDS);
    cover.teleport(balls, &centers, reach);
    cover.refine(0.5, 1, ROUNDS);
}

/// A mesh in about so many cells inside, each of the part of the place that it is nearest to.
fn solid(mesh: &TriangleMesh, places: &[(Vec3, u16)], cells: usize) -> Result<Solid, FitFailure> {
    let lattice = Lattice::around(mesh, cells).ok_or(FitFailure::NoInside)?;
    let mut part: Vec<u16> =
        inside(mesh, &lattice).into_iter().map(|inside| if inside { 0 } else { OUTSIDE }).collect();
    if part.iter().all(|part| *part == OUTSIDE) {
        return Err(FitFailure::NoInside);
    }
    if !places.is_empty() {
        let seeds: Vec<usize> = places.iter().map(|(place, _)| lattice.index_of(lattice.in_cells(*place))).collect();
        for (part, nearest) in part.iter_mut().zip(lattice.flood(&seeds)) {
            if *part != OUTSIDE {
                *part = places[nearest as usize].1;
            }
        }
    }
    Ok(Solid { lattice, part })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::occluder::shapes;
    use glam::vec3;
    use proptest::prelude::*;

    #[test]
    fn one_sphere_fits_a_ball() {
        let mut mesh = shapes::box_grid(Vec3::ONE, [16; 3]);
        mesh.positions.iter_mut().for_each(|point| *point = 0.5 * point.normalize());
        let fit = fit_solid(&mesh, 1).unwrap();
        let sphere = fit.spheres[0];
        // Radii are tried in quarters of cells, 1/40 of the diameter each.
        assert!(sphere.center.length() < 0.01 && (sphere.radius - 0.5).abs() < 0.01, "{sphere:?}");
        assert!(fit.error.difference < 0.04 && fit.error.silhouette < 0.03, "{:?}", fit.error);
        let volume = core::f32::consts::PI / 6.0;
        assert!((fit.error.volume / volume - 1.0).abs() < 0.02, "{:?}", fit.error);
    }

    #[test]
    fn more_spheres_are_closer() {
        let mesh = shapes::torus(1.0, 0.3, 48, 16);
        let errors = [6, 12, 24].map(|spheres| fit_solid(&mesh, spheres).unwrap().error);
        assert!(errors.windows(2).all(|pair| pair[1].silhouette < 0.7 * pair[0].silhouette), "{errors:?}");
        assert!(errors.windows(2).all(|pair| pair[1].difference < 0.7 * pair[0].difference), "{errors:?}");
        assert!(errors[2].difference < 0.1 && errors[2].outside <= errors[2].difference, "{errors:?}");
    }

    #[test]
    fn what_cannot_be_fitted_is_refused() {
        let mesh = shapes::box_grid(Vec3::ONE, [1; 3]);
        assert_eq!(fit_solid(&TriangleMesh::default(), 4), Err(FitFailure::NoTriangles));
        let mut bad = mesh.clone();
        bad.triangles[3][1] = 1000;
        assert_eq!(fit_solid(&bad, 4), Err(FitFailure::BadCorner));
        let mut bad = mesh.clone();
        bad.positions[2].y = f32::NAN;
        assert_eq!(fit_solid(&bad, 4), Err(FitFailure::BadCorner));
        let flat = shapes::box_grid(vec3(1.0, 0.0, 1.0), [1; 3]);
        assert_eq!(fit_solid(&flat, 4), Err(FitFailure::NoInside));
        let mut sheet = mesh.clone();
        sheet.positions.iter_mut().for_each(|point| point.y = point.x * point.x + point.z);
        sheet.triangles.truncate(2);
        assert_eq!(fit_solid(&sheet, 4), Err(FitFailure::NoInside));
        assert_eq!(fit_solid(&mesh, 0).unwrap().spheres, []);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(6))]
        /// Wherever a box lies and however large it is, its spheres are the same but for that.
        #[test]
        fn fits_follow_place_and_size(
            size in prop::array::uniform3(0.5_f32..2.0),
            exponent in -8_i32..8,
            place in prop::array::uniform3(-8_i32..8),
        ) {
            let mesh = shapes::box_grid(Vec3::from(size), [1; 3]);
            let fit = fit_solid(&mesh, 7).unwrap();
            prop_assert!(fit.spheres.len() <= 7);
            prop_assert!(fit.error.difference < 0.4, "{:?}", fit.error);
            prop_assert!(fit.spheres.iter().all(|sphere| sphere.center.is_finite() && sphere.radius > 0.0));
            prop_assert_eq!(&fit, &fit_solid(&mesh, 7).unwrap());
            // Powers of two are exact: positions that do not move keep every bit.
            let scale = 2.0_f32.powi(exponent);
            let offset = scale * Vec3::from(place.map(|place| place as f32));
            let mut moved = mesh.clone();
            moved.positions.iter_mut().for_each(|point| *point *= scale);
            let scaled = fit_solid(&moved, 7).unwrap();
            for (a, b) in fit.spheres.iter().zip(&scaled.spheres) {
                prop_assert!((a.center * scale).abs_diff_eq(b.center, 1e-4 * scale) && (a.radius * scale - b.radius).abs() < 1e-4 * scale);
            }
            // Elsewhere rounding may decide otherwise here and there.
            moved.positions.iter_mut().for_each(|point| *point += offset);
            let moved = fit_solid(&moved, 7).unwrap();
            prop_assert!((moved.error.difference - fit.error.difference).abs() < 0.03);
        }
    }
}
