//! Files the command writes: checked before the long work, written whole or not at all, never over an input.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};

/// A file to be written when the work is done.
#[derive(Clone, Debug)]
pub struct OutputFile {
    path: PathBuf,
}

impl OutputFile {
    /// Checks that `path` can be written, without leaving anything behind: its folder exists and takes new files, what
    /// is there already (if anything) is an ordinary file that may be replaced, and it is none of the files that are
    /// `taken`: inputs and other outputs.
    pub fn prepare(path: &Path, taken: &[&Path]) -> anyhow::Result<Self> {
        let describe = || format!("cannot write {}", path.display());
        ensure!(path.file_name().is_some(), "{} does not name a file", path.display());
        let target = resolve(path).with_context(describe)?;
        for other in taken {
            let same = resolve(other).is_ok_and(|other| other == target);
            ensure!(!same, "{} is an input, or another output: choose a different name", path.display());
        }
        match fs::metadata(&target) {
            Ok(found) if found.is_dir() => bail!("{} is a folder: name a file in it", path.display()),
            Ok(found) if !found.is_file() => bail!("{} is not an ordinary file", path.display()),
            Ok(found) if found.permissions().readonly() => bail!("{} is read-only", path.display()),
            _ => {}
        }
        let output = Self { path: target };
        let probe = output.temporary();
        File::create_new(&probe).with_context(describe)?;
        fs::remove_file(&probe).with_context(describe)?;
        Ok(output)
    }

    /// Where the file goes: its full path, links followed.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Writes the file: to a temporary file beside it first, which then takes its place.
    pub fn write(&self, bytes: &[u8]) -> anyhow::Result<()> {
        let describe = || format!("cannot write {}", self.path.display());
        self.write_with(|file| file.write_all(bytes).with_context(describe))
    }

    /// The same for a file that `write` writes piece by piece.
    pub fn write_with<T>(&self, write: impl FnOnce(&mut File) -> anyhow::Result<T>) -> anyhow::Result<T> {
        let describe = || format!("cannot write {}", self.path.display());
        let temporary = self.temporary();
        let result = File::create(&temporary).with_context(describe).and_then(|mut file| {
            let written = write(&mut file)?;
            file.sync_all().and_then(|()| fs::rename(&temporary, &self.path)).with_context(describe)?;
            Ok(written)
        });
        if result.is_err() {
            // Best effort: the error that matters is the first one.
            let _ = fs::remove_file(&temporary);
        }
        result
    }

    fn temporary(&self) -> PathBuf {
        let mut name = std::ffi::OsString::from(".");
        name.push(self.path.file_name().unwrap_or_default());
        name.push(format!(".{}.tmp", std::process::id()));
        self.path.with_file_name(name)
    }
}

/// The full path of a file that need not exist. A link is followed, so that what it points at is replaced and not the
/// link.
fn resolve(path: &Path) -> io::Result<PathBuf> {
    path.canonicalize().or_else(|_| {
        let folder = match path.parent() {
            Some(folder) if folder != Path::new("") => folder,
            _ => Path::new("."),
        };
        Ok(folder.canonicalize()?.join(path.file_name().unwrap_or_default()))
    })
}

/// Prints to standard output; a reader that has gone away (`smoke info … | head`) is no error.
pub fn print(text: &str) -> anyhow::Result<()> {
    let mut stdout = io::stdout().lock();
    match stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            Err(error).context("cannot write to standard output")
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn writes_whole_files_and_leaves_nothing_else() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("out.smoke");
        let output = OutputFile::prepare(&path, &[]).unwrap();
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0, "the check leaves nothing");
        output.write(b"one").unwrap();
        OutputFile::prepare(&path, &[]).unwrap().write(b"two").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"two");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn refuses_inputs_folders_and_missing_folders() {
        let dir = tempfile::tempdir().unwrap();
        let input = dir.path().join("in.vdb");
        fs::write(&input, "density").unwrap();
        let roundabout = dir.path().join(".").join("in.vdb");
        let refuse = |path: &Path| OutputFile::prepare(path, &[&input]).unwrap_err().to_string();
        assert!(refuse(&roundabout).contains("is an input"));
        assert!(refuse(dir.path()).contains("is a folder"));
        assert!(refuse(&dir.path().join("none/out.smoke")).contains("cannot write"));
        // Outputs that do not exist yet are told apart too.
        let new = dir.path().join("new.smoke");
        assert!(OutputFile::prepare(&dir.path().join("./new.smoke"), &[&new]).is_err());
        assert!(OutputFile::prepare(&new, &[&dir.path().join("other.smoke")]).is_ok());
        assert_eq!(fs::read(&input).unwrap(), b"density");
    }
}
