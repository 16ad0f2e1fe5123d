//! Options of `smoke render` that choose how multiple scattering is solved for.

use anyhow::ensure;
use clap::{Args, ValueEnum};
use serde::Serialize;

use super::render::Method;
use crate::paper::{PaperExponential, SmokePaper};
use crate::scattering::ScatteringSolver;
use crate::volume::LiveDensity;

/// Options of `smoke render` that only some methods have.
#[derive(Args, Debug)]
pub struct SolveArgs {
    /// paper: steps of conjugate gradients [default: 40]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=100_000))]
    cg_steps: Option<u32>,
    /// paper: how optical depth in spherical harmonics becomes transmittance [default: linear]
    #[arg(long, value_enum)]
    exponential: Option<Exponential>,
    /// rbf: how multiple scattering is solved for [default: transport]
    #[arg(long, value_enum)]
    solver: Option<Solver>,
    /// rbf on raw density: cells of the lattice of RBFs along the longest side, 4 to 16 [default: 12]
    #[arg(long, value_name = "CELLS", value_parser = clap::value_parser!(u32).range(4..=16))]
    lattice: Option<u32>,
}

#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Solver {
    /// Transport from RBF to RBF
    Transport,
    /// Diffusion on a grid
    Diffusion,
}

#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
enum Exponential {
    /// Optimal linear: two tables
    Linear,
    /// Scaling and squaring
    Hyb,
}

/// What of the paper's method was used, for `--stats`.
#[derive(Serialize)]
pub(super) struct PaperStats {
    cg_steps: u32,
    exponential: &'static str,
}

impl SolveArgs {
    /// Refuses options that the method does not have.
    pub(super) fn check(&self, method: Method, is_raw: bool) -> anyhow::Result<()> {
        ensure!(
            self.lattice.is_none() || is_raw && method == Method::Rbf,
            "--lattice is for --method rbf on a density file"
        );
        let given = self.cg_steps.is_some() || self.exponential.is_some();
        ensure!(method == Method::Paper || !given, "--cg-steps and --exponential are for --method paper");
        ensure!(method == Method::Rbf || self.solver.is_none(), "--solver is for --method rbf");
        Ok(())
    }

    /// Cells of the lattice along the longest side.
    pub(super) fn lattice(&self) -> u32 {
        self.lattice.unwrap_or(LiveDensity::LATTICE)
    }

    /// The solver that method rbf uses.
    pub(super) fn solver(&self) -> Solver {
        self.solver.unwrap_or(Solver::Transport)
    }

    /// The component that draws by the paper's method, if that is the method.
    pub(super) fn paper(&self, method: Method) -> Option<SmokePaper> {
        let default = SmokePaper::default();
        let exponential = match self.exponential {
            None => default.exponential,
            Some(Exponential::Linear) => PaperExponential::OptimalLinear,
            Some(Exponential::Hyb) => PaperExponential::Hybrid,
        };
        (method == Method::Paper).then(|| SmokePaper { steps: self.cg_steps.unwrap_or(default.steps), exponential })
    }
}

impl From<Solver> for ScatteringSolver {
    fn from(solver: Solver) -> Self {
        match solver {
            Solver::Transport => Self::Transport,
            Solver::Diffusion => Self::Diffusion,
        }
    }
}

impl PaperStats {
    pub fn of(paper: &SmokePaper, multiple: bool) -> Self {
        Self {
            cg_steps: if multiple { paper.steps } else { 0 },
            exponential: match paper.exponential {
                PaperExponential::OptimalLinear => "linear",
                PaperExponential::Hybrid => "hyb",
            },
        }
    }
}
