//! `smoke study quality`: what models cost and how far off their pictures are, and the two formulas of `quality::model`,
//! fitted to that.

mod fit;
mod stage;

use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use clap::Args;
use serde::Serialize;

use self::fit::{Fit, fit};
use self::stage::{Measurement, Stage};
use crate::bake::{BakeSettings, bake};
use crate::bundle::SmokeAnimation;
use crate::cli::bake::{BAR_STEPS, progress_bar};
use crate::cli::output::print;
use crate::cli::scene::Scene;
use crate::density;
use crate::quality::model::candidates;
use crate::quality::{SmokeModel, SmokeQuality};
use crate::random::SplitMix64;
use crate::rbf::fit::FitTarget;

/// Options of `smoke study quality`.
#[derive(Args, Debug)]
pub struct QualityStudyArgs {
    /// A folder of NAME.json and NAME/{full_a,full_b,alpha}.exr: scenes, and their path-traced pictures
    #[arg(long, value_name = "DIR")]
    references: PathBuf,
    /// Another such folder: scenes that nothing is fitted to
    #[arg(long, value_name = "DIR")]
    held_out: Option<PathBuf>,
    /// RBFs that densities are baked with
    #[arg(long, value_name = "N", default_value_t = 600)]
    rbfs: usize,
    /// Models drawn of every scene beside those that the fit needs
    #[arg(long, value_name = "N", default_value_t = 16)]
    others: usize,
    /// Writes the coefficients as Rust: src/quality/coefficients.rs
    #[arg(long, value_name = "FILE")]
    write: Option<PathBuf>,
}

/// What is printed.
#[derive(Serialize)]
struct Report {
    adapter: String,
    fit: Fit,
    /// Of pictures that nothing was fitted to: of the scenes fitted to, and of the held-out ones.
    prediction: [Prediction; 2],
    choices: Vec<Chosen>,
    measurements: Vec<Measurement>,
}

/// How close predictions are.
#[derive(Serialize, Default)]
struct Prediction {
    pictures: usize,
    /// Root mean square of ln(predicted / measured).
    error_log_rms: f64,
    milliseconds_log_rms: f64,
}

/// What auto came to, beside the best of the models that were drawn.
#[derive(Serialize)]
struct Chosen {
    scene: String,
    held_out: bool,
    asked: String,
    why: String,
    predicted_error: f64,
    error: f64,
    predicted_ms: f64,
    milliseconds: f64,
    /// Its time over that of the fastest model drawn that is no less accurate.
    slower: f64,
    /// Its error over that of the most accurate model drawn that is no slower.
    farther: f64,
}

/// A scene with its smoke.
struct Subject {
    name: String,
    held_out: bool,
    folder: PathBuf,
    scene: Scene,
    animation: SmokeAnimation,
}

/// Runs the study.
pub fn run(args: &QualityStudyArgs) -> anyhow::Result<()> {
    let mut subjects = Vec::new();
    for (folder, held_out) in [(Some(&args.references), false), (args.held_out.as_ref(), true)] {
        if let Some(folder) = folder {
            read_subjects(folder, held_out, args.rbfs, &mut subjects)?;
        }
    }
    let bar = progress_bar();
    let (mut measurements, mut adapter) = (Vec::new(), String::new());
    for (i, subject) in subjects.iter().enumerate() {
        bar.set_message(subject.name.clone());
        let mut stage = Stage::new(subject)?;
        adapter = stage.adapter();
        let mut random = SplitMix64(i as u64);
        let all: Vec<SmokeModel> = candidates(&stage.setting()?).collect();
        for model in simple_models(subject.scene.g != 0.0) {
            measurements.push(stage.measure(model, true)?);
        }
        for _ in 0..args.others {
            let model = all[random.below(all.len())];
            measurements.push(stage.measure(model, false)?);
        }
        for rays in [1, 4] {
            measurements.push(Stage::with_rays(subject, rays)?.measure_half()?);
        }
        bar.set_position(BAR_STEPS * (i as u64 + 1) / subjects.len() as u64);
    }
    let fit = fit(&measurements);
    let mut choices = Vec::new();
    for subject in &subjects {
        choose(subject, &mut measurements, &fit, &mut choices)?;
    }
    bar.finish_and_clear();
    if let Some(path) = &args.write {
        std::fs::write(path, fit.to_rust()).with_context(|| path.display().to_string())?;
    }
    let prediction = [false, true].map(|held_out| predict(&measurements, &fit, held_out));
    print(&format!("{}\n", serde_json::to_string_pretty(&Report { adapter, fit, prediction, choices, measurements })?))
}

/// The scenes in a folder.
fn read_subjects(folder: &Path, held_out: bool, rbfs: usize, subjects: &mut Vec<Subject>) -> anyhow::Result<()> {
    let advice = || {
        format!(
            "{}: a folder of NAME.json and NAME/{{full_a,full_b,alpha}}.exr is needed; `smoke render --method path --halves` \
             makes such pictures",
            folder.display()
        )
    };
    let mut paths: Vec<PathBuf> = std::fs::read_dir(folder)
        .with_context(advice)?
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|path| path.extension().is_some_and(|extension| extension == "json"))
        .collect();
    paths.sort();
    let mut baked: Vec<(PathBuf, SmokeAnimation)> = Vec::new();
    for path in paths {
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let pictures = folder.join(&name);
        if !["full_a", "full_b", "alpha"].iter().all(|file| pictures.join(file).with_extension("exr").exists()) {
            eprintln!("warning: {}: no path-traced pictures beside it, so it is left out", path.display());
            continue;
        }
        let (scene, _) = Scene::read(&path)?;
        let density = scene.density.clone().with_context(|| format!("{} names no density", path.display()))?;
        let animation = match baked.iter().find(|(path, _)| *path == density) {
            Some((_, animation)) => animation.clone(),
            None => {
                let settings = BakeSettings { target: FitTarget::Count(rbfs), ..Default::default() };
                let animation = bake(&density::read(&density, None)?, &settings, &|_| {})?.animation;
                baked.push((density, animation.clone()));
                animation
            }
        };
        subjects.push(Subject { name, held_out, folder: pictures, scene, animation });
    }
    ensure!(!subjects.is_empty(), advice());
    Ok(())
}

/// Models that differ from the full one in one thing, or in the RBFs too.
fn simple_models(directed: bool) -> Vec<SmokeModel> {
    let full = SmokeModel::FULL;
    let mut models = vec![full];
    models.extend([400, 200, 100, 50].map(|rbfs| SmokeModel { rbfs, ..full }));
    models.extend([u32::MAX, 100].map(|rbfs| SmokeModel { rbfs, probes: 1, ..full }));
    models.extend([32, 16].map(|directions| SmokeModel { directions, ..full }));
    models.extend([1.0, 2.0, 4.0].map(|step| SmokeModel { step, ..full }));
    models.push(SmokeModel { half_resolution: true, ..full });
    if directed {
        models.extend([1, 2, 3].map(|order| SmokeModel { order, ..full }));
    }
    models
}

/// Measures what auto comes to in a scene by the fit.
fn choose(
    subject: &Subject,
    measurements: &mut Vec<Measurement>,
    fit: &Fit,
    choices: &mut Vec<Chosen>,
) -> anyhow::Result<()> {
    let mut stage = Stage::new(subject)?;
    let setting = stage.setting()?;
    let full = fit.milliseconds(&setting, &SmokeModel::FULL) as f32;
    let asked = [0.01, 0.02, 0.04].map(SmokeQuality::Error);
    let budgets = [0.5, 0.2, 0.1].map(|share| SmokeQuality::Budget(share * full));
    for asked in asked.into_iter().chain(budgets) {
        let chosen = fit.choose(asked, &setting);
        let measured = stage.measure(chosen, false)?;
        let known: Vec<&Measurement> =
            measurements.iter().filter(|m| m.scene == subject.name && m.error.is_some()).collect();
        let (error, time) = (measured.error.unwrap_or_default(), measured.milliseconds);
        let fastest = known.iter().filter(|m| m.error.unwrap_or(1.0) <= error).map(|m| m.milliseconds);
        let closest = known.iter().filter(|m| m.milliseconds <= time).filter_map(|m| m.error);
        choices.push(Chosen {
            scene: subject.name.clone(),
            held_out: subject.held_out,
            asked: format!("{asked:?}"),
            why: format!("{chosen:?}"),
            predicted_error: fit.error(&setting, &chosen),
            error,
            predicted_ms: fit.milliseconds(&setting, &chosen),
            milliseconds: time,
            slower: time / fastest.fold(time, f64::min),
            farther: error / closest.fold(error, f64::min),
        });
        measurements.push(measured);
    }
    Ok(())
}

/// How close the fit comes to pictures that it does not rest on.
fn predict(measurements: &[Measurement], fit: &Fit, held_out: bool) -> Prediction {
    let mut prediction = Prediction::default();
    let mut sums = [0.0; 2];
    for m in measurements.iter().filter(|m| m.held_out == held_out && (held_out || !m.is_fitted)) {
        let Some(error) = m.error else { continue };
        sums[0] += (fit.error(&m.setting, &m.model) / error).ln().powi(2);
        sums[1] += (fit.milliseconds(&m.setting, &m.model) / m.milliseconds).ln().powi(2);
        prediction.pictures += 1;
    }
    let rms = |sum: f64| (sum / prediction.pictures.max(1) as f64).sqrt();
    (prediction.error_log_rms, prediction.milliseconds_log_rms) = (rms(sums[0]), rms(sums[1]));
    prediction
}
