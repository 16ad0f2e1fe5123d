//! `smoke bake`: a density file into a bundle.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, bail};
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;

use super::output::{OutputFile, print};
use crate::bake::{BakeProgress, BakeReport, BakeSettings, Baked, bake};
use crate::bundle::MAX_RBFS;
use crate::density::{self, DensityGrid};
use crate::rbf::fit::FitTarget;

pub(super) const EXAMPLES: &str = "\
More Gaussians make light more accurate and cost more per frame; the residual keeps the density itself exact to 8 bits
whatever their number. 300 to 600 do for most smoke (the default is 600).

  smoke bake plume_0031.vdb -o plume.smoke
  smoke bake plume_0031.vdb -o plume.smoke --rbfs 300 --report plume.json
  smoke bake plume_0031.vdb -o plume.smoke --error 0.1    as many as it takes for a fit within 10 %
  smoke bake cloud.vdb -o cloud.smoke --grid density_2    a grid of another name

The same input, settings and seed give the same bundle. Sequences of several frames are not supported yet.";

/// Options of `smoke bake`.
#[derive(Args, Debug)]
pub struct BakeArgs {
    /// The density file, OpenVDB (.vdb) or NumPy (.npy)
    #[arg(required = true, value_name = "FRAMES")]
    frames: Vec<PathBuf>,
    /// The bundle to write
    #[arg(short, long, value_name = "OUT.smoke")]
    output: PathBuf,
    /// Number of Gaussians [default: 600]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_RBFS)), conflicts_with = "error")]
    rbfs: Option<u32>,
    /// Error of the fit to reach instead, relative to the density (0.02 is 2 %)
    #[arg(long, value_name = "ERROR", value_parser = fit_error)]
    error: Option<f32>,
    /// Name of the grid in an OpenVDB file [default: density, or the only one there is]
    #[arg(long)]
    grid: Option<String>,
    /// Playback speed in frames a second
    #[arg(long, default_value_t = 30.0, value_parser = frames_per_second)]
    fps: f32,
    /// Seed of the fit's random choices
    #[arg(long, default_value_t = BakeSettings::default().seed)]
    seed: u64,
    /// Also write figures as JSON: errors, sizes, seconds
    #[arg(long, value_name = "report.json")]
    report: Option<PathBuf>,
}

fn fit_error(text: &str) -> Result<f32, String> {
    let error = text.parse().map_err(|_| "not a number".to_string())?;
    if error > 0.0 && error < 1.0 { Ok(error) } else { Err("not between 0 and 1".into()) }
}

fn frames_per_second(text: &str) -> Result<f32, String> {
    let fps: f32 = text.parse().map_err(|_| "not a number".to_string())?;
    if fps > 0.0 && fps.is_finite() { Ok(fps) } else { Err("not above 0".into()) }
}

/// Runs `smoke bake`.
pub fn run(args: &BakeArgs) -> anyhow::Result<()> {
    let [input] = args.frames.as_slice() else {
        bail!("{} frames given, but sequences are not supported yet: bake one frame", args.frames.len());
    };
    let output = OutputFile::prepare(&args.output, &[input])?;
    let report_file =
        args.report.as_deref().map(|path| OutputFile::prepare(path, &[input, &args.output])).transpose()?;

    let started = Instant::now();
    let grid = density::read(input, args.grid.as_deref())?;
    let read_seconds = started.elapsed().as_secs_f64();
    warn_of_lost_smoke(&grid);

    let defaults = BakeSettings::default();
    let target = match (args.rbfs, args.error) {
        (Some(rbfs), _) => FitTarget::Count(rbfs as usize),
        (None, Some(error)) => FitTarget::Error(error),
        (None, None) => defaults.target,
    };
    let settings = BakeSettings { target, seed: args.seed, frames_per_second: args.fps, ..defaults };
    let bar = progress_bar();
    let result = bake(&grid, &settings, &|progress| show(&bar, &progress));
    bar.finish_and_clear();
    let Baked { file, report, .. } = result.with_context(|| input.display().to_string())?;
    if !report.fit.reached {
        let (rbfs, error) = (report.fit.rbfs, 100.0 * report.fit.error);
        eprintln!(
            "warning: {rbfs} RBFs and an error of {error:.2} % are the best fit found, short of what was asked for"
        );
    }

    output.write(&file)?;
    let summary = summary(&report);
    if let Some(report_file) = report_file {
        let report = FileReport {
            input: input.display().to_string(),
            output: args.output.display().to_string(),
            read_seconds,
            report,
        };
        report_file.write(format!("{}\n", serde_json::to_string_pretty(&report)?).as_bytes())?;
    }
    print(&format!("{}: {summary}\n", args.output.display()))
}

/// A bake's figures with the files they belong to.
#[derive(Serialize)]
struct FileReport {
    input: String,
    output: String,
    /// Seconds spent reading the input.
    read_seconds: f64,
    #[serde(flatten)]
    report: BakeReport,
}

fn summary(report: &BakeReport) -> String {
    format!(
        "{} RBFs, fit error {:.2} %, {} residuals, {} bytes, quantisation error {:.4} % of the picture, {:.1} s",
        report.fit.rbfs,
        100.0 * report.fit.error,
        report.residual.count,
        report.bytes.file,
        100.0 * report.picture.quantized,
        report.seconds.fit + report.seconds.residual + report.seconds.compress + report.seconds.verify,
    )
}

/// Warns of what a density file holds that is not taken over.
pub(super) fn warn_of_lost_smoke(grid: &DensityGrid) {
    if grid.source.negative_voxels > 0 {
        eprintln!("warning: {} voxels have negative density; they are taken as empty", grid.source.negative_voxels);
    }
    if grid.source.background != 0.0 {
        eprintln!("warning: the grid's background is {}, not 0; smoke outside its box is lost", grid.source.background);
    }
}

/// Steps of the progress bar.
pub(super) const BAR_STEPS: u64 = 1000;
/// Share of the bar for the fit, which takes most of the time.
const FIT_SHARE: f32 = 0.9;

/// A bar on standard error, invisible where that is not a terminal.
pub(super) fn progress_bar() -> ProgressBar {
    let bar = ProgressBar::new(BAR_STEPS);
    let style = ProgressStyle::with_template("{msg:>20} [{bar:40}] {elapsed}, about {eta} left");
    bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
    bar
}

fn show(bar: &ProgressBar, progress: &BakeProgress) {
    let (position, message) = match progress {
        BakeProgress::Fitting(fit) => {
            (fit.fraction * FIT_SHARE, format!("{} RBFs, {:.1} %", fit.rbfs, 100.0 * fit.error))
        }
        BakeProgress::Residual => (FIT_SHARE, "residual".into()),
        BakeProgress::Compressing => (FIT_SHARE, "compressing".into()),
        BakeProgress::Verifying => (1.0, "verifying".into()),
    };
    bar.set_position((position * BAR_STEPS as f32) as u64);
    bar.set_message(message);
}

#[cfg(test)]
pub(super) mod tests {
    use std::path::Path;

    use super::*;

    /// A blob of 12 × 10 × 8 cells as a NumPy file.
    pub fn blob(folder: &Path) -> PathBuf {
        let path = folder.join("blob.npy");
        let mut header = "{'descr': '<f4', 'fortran_order': False, 'shape': (12, 10, 8), }".to_string();
        // The data begins at a multiple of 64 bytes, and the header ends in a line end.
        header = format!("{header:117}\n");
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header.as_bytes());
        for i in 0..12 * 10 * 8 {
            let [x, y, z] = [i / 80, i / 8 % 10, i % 8].map(|x| x as f32);
            let distance2 = (x - 5.5).powi(2) + (y - 4.0).powi(2) + (z - 3.0).powi(2);
            bytes.extend((-distance2 / 9.0).exp().to_le_bytes());
        }
        std::fs::write(&path, bytes).unwrap();
        path
    }

    fn args(frames: &[&Path], output: &Path) -> BakeArgs {
        BakeArgs {
            frames: frames.iter().map(|path| path.to_path_buf()).collect(),
            output: output.into(),
            rbfs: Some(3),
            error: None,
            grid: None,
            fps: 24.0,
            seed: 1,
            report: None,
        }
    }

    #[test]
    fn a_bundle_and_a_report() {
        let dir = tempfile::tempdir().unwrap();
        let (output, report) = (dir.path().join("blob.smoke"), dir.path().join("blob.json"));
        let input = blob(dir.path());
        run(&BakeArgs { report: Some(report.clone()), ..args(&[&input], &output) }).unwrap();

        let bytes = std::fs::read(&output).unwrap();
        let animation = crate::bundle::read(&bytes).unwrap();
        assert_eq!(animation.frames_per_second, 24.0);
        let report: serde_json::Value = serde_json::from_slice(&std::fs::read(&report).unwrap()).unwrap();
        assert_eq!(report["fit"]["rbfs"], animation.frames.get(0).unwrap().rbfs.rbfs.len());
        assert_eq!(report["bytes"]["file"], bytes.len());
        assert!(report["quantization"]["worst_half_steps"]["error"].as_f64().unwrap() <= 1.0);
    }

    #[test]
    fn refused_before_any_work() {
        let dir = tempfile::tempdir().unwrap();
        let output = dir.path().join("out.smoke");
        let refusal = |args: &BakeArgs| run(args).unwrap_err().to_string();
        let missing = dir.path().join("none.vdb");
        assert!(refusal(&args(&[&missing, &missing], &output)).contains("2 frames given"));
        // The output's folder is missing too, and is what the message is about: outputs are checked first.
        assert!(refusal(&args(&[&missing], &dir.path().join("none/out.smoke"))).contains("none/out.smoke"));
        assert!(refusal(&args(&[&missing], &output)).contains("none.vdb"));
        let input = blob(dir.path());
        assert!(refusal(&args(&[&input], &input)).contains("is an input"));
        let report = Some(output.clone());
        assert!(refusal(&BakeArgs { report, ..args(&[&input], &output) }).contains("another output"));
        assert!(!output.exists());
    }
}
