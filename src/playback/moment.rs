//! A moment of an animation: a frame, or something between two.

use std::sync::Arc;

use bevy::platform::collections::{HashMap, HashSet};

use crate::bundle::SmokeFrame;
use crate::density::GridShape;
use crate::rbf::{Rbf, RbfModel};

/// A moment of an animation: a blend of two frames, which may be the same one.
///
/// RBFs that both frames have (by [`ids`](SmokeFrame::ids)) move: centre, radius and weight are interpolated. Others fade:
/// weight times 1 − `blend` or `blend`. Residuals are blended cell by cell.
#[derive(Clone, Debug)]
pub struct Moment {
    /// The frame that counts 1 − `blend`.
    pub from: Arc<SmokeFrame>,
    /// The frame that counts `blend`, on the same cells; the same frame where `blend` is 0.
    pub to: Arc<SmokeFrame>,
    /// 0 up to but not including 1.
    pub blend: f32,
    /// The largest density of any frame of the animation.
    pub max_density: f32,
}

impl Moment {
    /// A frame as it is.
    pub fn frame(frame: Arc<SmokeFrame>, max_density: f32) -> Self {
        Self { to: frame.clone(), from: frame, blend: 0.0, max_density }
    }

    /// The cells of both frames.
    pub fn shape(&self) -> GridShape {
        self.from.residual.shape()
    }

    /// The density that the renderer's scaled density is 1 at: the largest, or 1 where there is none. Above 0.
    pub(crate) fn density_scale(&self) -> f32 {
        if self.max_density > 0.0 { self.max_density } else { 1.0 }
    }

    /// Whether this is the same blend of the same frames in memory.
    pub fn is_same(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.from, &other.from) && Arc::ptr_eq(&self.to, &other.to) && self.blend == other.blend
    }

    /// The Gaussians: those of `from` in their order, then those that only `to` has.
    pub fn rbfs(&self) -> RbfModel {
        let from = &self.from.rbfs.rbfs;
        if self.blend == 0.0 {
            return RbfModel { rbfs: from.clone() };
        }
        let t = self.blend;
        let to = self.to.ids.iter().copied().zip(&self.to.rbfs.rbfs);
        let mut arriving: HashMap<u32, Rbf> = to.clone().map(|(id, rbf)| (id, *rbf)).collect();
        let mut rbfs: Vec<Rbf> = self
            .from
            .ids
            .iter()
            .zip(from)
            .map(|(id, a)| match arriving.remove(id) {
                Some(b) => mix(a, &b, t),
                None => Rbf { weight: (1.0 - t) * a.weight, ..*a },
            })
            .collect();
        let only_there = to.filter(|(id, _)| arriving.contains_key(id));
        rbfs.extend(only_there.map(|(_, b)| Rbf { weight: t * b.weight, ..*b }));
        RbfModel { rbfs }
    }

    /// Whether each of [`rbfs`](Self::rbfs) is in both frames; the others come or go.
    pub fn stays(&self) -> Vec<bool> {
        let (from, to) = (&self.from.ids, &self.to.ids);
        if self.blend == 0.0 {
            return vec![true; from.len()];
        }
        let (in_from, in_to): (HashSet<u32>, HashSet<u32>) =
            (from.iter().copied().collect(), to.iter().copied().collect());
        let mut stays: Vec<bool> = from.iter().map(|id| in_to.contains(id)).collect();
        stays.resize(from.len() + to.iter().filter(|id| !in_from.contains(*id)).count(), false);
        stays
    }

    /// The density of every cell, in flat order: what the GPU's density pass computes.
    pub fn decode(&self) -> Vec<f32> {
        let mut density = self.rbfs().rasterize(self.shape());
        let (from, to) = (self.from.residual.decode_all(), self.to.residual.decode_all());
        for ((d, a), b) in density.iter_mut().zip(from).zip(to) {
            *d = (*d + (1.0 - self.blend) * a + self.blend * b).max(0.0);
        }
        density
    }
}

fn mix(a: &Rbf, b: &Rbf, t: f32) -> Rbf {
    let mix = |a: f32, b: f32| (1.0 - t) * a + t * b;
    Rbf {
        center: [0, 1, 2].map(|axis| mix(a.center[axis], b.center[axis])),
        radius: mix(a.radius, b.radius),
        weight: mix(a.weight, b.weight),
    }
}
