//! `smoke info`: what a bundle holds.

use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use serde::Serialize;

use super::output::print;
use crate::bundle::{self, BundleError, BundleHeader, FrameEntry, SectionBytes, SmokeFrame, section_bytes};

pub(super) const EXAMPLES: &str = "\
Every frame is decompressed and checked, so a bundle that `smoke info` accepts will load.

  smoke info plume.smoke
  smoke info plume.smoke --json | jq '.frames[0].rbfs'";

/// Options of `smoke info`.
#[derive(Args, Debug)]
pub struct InfoArgs {
    /// The bundle
    #[arg(value_name = "OUT.smoke")]
    bundle: PathBuf,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Info {
    format_version: u32,
    bytes: u64,
    dims: [u32; 3],
    /// World position of the box's centre, and the side of a cell in world units.
    center: [f64; 3],
    voxel_size: f64,
    frames_per_second: f32,
    seconds: f64,
    max_density: f32,
    frames: Vec<FrameInfo>,
}

#[derive(Serialize)]
struct FrameInfo {
    bytes: u64,
    uncompressed: SectionBytes,
    rbfs: usize,
    residuals: u32,
    offset_side: u32,
    slots: u32,
    law_max: f32,
    law_exponent: f32,
}

/// Runs `smoke info`.
pub fn run(args: &InfoArgs) -> anyhow::Result<()> {
    let name = args.bundle.display();
    let bytes = std::fs::read(&args.bundle).with_context(|| format!("cannot read {name}"))?;
    let info = describe(&bytes).with_context(|| name.to_string())?;
    if args.json {
        print(&format!("{}\n", serde_json::to_string_pretty(&info)?))
    } else {
        print(&format!("{name}: {info}"))
    }
}

fn describe(bytes: &[u8]) -> anyhow::Result<Info> {
    let header = BundleHeader::read(bytes)?;
    header.check_length(bytes.len() as u64)?;
    // One frame at a time in memory, however many there are.
    let frames = header.frames.iter().enumerate().map(|(index, entry)| {
        let frame = header.read_frame_of(bytes, index)?;
        Ok(FrameInfo::new(entry, &frame))
    });
    Ok(Info {
        format_version: bundle::VERSION,
        bytes: header.file_length(),
        dims: header.shape.dims.to_array(),
        center: header.placement.center.to_array(),
        voxel_size: header.placement.voxel_size,
        frames_per_second: header.frames_per_second,
        seconds: header.frames.len() as f64 / f64::from(header.frames_per_second),
        max_density: header.max_density,
        frames: frames.collect::<Result<_, BundleError>>()?,
    })
}

impl FrameInfo {
    fn new(entry: &FrameEntry, frame: &SmokeFrame) -> Self {
        let residual = &frame.residual;
        Self {
            bytes: entry.length,
            uncompressed: section_bytes(frame),
            rbfs: frame.rbfs.rbfs.len(),
            residuals: residual.count(),
            offset_side: residual.offset_side(),
            slots: residual.slots(),
            law_max: residual.law().max,
            law_exponent: residual.law().exponent,
        }
    }
}

impl std::fmt::Display for Info {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let [x, y, z] = self.dims;
        let cells = self.dims.map(u64::from).iter().product::<u64>();
        let [width, height, depth] = self.dims.map(|side| f64::from(side) * self.voxel_size);
        let share = 100.0 * self.bytes as f64 / (4 * cells * self.frames.len() as u64) as f64;
        let plural = if self.frames.len() == 1 { "" } else { "s" };
        writeln!(
            f,
            "{} frame{plural} of {x} × {y} × {z} cells at {} a second",
            self.frames.len(),
            self.frames_per_second
        )?;
        writeln!(f, "  bytes    {} ({share:.1} % of 32-bit densities)", self.bytes)?;
        writeln!(f, "  density  up to {}", self.max_density)?;
        writeln!(f, "  file's placement  centre {:?}, box {width:.4} × {height:.4} × {depth:.4}", self.center)?;
        writeln!(f, "  frame   RBFs  residuals  residual range  exponent     bytes")?;
        for (index, frame) in self.frames.iter().enumerate() {
            let FrameInfo { rbfs, residuals, law_max, law_exponent, bytes, .. } = frame;
            writeln!(
                f,
                "  {index:5} {rbfs:6} {residuals:10}  {:>14} {law_exponent:9} {bytes:9}",
                format!("±{law_max:.5}")
            )?;
        }
        Ok(())
    }
}
