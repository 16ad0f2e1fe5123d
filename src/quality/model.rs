//! What a model costs and how far off its picture is: two small formulas, fitted to measurements by `smoke study quality`.

use super::SmokeModel;
use super::coefficients::COEFFICIENTS;

/// Parts of the work of a frame, each of which has a price.
pub const WORK: usize = 8;

/// What cost and error depend on beside the model.
#[derive(Clone, Copy, Debug, PartialEq)]
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
    /// Cells of the density grid.
    pub cells: f32,
    /// Pixels that the box covers, in all views.
    pub pixels: f32,
    /// Cells along a ray through the box.
    pub cells_along: f32,
    /// Side of a pixel in cells, at the middle of the box.
    pub cells_a_pixel: f32,
}

/// The prices of work and the parts of the error.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Coefficients {
    /// Milliseconds a unit of each part of [`Setting::work`].
    pub prices: [f32; WORK],
    /// Of the full model at a number of RBFs n: ln e over 1, ln of the optical radius, ln n, |g|.
    pub base: [f32; 4],
    /// Of a probe in the place of seven: 1, ln of the optical radius.
    pub probes: [f32; 2],
    /// Of fewer directions: 1, ln(64 / directions).
    pub directions: [f32; 2],
    /// Of fewer bands: 1, order times ln |g|.
    pub order: [f32; 2],
    /// Of steps longer than half a cell: 1, ln of their cells.
    pub step: [f32; 2],
    /// Of half resolution: 1, ln of the cells a pixel.
    pub half: [f32; 2],
}

impl Setting {
    /// RBFs that light is computed at.
    fn lit(&self, model: &SmokeModel) -> f32 {
        if self.is_reducible { self.rbfs.min(model.rbfs as f32) } else { self.rbfs }
    }

    /// What [`Coefficients::base`] is about, of so many RBFs. Where fewer stand for all, they are as much larger.
    pub fn base_features(&self, model: &SmokeModel) -> [f32; 4] {
        let lit = self.lit(model).max(1.0);
        let radius = self.optical_radius.max(1e-3) * (self.rbfs.max(1.0) / lit).cbrt();
        [1.0, radius.ln(), lit.ln(), self.g.abs()]
    }

    /// The work of a frame in which everything changes: steps along rays, pixels that are blended, directions that probes
    /// look in, pairs of RBFs, pairs times coefficients in sweeps, cells, cells times RBFs, and 1.
    pub fn work(&self, model: &SmokeModel) -> [f32; WORK] {
        let lit = self.lit(model);
        let pairs = if self.multiple { lit * lit } else { 0.0 };
        let coefficients = if self.g == 0.0 { 1.0 } else { 1.0 + (model.order * model.order) as f32 };
        let (marched, blended) = if model.half_resolution && self.can_halve { (0.25, 1.0) } else { (1.0, 0.0) };
        let often = 1.0 / model.lighting_interval as f32;
        [
            1e-6 * marched * self.pixels * (self.cells_along / model.step),
            1e-6 * blended * self.pixels,
            1e-6 * often * lit * (model.probes * model.directions) as f32,
            1e-6 * often * pairs,
            1e-6 * often * pairs * coefficients * SWEEPS.min(model.sweeps as f32),
            1e-6 * often * self.cells,
            1e-9 * often * self.cells * lit,
            often,
        ]
    }

    /// Predicted milliseconds of the GPU, density left out, as measured where the prices are from: of light, and of the march.
    pub fn milliseconds(&self, model: &SmokeModel) -> Milliseconds {
        self.milliseconds_with(model, &COEFFICIENTS)
    }

    /// The same by other coefficients.
    pub fn milliseconds_with(&self, model: &SmokeModel, by: &Coefficients) -> Milliseconds {
        let work = self.work(model);
        let parts: [f32; WORK] = core::array::from_fn(|i| by.prices[i] * work[i]);
        Milliseconds { light: parts[2..].iter().sum(), view: parts[..2].iter().sum() }
    }

    /// Predicted relative RMS error of the picture: the parts add up in squares, as errors do that have nothing to do with
    /// each other.
    pub fn error(&self, model: &SmokeModel) -> f32 {
        self.error_with(model, &COEFFICIENTS)
    }

    /// The same by other coefficients.
    pub fn error_with(&self, model: &SmokeModel, by: &Coefficients) -> f32 {
        let base = self.base_features(model);
        let radius = base[1];
        let mut sum = 0.0;
        let mut add = |applies: bool, weights: &[f32], features: &[f32]| {
            if applies {
                let log: f32 = weights.iter().zip(features).map(|(weight, feature)| weight * feature).sum();
                sum += (2.0 * log).exp();
            }
        };
        add(true, &by.base, &base);
        add(model.probes == 1, &by.probes, &[1.0, radius]);
        add(model.directions < 64, &by.directions, &[1.0, (64.0 / model.directions as f32).ln()]);
        let order = [1.0, model.order as f32 * self.g.abs().max(0.01).ln()];
        add(model.order < 4 && self.g != 0.0, &by.order, &order);
        add(model.step > 0.5, &by.step, &[1.0, model.step.ln()]);
        add(model.half_resolution && self.can_halve, &by.half, &[1.0, self.cells_a_pixel.max(1e-3).ln()]);
        sum.sqrt()
    }
}

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
    let Setting { rbfs: all, g, is_reducible, can_halve, .. } = *setting;
    let halves: &[bool] = if can_halve { &[false, true] } else { &[false] };
    let counts = [u32::MAX, 800, 400, 200, 100, 50]
        .into_iter()
        .filter(move |&n| n == u32::MAX || is_reducible && (n as f32) < all);
    let orders = move || (1..=4).rev().filter(move |&order| order == 4 || g != 0.0);
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
