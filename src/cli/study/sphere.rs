//! `smoke study sphere`: the diffusion equations as printed and as they should be, against random paths.

use clap::Args;
use serde::Serialize;

use crate::cli::output::print;
use crate::reference::sphere::{Equation, Sphere, compare, diffusion, monte_carlo};

/// Options of `smoke study sphere`.
#[derive(Args, Debug)]
pub struct SphereArgs {
    /// Random paths for every line: noise falls with their square root
    #[arg(long, value_name = "N", default_value_t = 1_000_000, value_parser = clap::value_parser!(u64).range(1..=1_000_000_000))]
    paths: u64,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Shells in which light is counted.
const SHELLS: usize = 10;

#[derive(Serialize)]
struct Row {
    /// Optical radius.
    sigma_r: f64,
    albedo: f64,
    g: f64,
    /// Light in the sphere over the true amount.
    printed_ratio: f64,
    corrected_ratio: f64,
    /// Relative root mean square error over ten shells, by volume.
    printed_error: f64,
    corrected_error: f64,
}

/// Runs the study.
pub fn run(args: &SphereArgs) -> anyhow::Result<()> {
    let rows: Vec<Row> = spheres().map(|sphere| row(&sphere, args.paths as usize)).collect();
    if args.json {
        return print(&format!("{}\n", serde_json::to_string_pretty(&rows)?));
    }
    let mut table = String::from(
        "| σ_t R | Ω | g | printed: ratio | error | corrected: ratio | error |\n|---|---|---|---|---|---|---|\n",
    );
    for Row { sigma_r, albedo, g, printed_ratio, printed_error, corrected_ratio, corrected_error } in rows {
        let [printed, corrected] = [printed_error, corrected_error].map(|error| 100.0 * error);
        table += &format!(
            "| {sigma_r} | {albedo} | {g} | {printed_ratio:.2} | {printed:.1} % | {corrected_ratio:.3} | {corrected:.1} % |\n"
        );
    }
    print(&table)
}

/// From thin to thick, half and nearly white, scattering evenly and forward.
fn spheres() -> impl Iterator<Item = Sphere> {
    [2.0, 4.0, 8.0, 16.0].into_iter().flat_map(|extinction| {
        [(0.66, 0.0), (0.66, 0.6), (0.95, 0.0), (0.95, 0.6)].map(|(albedo, g)| Sphere { extinction, albedo, g })
    })
}

fn row(sphere: &Sphere, paths: usize) -> Row {
    let truth = monte_carlo(sphere, SHELLS, paths, 1);
    let [printed, corrected] =
        [Equation::Printed, Equation::Corrected].map(|equation| compare(&diffusion(sphere, equation, SHELLS), &truth));
    Row {
        sigma_r: sphere.extinction,
        albedo: sphere.albedo,
        g: sphere.g,
        printed_ratio: printed.mean_ratio,
        printed_error: printed.error,
        corrected_ratio: corrected.mean_ratio,
        corrected_error: corrected.error,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_of_the_table() {
        let row = row(&Sphere { extinction: 8.0, albedo: 0.66, g: 0.0 }, 50_000);
        // The printed equation is that of light 1/Ω times as bright where there is no first moment.
        assert!((row.printed_ratio / row.corrected_ratio - 1.0 / 0.66).abs() < 1e-12);
        assert!((row.corrected_ratio - 1.0).abs() < 0.05, "{}", row.corrected_ratio);
    }
}
