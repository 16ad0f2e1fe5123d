//! `smoke study stability`: the product's solvers where methods fail, against what is known exactly or path-traced.

mod cases;
mod stage;

use anyhow::ensure;
use clap::Args;

use self::cases::{Case, Truth, cases};
use self::stage::{Picture, SIZE, Stage};
use crate::cli::bake::{BAR_STEPS, progress_bar};
use crate::cli::output::print;
use crate::reference::compare::{CompareError, image_error};

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

/// How multiple scattering is found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Method {
    /// Transport between RBFs.
    Transport,
    /// Corrected diffusion on a grid.
    Diffusion,
    /// Zhou et al. 2008 as printed.
    Paper,
}

/// Runs the study.
pub fn run(args: &StabilityArgs) -> anyhow::Result<()> {
    let mut stage = Stage::new()?;
    let mut table = String::from(HEADER);
    let (mut group, mut sound) = ("", true);
    let cases = cases();
    let bar = progress_bar();
    for (i, case) in cases.iter().enumerate() {
        bar.set_message(format!("{}: {}", case.group, case.name));
        let [ours, others @ ..] = examine(&mut stage, case, args.spp)?;
        sound &= ours.is_sound();
        if case.group != group {
            group = case.group;
            table += &format!("| **{group}** | | | | | | | | |\n");
        }
        table += &line(case, &ours, &others);
        bar.set_position(BAR_STEPS * (i as u64 + 1) / cases.len() as u64);
    }
    bar.finish_and_clear();
    print(&table)?;
    ensure!(sound, "a line is not finite, negative, or brighter than the light: this is a fault of bevy_smoke");
    Ok(())
}

const HEADER: &str = "\
# Stability

Multiple scattering where methods fail: by transport between RBFs, the plug-in's own solver, in the first columns; beside
it by diffusion, which it has too, and by Zhou et al. 2008 as printed, kept to compare with. Regenerate with
`smoke study stability > docs/stability.md`.

A synthetic cloud of 60 RBFs in a box 3 m wide, extinction 2.5 per metre, albedo 0.8, isotropic, under a soft light on a
dim sky; each line changes what it names. *Error*: relative RMS over the pixels with smoke, against the exact picture
where there is one, else against path tracing of the same density; 0.00 % is less than its noise can tell. Against
*afresh*: the same method without what came before, or at the usual size. *Sweeps*: over all pairs of RBFs, until the
solver's own estimate of its error is below 0.5 %; a star where it stopped before that. *Brightest*: the brightest pixel
over the brightest light that shines on the smoke; light that is only scattered cannot be brighter. Diffusion takes 20
steps of conjugate gradients, the paper's solver 40; what is wrong with them beside their error is said.

Where smoke is so thick that light ends within single RBFs (extinction 100 and more here, the RBFs being as large as they
get), or where sharp light scatters far forward, the plug-in says once that its picture is off.

| case | error | against | sweeps | finite | ≥ 0 | brightest | diffusion | paper |
|---|---|---|---|---|---|---|---|---|
";

fn percent(error: Option<f64>) -> String {
    error.map_or("–".into(), |error| format!("{:.2} %", 100.0 * error))
}

fn line(case: &Case, ours: &Outcome, others: &[Outcome]) -> String {
    let star = if ours.converged { "" } else { "*" };
    let sweeps = ours.sweeps.map_or("–".into(), |sweeps| format!("{sweeps}{star}"));
    let yes = |fine: bool| if fine { "yes" } else { "**no**" };
    let mut line = format!(
        "| {} | {} | {} | {sweeps} | {} | {} | {:.3} |",
        case.name,
        percent(ours.error),
        case.truth.name(),
        yes(ours.finite),
        yes(ours.non_negative),
        ours.brightest,
    );
    for other in others {
        line += &format!(" {}", percent(other.error));
        let faults = [
            (!other.finite).then(|| "not finite".into()),
            (!other.non_negative).then(|| "negative".into()),
            (other.brightest > 1.005).then(|| format!("brightest {:.2}", other.brightest)),
        ];
        for fault in faults.into_iter().flatten() {
            line += &format!(", {fault}");
        }
        line += " |";
    }
    line + "\n"
}

impl Outcome {
    /// Whether it is what a game must be able to rely on, everywhere.
    fn is_sound(&self) -> bool {
        self.finite && self.non_negative && self.brightest <= 1.005
    }
}

/// The case by every method, transport first.
fn examine(stage: &mut Stage, case: &Case, spp: u32) -> anyhow::Result<[Outcome; 3]> {
    let mut known = None;
    let mut outcome = |method| {
        let picture = stage.draw(case, method);
        let truth = match (&case.truth, &known) {
            // What came before, or the size, must not matter: each method is compared with itself.
            (Truth::Same(other), _) => {
                let pixels = colors(&stage.draw(other, method));
                [pixels.clone(), pixels]
            }
            (_, Some(known)) => Clone::clone(known),
            _ => known.insert(truth(case, &picture, spp)).clone(),
        };
        judge(case, &picture, &truth)
    };
    Ok([outcome(Method::Transport)?, outcome(Method::Diffusion)?, outcome(Method::Paper)?])
}

fn judge(case: &Case, picture: &Picture, truth: &[Vec<[f32; 3]>; 2]) -> anyhow::Result<Outcome> {
    let alpha: Vec<f32> = picture.pixels.iter().map(|pixel| pixel[3]).collect();
    let drawn = colors(picture);
    let values = || drawn.iter().flatten().copied();
    let finite = picture.pixels.iter().flatten().all(|value| value.is_finite());
    let error = match image_error([&drawn, &drawn], [&truth[0], &truth[1]], &alpha) {
        Ok(error) => Some(error.relative),
        // No smoke, or no light: then there must be nothing. Or no picture.
        Err(CompareError::NoSmoke | CompareError::Black | CompareError::NotFinite { .. }) => None,
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

fn colors(picture: &Picture) -> Vec<[f32; 3]> {
    picture.pixels.iter().map(|&[r, g, b, _]| [r, g, b]).collect()
}

/// Two halves of the picture as it should be, known from the case alone.
fn truth(case: &Case, picture: &Picture, spp: u32) -> [Vec<[f32; 3]>; 2] {
    match &case.truth {
        // Smoke that only scatters under the same light from everywhere sends on what it takes out.
        Truth::Furnace => {
            let seen = picture.pixels.iter().map(|pixel| [pixel[3]; 3]).collect::<Vec<_>>();
            [seen.clone(), seen]
        }
        // Few paths meet thin smoke: as many more.
        Truth::Paths => {
            let seen =
                picture.pixels.iter().map(|pixel| f64::from(pixel[3])).sum::<f64>() / picture.pixels.len() as f64;
            stage::trace(case, (f64::from(spp) * (0.3 / seen.max(1e-3)).clamp(1.0, 30.0)) as u32)
        }
        Truth::Black | Truth::Same(_) => core::array::from_fn(|_| vec![[0.0; 3]; SIZE.element_product() as usize]),
    }
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
            let [outcome, others @ ..] = examine(&mut stage, &case, 2).unwrap();
            let line = line(&case, &outcome, &others);
            println!("{line}");
            assert!(outcome.is_sound(), "{line}");
            // The solver's half percent, and what f16 and the march take.
            assert!(!exact || outcome.error.is_none_or(|error| error < 0.01), "{line}");
        }
    }
}
