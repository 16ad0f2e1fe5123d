//! Tracking: random distances to collisions, and transmittance, without steps.

use core::ops::ControlFlow;

use glam::{DVec3, IVec3, UVec3};

use super::Rng;
use crate::{
    density::GridShape,
    reference::{Grid, Ray, cell_size, half_extent},
};

/// Cells a side of a block that shares one majorant.
pub(super) const BLOCK: u32 = 4;
/// What majorants have in hand, for rounding in [`Extinction::sample`].
const MARGIN: f64 = 1e-6;

/// The extinction of smoke on a box, and bounds of it.
pub(super) struct Extinction {
    shape: GridShape,
    /// Extinction per bundle unit at the cells of the box and one more, empty, on every side.
    ///
    /// In f32, for half the memory traffic: its rounding is far below the noise of any picture.
    padded: Vec<f32>,
    /// Blocks of [`BLOCK`]³ cells from the box's lowest corner on; the last ones may stick out.
    pub(super) blocks: GridShape,
    /// The largest extinction in each block.
    pub(super) majorants: Vec<f64>,
}

impl Extinction {
    /// `sigma` times a density that is at least 0 everywhere.
    pub(super) fn new(density: &Grid, sigma: f64) -> Self {
        let shape = density.shape;
        let around = GridShape::new(shape.dims + 2);
        let mut padded = vec![0.0; around.len()];
        for (index, value) in density.values.iter().enumerate() {
            padded[around.index(shape.cell(index) + 1)] = (sigma * value) as f32;
        }
        let blocks = GridShape::new(shape.dims.map(|cells| cells.div_ceil(BLOCK)));
        let majorant = |index| {
            // Points of the block reach the cells around it too, for half a cell.
            let low = blocks.cell(index) * BLOCK;
            let high = around.dims.min(low + BLOCK + 2);
            let cells = |axis: usize| low[axis]..high[axis];
            let rows = cells(2).flat_map(|z| cells(1).map(move |y| (y, z)));
            let values = rows.flat_map(|(y, z)| cells(0).map(move |x| around.index(UVec3::new(x, y, z))));
            f64::from(values.map(|i| padded[i]).fold(0.0, f32::max)) * (1.0 + MARGIN)
        };
        let majorants = (0..blocks.len()).map(majorant).collect();
        Self { shape, padded, blocks, majorants }
    }

    /// Extinction at a point of the box, trilinear between cell centres.
    pub(super) fn sample(&self, x: DVec3) -> f64 {
        let dims = self.shape.dims;
        // In cells from the centre of the padded grid's first cell, which is half a cell outside the box.
        let p = (x * f64::from(self.shape.longest()) + 0.5 * dims.as_dvec3() + 0.5)
            .clamp(DVec3::ZERO, dims.as_dvec3() + 0.75);
        let base = p.as_uvec3();
        let f = (p - base.as_dvec3()).as_vec3();
        let (row, layer) = ((dims.x + 2) as usize, ((dims.x + 2) * (dims.y + 2)) as usize);
        let first = base.x as usize + row * base.y as usize + layer * base.z as usize;
        let along_x = |i: usize| {
            let [a, b] = [self.padded[i], self.padded[i + 1]];
            a + f.x * (b - a)
        };
        let in_layer = |i: usize| {
            let [a, b] = [along_x(i), along_x(i + row)];
            a + f.y * (b - a)
        };
        let [a, b] = [in_layer(first), in_layer(first + layer)];
        f64::from(a + f.z * (b - a))
    }

    /// Walks along `ray` through tentative collisions, as dense as the majorants; `visit` hears for each the share of
    /// it that is real (0 to 1), and may end the walk there. Returns the distance where it did, `None` past the smoke.
    fn walk(&self, ray: &Ray, rng: &mut Rng, mut visit: impl FnMut(f64, &mut Rng) -> ControlFlow<()>) -> Option<f64> {
        let half = half_extent(self.shape);
        let (mut t, end) = ray.clip(half)?;
        let side = f64::from(BLOCK) * cell_size(self.shape);
        let last = self.blocks.dims.as_ivec3() - 1;
        // Rounding may put the start into a neighbouring block: the first stretch is then empty.
        let mut block = ((ray.at(t) + half) / side).floor().as_ivec3().clamp(IVec3::ZERO, last);
        let step = ray.dir.map(|d| if d > 0.0 { 1.0 } else { -1.0 }).as_ivec3();
        // Distances to the next face across each axis, and between faces.
        let between = (DVec3::splat(side) / ray.dir).abs();
        let faces = (block + step.max(IVec3::ZERO)).as_dvec3() * side - half;
        let mut exits = (faces - ray.origin) / ray.dir;
        for axis in 0..3 {
            if ray.dir[axis] == 0.0 {
                exits[axis] = f64::INFINITY;
            }
        }
        let mut remaining = rng.exponential();
        loop {
            let axis = if exits.x < exits.y { 0 } else { 1 };
            let axis = if exits.z < exits[axis] { 2 } else { axis };
            let exit = exits[axis].min(end);
            let majorant = self.majorants[self.blocks.index(block.as_uvec3())];
            while majorant * (exit - t) > remaining {
                t += remaining / majorant;
                remaining = rng.exponential();
                if visit(self.sample(ray.at(t)) / majorant, rng).is_break() {
                    return Some(t);
                }
            }
            // Exponential distances have no memory: what is left of one carries over, measured in optical depth.
            remaining -= majorant * (exit - t).max(0.0);
            t = t.max(exit);
            exits[axis] += between[axis];
            block[axis] += step[axis];
            if t >= end || block[axis] < 0 || block[axis] > last[axis] {
                return None;
            }
        }
    }

    /// A random distance to the next collision along `ray`; `None` where it leaves the smoke or meets a surface first.
    /// Delta tracking: a tentative collision is real with the probability of its share.
    pub(super) fn collide(&self, ray: &Ray, rng: &mut Rng) -> Option<f64> {
        self.walk(ray, rng, |share, rng| match rng.uniform() < share {
            true => ControlFlow::Break(()),
            false => ControlFlow::Continue(()),
        })
    }

    /// A random number whose mean is the transmittance along `ray`. Ratio tracking: a tentative collision lets through
    /// what of it is not real.
    pub(super) fn transmittance(&self, ray: &Ray, rng: &mut Rng) -> f64 {
        let mut transmittance = 1.0;
        self.walk(ray, rng, |share, _| {
            transmittance *= 1.0 - share;
            ControlFlow::Continue(())
        });
        transmittance
    }

    /// The transmittance along `ray` by midpoints of steps of at most half a cell.
    pub(super) fn march(&self, ray: &Ray) -> f64 {
        let Some((start, end)) = ray.clip(half_extent(self.shape)) else {
            return 1.0;
        };
        let steps = ((end - start) / (0.5 * cell_size(self.shape))).ceil();
        let step = (end - start) / steps;
        let sum: f64 = (0..steps as usize).map(|i| self.sample(ray.at(start + (i as f64 + 0.5) * step))).sum();
        (-step * sum).exp()
    }
}
