//! L-BFGS-B over the centres, radii and weights of a set of Gaussians.

use std::cell::RefCell;
use std::convert::Infallible;

use basin::{
    BoxBounds, ConstraintDescription, ConstraintSet, Constraints, CostFunction, Executor, FirstOrderState, Gradient,
    Lbfgs, State, StepOutcome,
};
use glam::Vec3;

use super::objective::Objective;
use crate::rbf::Rbf;

/// Variables of one Gaussian: centre, radius, weight.
const VARIABLES: usize = 5;

/// Curvature pairs that the minimiser keeps.
const MEMORY: usize = 12;

/// Iterations over which progress is judged.
const WINDOW: usize = 5;

/// What the variables may range over (Zhou et al. 5.1); densities are normalised to a maximum of 1.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bounds {
    pub half_extent: Vec3,
    pub radius: (f32, f32),
    pub weight: (f32, f32),
}

impl Bounds {
    pub fn clamp(&self, rbf: Rbf) -> Rbf {
        Rbf {
            center: Vec3::from(rbf.center).clamp(-self.half_extent, self.half_extent).to_array(),
            radius: rbf.radius.clamp(self.radius.0, self.radius.1),
            weight: rbf.weight.clamp(self.weight.0, self.weight.1),
        }
    }

    fn range(&self, variable: usize) -> (f32, f32) {
        match variable {
            0..3 => (-self.half_extent[variable], self.half_extent[variable]),
            3 => self.radius,
            _ => self.weight,
        }
    }
}

/// What a run of the minimiser did.
#[derive(Clone, Copy, Debug)]
pub(super) struct Outcome {
    /// Sum of squared errors at the end.
    pub cost: f64,
    pub iterations: u32,
    pub evaluations: u32,
}

/// Improves `rbfs` for at most `iterations` iterations, or until [`WINDOW`] of them gain less than `tolerance` of the
/// cost. The objective is left evaluated at the result. `observe` gets the cost after each iteration.
pub(super) fn minimize(
    objective: &mut Objective,
    rbfs: &mut [Rbf],
    bounds: &Bounds,
    iterations: u32,
    tolerance: f64,
    observe: &mut dyn FnMut(f64),
) -> Outcome {
    let start = variables(rbfs);
    let scale = scales(rbfs, objective.field.blocks_per_volume());
    let bound = |side: fn((f32, f32)) -> f32| -> Vec<f64> {
        (0..start.len()).map(|i| f64::from(side(bounds.range(i % VARIABLES))) / scale[i]).collect()
    };
    let problem = Problem {
        lower: bound(|range| range.0),
        upper: bound(|range| range.1),
        scale: &scale,
        bounds,
        objective: RefCell::new(objective),
    };
    let solver = Lbfgs::new()
        .with_m_capacity(MEMORY)
        .with_absolute_projected_gradient_tolerance(None)
        .with_relative_cost_reduction_tolerance(None);
    let state = FirstOrderState::new(start.iter().zip(&scale).map(|(x, s)| x / s).collect());
    // Bounds and objective are finite, so this does not fail; if it did, the start would stand.
    let Ok(mut stepper) = Executor::new(problem, solver, state).max_iter(u64::from(iterations)).into_stepper() else {
        return Outcome { cost: objective.evaluate(rbfs), iterations: 0, evaluations: 1 };
    };
    let mut costs = vec![2.0 * stepper.state().cost()];
    // It stops by itself at its limit, or where no step helps any more.
    while let Ok(StepOutcome::Continue) = stepper.step() {
        let cost = 2.0 * stepper.state().cost();
        observe(cost);
        costs.push(cost);
        if costs.len() > WINDOW && costs[costs.len() - 1 - WINDOW] - cost < tolerance * cost {
            break;
        }
    }
    let evaluations = stepper.counts().gradient_evals as u32;
    let best = stepper.state().best_param().clone();
    drop(stepper);
    unpack(&best, &scale, bounds, rbfs);
    Outcome { cost: objective.evaluate(rbfs), iterations: costs.len() as u32 - 1, evaluations }
}

/// The objective as the minimiser sees it: half the sum of squared errors over scaled variables.
struct Problem<'a, 'f> {
    objective: RefCell<&'a mut Objective<'f>>,
    bounds: &'a Bounds,
    scale: &'a [f64],
    lower: Vec<f64>,
    upper: Vec<f64>,
}

impl Problem<'_, '_> {
    fn evaluate(&self, variables: &[f64]) -> f64 {
        let mut rbfs = vec![Rbf { center: [0.0; 3], radius: 0.0, weight: 0.0 }; variables.len() / VARIABLES];
        unpack(variables, self.scale, self.bounds, &mut rbfs);
        0.5 * self.objective.borrow_mut().evaluate(&rbfs)
    }
}

impl CostFunction for Problem<'_, '_> {
    type Param = Vec<f64>;
    type Output = f64;
    type Error = Infallible;

    fn cost(&self, variables: &Vec<f64>) -> Result<f64, Infallible> {
        Ok(self.evaluate(variables))
    }
}

impl Gradient for Problem<'_, '_> {
    type Gradient = Vec<f64>;

    fn gradient(&self, variables: &Vec<f64>) -> Result<Vec<f64>, Infallible> {
        Ok(self.cost_and_gradient(variables)?.1)
    }

    fn cost_and_gradient(&self, variables: &Vec<f64>) -> Result<(f64, Vec<f64>), Infallible> {
        let cost = self.evaluate(variables);
        let gradient = self.objective.borrow().gradient();
        Ok((cost, gradient.as_flattened().iter().zip(self.scale).map(|(g, s)| g * s).collect()))
    }
}

impl Constraints for Problem<'_, '_> {
    type Set = ConstraintSet<BoxBounds<Vec<f64>>>;

    fn constraints(&self) -> <Self::Set as ConstraintDescription>::Borrowed<'_> {
        ConstraintSet::new().with_bounds(BoxBounds::new(Some(&self.lower), Some(&self.upper)))
    }
}

/// The variables of all Gaussians in a row.
fn variables(rbfs: &[Rbf]) -> Vec<f64> {
    rbfs.iter().flat_map(|r| [r.center[0], r.center[1], r.center[2], r.radius, r.weight]).map(f64::from).collect()
}

/// Units in which a step of 1 costs about the same in every variable: one over the root of the curvature that the
/// variable of a lone Gaussian has. Radii differ by 6 and weights by 100, so without this the minimiser crawls.
fn scales(rbfs: &[Rbf], blocks_per_volume: f32) -> Vec<f64> {
    rbfs.iter()
        .flat_map(|rbf| {
            let (r, w) = (f64::from(rbf.radius), f64::from(rbf.weight).max(0.05));
            // Σ B² = (π/2)^(3/2) r³, but at least about one block.
            let norm = (1.9687 * r.powi(3) * f64::from(blocks_per_volume)).max(0.3).sqrt();
            let center = r / (w * norm);
            [center, center, center, center / 3.75f64.sqrt(), 1.0 / norm]
        })
        .collect()
}

/// Scaled variables back to Gaussians, exactly within bounds.
fn unpack(variables: &[f64], scale: &[f64], bounds: &Bounds, rbfs: &mut [Rbf]) {
    let (variables, _) = variables.as_chunks::<VARIABLES>();
    let (scale, _) = scale.as_chunks::<VARIABLES>();
    for ((rbf, v), s) in rbfs.iter_mut().zip(variables).zip(scale) {
        let [x, y, z, radius, weight] = std::array::from_fn(|i| (v[i] * s[i]) as f32);
        *rbf = bounds.clamp(Rbf { center: [x, y, z], radius, weight });
    }
}
