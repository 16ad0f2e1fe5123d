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
        center: solid.lattice.to_space(ball.center),
        radius: ball.radius * solid.lattice.cell,
        part: ball.part,
    };
    let balls = cover.balls.iter().map(|ball| to_space(&coarse, ball));

    let fine = solid(mesh, places, fine)?;
    let mut cover = Cover::new(&fine);
    for ball in balls {
        cover.add(Ball {
            center: fine.lattice.from_space(ball.center),
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
        let seeds: Vec<usize> = places.iter().map(|(place, _)| lattice.index_of(lattice.from_space(*place))).collect();
        for (part, nearest) in part.iter_mut().zip(lattice.flood(&seeds)) {
            if *part != OUTSIDE {
                *part = places[nearest as usize].1;
            }
        }
    }
    Ok(Solid { lattice, part })
}
