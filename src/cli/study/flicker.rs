//! `smoke study flicker`: how much a baked animation flickers when the plug-in draws it, against a truth without noise.
//!
//! Both are pictures of single scattering from a camera that does not move, one ray a pixel: the plug-in's of every frame of
//! the bundle, and the truth, computed voxel by voxel from the density that the frame was baked from. What flickers is their
//! difference, the error: see [`flicker`].

mod stage;
mod truth;

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, ensure};
use clap::Args;
use serde::Serialize;

use self::stage::Stage;
use self::truth::{Picture, Truth};
use crate::bundle::{self, SmokeAnimation};
use crate::cli::bake::{BAR_STEPS, progress_bar, warn_of_lost_smoke};
use crate::cli::output::print;
use crate::cli::render::parse_size;
use crate::cli::scene::{Scene, ScenePlacement};
use crate::density;
use crate::reference::compare::{CompareError, image_error};
use crate::reference::flicker::{Change, flicker};

/// Options of `smoke study flicker`.
#[derive(Args, Debug)]
pub struct FlickerArgs {
    /// Bundles of the same animation, to be compared with each other
    #[arg(required = true, value_name = "BUNDLE.smoke")]
    bundles: Vec<PathBuf>,
    /// The density files that all of them were baked from; sorted by path they are the frames, the first one 0
    #[arg(long, required = true, num_args = 2.., value_name = "FRAMES")]
    density: Vec<PathBuf>,
    /// Medium, light from all around and camera, as for `smoke render`, with "placement": "file" [default: the scene of a
    /// plume 3 m tall, isotropic and grey, under a soft light]
    #[arg(long)]
    scene: Option<PathBuf>,
    /// Picture size, in place of the scene's
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    size: Option<[u32; 2]>,
    /// Directions in which every voxel of the truth looks for light. The plug-in's probes look along the same 64: what
    /// both miss is seen with more, 300 say
    #[arg(long, value_name = "N", default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..=65_536))]
    directions: u32,
    /// Print JSON, with the error of every frame and the change from each to the next
    #[arg(long)]
    json: bool,
}

/// A plume 3 m tall under a soft light.
pub(super) const DEFAULT_SCENE: &str = r#"{
    "placement": "file", "sigma_t": 2.49, "albedo": [0.66, 0.66, 0.66], "g": 0,
    "env": {
        "kind": "lobes", "ambient": [0.12, 0.15, 0.2],
        "lobes": [
            { "dir": [0.6, 0.75, 0.28], "rgb": [3.0, 2.7, 2.2] },
            { "dir": [-0.8, -0.1, 0.6], "rgb": [0.2, 0.3, 0.5] }
        ]
    },
    "eye": [0, 0, 6], "target": [0, 0, 0], "fov_y_deg": 28, "size": [96, 128]
}"#;

#[derive(Serialize)]
struct Report {
    size: [u32; 2],
    directions: u32,
    frames: usize,
    /// Mean seconds that a frame of the truth took.
    truth_seconds: f64,
    bundles: Vec<Row>,
}

/// What came of a bundle.
#[derive(Serialize)]
struct Row {
    bundle: String,
    /// Relative error of the frames with smoke; 0.01 is one per cent.
    error_mean: f64,
    error_max: f64,
    /// Null where the truth stands still.
    flicker: Option<f64>,
    /// One a frame; null where there is no smoke or no light.
    errors: Vec<Option<f64>>,
    /// One a pair of frames that follow each other.
    changes: Vec<Step>,
}

/// Root mean square change from one frame to the next, in units of radiance.
#[derive(Serialize)]
struct Step {
    error: f64,
    truth: f64,
}

/// Runs the study.
pub fn run(args: &FlickerArgs) -> anyhow::Result<()> {
    let report = study(args)?;
    if args.json {
        return print(&format!("{}\n", serde_json::to_string_pretty(&report)?));
    }
    let mut table = String::from("| bundle | frames | error mean | error max | flicker |\n|---|---|---|---|---|\n");
    for Row { bundle, error_mean, error_max, flicker, .. } in &report.bundles {
        let [mean, max] = [error_mean, error_max].map(|error| 100.0 * error);
        let flicker = flicker.map_or("–".into(), |flicker| format!("{flicker:.3}"));
        table += &format!("| {bundle} | {} | {mean:.2} % | {max:.2} % | {flicker} |\n", report.frames);
    }
    print(&table)
}

fn study(args: &FlickerArgs) -> anyhow::Result<Report> {
    let scene = read_scene(args)?;
    let size = scene.camera.size;
    let mut paths = args.density.clone();
    paths.sort();
    let animations =
        args.bundles.iter().map(|path| read_bundle(path, paths.len())).collect::<anyhow::Result<Vec<_>>>()?;
    let truth = Truth::new(&scene, args.directions as usize)?;
    let mut stage = Stage::new(&scene, animations)?;

    let bar = progress_bar();
    let mut records: Vec<Record> = args.bundles.iter().map(|_| Record::default()).collect();
    let mut before = None;
    let mut truth_seconds = 0.0;
    for (frame, path) in paths.iter().enumerate() {
        bar.set_message(format!("frame {frame}"));
        let density = density::read(path, None)?;
        warn_of_lost_smoke(&density);
        let started = Instant::now();
        let truth = truth.picture(&density);
        truth_seconds += started.elapsed().as_secs_f64();
        for (index, record) in records.iter_mut().enumerate() {
            let picture = stage.draw(index, frame as u32)?;
            record.add(before.as_ref(), picture, &truth).with_context(|| path.display().to_string())?;
        }
        before = Some(truth);
        bar.set_position(BAR_STEPS * (frame as u64 + 1) / paths.len() as u64);
    }
    bar.finish_and_clear();

    let frames = paths.len();
    let bundles = args.bundles.iter().zip(records).map(|(path, record)| record.row(path)).collect();
    Ok(Report { size, directions: args.directions, frames, truth_seconds: truth_seconds / frames as f64, bundles })
}

fn read_scene(args: &FlickerArgs) -> anyhow::Result<Scene> {
    let (mut scene, warnings) = match &args.scene {
        Some(path) => Scene::read(path)?,
        None => Scene::parse(DEFAULT_SCENE, Path::new(""))?,
    };
    let name = args.scene.as_deref().unwrap_or(Path::new("the default scene")).display();
    for warning in warnings {
        eprintln!("warning: {name}: {warning}");
    }
    ensure!(
        scene.placement == ScenePlacement::File,
        "{name}: placement: \"file\" is needed, for the box of every density file is another"
    );
    ensure!(scene.lights.is_empty(), "{name}: lights: this study lights smoke by its environment alone");
    scene.camera.size = args.size.unwrap_or(scene.camera.size);
    Ok(scene)
}

fn read_bundle(path: &Path, frames: usize) -> anyhow::Result<SmokeAnimation> {
    let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    let animation = bundle::read(&bytes).with_context(|| path.display().to_string())?;
    let found = animation.frames.len();
    ensure!(found == frames, "{} has {found} frames, but {frames} density files are given", path.display());
    Ok(animation)
}

/// What is known of a bundle so far.
#[derive(Default)]
struct Record {
    /// What was drawn of the frame before.
    picture: Vec<[f32; 3]>,
    errors: Vec<Option<f64>>,
    changes: Vec<Change>,
}

impl Record {
    fn add(&mut self, before: Option<&Picture>, picture: Vec<[f32; 3]>, truth: &Picture) -> Result<(), CompareError> {
        // Neither has noise: each is its own second half.
        self.errors.push(match image_error([&picture, &picture], [&truth.radiance, &truth.radiance], &truth.alpha) {
            Ok(error) => Some(error.relative),
            Err(CompareError::NoSmoke | CompareError::Black) => None,
            Err(error) => return Err(error),
        });
        if let Some(before) = before {
            self.changes.push(Change::between(before.drawn_as(&self.picture), truth.drawn_as(&picture)));
        }
        self.picture = picture;
        Ok(())
    }

    fn row(self, path: &Path) -> Row {
        let known: Vec<f64> = self.errors.iter().flatten().copied().collect();
        Row {
            bundle: path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned(),
            error_mean: known.iter().sum::<f64>() / known.len().max(1) as f64,
            error_max: known.iter().copied().fold(0.0, f64::max),
            flicker: flicker(&self.changes),
            errors: self.errors,
            changes: self.changes.iter().map(|&Change { error, truth }| Step { error, truth }).collect(),
        }
    }
}

#[cfg(test)]
mod tests;
