//! Bundles end to end: the segments of a sequence become one animation.
//!
//! Segments are fitted without knowledge of each other, so the Gaussians on the two sides of a seam are strangers. Where
//! two of them are nearly the same ([`similarity`]) they become one that goes on; the others fade out and in.

use std::collections::HashMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use super::{BakeError, at};
use crate::bundle::{BundleError, BundleHeader, BundleWriter, FrameError, PackedFrame, SmokeFrame};
use crate::rbf::Rbf;

/// Least [`similarity`] of two Gaussians that become one. Every match saves a Gaussian while the seam is shown, but those of
/// two fits rarely are the same thing: at three seams of a plume of 600 Gaussians, what is shown half-way is off the true
/// frame there by
///
/// | least similarity | 0.9 | 0.7 | 0.5 | 0.3 | 0.1 | (all fade) |
/// |---|---|---|---|---|---|---|
/// | matched | 22 | 163 | 323 | 398 | 432 | 0 |
/// | error | 34.0 % | 34.2 % | 34.9 % | 35.0 % | 35.0 % | 34.0 % |
const SIMILAR: f32 = 0.7;

/// What joining did.
#[derive(Clone, Debug, PartialEq)]
pub struct Joined {
    /// Frames in all.
    pub frames: usize,
    /// Bytes of the file.
    pub bytes: u64,
    /// One a seam.
    pub seams: Vec<Seam>,
}

/// Gaussians where one bundle ends and the next begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Seam {
    /// In the last frame of the one.
    pub before: usize,
    /// In the first frame of the next.
    pub after: usize,
    /// That go on from one to the other.
    pub matched: usize,
}

/// Writes the frames of `inputs`, one bundle after the other, as one bundle to an empty `file` named `path`. As many
/// frames are in memory as there are threads.
///
/// # Errors
///
/// Bundles of different boxes, placements or speeds, bundles that cannot be read, or a file that cannot be written.
pub fn join(inputs: &[PathBuf], path: &Path, file: impl Write + Seek) -> Result<Joined, BakeError> {
    let mut bundles = inputs.iter().map(|path| Bundle::open(path)).collect::<Result<Vec<_>, _>>()?;
    let Some((first, others)) = bundles.split_first() else {
        return Err(BakeError::Inputs("no bundles to join".into()));
    };
    others.iter().try_for_each(|other| check(first, other))?;
    let frames = bundles.iter().map(|bundle| bundle.header.frames.len()).sum();
    let max_density = bundles.iter().map(|bundle| bundle.header.max_density).fold(0.0, f32::max);
    let header = BundleHeader { frames: Vec::new(), max_density, ..first.header.clone() };

    let mut writer = BundleWriter::new(file, header, frames).map_err(|error| at(path, error))?;
    let mut seams = Vec::new();
    // The last frame written, and the first number that has not been used.
    let mut last: Option<SmokeFrame> = None;
    let mut free = 0u32;
    for bundle in &mut bundles {
        let mut numbers = Numbers { matched: HashMap::new(), base: free };
        if let Some(last) = &last {
            let first = bundle.read(0)?.0;
            numbers.matched = matched(last, &first);
            let counts = [last, &first].map(|frame| frame.ids.len());
            seams.push(Seam { before: counts[0], after: counts[1], matched: numbers.matched.len() });
        }
        let count = bundle.header.frames.len();
        let mut done = 0;
        while done < count {
            let end = (done + rayon::current_num_threads()).min(count);
            let read = (done..end).map(|index| bundle.read(index)).collect::<Result<Vec<_>, _>>()?;
            let renumbered: Vec<(SmokeFrame, PackedFrame)> =
                read.into_par_iter().map(|(frame, packed)| numbers.apply(frame, packed)).collect::<Result<_, _>>()?;
            for (frame, packed) in renumbered {
                writer.push(&packed).map_err(|error| at(path, error))?;
                free = frame.ids.iter().map(|&id| id.saturating_add(1)).fold(free, u32::max);
                last = Some(frame);
            }
            done = end;
        }
    }
    let (_, header) = writer.finish(max_density).map_err(|error| at(path, error))?;
    Ok(Joined { frames, bytes: header.file_length(), seams })
}

/// A bundle of which frames are read one by one.
struct Bundle<'a> {
    path: &'a Path,
    file: File,
    header: BundleHeader,
}

impl<'a> Bundle<'a> {
    fn open(path: &'a Path) -> Result<Self, BakeError> {
        let io = |source| BakeError::Io { path: path.into(), source };
        let fault = |error: BundleError| BakeError::Inputs(format!("{}: {error}", path.display()));
        let mut file = File::open(path).map_err(io)?;
        let length = file.metadata().map_err(io)?.len();
        let mut bytes = Vec::new();
        Read::by_ref(&mut file).take(BundleHeader::FIXED_BYTES as u64).read_to_end(&mut bytes).map_err(io)?;
        let rest = BundleHeader::byte_length(&bytes).map_err(fault)? - bytes.len();
        Read::by_ref(&mut file).take(rest as u64).read_to_end(&mut bytes).map_err(io)?;
        let header = BundleHeader::read(&bytes).map_err(fault)?;
        header.check_length(length).map_err(fault)?;
        Ok(Self { path, file, header })
    }

    fn read(&mut self, index: usize) -> Result<(SmokeFrame, PackedFrame), BakeError> {
        let io = |source| BakeError::Io { path: self.path.into(), source };
        let entry = self.header.frames[index];
        // It lies within the file, whose length has been checked.
        let mut bytes = vec![0; entry.length as usize];
        self.file.seek(SeekFrom::Start(entry.offset)).map_err(io)?;
        self.file.read_exact(&mut bytes).map_err(io)?;
        let frame = self.header.read_frame(index, &bytes);
        let frame = frame.map_err(|error| BakeError::Inputs(format!("{}: {error}", self.path.display())))?;
        Ok((frame, PackedFrame { bytes, uncompressed: entry.uncompressed }))
    }
}

/// Whether two bundles may follow each other.
fn check(a: &Bundle, b: &Bundle) -> Result<(), BakeError> {
    let (x, y) = (&a.header, &b.header);
    let differ = |what: &str, x: String, y: String| {
        let (a, b) = (a.path.display(), b.path.display());
        Err(BakeError::Inputs(format!("{what} of {b} is {y}, that of {a} {x}: segments of one sequence agree in it")))
    };
    let cells = |header: &BundleHeader| header.shape.dims.to_array().map(|side| side.to_string()).join(" × ");
    if x.shape != y.shape {
        return differ("the box", format!("{} cells", cells(x)), format!("{} cells", cells(y)));
    }
    if x.placement != y.placement {
        return differ("the placement", format!("{:?}", x.placement), format!("{:?}", y.placement));
    }
    if x.frames_per_second != y.frames_per_second {
        return differ("the speed", x.frames_per_second.to_string(), y.frames_per_second.to_string());
    }
    Ok(())
}

/// How the Gaussians of a bundle are numbered anew.
struct Numbers {
    /// Those that go on from the bundle before, by their old numbers.
    matched: HashMap<u32, u32>,
    /// What is added to all other numbers.
    base: u32,
}

impl Numbers {
    fn apply(&self, mut frame: SmokeFrame, packed: PackedFrame) -> Result<(SmokeFrame, PackedFrame), BakeError> {
        if self.base == 0 {
            return Ok((frame, packed));
        }
        for id in &mut frame.ids {
            let number = self.matched.get(id).copied().or_else(|| id.checked_add(self.base));
            *id = number.ok_or_else(|| FrameError::Field {
                field: "ids",
                problem: "no numbers are left: the bundles have used all 2³²".into(),
            })?;
        }
        let packed = PackedFrame::new(&frame)?;
        Ok((frame, packed))
    }
}

/// The numbers that Gaussians of `next` take over from `last`, by their own: the most similar first, each once.
fn matched(last: &SmokeFrame, next: &SmokeFrame) -> HashMap<u32, u32> {
    // By x, so that only neighbours are compared.
    let mut sorted: Vec<(u32, Rbf)> = last.ids.iter().copied().zip(last.rbfs.rbfs.iter().copied()).collect();
    sorted.sort_by(|a, b| a.1.center[0].total_cmp(&b.1.center[0]));
    let widest = sorted.iter().map(|(_, rbf)| rbf.radius).fold(0.0, f32::max);
    let mut pairs: Vec<(f32, u32, u32)> = Vec::new();
    for (&id, rbf) in next.ids.iter().zip(&next.rbfs.rbfs) {
        let reach = (-SIMILAR.ln()).sqrt() * widest.hypot(rbf.radius);
        let start = sorted.partition_point(|(_, other)| other.center[0] < rbf.center[0] - reach);
        let near = sorted[start..].iter().take_while(|(_, other)| other.center[0] <= rbf.center[0] + reach);
        pairs.extend(near.map(|(other_id, other)| (similarity(other, rbf), *other_id, id)));
    }
    pairs.retain(|pair| pair.0 >= SIMILAR);
    pairs.sort_by(|a, b| b.0.total_cmp(&a.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    let mut taken = HashMap::new();
    let mut matched = HashMap::new();
    for (_, before, after) in pairs {
        if !taken.contains_key(&before) && !matched.contains_key(&after) {
            taken.insert(before, after);
            matched.insert(after, before);
        }
    }
    matched
}

/// How much two Gaussians are one: 1 for the same, 0 for such as have nothing in common. The cosine between them as
/// functions, `∫ A B / √(∫ A² ∫ B²)`, times the like for their weights, `2 w v / (w² + v²)`.
fn similarity(a: &Rbf, b: &Rbf) -> f32 {
    let squares = a.radius * a.radius + b.radius * b.radius;
    let distance2: f32 = a.center.iter().zip(b.center).map(|(x, y)| (x - y) * (x - y)).sum();
    let shape = (2.0 * a.radius * b.radius / squares).powf(1.5) * (-distance2 / squares).exp();
    // As a ratio, so that squares of large densities do not overflow.
    let ratio = a.weight / b.weight;
    shape * 2.0 * ratio / (1.0 + ratio * ratio)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::density::GridShape;
    use crate::rbf::RbfModel;
    use crate::residual::HashedResidual;

    fn frame(rbfs: Vec<Rbf>, ids: Vec<u32>) -> SmokeFrame {
        let residual = HashedResidual::empty(GridShape::new(glam::UVec3::ONE));
        SmokeFrame { rbfs: RbfModel { rbfs }, ids, residual }
    }

    #[test]
    fn the_most_similar_are_matched() {
        let rbf = |x, radius, weight| Rbf { center: [x, 0.0, 0.0], radius, weight };
        let last = frame(vec![rbf(0.0, 0.1, 1.0), rbf(0.3, 0.05, 1.0), rbf(-0.4, 0.02, 1.0)], vec![10, 11, 12]);
        // Two lay claim to 10: the nearer gets it. 11 has moved a little, 12's place is empty, and one is too faint.
        let next = frame(
            vec![rbf(0.05, 0.1, 1.0), rbf(0.01, 0.1, 1.0), rbf(0.31, 0.05, 1.1), rbf(0.3, 0.05, 0.1)],
            vec![3, 2, 1, 0],
        );
        assert_eq!(matched(&last, &next), HashMap::from([(2, 10), (1, 11)]));
        assert!(matched(&last, &frame(vec![], vec![])).is_empty());
    }

    #[test]
    fn similarity_is_a_cosine() {
        let a = Rbf { center: [0.1, 0.0, 0.0], radius: 0.1, weight: 2.0 };
        assert!((similarity(&a, &a) - 1.0).abs() < 1e-6);
        let b = Rbf { center: [0.15, 0.02, 0.0], radius: 0.08, weight: 2.0 };
        // By sums over a fine grid in place of the integrals; the step is 1/16 of a radius, where they agree to rounding.
        let (mut ab, mut aa, mut bb) = (0.0f64, 0.0f64, 0.0f64);
        for cell in 0..64 * 64 * 64 {
            let x = [cell % 64, cell / 64 % 64, cell / 4096].map(|i| 0.0125 * (i as f32 - 32.0) + 0.1);
            let value = |rbf: &Rbf| {
                let d2: f32 =
                    rbf.center.iter().zip([x[0], x[1] - 0.1, x[2] - 0.1]).map(|(c, x)| (x - c) * (x - c)).sum();
                f64::from((-d2 / (rbf.radius * rbf.radius)).exp())
            };
            let (a, b) = (value(&a), value(&b));
            (ab, aa, bb) = (ab + a * b, aa + a * a, bb + b * b);
        }
        let cosine = (ab / (aa * bb).sqrt()) as f32;
        assert!((similarity(&a, &b) - cosine).abs() < 1e-3, "{} {cosine}", similarity(&a, &b));
    }
}
