//! What is between two frames.

use std::sync::Arc;

use glam::UVec3;

use crate::bundle::SmokeFrame;
use crate::density::GridShape;
use crate::playback::Moment;
use crate::rbf::{Rbf, RbfModel};
use crate::residual::{HashedResidual, QuantizationLaw};

const SHAPE: GridShape = GridShape::new(UVec3::new(4, 4, 4));

fn rbf(x: f32, radius: f32, weight: f32) -> Rbf {
    Rbf { center: [x, -x, 2.0 * x], radius, weight }
}

fn frame(rbfs: &[(u32, Rbf)], residual: HashedResidual) -> Arc<SmokeFrame> {
    let (ids, rbfs) = rbfs.iter().copied().unzip();
    Arc::new(SmokeFrame { rbfs: RbfModel { rbfs }, ids, residual })
}

/// 1 in the first cell: one bucket and a table as long as the grid put it into slot 0.
fn residual() -> HashedResidual {
    let law = QuantizationLaw { max: 1.0, exponent: 1.0 };
    HashedResidual::from_parts(SHAPE, law, vec![1, 0], &[127], 1, vec![0], 64).unwrap()
}

fn between(blend: f32) -> Moment {
    let from = frame(&[(7, rbf(0.0, 0.1, 1.0)), (3, rbf(0.25, 0.2, 2.0))], HashedResidual::empty(SHAPE));
    let to = frame(&[(9, rbf(-0.25, 0.3, 4.0)), (7, rbf(0.5, 0.3, 3.0))], residual());
    Moment { from, to, blend, max_density: 1.0 }
}

#[test]
fn rbfs_of_the_same_number_move_and_others_fade() {
    // All these numbers are exact in f32.
    let moment = between(0.25);
    let [moved, gone, come] = moment.rbfs().rbfs[..] else { panic!("{:?}", moment.rbfs()) };
    assert_eq!((moved.center, moved.weight), ([0.125, -0.125, 0.25], 1.5));
    assert!((moved.radius - 0.15).abs() < 1e-7);
    assert_eq!(gone, rbf(0.25, 0.2, 1.5));
    assert_eq!(come, rbf(-0.25, 0.3, 1.0));
}

/// Nearly at a frame it looks nearly like that frame.
#[test]
fn both_ends_are_the_frames() {
    assert_eq!(between(0.0).rbfs(), between(0.0).from.rbfs);
    assert_eq!(between(0.0).decode(), between(0.0).from.decode());
    let moment = between(1.0 - 1e-6);
    for (between, there) in moment.decode().into_iter().zip(moment.to.decode()) {
        // Densities are below 6, and change by at most that over a whole frame.
        assert!((between - there).abs() < 1e-5, "{between} where the frame has {there}");
    }
}

#[test]
fn residuals_are_blended() {
    let moment = between(0.5);
    let rbfs = moment.rbfs().rasterize(SHAPE);
    let density = moment.decode();
    assert!((density[0] - rbfs[0] - 0.5).abs() < 1e-6, "half of a residual of 1");
    assert_eq!(density[1..], rbfs[1..]);
}

#[test]
fn moments_are_told_apart_by_frames_and_blend() {
    let moment = between(0.5);
    assert!(moment.is_same(&moment.clone()));
    assert!(!moment.is_same(&Moment { blend: 0.25, ..moment.clone() }));
    assert!(!moment.is_same(&between(0.5)), "equal frames, but others in memory");
}
