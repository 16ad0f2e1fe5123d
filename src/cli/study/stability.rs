//! `smoke study stability`: the product's solvers where methods fail, against what is known exactly or path-traced.

mod cases;
mod stage;

use anyhow::ensure;
use clap::Args;

use self::cases::{Case, Truth, cases};
use self::stage::{Picture, SIZE, Stage};
use crate::cli::output::print;
use crate::reference::compare::{CompareError, image_error};
use crate::scattering::SmokeScattering;

/// Options of `smoke study stability`.
#[derive(Args, Debug)]
pub struct StabilityArgs {
    /// Paths a pixel for every line that is path-traced: noise falls with their square root
    #[arg(long, value_name = "N", default_value_t = 1024, value_parser = clap::value_parser!(u32).range(2..=1_000_000))]
    spp: u32,
}

/// What came of a case.
struct Outcome {
    /// Relative error over the smoke; None where there is no smoke or no light, and nothing is what was drawn.
    error: Option<f64>,
    sweeps: Option<u32>,
    converged: bool,
    finite: bool,
    non_negative: bool,
    /// The brightest pixel over the brightest light.
    brightest: f64,
}

/// Runs the study.
pub fn run(args: &StabilityArgs) -> anyhow::Result<()> {
    let mut stage = Stage::new()?;
    let mut table = String::from(HEADER);
    let (mut group, mut sound) = ("", true);
    for case in cases() {
        let outcome = examine(&mut stage, &case, args.spp)?;
        sound &= outcome.is_sound();
        if case.group != group {
            group = case.group;
            table += &format!("| **{group}** | | | | | | |\n");
        }
        table += &line(&case, &outcome);
    }
    print(&table)?;
    ensure!(sound, "a line is not finite, negative, or brighter than the light: this is a fault of bevy_smoke");
    Ok(())
}

const HEADER: &str = "\
# Stability

Multiple scattering by transport between RBFs, the solver of the plug-in, where methods fail. Regenerate with
`smoke study stability > docs/stability.md`.

A synthetic cloud of 60 RBFs in a box 3 m wide, extinction 2.5 per metre, albedo 0.8, isotropic, under a soft light on a
dim sky; each line changes what it names. *Error*: relative RMS over the pixels with smoke, against the exact picture
where there is one, else against path tracing of the same density. *Sweeps*: over all pairs of RBFs, until the solver's
own estimate of its error is below 0.5 %; a star where it stopped before that. *Brightest*: the brightest pixel over the
brightest light that shines on the smoke; light that is only scattered cannot be brighter.

| case | error | against | sweeps | finite | ≥ 0 | brightest |
|---|---|---|---|---|---|---|
";

fn line(case: &Case, outcome: &Outcome) -> String {
    let error = outcome.error.map_or("–".into(), |error| format!("{:.2} %", 100.0 * error));
    let star = if outcome.converged { "" } else { "*" };
    let sweeps = outcome.sweeps.map_or("–".into(), |sweeps| format!("{sweeps}{star}"));
    let yes = |fine: bool| if fine { "yes" } else { "**no**" };
    format!(
        "| {} | {error} | {} | {sweeps} | {} | {} | {:.3} |\n",
        case.name,
        case.truth.name(),
        yes(outcome.finite),
        yes(outcome.non_negative),
        outcome.brightest,
    )
}

impl Outcome {
    /// Whether it is what a game must be able to rely on, everywhere.
    fn is_sound(&self) -> bool {
        self.finite && self.non_negative && self.brightest <= 1.005
    }
}

fn examine(stage: &mut Stage, case: &Case, spp: u32) -> anyhow::Result<Outcome> {
    let picture = stage.draw(case, SmokeScattering::MULTIPLE);
    let truth = truth(stage, case, &picture, spp)?;
    let alpha: Vec<f32> = picture.pixels.iter().map(|pixel| pixel[3]).collect();
    let drawn: Vec<[f32; 3]> = picture.pixels.iter().map(|&[r, g, b, _]| [r, g, b]).collect();
    let values = || drawn.iter().flatten().copied();
    let finite = picture.pixels.iter().flatten().all(|value| value.is_finite());
    let error = match image_error([&drawn, &drawn], [&truth[0], &truth[1]], &alpha) {
        Ok(error) => Some(error.relative),
        // No smoke, or no light: then there must be nothing.
        Err(CompareError::NoSmoke | CompareError::Black) => None,
        Err(error) => return Err(error.into()),
    };
    Ok(Outcome {
        error,
        sweeps: picture.report.map(|report| report.sweeps),
        converged: picture.report.is_none_or(|report| report.converged),
        finite,
        non_negative: values().all(|value| value >= 0.0),
        brightest: f64::from(values().fold(0.0, f32::max)) / case.light.brightest().max(f64::MIN_POSITIVE),
    })
}

/// Two halves of the picture as it should be.
fn truth(stage: &mut Stage, case: &Case, picture: &Picture, spp: u32) -> anyhow::Result<[Vec<[f32; 3]>; 2]> {
    Ok(match &case.truth {
        // Smoke that only scatters under the same light from everywhere sends on what it takes out.
        Truth::Furnace => {
            let seen = picture.pixels.iter().map(|pixel| [pixel[3]; 3]).collect::<Vec<_>>();
            [seen.clone(), seen]
        }
        Truth::Black => {
            [vec![[0.0; 3]; SIZE.element_product() as usize], vec![[0.0; 3]; SIZE.element_product() as usize]]
        }
        // Few paths meet thin smoke: as many more.
        Truth::Paths => {
            let seen =
                picture.pixels.iter().map(|pixel| f64::from(pixel[3])).sum::<f64>() / picture.pixels.len() as f64;
            stage::trace(case, (f64::from(spp) * (0.3 / seen.max(1e-3)).clamp(1.0, 30.0)) as u32)
        }
        // The same case without what came before it, or at another size.
        Truth::Same(other) => {
            let pixels: Vec<[f32; 3]> =
                stage.draw(other, SmokeScattering::MULTIPLE).pixels.iter().map(|&[r, g, b, _]| [r, g, b]).collect();
            [pixels.clone(), pixels]
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every case but for path tracing: what a game must be able to rely on, and the error where the truth is exact.
    #[test]
    fn every_case_is_finite_and_bounded_and_exact_ones_are_met() {
        let mut stage = Stage::new().unwrap();
        for mut case in cases() {
            let exact = !matches!(case.truth, Truth::Paths);
            if !exact {
                case.truth = Truth::Black;
            }
            let outcome = examine(&mut stage, &case, 2).unwrap();
            println!("{}", line(&case, &outcome));
            assert!(outcome.is_sound(), "{}", line(&case, &outcome));
            // The solver's half percent, and what f16 and the march take: as for the white furnace of the README.
            assert!(!exact || outcome.error.is_none_or(|error| error < 0.01), "{}", line(&case, &outcome));
        }
    }
}
