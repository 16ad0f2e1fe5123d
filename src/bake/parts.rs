//! The work folder of a bake: what has been finished, so that a bake that was stopped can go on.
//!
//! `OUT.smoke.parts` holds a lock, a manifest that says what is being baked, and one part a frame. Every file is written
//! beside its place, flushed to disk and renamed, so a file that is there is whole, unless the disk lost it: a checksum
//! tells. A part holds all that the next frame needs, so a bake that goes on gives the same bytes as one that was never
//! stopped.

use std::fs::{self, File, TryLockError};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use glam::{DVec3, IVec3, UVec3};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::BakeError;
use super::report::FrameReport;
use super::survey::Survey;
use crate::bundle::PackedFrame;
use crate::density::{GridShape, Placement};

/// Where a bake keeps what it has done.
pub(super) struct WorkFolder {
    path: PathBuf,
    /// Held for as long as the bake runs; a process that is killed lets go of it.
    lock: File,
}

/// What is being baked: a bake goes on only with parts of the same.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Job {
    /// Versions of the program and of the format.
    pub version: (String, u32),
    /// All settings, written out.
    pub settings: String,
    pub inputs: Vec<Input>,
}

/// An input file. Contents are not read again to see whether a bake may go on: length and time tell.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Input {
    path: PathBuf,
    bytes: u64,
    /// Time of the last change, since 1970.
    modified: (u64, u32),
}

impl Input {
    pub fn new(path: &Path) -> Result<Self, BakeError> {
        let describe = |source| BakeError::Io { path: path.into(), source };
        let metadata = fs::metadata(path).map_err(describe)?;
        let modified = metadata.modified().map_err(describe)?.duration_since(std::time::UNIX_EPOCH).unwrap_or_default();
        Ok(Self {
            path: path.canonicalize().map_err(describe)?,
            bytes: metadata.len(),
            modified: (modified.as_secs(), modified.subsec_nanos()),
        })
    }
}

/// The survey's result in whole numbers, since text need not keep the last bit of a fraction.
#[derive(Serialize, Deserialize)]
struct StoredSurvey {
    min: [i32; 3],
    dims: [u32; 3],
    center: [u64; 3],
    voxel_size: u64,
    first_smoke: usize,
}

#[derive(Serialize, Deserialize)]
struct Manifest {
    job: Job,
    survey: StoredSurvey,
}

/// A finished frame.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Part {
    pub figures: PartFigures,
    pub packed: PackedFrame,
}

/// What a part holds beside the frame itself. Fractions that matter are stored by their bits.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct PartFigures {
    uncompressed: u64,
    max_density: u32,
    /// For the frame after this one: the next new Gaussian's number, and the error of the first frame.
    pub next_id: u32,
    reference: Option<u32>,
    pub report: FrameReport,
}

impl PartFigures {
    pub fn new(uncompressed: u64, max_density: f32, next_id: u32, reference: Option<f32>, report: FrameReport) -> Self {
        let max_density = max_density.to_bits();
        Self { uncompressed, max_density, next_id, reference: reference.map(f32::to_bits), report }
    }

    pub fn max_density(&self) -> f32 {
        f32::from_bits(self.max_density)
    }

    pub fn reference(&self) -> Option<f32> {
        self.reference.map(f32::from_bits)
    }
}

impl WorkFolder {
    /// Opens the work folder of an output, which is made if it is missing, for this process alone.
    pub fn open(output: &Path) -> Result<Self, BakeError> {
        let mut name = output.file_name().unwrap_or_default().to_os_string();
        name.push(".parts");
        let path = output.with_file_name(name);
        let lock_path = path.join("lock");
        let describe = |source| BakeError::Io { path: path.clone(), source };
        loop {
            fs::create_dir_all(&path).map_err(describe)?;
            let lock = match File::options().create(true).truncate(false).write(true).open(&lock_path) {
                // Another process has just finished and taken the folder away.
                Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
                lock => lock.map_err(describe)?,
            };
            match lock.try_lock() {
                Ok(()) => {}
                Err(TryLockError::WouldBlock) => return Err(BakeError::Busy(output.into())),
                Err(TryLockError::Error(error)) => return Err(describe(error)),
            }
            if is_at(&lock, &lock_path) {
                return Ok(Self { path, lock });
            }
        }
    }

    /// The survey of an earlier run of the same job. The folder of another one is emptied; the second value tells.
    pub fn resume(&self, job: &Job) -> Result<(Option<Survey>, bool), BakeError> {
        let found: Option<Manifest> =
            fs::read(self.manifest()).ok().and_then(|text| serde_json::from_slice(&text).ok());
        if let Some(Manifest { job: found, survey }) = found
            && found == *job
        {
            return Ok((Some(survey.into()), false));
        }
        let mut other = false;
        for entry in fs::read_dir(&self.path).map_err(|error| self.fault(error))? {
            let path = entry.map_err(|error| self.fault(error))?.path();
            if path.file_name().is_some_and(|name| name != "lock") {
                fs::remove_file(&path).map_err(|source| BakeError::Io { path, source })?;
                other = true;
            }
        }
        Ok((None, other))
    }

    /// Begins a job: from here on it may be resumed.
    pub fn begin(&self, job: &Job, survey: &Survey) -> Result<(), BakeError> {
        let manifest = Manifest { job: job.clone(), survey: survey.into() };
        self.write(&self.manifest(), &[&json(&manifest)])
    }

    /// Stores a finished frame.
    pub fn store(&self, index: usize, part: &Part) -> Result<(), BakeError> {
        let figures = json(&part.figures);
        let length = (figures.len() as u64).to_le_bytes();
        let mut crc = crc32fast::Hasher::new();
        let sections = [&length[..], &figures, &part.packed.bytes];
        sections.iter().for_each(|section| crc.update(section));
        self.write(&self.part(index), &[sections[0], sections[1], sections[2], &crc.finalize().to_le_bytes()])
    }

    /// A finished frame, if it is there and whole.
    pub fn load(&self, index: usize) -> Option<Part> {
        let bytes = fs::read(self.part(index)).ok()?;
        let (body, crc) = bytes.split_last_chunk()?;
        if crc32fast::hash(body) != u32::from_le_bytes(*crc) {
            return None;
        }
        let (length, rest) = body.split_first_chunk()?;
        let (figures, packed) = rest.split_at_checked(usize::try_from(u64::from_le_bytes(*length)).ok()?)?;
        let figures: PartFigures = from_json(figures)?;
        let packed = PackedFrame { bytes: packed.to_vec(), uncompressed: figures.uncompressed };
        Some(Part { figures, packed })
    }

    /// A finished frame that has been stored before.
    pub fn load_finished(&self, index: usize) -> Result<Part, BakeError> {
        let damaged = || io::Error::new(io::ErrorKind::InvalidData, "a finished frame is damaged: bake again");
        self.load(index).ok_or_else(|| BakeError::Io { path: self.part(index), source: damaged() })
    }

    /// Where the bundle is put together, on the same disk as its place.
    pub fn bundle(&self) -> PathBuf {
        self.path.join("bundle.tmp")
    }

    /// Takes the folder away: its job is done.
    pub fn remove(self) -> Result<(), BakeError> {
        // The lock last, and the manifest before the parts: what is left of a folder is never taken for a job.
        let files = fs::read_dir(&self.path).map_err(|error| self.fault(error))?;
        let mut files: Vec<PathBuf> =
            files.map(|entry| Ok(entry?.path())).collect::<io::Result<_>>().map_err(|error| self.fault(error))?;
        files.sort_by_key(|path| (path.ends_with("lock"), !path.ends_with("manifest.json")));
        for path in files {
            fs::remove_file(&path).map_err(|source| BakeError::Io { path, source })?;
        }
        fs::remove_dir(&self.path).map_err(|error| self.fault(error))?;
        drop(self.lock);
        Ok(())
    }

    fn manifest(&self) -> PathBuf {
        self.path.join("manifest.json")
    }

    fn part(&self, index: usize) -> PathBuf {
        self.path.join(format!("frame_{index:05}.part"))
    }

    /// Writes a file beside its place, and renames it when it is on disk.
    fn write(&self, path: &Path, sections: &[&[u8]]) -> Result<(), BakeError> {
        let temporary = path.with_extension("tmp");
        let write = || {
            let mut file = File::create(&temporary)?;
            sections.iter().try_for_each(|section| file.write_all(section))?;
            file.sync_all()?;
            replace(&temporary, path)
        };
        write().map_err(|source| BakeError::Io { path: path.into(), source })
    }

    fn fault(&self, source: io::Error) -> BakeError {
        BakeError::Io { path: self.path.clone(), source }
    }
}

/// Renames a file that is on disk, and flushes the name too.
pub(super) fn replace(temporary: &Path, path: &Path) -> io::Result<()> {
    fs::rename(temporary, path)?;
    // Only some systems can flush a folder; elsewhere renaming is all there is.
    #[cfg(unix)]
    if let Some(folder) = path.parent() {
        let folder = if folder == Path::new("") { Path::new(".") } else { folder };
        File::open(folder)?.sync_all()?;
    }
    Ok(())
}

/// Whether an open file is still the one of that name. Where a file cannot be removed while it is open it always is.
fn is_at(file: &File, path: &Path) -> bool {
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        let same = || Ok::<_, io::Error>(file.metadata()?.ino() == fs::metadata(path)?.ino());
        same().unwrap_or(false)
    }
    #[cfg(not(unix))]
    {
        let _ = file;
        path.exists()
    }
}

fn json(value: &impl Serialize) -> Vec<u8> {
    serde_json::to_vec(value).expect("plain data with text keys")
}

fn from_json<T: DeserializeOwned>(text: &[u8]) -> Option<T> {
    serde_json::from_slice(text).ok()
}

impl From<&Survey> for StoredSurvey {
    fn from(survey: &Survey) -> Self {
        let Survey { min, shape, placement, first_smoke } = *survey;
        Self {
            min: min.to_array(),
            dims: shape.dims.to_array(),
            center: placement.center.to_array().map(f64::to_bits),
            voxel_size: placement.voxel_size.to_bits(),
            first_smoke,
        }
    }
}

impl From<StoredSurvey> for Survey {
    fn from(stored: StoredSurvey) -> Self {
        let placement = Placement {
            center: DVec3::from_array(stored.center.map(f64::from_bits)),
            voxel_size: f64::from_bits(stored.voxel_size),
        };
        Self {
            min: IVec3::from_array(stored.min),
            shape: GridShape { dims: UVec3::from_array(stored.dims) },
            placement,
            first_smoke: stored.first_smoke,
        }
    }
}
