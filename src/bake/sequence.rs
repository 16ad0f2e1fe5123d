//! Baking a list of files: all are looked at for a common box, then fitted one after the other, each from the one before.
//!
//! While a frame is fitted, the one before it is hashed, compressed and verified on another thread and the next is read on
//! a third: about three frames are in memory, however long the sequence.

use std::fs::{self, File};
use std::io::{BufReader, BufWriter, Read};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread;
use std::time::Instant;

use super::frame::{FinishedFrame, finish};
use super::parts::{Input, Job, Part, PartFigures, WorkFolder, replace};
use super::report::{FitSummary, InputReport, SequenceReport, StageSeconds, SummaryReport};
use super::survey::{Survey, survey};
use super::track::Track;
use super::{BakeError, BakeSettings, Clock, at};
use crate::bundle::{self, BundleError, BundleHeader, BundleWriter, WriteError};
use crate::density::DensityGrid;
use crate::rbf::fit::{FitProgress, NumberedRbfs};

/// The part of a sequence that is baked: the `number`-th of `of` runs of about the same length, from 1. The frames of a
/// segment are in the box of the whole sequence.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Segment {
    /// Which run, from 1.
    pub number: usize,
    /// How many runs there are, at most as many as frames.
    pub of: usize,
}

impl Segment {
    /// The whole sequence.
    pub const WHOLE: Self = Self { number: 1, of: 1 };

    /// The frames of the segment, of so many.
    pub fn range(&self, frames: usize) -> std::ops::Range<usize> {
        (self.number - 1) * frames / self.of..self.number * frames / self.of
    }
}

/// What to bake, and where to.
#[derive(Clone, Debug)]
pub struct Sequence<'a> {
    /// The density files, one a frame, at least one.
    pub inputs: &'a [PathBuf],
    /// Name of the grid in OpenVDB files.
    pub grid: Option<&'a str>,
    /// The part that is baked.
    pub segment: Segment,
    /// The bundle. Beside it a folder `NAME.parts` holds what has been finished, until all is.
    pub output: &'a Path,
}

/// How far a bake has come. Frames are counted from 0 within the segment.
#[derive(Clone, Copy, Debug)]
pub enum SequenceProgress {
    /// The work folder held the frames of other inputs or settings: they have been deleted.
    Restarted,
    /// So many inputs have been looked at.
    Surveyed(usize),
    /// So many frames have been finished before.
    Resumed(usize),
    /// A frame is being fitted.
    Fitting(usize, FitProgress),
    /// So many frames are finished.
    Finished(usize),
}

/// Bakes a sequence into a file. A bake that was stopped goes on where it was, with the same result to the last byte.
///
/// # Errors
///
/// Inputs that cannot be read or do not belong together, settings that make no sense, a box beyond the format's limits,
/// another process at work on the same output, or a disk that is full.
pub fn bake_sequence(
    sequence: &Sequence,
    settings: &BakeSettings,
    progress: &(dyn Fn(SequenceProgress) + Sync),
) -> Result<SequenceReport, BakeError> {
    let started = Instant::now();
    let Sequence { inputs, grid, segment, output } = *sequence;
    check_inputs(inputs, segment)?;
    let job = Job {
        version: (env!("CARGO_PKG_VERSION").into(), bundle::VERSION),
        settings: format!("{settings:?} {grid:?} {segment:?}"),
        inputs: inputs.iter().map(|path| Input::new(path)).collect::<Result<_, _>>()?,
    };
    let folder = WorkFolder::open(output)?;
    let (found, restarted) = folder.resume(&job)?;
    if restarted {
        progress(SequenceProgress::Restarted);
    }
    let survey = match found {
        Some(survey) => survey,
        None => {
            let done = AtomicUsize::new(0);
            let tell = || progress(SequenceProgress::Surveyed(done.fetch_add(1, Ordering::Relaxed) + 1));
            let survey = survey(inputs, grid, &tell)?;
            folder.begin(&job, &survey)?;
            survey
        }
    };
    let bake = Bake { sequence, settings, survey: &survey, folder: &folder, progress };
    let resumed = bake.frames()?;
    let (header, frames) = bake.assemble()?;
    let mut summary = SummaryReport::new(&frames, &header, settings.seed);
    summary.resumed = resumed;
    summary.seconds = started.elapsed().as_secs_f64();
    folder.remove()?;
    Ok(SequenceReport { summary, frames })
}

fn check_inputs(inputs: &[PathBuf], segment: Segment) -> Result<(), BakeError> {
    let Segment { number, of } = segment;
    if inputs.is_empty() {
        return Err(BakeError::Inputs("no frames to bake".into()));
    }
    if inputs.len() > bundle::MAX_FRAMES as usize {
        let problem = format!("{} frames; a bundle has at most {}", inputs.len(), bundle::MAX_FRAMES);
        return Err(BakeError::Inputs(problem));
    }
    if !(1..=of).contains(&number) || of > inputs.len() {
        let problem = format!("segment {number}/{of} of {} frames: there is no such segment", inputs.len());
        return Err(BakeError::Inputs(problem));
    }
    Ok(())
}

/// A frame that has been read.
struct Loaded {
    index: usize,
    grid: DensityGrid,
    seconds: f64,
}

/// A frame that has been fitted.
struct Fitted {
    loaded: Loaded,
    rbfs: NumberedRbfs,
    reference: Option<f32>,
    summary: FitSummary,
    seconds: f64,
}

struct Bake<'a> {
    sequence: &'a Sequence<'a>,
    settings: &'a BakeSettings,
    survey: &'a Survey,
    folder: &'a WorkFolder,
    progress: &'a (dyn Fn(SequenceProgress) + Sync),
}

impl Bake<'_> {
    /// The inputs of the segment.
    fn inputs(&self) -> &[PathBuf] {
        let Sequence { inputs, segment, .. } = self.sequence;
        &inputs[segment.range(inputs.len())]
    }

    /// Bakes all frames that are missing and returns how many were not.
    fn frames(&self) -> Result<usize, BakeError> {
        let (done, track) = self.resume();
        if done > 0 {
            (self.progress)(SequenceProgress::Resumed(done));
        }
        if done < self.inputs().len() {
            let mut track = match track {
                Some(track) => track,
                None => self.begin()?,
            };
            self.run(done, &mut track)?;
        }
        Ok(done)
    }

    /// How many frames are finished, and where the last of them left off.
    fn resume(&self) -> (usize, Option<Track>) {
        let mut track = None;
        for index in 0..self.inputs().len() {
            // A frame depends on the one before, so the first that is missing or damaged ends the row.
            let Some(part) = self.folder.load(index) else {
                return (index, track);
            };
            let Ok(frame) = part.packed.unpack(self.survey.shape) else {
                return (index, track);
            };
            let PartFigures { next_id, .. } = part.figures;
            let rbfs = NumberedRbfs { model: frame.rbfs, ids: frame.ids, next_id };
            track = Some(Track { rbfs, reference: part.figures.reference() });
        }
        (self.inputs().len(), track)
    }

    /// Where the segment begins: a later one needs the error of the sequence's first frame.
    fn begin(&self) -> Result<Track, BakeError> {
        let Sequence { inputs, segment, grid, .. } = self.sequence;
        let first = self.survey.first_smoke;
        let mut track = Track::default();
        if first < segment.range(inputs.len()).start {
            let path = &inputs[first];
            let grid = self.survey.read(path, *grid)?;
            let tell = |fit| (self.progress)(SequenceProgress::Fitting(0, fit));
            track.advance(&grid, self.settings, &tell).map_err(|error| in_frame(path, error))?;
            track.rbfs = NumberedRbfs::default();
        }
        Ok(track)
    }

    /// Bakes the frames from `first` on.
    fn run(&self, first: usize, track: &mut Track) -> Result<(), BakeError> {
        thread::scope(|scope| {
            // Without room in the channels: a thread hands over what it has and only then starts on the next.
            let (loaded_to, loaded) = sync_channel(0);
            let (fitted_to, fitted) = sync_channel(0);
            let reader = scope.spawn(move || self.read(first, &loaded_to));
            let finisher = scope.spawn(move || self.finish(&fitted));
            let fitter = self.fit(track, &loaded, &fitted_to);
            // The others end when nobody listens or speaks any more.
            drop((loaded, fitted_to));
            let results = [finisher.join(), reader.join()].map(|result| result.expect("no thread panics"));
            let [finisher, reader] = results;
            finisher.and(fitter).and(reader)
        })
    }

    fn read(&self, first: usize, to: &SyncSender<Loaded>) -> Result<(), BakeError> {
        for (index, path) in self.inputs().iter().enumerate().skip(first) {
            let mut clock = Clock::start();
            let grid = self.survey.read(path, self.sequence.grid)?;
            if to.send(Loaded { index, grid, seconds: clock.lap() }).is_err() {
                break;
            }
        }
        Ok(())
    }

    fn fit(&self, track: &mut Track, from: &Receiver<Loaded>, to: &SyncSender<Fitted>) -> Result<(), BakeError> {
        for loaded in from {
            let mut clock = Clock::start();
            let tell = |fit| (self.progress)(SequenceProgress::Fitting(loaded.index, fit));
            let summary = track
                .advance(&loaded.grid, self.settings, &tell)
                .map_err(|error| in_frame(&self.inputs()[loaded.index], error))?;
            let (rbfs, reference) = (track.rbfs.clone(), track.reference);
            if to.send(Fitted { loaded, rbfs, reference, summary, seconds: clock.lap() }).is_err() {
                break;
            }
        }
        Ok(())
    }

    fn finish(&self, from: &Receiver<Fitted>) -> Result<(), BakeError> {
        for Fitted { loaded: Loaded { index, grid, seconds: read }, rbfs, reference, summary, seconds: fit } in from {
            let seconds = StageSeconds { read, fit, ..StageSeconds::default() };
            let NumberedRbfs { model, ids, next_id } = rbfs;
            let exponent = self.settings.residual_exponent;
            let FinishedFrame { packed, max_density, report, .. } =
                finish(&grid, model, ids, summary, exponent, seconds, &|_| {})
                    .map_err(|error| in_frame(&self.inputs()[index], error))?;
            let figures = PartFigures::new(packed.uncompressed, max_density, next_id, reference, report);
            self.folder.store(index, &Part { figures, packed })?;
            (self.progress)(SequenceProgress::Finished(index + 1));
        }
        Ok(())
    }

    /// Puts the bundle together and into its place. Returns its header and the figures of its frames.
    fn assemble(&self) -> Result<(BundleHeader, Vec<InputReport>), BakeError> {
        let temporary = self.folder.bundle();
        let output = self.sequence.output;
        let header = BundleHeader {
            shape: self.survey.shape,
            placement: self.survey.placement,
            frames_per_second: self.settings.frames_per_second,
            max_density: 0.0,
            frames: Vec::new(),
        };
        let count = self.inputs().len();
        let fault = |error| at(&temporary, error);
        let file = File::create(&temporary).map_err(|error| fault(error.into()))?;
        let mut writer = BundleWriter::new(BufWriter::new(file), header, count).map_err(fault)?;
        let mut max_density = 0f32;
        let mut frames = Vec::with_capacity(count);
        for (index, path) in self.inputs().iter().enumerate() {
            let Part { figures, packed } = self.folder.load_finished(index)?;
            max_density = max_density.max(figures.max_density());
            writer.push(&packed).map_err(fault)?;
            frames.push(InputReport { input: path.display().to_string(), report: figures.report });
        }
        let (file, header) = writer.finish(max_density).map_err(fault)?;
        file.get_ref().sync_all().map_err(|error| fault(error.into()))?;
        verify(&temporary, &header).map_err(fault)?;
        replace(&temporary, output).map_err(|source| BakeError::Io { path: output.into(), source })?;
        Ok((header, frames))
    }
}

/// Reads a finished file again: its header, its length and every frame's checksum.
pub(super) fn verify(path: &Path, expected: &BundleHeader) -> Result<(), WriteError> {
    let length = fs::metadata(path)?.len();
    let mut file = BufReader::new(File::open(path)?);
    let mut bytes = vec![0; expected.frames[0].offset as usize];
    file.read_exact(&mut bytes)?;
    let header = BundleHeader::read(&bytes)?;
    header.check_length(length)?;
    for (index, entry) in header.frames.iter().enumerate() {
        bytes.resize(entry.length as usize, 0);
        file.read_exact(&mut bytes)?;
        if header != *expected || crc32fast::hash(&bytes) != entry.crc32 {
            return Err(BundleError::Frame { index, error: bundle::FrameError::Checksum }.into());
        }
    }
    Ok(())
}

fn in_frame(path: &Path, source: BakeError) -> BakeError {
    BakeError::Frame { path: path.into(), source: source.into() }
}
