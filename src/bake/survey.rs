//! The first look at a sequence: one box for all frames.

use std::path::{Path, PathBuf};

use glam::{DVec3, I64Vec3, IVec3};
use rayon::prelude::*;

use super::BakeError;
use crate::bundle;
use crate::density::{self, DensityError, DensityGrid, GridShape, Placement, SourceInfo};

/// Two grids are the same where their voxels are, to this share of a voxel.
const ALIGNMENT: f64 = 1e-3;

/// The box that the active voxels of all frames share, and where there is smoke.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Survey {
    /// Index of the box's first cell.
    pub min: IVec3,
    pub shape: GridShape,
    pub placement: Placement,
    /// The first input that has any smoke; the number of inputs if none has.
    pub first_smoke: usize,
}

/// What is kept of an input while all are looked at.
struct Outline {
    min: IVec3,
    shape: GridShape,
    placement: Placement,
    smoke: bool,
}

impl Outline {
    /// World position of index 0, lower corner.
    fn origin(&self) -> DVec3 {
        self.placement.center - self.placement.voxel_size * (self.min.as_dvec3() + 0.5 * self.shape.dims.as_dvec3())
    }
}

/// Reads all inputs, as many at a time as there are threads. `done` is called after each, from any thread.
pub(super) fn survey(inputs: &[PathBuf], grid: Option<&str>, done: &(dyn Fn() + Sync)) -> Result<Survey, BakeError> {
    let outlines: Vec<Option<Outline>> = inputs
        .par_iter()
        .map(|path| {
            let outline = read(path, grid)?.map(|grid| Outline {
                min: grid.source.index_min,
                shape: grid.shape,
                placement: grid.placement,
                smoke: grid.max() > 0.0,
            });
            done();
            Ok(outline)
        })
        .collect::<Result<_, BakeError>>()?;
    combine(inputs, &outlines)
}

/// The box of all. Inputs without active voxels have no outline.
fn combine(inputs: &[PathBuf], outlines: &[Option<Outline>]) -> Result<Survey, BakeError> {
    let mut found = inputs.iter().zip(outlines).filter_map(|(path, outline)| Some((path, outline.as_ref()?)));
    let Some((first_path, first)) = found.next() else {
        let problem = format!("{}: no input has any active voxels", inputs[0].display());
        return Err(BakeError::Inputs(problem));
    };
    let (mut min, mut end) = (first.min.as_i64vec3(), first.min.as_i64vec3() + first.shape.dims.as_i64vec3());
    for (path, outline) in found {
        check_grid((first_path, first), (path, outline))?;
        min = min.min(outline.min.as_i64vec3());
        end = end.max(outline.min.as_i64vec3() + outline.shape.dims.as_i64vec3());
    }
    let dims = end - min;
    // Sides are far within 32 bits, but for frames that are worlds apart.
    if dims.cmpgt(I64Vec3::splat(bundle::MAX_SIDE.into())).any() {
        let problem = format!("all frames together take {dims} cells; a side has at most {}", bundle::MAX_SIDE);
        return Err(BakeError::Inputs(problem));
    }
    let shape = GridShape::new(dims.as_uvec3());
    bundle::check_shape(shape)?;
    let moved = (min - first.min.as_i64vec3()).as_dvec3() + 0.5 * (dims.as_dvec3() - first.shape.dims.as_dvec3());
    let Placement { center, voxel_size } = first.placement;
    Ok(Survey {
        min: min.as_ivec3(),
        shape,
        placement: Placement { center: center + voxel_size * moved, voxel_size },
        first_smoke: outlines.iter().position(|o| o.as_ref().is_some_and(|o| o.smoke)).unwrap_or(inputs.len()),
    })
}

fn check_grid(a: (&Path, &Outline), b: (&Path, &Outline)) -> Result<(), BakeError> {
    let ((path_a, a), (path_b, b)) = (a, b);
    let (path_a, path_b) = (path_a.display(), path_b.display());
    let (size_a, size_b) = (a.placement.voxel_size, b.placement.voxel_size);
    // Voxels of the farthest corner stay where they are.
    let reach = f64::from(a.shape.longest().max(b.shape.longest()));
    if (size_b / size_a - 1.0).abs() * reach > ALIGNMENT {
        let problem =
            format!("voxels of {path_b} have size {size_b}, those of {path_a} {size_a}: all frames need the same");
        return Err(BakeError::Inputs(problem));
    }
    let apart = (b.origin() - a.origin()) / size_a;
    if apart.abs().max_element() > ALIGNMENT {
        let [ax, ay, az] = a.shape.dims.to_array();
        let [bx, by, bz] = b.shape.dims.to_array();
        let problem = format!(
            "the grids of {path_a} ({ax} × {ay} × {az} cells) and {path_b} ({bx} × {by} × {bz}) lie {apart} voxels apart: all frames need the same grid"
        );
        return Err(BakeError::Inputs(problem));
    }
    Ok(())
}

impl Survey {
    /// Reads a frame in the box of all.
    pub fn read(&self, path: &Path, grid: Option<&str>) -> Result<DensityGrid, BakeError> {
        let Some(grid) = read(path, grid)? else {
            let source = SourceInfo { index_min: self.min, ..SourceInfo::default() };
            let values = vec![0.0; self.shape.len()];
            return Ok(DensityGrid { shape: self.shape, values, placement: self.placement, source });
        };
        let (min, end) = (grid.source.index_min.as_i64vec3(), self.min.as_i64vec3() + self.shape.dims.as_i64vec3());
        let inside = min.cmpge(self.min.as_i64vec3()) & (min + grid.shape.dims.as_i64vec3()).cmple(end);
        if !inside.all() {
            return Err(BakeError::Inputs(format!("{} has changed while it was being baked", path.display())));
        }
        let grid = if grid.source.index_min == self.min && grid.shape == self.shape {
            grid
        } else {
            grid.reframed(self.min, self.shape)
        };
        Ok(DensityGrid { placement: self.placement, ..grid })
    }
}

/// Reads a file; nothing where it has no active voxels, which is a frame without smoke.
fn read(path: &Path, grid: Option<&str>) -> Result<Option<DensityGrid>, BakeError> {
    match density::read(path, grid) {
        Ok(grid) => Ok(Some(grid)),
        Err(DensityError::File { source, .. }) if matches!(*source, DensityError::Empty(_)) => Ok(None),
        Err(error) => Err(error.into()),
    }
}

#[cfg(test)]
mod tests {
    use glam::UVec3;

    use super::*;

    /// A box of a grid whose voxel of index 0 has its lower corner at (1, 2, 3).
    fn outline(min: [i32; 3], dims: [u32; 3], voxel_size: f64) -> Option<Outline> {
        let (min, dims) = (IVec3::from_array(min), UVec3::from_array(dims));
        let center = DVec3::new(1.0, 2.0, 3.0) + voxel_size * (min.as_dvec3() + 0.5 * dims.as_dvec3());
        Some(Outline { min, shape: GridShape::new(dims), placement: Placement { center, voxel_size }, smoke: true })
    }

    fn combined(outlines: &[Option<Outline>]) -> Result<Survey, String> {
        let inputs: Vec<PathBuf> = ["a.vdb", "b.vdb", "c.vdb"].map(PathBuf::from).into();
        combine(&inputs[..outlines.len()], outlines).map_err(|error| error.to_string())
    }

    #[test]
    fn the_box_holds_all_boxes() {
        let outlines = [None, outline([-3, 10, 0], [4, 5, 6], 0.5), outline([-1, 2, 3], [4, 5, 9], 0.5)];
        let survey = combined(&outlines).unwrap();
        assert_eq!((survey.min, survey.shape.dims), (IVec3::new(-3, 2, 0), UVec3::new(6, 13, 12)));
        assert_eq!(survey.first_smoke, 1);
        let corner = survey.placement.center - 0.25 * survey.shape.dims.as_dvec3();
        assert_eq!(corner, DVec3::new(1.0 - 1.5, 2.0 + 1.0, 3.0));
    }

    #[test]
    fn frames_of_different_grids_are_refused() {
        let first = || outline([0, 0, 0], [8, 8, 8], 0.5);
        let refusal = |other| combined(&[first(), first(), other]).unwrap_err();
        let sizes = refusal(outline([0, 0, 0], [8, 8, 8], 0.6));
        assert!(sizes.contains("c.vdb have size 0.6, those of a.vdb 0.5"), "{sizes}");
        let mut moved = outline([0, 0, 0], [8, 8, 8], 0.5);
        moved.as_mut().unwrap().placement.center.y += 0.25;
        let apart = refusal(moved);
        assert!(
            apart.contains("a.vdb") && apart.contains("c.vdb") && apart.contains("0.5, 0] voxels apart"),
            "{apart}"
        );
        assert!(refusal(outline([5000, 0, 0], [8, 8, 8], 0.5)).contains("a side has at most"));
        assert!(combined(&[None, None]).unwrap_err().contains("no input has any active voxels"));
        // Rounding in a file is no difference.
        assert!(combined(&[first(), outline([0, 0, 0], [8, 8, 8], 0.5 + 1e-9)]).is_ok());
    }
}
