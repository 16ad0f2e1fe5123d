//! What a model costs and how far off its picture is: two small formulas, fitted to measurements by `smoke study quality`.

use super::SmokeModel;

/// Parts of the work of a frame, each of which has a price.
pub const WORK: usize = 9;
/// Parts of the error.
pub const PARTS: usize = 7;
/// Numbers that the logarithm of each is linear in.
pub const FEATURES: usize = 4;

/// What cost and error depend on beside the model.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "bake", derive(serde::Serialize, serde::Deserialize))]
pub struct Setting {
    /// RBFs that the smoke has been baked with; of live smoke, that there may be.
    pub rbfs: f32,
    /// Whether fewer can stand for them: not in live smoke.
    pub is_reducible: bool,
    /// Whether all views can draw at half resolution.
    pub can_halve: bool,
    /// Extinction times density times radius of a typical RBF.
    pub optical_radius: f32,
    /// Mean cosine of the phase function.
    pub g: f32,
    /// Whether light that scatters more than once is drawn.
    pub multiple: bool,
    /// Lamps that light it, a sun among them.
    pub lamps: f32,
    /// Cells of the density grid.
    pub cells: f32,
    /// Pixels that the box covers, in all views.
    pub pixels: f32,
    /// Cells along a ray through the box.
    pub cells_along: f32,
    /// Side of a pixel in cells, at the middle of the box.
    pub cells_a_pixel: f32,
}

/// Milliseconds a unit of each part of [`Setting::work`].
pub type Prices = [f32; WORK];

/// Weights of the features of [`Setting::parts`].
pub type Errors = [[f32; FEATURES]; PARTS];

impl Setting {
    /// RBFs that light is computed at.
    fn lit(&self, model: &SmokeModel) -> f32 {
        if self.is_reducible { self.rbfs.min(model.rbfs as f32) } else { self.rbfs }
    }

    /// 1 where light scatters once.
    pub fn once(&self) -> f32 {
        if self.multiple { 0.0 } else { 1.0 }
    }

    /// ln of the optical radius of the RBFs that light is computed at: where fewer stand for all, they are as much larger. That
    /// of the thinnest or the densest smoke that has been measured, where it is thinner or denser still.
    pub fn radius(&self, model: &SmokeModel) -> f32 {
        self.optical_radius.clamp(0.015, 0.5).ln() + self.fewer(model) / 3.0
    }

    /// ln of how many times as many RBFs there are as light is computed at.
    pub fn fewer(&self, model: &SmokeModel) -> f32 {
        (self.rbfs.max(1.0) / self.lit(model).max(1.0)).ln()
    }

    /// The work of a frame in which everything changes: steps along rays, pixels that are blended, directions that probes
    /// look in, RBFs, pairs of RBFs, pairs times coefficients in sweeps, cells, cells times RBFs, and 1. Lamps are work at each cell,
    /// and four at a time as much as the rest of what an RBF has for it.
    pub fn work(&self, model: &SmokeModel) -> [f32; WORK] {
        let lit = self.lit(model);
        let pairs = if self.multiple { lit * lit } else { 0.0 };
        let coefficients = if self.g == 0.0 { 1.0 } else { 1.0 + (model.order * model.order) as f32 };
        let (marched, blended) = if model.half_resolution && self.can_halve { (0.25, 1.0) } else { (1.0, 0.0) };
        [
            1e-6 * marched * self.pixels * (self.cells_along / model.step),
            1e-6 * blended * self.pixels,
            1e-6 * lit * (model.probes * model.directions) as f32,
            1e-3 * lit,
            1e-6 * pairs,
            1e-6 * pairs * coefficients * SWEEPS.min(model.sweeps as f32),
            1e-6 * self.cells * (1.0 + LAMP * self.lamps),
            1e-9 * self.cells * lit * (1.0 + (0.25 * self.lamps).ceil()),
            1.0,
        ]
    }

    /// Predicted milliseconds of the GPU, density left out, as measured where the prices are from: of light, and of the march.
    pub fn milliseconds(&self, model: &SmokeModel, prices: &Prices) -> Milliseconds {
        let work = self.work(model);
        let parts: [f32; WORK] = core::array::from_fn(|i| prices[i] * work[i]);
        Milliseconds { light: parts[2..].iter().sum(), view: parts[..2].iter().sum() }
    }

    /// The parts of the error, and what the logarithm of each is linear in; None of what is not left out.
    pub fn parts(&self, model: &SmokeModel) -> [Option<[f32; FEATURES]>; PARTS] {
        let (all, once, fewer) = (self.radius(&SmokeModel::FULL), self.once(), self.fewer(model));
        let (order, step) = (model.order as f32, model.step.ln());
        let cut = model.order < 4 && self.g != 0.0 && self.multiple;
        let half = model.half_resolution && self.can_halve;
        [
            // Of the full model, against the truth. Light that scatters more than once hides much.
            Some([1.0, all, all * all, once]),
            // Of fewer RBFs that stand for all.
            (fewer > 0.0).then_some([1.0, all, fewer, once]),
            // Of a probe in the place of seven.
            (model.probes == 1).then(|| [1.0, self.radius(model), once, 0.0]),
            // Of fewer directions.
            (model.directions < 64).then(|| [1.0, (64.0 / model.directions as f32).ln(), once, 0.0]),
            // Of fewer bands: the phase function's are as g to the power of the band.
            cut.then(|| [1.0, order, order * self.g.abs().max(0.01).ln(), 0.0]),
            // Of steps longer than half a cell.
            (model.step > 0.5).then_some([1.0, step, step * step, 0.0]),
            // Of half resolution.
            half.then(|| [1.0, self.cells_a_pixel.max(1e-3).ln(), 0.0, 0.0]),
        ]
    }

    /// Predicted relative RMS error of the picture: the parts add up in squares, as errors do that have nothing to do with
    /// each other.
    pub fn error(&self, model: &SmokeModel, by: &Errors) -> f32 {
        let parts = self.parts(model).into_iter().zip(by);
        parts.filter_map(|(features, weights)| Some(square(&features?, weights))).sum::<f32>().sqrt()
    }
}

/// Of a part of the error.
pub fn square(features: &[f32; FEATURES], weights: &[f32; FEATURES]) -> f32 {
    let log: f32 = features.iter().zip(weights).map(|(feature, weight)| feature * weight).sum();
    (2.0 * log).exp()
}

/// What a lamp adds to the work at a cell, by measurement with one lamp.
const LAMP: f32 = 0.4;

/// Sweeps that a solve takes where the solution before is not far off.
const SWEEPS: f32 = 5.0;

/// Predicted time of a frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Milliseconds {
    /// Of light, where it changes.
    pub light: f32,
    /// Of the march along the views' rays.
    pub view: f32,
}

impl Milliseconds {
    /// All together.
    pub fn total(&self) -> f32 {
        self.light + self.view
    }
}

/// The models there are to choose from in a setting.
pub fn candidates(setting: &Setting) -> impl Iterator<Item = SmokeModel> + use<> {
    let Setting { rbfs: all, g, multiple, is_reducible, can_halve, .. } = *setting;
    let halves: &[bool] = if can_halve { &[false, true] } else { &[false] };
    let counts = [u32::MAX, 800, 400, 200, 100, 50]
        .into_iter()
        .filter(move |&n| n == u32::MAX || is_reducible && (n as f32) < all);
    let orders = move || (1..=4).rev().filter(move |&order| order == 4 || g != 0.0 && multiple);
    counts.flat_map(move |rbfs| {
        [7, 1].into_iter().flat_map(move |probes| {
            [64, 32, 16].into_iter().flat_map(move |directions| {
                orders().flat_map(move |order| {
                    [0.5, 1.0, 2.0, 4.0].into_iter().flat_map(move |step| {
                        halves.iter().map(move |&half_resolution| SmokeModel {
                            rbfs,
                            probes,
                            order,
                            directions,
                            step,
                            half_resolution,
                            ..SmokeModel::FULL
                        })
                    })
                })
            })
        })
    })
}
