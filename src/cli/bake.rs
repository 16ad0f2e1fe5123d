//! `smoke bake`: density files into a bundle.

use std::path::{Path, PathBuf};

use anyhow::ensure;
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};

use super::frames;
use super::output::{OutputFile, print};
use crate::bake::{
    BakeSettings, InputReport, Segment, Sequence, SequenceProgress, SequenceReport, SourceReport, SummaryReport,
    bake_sequence,
};
use crate::bundle::MAX_RBFS;
use crate::density::DensityGrid;
use crate::rbf::fit::FitTarget;

pub(super) const EXAMPLES: &str = "\
More Gaussians make light more accurate and cost more per frame; the residual keeps the density itself exact to 8 bits
whatever their number. 300 to 600 do for most smoke (the default is 600).

  smoke bake plume_0031.vdb -o plume.smoke
  smoke bake plume_*.vdb -o plume.smoke --rbfs 300 --report plume.json
  smoke bake 'plume_*.vdb' -o plume.smoke           the same, sorted by number: 9 before 10 without zeros too
  smoke bake plume_%04d.vdb -o plume.smoke          all numbers there are; a gap is an error
  smoke bake cloud.vdb -o cloud.smoke --error 0.1   as many as it takes for a fit within 10 %
  smoke bake cloud.vdb -o cloud.smoke --grid density_2    a grid of another name

FRAMES are taken in the order given (the shell sorts its patterns letter by letter). All frames get one box, so their
voxels have to be of one grid. Each frame is fitted from the one before: --rbfs is the number of Gaussians in the first,
later ones get more while their error is above --threshold times the first's, up to --max-rbfs.

A bake that was stopped, or killed, goes on when the same command is given again, and gives the same bytes: what is done
is kept in OUT.smoke.parts until all is. Inputs, settings and seed decide the bundle; threads do not.

Segments bake on as many machines as there are, here with GNU parallel; any farm's scheduler does:

  parallel -q smoke bake 'plume_*.vdb' -o seg{}.smoke --segment {}/4 ::: 1 2 3 4
  smoke join seg1.smoke seg2.smoke seg3.smoke seg4.smoke -o plume.smoke";

/// Options of `smoke bake`.
#[derive(Args, Debug)]
pub struct BakeArgs {
    /// The density files, OpenVDB (.vdb) or NumPy (.npy), one a frame; quoted, `name_*.vdb` and `name_%04d.vdb` work too
    #[arg(required = true, value_name = "FRAMES")]
    frames: Vec<PathBuf>,
    /// The bundle to write
    #[arg(short, long, value_name = "OUT.smoke")]
    output: PathBuf,
    /// Number of Gaussians in the first frame [default: 600]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_RBFS)), conflicts_with = "error")]
    rbfs: Option<u32>,
    /// Error of the fit to reach instead, relative to the density (0.02 is 2 %)
    #[arg(long, value_name = "ERROR", value_parser = fit_error)]
    error: Option<f32>,
    /// Most Gaussians in a later frame [default: twice --rbfs, with --error 2000]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_RBFS)))]
    max_rbfs: Option<u32>,
    /// Later frames get more Gaussians while their error is above this times the first frame's; at least 1
    #[arg(long, default_value_t = BakeSettings::default().threshold, value_parser = threshold)]
    threshold: f32,
    /// Bake only the K-th of N runs of the frames, in the box of all: see `smoke join`
    #[arg(long, value_name = "K/N", value_parser = segment)]
    segment: Option<Segment>,
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

fn threshold(text: &str) -> Result<f32, String> {
    let threshold: f32 = text.parse().map_err(|_| "not a number".to_string())?;
    if threshold >= 1.0 && threshold.is_finite() { Ok(threshold) } else { Err("below 1".into()) }
}

fn segment(text: &str) -> Result<Segment, String> {
    let parse = || {
        let (number, of) = text.split_once('/')?;
        let (number, of) = (number.parse().ok()?, of.parse().ok()?);
        (1..=of).contains(&number).then_some(Segment { number, of })
    };
    parse().ok_or_else(|| "not K/N with K from 1 to N".into())
}

/// Runs `smoke bake`.
pub fn run(args: &BakeArgs) -> anyhow::Result<()> {
    let inputs = frames::expand(&args.frames)?;
    let taken: Vec<&Path> = inputs.iter().map(PathBuf::as_path).collect();
    let output = OutputFile::prepare(&args.output, &taken)?;
    let taken: Vec<&Path> = taken.into_iter().chain([args.output.as_path()]).collect();
    let report_file = args.report.as_deref().map(|path| OutputFile::prepare(path, &taken)).transpose()?;
    if !frames::is_in_natural_order(&inputs) {
        eprintln!("warning: the frames are not in the order of their numbers; quote the pattern to have it sorted");
    }
    if let (Some(rbfs), Some(most)) = (args.rbfs, args.max_rbfs) {
        ensure!(most >= rbfs, "--max-rbfs {most} is less than --rbfs {rbfs}");
    }

    let settings = settings(args);
    let sequence = Sequence {
        inputs: &inputs,
        grid: args.grid.as_deref(),
        segment: args.segment.unwrap_or(Segment::WHOLE),
        output: output.path(),
    };
    let bar = Bar::new(inputs.len(), sequence.segment);
    let result = bake_sequence(&sequence, &settings, &|progress| bar.show(&progress));
    bar.0.finish_and_clear();
    let report = result?;
    warn(&report, &settings);
    if let Some(report_file) = report_file {
        report_file.write(format!("{}\n", serde_json::to_string_pretty(&report)?).as_bytes())?;
    }
    print(&format!("{}: {}\n", args.output.display(), summary(&report)))
}

fn settings(args: &BakeArgs) -> BakeSettings {
    let defaults = BakeSettings::default();
    let target = match (args.rbfs, args.error) {
        (Some(rbfs), _) => FitTarget::Count(rbfs as usize),
        (None, Some(error)) => FitTarget::Error(error),
        (None, None) => defaults.target,
    };
    BakeSettings {
        target,
        max_rbfs: args.max_rbfs.map(|most| most as usize),
        threshold: args.threshold,
        seed: args.seed,
        frames_per_second: args.fps,
        ..defaults
    }
}

fn summary(report: &SequenceReport) -> String {
    let SummaryReport { frames, rbfs: [fewest, most], worst_error, worst_frame, bytes, .. } = report.summary;
    let plural = if frames == 1 { "" } else { "s" };
    let rbfs = if fewest == most { most.to_string() } else { format!("{fewest} to {most}") };
    let quantized = report.frames.iter().map(|frame| frame.report.picture.quantized).fold(0.0, f64::max);
    let baked = frames - report.summary.resumed;
    format!(
        "{frames} frame{plural}, {rbfs} RBFs, fit error up to {:.2} % (frame {worst_frame}, {}), quantisation error up to {:.4} % of \
         the picture, {bytes} bytes ({:.0} a frame), {:.1} s ({:.2} a frame)",
        100.0 * worst_error,
        report.frames[worst_frame].input,
        100.0 * quantized,
        report.summary.bytes_per_frame,
        report.summary.seconds,
        report.summary.seconds / baked.max(1) as f64,
    )
}

/// One line for every kind of thing to know about a bake.
fn warn(report: &SequenceReport, settings: &BakeSettings) {
    let frames_with = |has: fn(&SourceReport) -> bool| {
        let frames = report.frames.iter().enumerate().filter(|(_, frame)| has(&frame.report.source));
        ranges(frames.map(|(index, _)| index))
    };
    let negative = frames_with(|source| source.negative_voxels > 0);
    if !negative.is_empty() {
        eprintln!("warning: voxels of negative density are taken as empty (frame {negative})");
    }
    let background = frames_with(|source| source.background != 0.0);
    if !background.is_empty() {
        eprintln!("warning: the grid's background is not 0; smoke outside its box is lost (frame {background})");
    }
    let with_reason = |frame: &InputReport| frame.report.fit.shortfall.clone();
    let mut reasons: Vec<String> = report.frames.iter().filter_map(with_reason).collect();
    reasons.sort();
    reasons.dedup();
    for reason in reasons {
        let short: Vec<usize> = (0..report.frames.len())
            .filter(|&index| report.frames[index].report.fit.shortfall.as_ref() == Some(&reason))
            .collect();
        let fits = || short.iter().map(|&index| &report.frames[index].report.fit);
        let worst = 100.0 * fits().map(|fit| fit.error).fold(0.0, f64::max);
        let ratio = fits().map(|fit| fit.ratio).fold(0.0, f64::max);
        let beyond = match settings.target {
            FitTarget::Count(_) if ratio > f64::from(settings.threshold) => {
                format!("above {} times the first frame's, up to {ratio:.2} times", settings.threshold)
            }
            FitTarget::Count(_) => "with fewer RBFs than asked for".into(),
            FitTarget::Error(error) => format!("above {} %", 100.0 * error),
        };
        let short = ranges(short.into_iter());
        eprintln!("warning: frame {short}: {reason}; fit error up to {worst:.2} %, {beyond}");
    }
}

/// Numbers as ranges: `0, 3–7, 9`.
fn ranges(numbers: impl Iterator<Item = usize>) -> String {
    let mut ranges: Vec<(usize, usize)> = Vec::new();
    for number in numbers {
        match ranges.last_mut() {
            Some((_, last)) if *last + 1 == number => *last = number,
            _ => ranges.push((number, number)),
        }
    }
    let text =
        |(first, last): &(usize, usize)| if first == last { first.to_string() } else { format!("{first}–{last}") };
    ranges.iter().map(text).collect::<Vec<_>>().join(", ")
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

/// Steps of a progress bar, or of one frame in a bar of several.
pub(super) const BAR_STEPS: u64 = 1000;

/// A bar on standard error, invisible where that is not a terminal.
pub(super) fn progress_bar() -> ProgressBar {
    let bar = ProgressBar::new(BAR_STEPS);
    let style = ProgressStyle::with_template("{msg:>20} [{bar:40}] {elapsed}, about {eta} left");
    bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
    bar
}

/// The bar of a whole bake.
struct Bar(ProgressBar, usize);

impl Bar {
    fn new(inputs: usize, segment: Segment) -> Self {
        let bar = progress_bar();
        let frames = segment.range(inputs).len();
        bar.set_length(frames as u64 * BAR_STEPS);
        Self(bar, frames)
    }

    fn show(&self, progress: &SequenceProgress) {
        let Self(bar, frames) = self;
        let reach = |position: u64| bar.set_position(bar.position().max(position));
        match *progress {
            SequenceProgress::Restarted => {
                bar.suspend(|| eprintln!("inputs or settings have changed: the bake starts afresh"));
            }
            SequenceProgress::Surveyed(inputs) => bar.set_message(format!("{inputs} inputs read")),
            SequenceProgress::Resumed(done) => {
                bar.suspend(|| eprintln!("{done} of {frames} frames are finished already"));
                bar.set_position(done as u64 * BAR_STEPS);
                bar.reset_eta();
            }
            SequenceProgress::Fitting(frame, fit) => {
                reach(frame as u64 * BAR_STEPS + (fit.fraction * BAR_STEPS as f32) as u64);
                bar.set_message(format!("frame {}/{frames}: {} RBFs, {:.1} %", frame + 1, fit.rbfs, 100.0 * fit.error));
            }
            SequenceProgress::Finished(_) => {}
        }
    }
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
            max_rbfs: None,
            threshold: 1.2,
            segment: None,
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
        let frame = &report["frames"][0];
        assert_eq!(frame["fit"]["rbfs"], animation.frames.get(0).unwrap().rbfs.rbfs.len());
        assert_eq!(report["summary"]["bytes"], bytes.len());
        assert!(frame["quantization"]["worst_half_steps"]["error"].as_f64().unwrap() <= 1.0);
        assert!(!dir.path().join("blob.smoke.parts").exists());
    }

    #[test]
    fn refused_before_any_work() {
        let dir = tempfile::tempdir().unwrap();
        let output = dir.path().join("out.smoke");
        let refusal = |args: &BakeArgs| run(args).unwrap_err().to_string();
        let missing = dir.path().join("none.vdb");
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
