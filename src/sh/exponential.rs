//! Exponentials of functions on the sphere: transmittance from optical depth without leaving spherical harmonics.
//!
//! exp*(f) is the projection of exp f(ω) to the order of f (Ren et al. 2006; Zhou et al. 2008, appendix). Every way
//! splits off the mean exactly: with f̂ = f without its first coefficient, exp*(f) = exp(f_0/√4π) exp*(f̂).
//!
//! The product itself uses none of them for smoke: four bands are off by a third of the shadow that smoke throws on a surface outside
//! it, and sums over directions cost no more (docs/measurements/2026-11-25-shadows.md). They serve the method as printed, and
//! the choice between them is its user's: HYB is the more accurate, optimal linear the cheaper. For spheres on meshes, where
//! logarithms of visibility add up, the sum is exponentiated direction by direction: [`log_visibility`](super::log_visibility).
//!
//! An order n, 1 to [`BANDS`], keeps n² coefficients; those beyond are taken for zero, and are zero in the result.

use core::f64::consts::PI;
use std::sync::OnceLock;

use glam::DVec3;

use super::{BANDS, Sh, SphereRule};
use crate::{optics::gaussian_column, random::SplitMix64};

/// How to exponentiate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exponential {
    /// [`OptimalLinear`]: two table look-ups.
    OptimalLinear,
    /// [`scaling_and_squaring`]: four products of two functions.
    Hybrid,
    /// [`by_quadrature`]: exact, the yardstick of the other two.
    Quadrature,
}

impl Exponential {
    /// exp*(f) of order `order`.
    pub fn apply(self, f: &Sh<f64>, order: usize) -> Sh<f64> {
        match self {
            Self::OptimalLinear => OptimalLinear::get(order).exp(f),
            Self::Hybrid => scaling_and_squaring(f, order),
            Self::Quadrature => by_quadrature(f, order),
        }
    }
}

/// exp*(f) ≈ exp(f_0/√4π) (a(‖f̂‖) 1 + b(‖f̂‖) f̂) with a and b tabulated (Ren et al. 2006, section 5).
///
/// Their tables are not published. These are least squares fits at every norm over the optical depths that a few
/// hundred points see in random clouds of Gaussians.
#[derive(Clone, Debug, PartialEq)]
pub struct OptimalLinear {
    order: usize,
    /// Logarithms of a and b at the norms 0, [`NORM_STEP`], …: both grow exponentially, their logarithms smoothly.
    table: Vec<[f64; 2]>,
}

/// Distance of the table's entries.
pub const NORM_STEP: f64 = 0.25;
/// Entries of the table: norms up to 16. A plume of optical thickness 2 across has norms up to 1.4, one of 10 up to 7.
pub const NORMS: usize = 65;

impl OptimalLinear {
    /// Fits the tables for one order; the same every time.
    pub fn new(order: usize) -> Self {
        let shapes: Vec<Vec<f64>> = depth_vectors(1, 8)
            .iter()
            .filter_map(|depth| {
                let (_, f) = split_mean(&(*depth * -1.0), order);
                let norm = norm(&f);
                // Order 1 has no shape: a is 1 and b does not matter.
                (norm > 0.0).then(|| rule().nodes().iter().map(|&(dir, _)| f.evaluate(dir) / norm).collect())
            })
            .collect();
        let fit = |norm: f64| {
            if norm == 0.0 || shapes.is_empty() {
                return [0.0; 2];
            }
            // 1 and f̂ are orthogonal, so that a and b are two projections: mean exp*(f̂)_0/√4π and
            // mean exp*(f̂)·f̂/‖f̂‖².
            let (mut a, mut b) = (0.0, 0.0);
            for shape in &shapes {
                for (&(_, weight), value) in rule().nodes().iter().zip(shape) {
                    let e = weight * (norm * value).exp();
                    a += e / (4.0 * PI);
                    b += e * value / norm;
                }
            }
            [a, b].map(|sum| (sum / shapes.len() as f64).ln())
        };
        Self { order, table: (0..NORMS).map(|i| fit(i as f64 * NORM_STEP)).collect() }
    }

    /// The tables of an order, 1 to [`BANDS`], made once: a quarter of a second.
    pub fn get(order: usize) -> &'static Self {
        static TABLES: [OnceLock<OptimalLinear>; BANDS] = [const { OnceLock::new() }; BANDS];
        TABLES[order - 1].get_or_init(|| Self::new(order))
    }

    /// ln a and ln b at every norm of the table.
    pub fn logarithms(&self) -> &[[f64; 2]] {
        &self.table
    }

    /// a and b of a norm; beyond the table they go on exponentially.
    pub fn coefficients(&self, norm: f64) -> [f64; 2] {
        let position = norm / NORM_STEP;
        let index = (position as usize).min(NORMS - 2);
        let t = position - index as f64;
        let [low, high] = [self.table[index], self.table[index + 1]];
        core::array::from_fn(|i| (low[i] + t * (high[i] - low[i])).exp())
    }

    /// exp*(f).
    pub fn exp(&self, f: &Sh<f64>) -> Sh<f64> {
        let (mean, f) = split_mean(f, self.order);
        let [a, b] = self.coefficients(norm(&f));
        (Sh::constant(a) + f * b) * mean.exp()
    }
}

/// Halvings of [`scaling_and_squaring`].
pub const HALVINGS: u32 = 3;

/// exp*(f̂) by squaring the series 1 + g + g²/2 of g = f̂/2³ three times, in products cut off at the order ("HYB" of
/// Ren et al. 2006).
pub fn scaling_and_squaring(f: &Sh<f64>, order: usize) -> Sh<f64> {
    let (mean, f) = split_mean(f, order);
    let product = |a: &Sh<f64>, b: &Sh<f64>| truncate(&a.product(b), order);
    let g = f * 0.5f64.powi(HALVINGS as i32);
    let series = Sh::constant(1.0) + g + product(&g, &g) * 0.5;
    (0..HALVINGS).fold(series, |e, _| product(&e, &e)) * mean.exp()
}

/// exp*(f) by quadrature over 1152 directions: to 1e-9 while ‖f̂‖ ≤ 16.
pub fn by_quadrature(f: &Sh<f64>, order: usize) -> Sh<f64> {
    let f = truncate(f, order);
    truncate(&Sh::project(rule(), |dir| f.evaluate(dir).exp()), order)
}

/// The directions of [`by_quadrature`], exact through degree 47.
fn rule() -> &'static SphereRule {
    static RULE: OnceLock<SphereRule> = OnceLock::new();
    RULE.get_or_init(|| SphereRule::new(24))
}

/// The mean value and the rest of the first n² coefficients.
fn split_mean(f: &Sh<f64>, order: usize) -> (f64, Sh<f64>) {
    let mut rest = truncate(f, order);
    rest.0[0] = 0.0;
    (f.0[0] / (4.0 * PI).sqrt(), rest)
}

fn truncate(f: &Sh<f64>, order: usize) -> Sh<f64> {
    Sh(core::array::from_fn(|k| if k < order * order { f.0[k] } else { 0.0 }))
}

fn norm(f: &Sh<f64>) -> f64 {
    f.0.iter().map(|c| c * c).sum::<f64>().sqrt()
}

/// Optical depths like those met in smoke: random clouds of 24 Gaussians, each seen from the centres of its own.
fn depth_vectors(seed: u64, clouds: usize) -> Vec<Sh<f64>> {
    const GAUSSIANS: usize = 24;
    let mut random = SplitMix64(seed);
    let mut cloud = || -> Vec<(DVec3, f64, f64)> {
        (0..GAUSSIANS)
            .map(|_| {
                let [x, y, z, radius, weight] = [(); 5].map(|()| random.unit());
                let center = DVec3::new(0.5, 1.0, 0.5) * (DVec3::new(x, y, z) - 0.5);
                (center, 0.04 * 3f64.powf(radius), 0.2 + 0.8 * weight)
            })
            .collect()
    };
    // Smooth functions, of which four bands are wanted: half the directions of the yardstick do.
    let rule = SphereRule::new(12);
    let mut vectors = Vec::with_capacity(clouds * GAUSSIANS);
    for _ in 0..clouds {
        let cloud = cloud();
        for &(eye, ..) in &cloud {
            vectors.push(Sh::project(&rule, |dir| {
                cloud.iter().map(|&(center, radius, weight)| gaussian_column(eye, dir, center, radius, weight)).sum()
            }));
        }
    }
    vectors
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [Exponential; 3] = [Exponential::OptimalLinear, Exponential::Hybrid, Exponential::Quadrature];

    fn difference(a: &Sh<f64>, b: &Sh<f64>) -> f64 {
        norm(&(*a + *b * -1.0))
    }

    #[test]
    fn constants_are_exact() {
        for exponential in ALL {
            for order in 1..=BANDS {
                let found = exponential.apply(&Sh::constant(-1.7), order);
                // Rounding of sums over 1152 directions.
                assert!(difference(&found, &Sh::constant((-1.7f64).exp())) < 1e-13, "{exponential:?} {order}");
            }
        }
    }

    #[test]
    fn small_functions_have_the_series_as_limit() {
        let f = depth_vectors(5, 1)[3];
        for exponential in ALL {
            for order in 2..=BANDS {
                let g = truncate(&f, order) * (1e-4 / norm(&f));
                let found = exponential.apply(&g, order);
                // What is left is of second order, ‖g‖²/2 times a Gaunt factor below 1; but for the tables, which lie by
                // their curvature, 0.25 ‖g‖ / 8π · √4π, near zero.
                let tolerance = if exponential == Exponential::OptimalLinear { 1e-5 } else { 1e-8 };
                assert!(difference(&found, &(Sh::constant(1.0) + g)) < tolerance, "{exponential:?} {order}");
            }
        }
        // Scaling and squaring keeps the second order too: its own error is g³/6.
        let g = truncate(&f, 4) * (1e-2 / norm(&f));
        assert!(difference(&scaling_and_squaring(&g, 4), &by_quadrature(&g, 4)) < 1e-7);
    }

    #[test]
    fn quadrature_matches_a_closed_form() {
        // exp(s z): the mean is sinh(s)/s, and band 1 along z is √(12π)(cosh s/s − sinh s/s²).
        let s = 6.0f64;
        let f = Sh::zonal(DVec3::Z, &[0.0, 4.0 * PI / 3.0, 0.0, 0.0], s);
        let found = by_quadrature(&f, 4);
        let expected = [(4.0 * PI).sqrt() * s.sinh() / s, (12.0 * PI).sqrt() * (s.cosh() / s - s.sinh() / (s * s))];
        assert!((found.0[0] / expected[0] - 1.0).abs() < 1e-12, "{} {}", found.0[0], expected[0]);
        assert!((found.0[2] / expected[1] - 1.0).abs() < 1e-12, "{} {}", found.0[2], expected[1]);
        // Twice as many directions along each axis change nothing that matters, up to where the tables end.
        let f = depth_vectors(7, 1)[0];
        let f = f * (-16.0 / norm(&split_mean(&f, 4).1));
        let fine = Sh::project(&SphereRule::new(48), |dir| f.evaluate(dir).exp());
        assert!(difference(&by_quadrature(&f, 4), &fine) < 1e-9 * norm(&fine));
        let f = Sh::zonal(DVec3::Z, &[0.0, 4.0 * PI / 3.0, 0.0, 0.0], s);
        // Order 2 cuts off the rest.
        assert_eq!(by_quadrature(&f, 2).0[4..], [0.0; 12]);
    }

    #[test]
    fn tables_start_at_one_and_rise() {
        for order in 2..=BANDS {
            let tables = OptimalLinear::get(order);
            assert_eq!(tables.coefficients(0.0), [1.0, 1.0]);
            let values: Vec<_> = (0..150).map(|i| tables.coefficients(0.25 * f64::from(i) + 0.1)).collect();
            // a = mean of exp, convex in the norm; beyond the end they go on.
            assert!(values.windows(2).all(|pair| pair[1][0] > pair[0][0] && pair[1][1] > 0.0), "{order}");
        }
        assert_eq!(OptimalLinear::new(3), *OptimalLinear::get(3));
    }

    /// Root mean square error over root mean square of the transmittances of clouds that the tables were not made
    /// from, with the mean norm of their depths scaled to `target`.
    fn error(exponential: Exponential, order: usize, target: f64) -> f64 {
        let depths = depth_vectors(99, 4);
        let mean = depths.iter().map(|d| norm(&split_mean(d, order).1)).sum::<f64>() / depths.len() as f64;
        let (mut error, mut power) = (0.0, 0.0);
        for depth in &depths {
            let f = *depth * (-target / mean);
            let exact = by_quadrature(&f, order);
            error += difference(&exponential.apply(&f, order), &exact).powi(2);
            power += norm(&exact).powi(2);
        }
        (error / power).sqrt()
    }

    #[test]
    fn errors_on_clouds() {
        // Measured, with a fifth to spare. The plume of the reference scenes has mean norms of 0.1 to 4.
        for (order, target, linear, hybrid) in [
            (4, 1.0, 0.032, 0.0029),
            (4, 3.0, 0.163, 0.038),
            (4, 8.0, 0.60, 0.24),
            (3, 3.0, 0.150, 0.046),
            // Of order 2 every shape is the same but for its direction: what is left is the table's step.
            (2, 3.0, 0.0003, 0.084),
        ] {
            let found = [Exponential::OptimalLinear, Exponential::Hybrid].map(|e| error(e, order, target));
            let within = found[0] < 1.2 * linear && found[1] < 1.2 * hybrid;
            assert!(within, "order {order} norm {target}: {found:?} for {linear} {hybrid}");
        }
    }
}
