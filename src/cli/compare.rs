//! `smoke compare`: the error of an image against a reference.

use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use clap::{Args, ValueEnum};
use serde::Serialize;

use super::exr_io::ExrImage;
use super::output::print;
use crate::reference::compare::{ImageError, image_error};

pub(super) const EXAMPLES: &str = "\
The error is the root mean square difference relative to the reference's root mean square, over the pixels whose
reference alpha is above 0.02.

A path-traced reference is noisy. Given as two independent halves, its noise does not count as error:
  smoke compare plume.exr full_a.exr full_b.exr --alpha alpha.exr
An image that is noisy itself comes as halves too, joined by a comma:
  smoke compare path_a.exr,path_b.exr full_a.exr full_b.exr --alpha alpha.exr
Opacity against a reference whose only channel is alpha:
  smoke compare plume.exr alpha.exr --alpha alpha.exr --channel alpha";

/// Options of `smoke compare`.
#[derive(Args, Debug)]
pub struct CompareArgs {
    /// The image to measure; two independent halves joined by a comma if it is noisy
    #[arg(value_name = "A.exr[,A2.exr]")]
    image: String,
    /// The reference
    #[arg(value_name = "REF_a.exr")]
    reference: PathBuf,
    /// An independent second half of the reference, if it is noisy
    #[arg(value_name = "REF_b.exr")]
    second_reference: Option<PathBuf>,
    /// The reference's alpha: which pixels hold smoke
    #[arg(long, value_name = "alpha.exr")]
    alpha: PathBuf,
    /// What to compare
    #[arg(long, value_enum, default_value_t = Channel::Rgb)]
    channel: Channel,
    /// Print JSON: relative error, its absolute value, the number of pixels
    #[arg(long)]
    json: bool,
}

/// Which channels of the images are compared.
#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum Channel {
    /// Radiance: R, G and B
    Rgb,
    /// Opacity: A, or the only channel there is
    Alpha,
}

#[derive(Serialize)]
struct Report {
    channel: Channel,
    /// 0.01 is one per cent.
    relative_error: f64,
    rms_error: f64,
    pixels: usize,
}

/// Runs `smoke compare`.
pub fn run(args: &CompareArgs) -> anyhow::Result<()> {
    let images = halves(&args.image)?;
    let images: Vec<&Path> = images.iter().map(PathBuf::as_path).collect();
    let mut references = vec![args.reference.as_path()];
    references.extend(args.second_reference.as_deref());
    let ImageError { relative, rms, pixels } = match args.channel {
        Channel::Rgb => measure(&images, &references, &args.alpha, ExrImage::rgb)?,
        Channel::Alpha => measure(&images, &references, &args.alpha, |image| {
            Ok(image.alpha()?.iter().map(|&alpha| [alpha]).collect::<Vec<_>>())
        })?,
    };
    if args.json {
        let report = Report { channel: args.channel, relative_error: relative, rms_error: rms, pixels };
        print(&format!("{}\n", serde_json::to_string_pretty(&report)?))
    } else {
        print(&format!("{:.3} % over {pixels} smoke pixels\n", 100.0 * relative))
    }
}

/// One path, or two joined by a comma; a file whose name has a comma is taken whole.
fn halves(argument: &str) -> anyhow::Result<Vec<PathBuf>> {
    if Path::new(argument).exists() {
        return Ok(vec![argument.into()]);
    }
    let paths: Vec<PathBuf> = argument.split(',').map(PathBuf::from).collect();
    ensure!(paths.len() <= 2, "{argument}: an image comes as one file, or as two halves joined by a comma");
    Ok(paths)
}

fn measure<const C: usize>(
    images: &[&Path],
    references: &[&Path],
    alpha: &Path,
    channels: impl Fn(&ExrImage) -> anyhow::Result<Vec<[f32; C]>>,
) -> anyhow::Result<ImageError> {
    let alpha_image = ExrImage::read(alpha)?;
    let mask = alpha_image.alpha().with_context(|| alpha.display().to_string())?;
    let read = |path: &&Path| {
        let image = ExrImage::read(path)?;
        ensure!(
            image.size == alpha_image.size,
            "{} is {} × {} pixels and {} is {} × {}: compare images of one size",
            path.display(),
            image.size[0],
            image.size[1],
            alpha.display(),
            alpha_image.size[0],
            alpha_image.size[1]
        );
        channels(&image).with_context(|| path.display().to_string())
    };
    let read_all = |paths: &[&Path]| paths.iter().map(read).collect::<anyhow::Result<Vec<_>>>();
    let (images, references) = (read_all(images)?, read_all(references)?);
    // A noise-free image is its own second half.
    fn pair<const C: usize>(halves: &[Vec<[f32; C]>]) -> [&[[f32; C]]; 2] {
        [&halves[0], &halves[halves.len() - 1]]
    }
    Ok(image_error(pair(&images), pair(&references), mask)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::exr_io::encode_rgba;

    fn save(folder: &Path, name: &str, pixels: &[[f32; 4]]) -> PathBuf {
        let path = folder.join(name);
        std::fs::write(&path, encode_rgba(pixels.len(), 1, pixels).unwrap()).unwrap();
        path
    }

    #[test]
    fn a_known_difference() {
        let dir = tempfile::tempdir().unwrap();
        let reference = save(dir.path(), "ref.exr", &[[2.0, 0.0, 0.0, 1.0], [9.0, 9.0, 9.0, 0.01]]);
        let image = save(dir.path(), "image.exr", &[[2.0, 0.0, 0.5, 0.5], [0.0, 0.0, 0.0, 0.0]]);
        let rgb = measure(&[&image], &[&reference], &reference, ExrImage::rgb).unwrap();
        assert_eq!((rgb.relative, rgb.pixels), (0.25, 1));
        let alpha = |image: &ExrImage| Ok(image.alpha()?.iter().map(|&a| [a]).collect::<Vec<_>>());
        assert_eq!(measure(&[&image], &[&reference], &reference, alpha).unwrap().relative, 0.5);
    }

    #[test]
    fn faults_name_the_file() {
        let dir = tempfile::tempdir().unwrap();
        let one = save(dir.path(), "one.exr", &[[1.0; 4]]);
        let two = save(dir.path(), "two.exr", &[[1.0; 4]; 2]);
        let fault = |image: &Path| {
            let result = measure(&[image], &[&one], &one, ExrImage::rgb);
            format!("{:#}", result.unwrap_err())
        };
        assert!(fault(&two).contains("two.exr is 2 × 1"));
        assert!(fault(&dir.path().join("none.exr")).contains("none.exr"));
        assert!(halves("a.exr,b.exr,c.exr").is_err());
        assert_eq!(halves("a.exr,b.exr").unwrap().len(), 2);
    }
}
