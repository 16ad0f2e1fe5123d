//! A grid's transform: from index space, where voxel (i, j, k) has its centre at (i, j, k), to the world.

use glam::{DMat4, DVec3, IVec3};

use super::super::Placement;
use super::DensityError;
use super::cursor::Cursor;

/// Axes may differ by this much, relative to the size of a voxel, and count as alike: what single-precision authoring
/// leaves behind, and a hundredth of a voxel across a thousand.
const TOLERANCE: f64 = 1e-5;

/// The world position of index position p is `self.0 · p`.
#[derive(Clone, Copy)]
pub(super) struct Transform(DMat4);

impl Transform {
    pub fn read(at: &mut Cursor) -> Result<Transform, DensityError> {
        const WHAT: &str = "a grid's transform";
        let kind = at.string(WHAT)?;
        let mut vector = || Ok::<_, DensityError>(DVec3::new(at.f64(WHAT)?, at.f64(WHAT)?, at.f64(WHAT)?));
        let matrix = match kind.as_str() {
            "TranslationMap" => DMat4::from_translation(vector()?),
            // Behind a scale come four vectors derived from it.
            "ScaleMap" | "UniformScaleMap" => {
                let [scale, ..] = [vector()?, vector()?, vector()?, vector()?, vector()?];
                DMat4::from_scale(scale)
            }
            "ScaleTranslateMap" | "UniformScaleTranslateMap" => {
                let [translation, scale, ..] = [vector()?, vector()?, vector()?, vector()?, vector()?, vector()?];
                DMat4::from_translation(translation) * DMat4::from_scale(scale)
            }
            // OpenVDB multiplies row vectors from the left, so its rows are our columns.
            "AffineMap" | "UnitaryMap" => {
                let mut columns = [0.0; 16];
                for element in &mut columns {
                    *element = at.f64(WHAT)?;
                }
                DMat4::from_cols_array(&columns)
            }
            "NonlinearFrustumMap" => {
                return Err(DensityError::Unsupported(
                    "the grid's transform is a camera frustum, not a box: resample it into a box".into(),
                ));
            }
            _ => {
                return Err(DensityError::Unsupported(format!("a transform of kind \"{kind}\" is not known")));
            }
        };
        Ok(Transform(matrix))
    }

    /// The placement of the box of voxels `min..=max`, or what is wrong with the transform, as the end of a sentence.
    pub fn placement(&self, min: IVec3, max: IVec3) -> Result<Placement, &'static str> {
        let matrix = self.0;
        if !matrix.is_finite() {
            return Err("is not finite");
        }
        let voxel_size = matrix.x_axis.x;
        let tolerance = TOLERANCE * matrix.x_axis.truncate().length();
        for (axis, column) in [matrix.x_axis, matrix.y_axis, matrix.z_axis].into_iter().enumerate() {
            if column.w != 0.0 {
                return Err("has a perspective");
            }
            if (0..3).any(|other| other != axis && column[other].abs() > tolerance) {
                return Err("rotates or shears");
            }
            if column[axis] <= 0.0 {
                return Err("mirrors or flattens");
            }
            if (column[axis] - voxel_size).abs() > tolerance {
                return Err("scales the axes differently");
            }
        }
        let center = matrix.transform_point3(0.5 * (min.as_dvec3() + max.as_dvec3()));
        if !center.is_finite() {
            return Err("leads out of the range of numbers");
        }
        Ok(Placement { center, voxel_size })
    }
}
