//! Which files a command line means by its frames.

use std::cmp::Ordering;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};

/// The files of a list of names and patterns, in order.
///
/// A name is taken as it is. `*` and `?` in a file name stand for any characters and one character; what matches comes in
/// natural order, by the value of the numbers in it. `%04d` stands for the numbers of a row, here of at least four digits;
/// all that exist are taken, and the row may have no gap.
pub fn expand(names: &[PathBuf]) -> anyhow::Result<Vec<PathBuf>> {
    let mut frames = Vec::new();
    for name in names {
        let file = name.file_name().map(|file| file.to_string_lossy().into_owned()).unwrap_or_default();
        if name.exists() {
            frames.push(name.clone());
        } else if let Some(numbered) = Numbered::parse(&file) {
            frames.extend(numbered_frames(name, &numbered)?);
        } else if file.contains(['*', '?']) {
            let mut found = neighbours(name)?;
            found.retain(|found| matches(&file, found));
            ensure!(!found.is_empty(), "no file matches {}", name.display());
            found.sort_by(|a, b| natural(a, b));
            frames.extend(found.into_iter().map(|found| name.with_file_name(found)));
        } else {
            frames.push(name.clone());
        }
    }
    Ok(frames)
}

/// Whether a list is in natural order.
pub fn is_in_natural_order(frames: &[PathBuf]) -> bool {
    frames.windows(2).all(|pair| natural(&pair[0].to_string_lossy(), &pair[1].to_string_lossy()) != Ordering::Greater)
}

/// The names of the files in the folder of `path`.
fn neighbours(path: &Path) -> anyhow::Result<Vec<String>> {
    let folder = match path.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    };
    let describe = || format!("cannot read the folder {}", folder.display());
    let entries = folder.read_dir().with_context(describe)?;
    entries.map(|entry| Ok(entry.with_context(describe)?.file_name().to_string_lossy().into_owned())).collect()
}

/// A file name with a number in it.
struct Numbered<'a> {
    before: &'a str,
    /// Digits at least, filled up with zeros.
    width: usize,
    after: &'a str,
}

impl<'a> Numbered<'a> {
    /// Reads `name_%04d.vdb` or `name_%d.vdb`.
    fn parse(name: &'a str) -> Option<Self> {
        let (before, rest) = name.split_once('%')?;
        let (width, after) = rest.split_once('d')?;
        let width = match width {
            "" => 1,
            width => width.strip_prefix('0')?.parse().ok()?,
        };
        Some(Self { before, width, after })
    }

    fn name(&self, number: u64) -> String {
        format!("{}{number:0width$}{}", self.before, self.after, width = self.width)
    }

    fn number(&self, name: &str) -> Option<u64> {
        let digits = name.strip_prefix(self.before)?.strip_suffix(self.after)?;
        // Read and written again: other widths are other files.
        let number = digits.bytes().all(|digit| digit.is_ascii_digit()).then(|| digits.parse().ok())??;
        (self.name(number) == name).then_some(number)
    }
}

fn numbered_frames(pattern: &Path, numbered: &Numbered) -> anyhow::Result<Vec<PathBuf>> {
    let mut numbers: Vec<u64> = neighbours(pattern)?.iter().filter_map(|name| numbered.number(name)).collect();
    numbers.sort_unstable();
    let path = |number| pattern.with_file_name(numbered.name(number));
    if numbers.is_empty() {
        bail!("no file matches {}", pattern.display());
    }
    if let Some(pair) = numbers.windows(2).find(|pair| pair[1] != pair[0] + 1) {
        let (missing, next) = (path(pair[0] + 1), path(pair[1]));
        bail!("{} is missing; the next is {}", missing.display(), next.display());
    }
    Ok(numbers.into_iter().map(path).collect())
}

/// Whether a name matches a pattern of `*` and `?`.
fn matches(pattern: &str, name: &str) -> bool {
    let Some(first) = pattern.chars().next() else {
        return name.is_empty();
    };
    let rest = &pattern[first.len_utf8()..];
    let mut characters = name.chars();
    match first {
        '*' => matches(rest, name) || (characters.next().is_some() && matches(pattern, characters.as_str())),
        '?' => characters.next().is_some() && matches(rest, characters.as_str()),
        _ => characters.next() == Some(first) && matches(rest, characters.as_str()),
    }
}

/// Compares names, numbers in them by their values.
pub fn natural(a: &str, b: &str) -> Ordering {
    let (mut left, mut right) = (a, b);
    loop {
        let (digits_a, digits_b) = (digits(left), digits(right));
        if !digits_a.is_empty() && !digits_b.is_empty() {
            let value = |digits: &str| digits.trim_start_matches('0').to_string();
            let (value_a, value_b) = (value(digits_a), value(digits_b));
            let order = value_a.len().cmp(&value_b.len()).then(value_a.cmp(&value_b));
            if order != Ordering::Equal {
                return order;
            }
            (left, right) = (&left[digits_a.len()..], &right[digits_b.len()..]);
            continue;
        }
        let (mut rest_a, mut rest_b) = (left.chars(), right.chars());
        match (rest_a.next(), rest_b.next()) {
            // Names that differ in zeros alone.
            (None, None) => return a.cmp(b),
            (x, y) if x != y => return x.cmp(&y),
            _ => (left, right) = (rest_a.as_str(), rest_b.as_str()),
        }
    }
}

fn digits(text: &str) -> &str {
    let end = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    &text[..end]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(names: &[&str]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for name in names {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        folder
    }

    fn expanded(folder: &Path, pattern: &str) -> Result<Vec<String>, String> {
        let frames = expand(&[folder.join(pattern)]).map_err(|error| error.to_string())?;
        Ok(frames.iter().map(|frame| frame.file_name().unwrap().to_str().unwrap().to_string()).collect())
    }

    #[test]
    fn patterns_give_natural_order() {
        let folder = folder(&["s_10.vdb", "s_9.vdb", "s_1.vdb", "other.vdb", "s_2.npy"]);
        assert_eq!(expanded(folder.path(), "s_*.vdb").unwrap(), ["s_1.vdb", "s_9.vdb", "s_10.vdb"]);
        assert_eq!(expanded(folder.path(), "s_?.*").unwrap(), ["s_1.vdb", "s_2.npy", "s_9.vdb"]);
        assert!(expanded(folder.path(), "t_*.vdb").unwrap_err().contains("no file matches"));
        assert_eq!(natural("a007b", "a7b"), Ordering::Less, "equal but for zeros: any order, always the same");
    }

    #[test]
    fn numbers_have_no_gap() {
        let folder = folder(&["p_0008.vdb", "p_0009.vdb", "p_0010.vdb", "p_10.vdb", "p_00011.vdb", "p_x.vdb"]);
        assert_eq!(expanded(folder.path(), "p_%04d.vdb").unwrap(), ["p_0008.vdb", "p_0009.vdb", "p_0010.vdb"]);
        assert_eq!(expanded(folder.path(), "p_%d.vdb").unwrap(), ["p_10.vdb"]);
        std::fs::remove_file(folder.path().join("p_0009.vdb")).unwrap();
        let gap = expanded(folder.path(), "p_%04d.vdb").unwrap_err();
        assert!(gap.contains("p_0009.vdb is missing; the next is") && gap.contains("p_0010.vdb"), "{gap}");
        assert!(expanded(folder.path(), "q_%04d.vdb").unwrap_err().contains("no file matches"));
    }

    #[test]
    fn names_are_taken_as_they_are() {
        let folder = folder(&["odd*%04d.vdb"]);
        assert_eq!(expanded(folder.path(), "odd*%04d.vdb").unwrap(), ["odd*%04d.vdb"]);
        assert_eq!(expanded(folder.path(), "none.vdb").unwrap(), ["none.vdb"]);
        let unsorted: Vec<PathBuf> = ["f_10", "f_9"].map(PathBuf::from).into();
        assert!(!is_in_natural_order(&unsorted));
    }
}
