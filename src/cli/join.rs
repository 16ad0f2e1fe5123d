//! `smoke join`: the segments of a sequence into one bundle.

use std::path::{Path, PathBuf};

use clap::Args;

use super::output::{OutputFile, print};
use crate::bake::{Joined, join};

pub(super) const EXAMPLES: &str = "\
Frames come in the order of the bundles, which have to agree in box, placement and speed: segments of one sequence do.
RBFs that are nearly the same where two bundles meet go on as one; the others fade out and in within a frame.

  parallel -q smoke bake 'plume_*.vdb' -o seg{}.smoke --segment {}/4 ::: 1 2 3 4
  smoke join seg1.smoke seg2.smoke seg3.smoke seg4.smoke -o plume.smoke";

/// Options of `smoke join`.
#[derive(Args, Debug)]
pub struct JoinArgs {
    /// The bundles, in order
    #[arg(required = true, value_name = "SEGMENTS")]
    bundles: Vec<PathBuf>,
    /// The bundle to write
    #[arg(short, long, value_name = "OUT.smoke")]
    output: PathBuf,
}

/// Runs `smoke join`.
pub fn run(args: &JoinArgs) -> anyhow::Result<()> {
    let taken: Vec<&Path> = args.bundles.iter().map(PathBuf::as_path).collect();
    let output = OutputFile::prepare(&args.output, &taken)?;
    let name = args.output.display();
    let Joined { frames, bytes, seams } =
        output.write_with(|file| Ok(join(&args.bundles, &args.output, std::io::BufWriter::new(file))?))?;
    let mut seams = seams.iter().map(|seam| format!("{} of {}", seam.matched, seam.before.min(seam.after)));
    let went_on = match seams.len() {
        0 => String::new(),
        _ => format!(", RBFs that go on across seams: {}", seams.by_ref().collect::<Vec<_>>().join(", ")),
    };
    print(&format!("{name}: {frames} frames, {bytes} bytes{went_on}\n"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refusals_name_the_bundle() {
        let folder = tempfile::tempdir().unwrap();
        let (input, output) = (folder.path().join("a.smoke"), folder.path().join("out.smoke"));
        std::fs::write(&input, "no bundle").unwrap();
        let refusal = |bundles: &[&Path], output: &Path| {
            let bundles = bundles.iter().map(|path| path.to_path_buf()).collect();
            run(&JoinArgs { bundles, output: output.into() }).unwrap_err().to_string()
        };
        assert!(refusal(&[&input], &output).contains("a.smoke: not a .smoke file"));
        assert!(refusal(&[&input], &input).contains("is an input"));
        assert!(refusal(&[&folder.path().join("none.smoke")], &output).contains("none.smoke"));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing is left");
    }
}
