//! `smoke simulate`: a plume to try the plug-in with.

use std::fs;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context;
use clap::Args;
use glam::{UVec3, Vec3};

use super::bake::{BAR_STEPS, progress_bar};
use super::output::{OutputFile, print};
use crate::density::{GridShape, write_npy};
use crate::simulate::{Plume, PlumeSettings, Sphere};

pub(super) const EXAMPLES: &str = "\
Hot smoke rises from a source on the floor and leaves through the sides and the top. The frames are DIR/plume_0001.npy
and so on, NumPy arrays of densities from 0 to 1 that `smoke bake` reads. Frames of these names that are there already
are replaced; the folder is made if it is missing.

  smoke simulate -o plume                                        60 frames of 48 x 96 x 48 cells
  smoke bake plume/plume_0040.npy -o plume.smoke --rbfs 300      one of them as a bundle
  smoke simulate --size 64,128,64 --frames 120 --seed 7 -o fine  finer, longer, other puffs
  smoke simulate --warmup 1.5 --frames 90 -o risen               from when the smoke has reached the top
  smoke simulate --obstacle sphere -o around                     around a sphere in the middle of the box
  smoke simulate --obstacle 0.05,-0.2,0,0.08 -o beside           around one that is somewhere else
  smoke simulate --buoyancy 1.2 --vorticity 0 -o calm            slower and smoother

Lengths are in units of the box's longest side, measured from the box's centre with Y up, as in the space of a
SmokeVolume: a mesh at the obstacle's place, as a child of the volume, is where the smoke flows around. The same options
give the same files. The work grows with the number of cells and with speed.";

/// Seconds of warm-up between two looks at the progress bar, at most.
const WARMUP_STEP: f32 = 1.0 / 30.0;

/// Options of `smoke simulate`.
#[derive(Args, Debug)]
pub struct SimulateArgs {
    /// Cells along X, Y (up) and Z: 8 or more each
    #[arg(long, value_name = "X,Y,Z", default_value = "48,96,48", value_parser = size)]
    size: UVec3,
    /// Number of frames to write
    #[arg(long, value_name = "N", default_value_t = 60, value_parser = clap::value_parser!(u32).range(1..=9999))]
    frames: u32,
    /// Seed of the source's random puffs
    #[arg(long, value_name = "S", default_value_t = 1)]
    seed: u64,
    /// Folder for the frames
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Frames a second
    #[arg(long, default_value_t = 30.0, value_parser = within(1.0..=1000.0))]
    fps: f32,
    /// Seconds that pass before the first frame
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0, value_parser = within(0.0..=3600.0))]
    warmup: f32,
    /// Lift of the hottest smoke, in lengths of the box's longest side a second²
    #[arg(long, value_name = "LIFT", default_value_t = PlumeSettings::BUOYANCY, value_parser = within(0.0..=PlumeSettings::MAX_BUOYANCY))]
    buoyancy: f32,
    /// Strength of vorticity confinement (eddies that the grid would blur), per second
    #[arg(long, value_name = "RATE", default_value_t = PlumeSettings::VORTICITY, value_parser = within(0.0..=PlumeSettings::MAX_VORTICITY))]
    vorticity: f32,
    /// What the smoke flows around: none, sphere (in the middle of the box), or a sphere's centre and radius
    #[arg(long, value_name = "none|sphere|X,Y,Z,R", default_value = "none", value_parser = obstacle, allow_hyphen_values = true)]
    obstacle: Obstacle,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Obstacle {
    None,
    Middle,
    Sphere(Sphere),
}

fn size(text: &str) -> Result<UVec3, String> {
    let sides: Result<Vec<u32>, _> = text.split(',').map(|side| side.trim().parse()).collect();
    match sides.as_deref() {
        Ok(&[x, y, z]) => Ok(UVec3::new(x, y, z)),
        _ => Err("not three numbers of cells, such as 48,96,48".into()),
    }
}

fn within(range: RangeInclusive<f32>) -> impl Fn(&str) -> Result<f32, String> + Clone {
    move |text| {
        let value = text.parse().map_err(|_| "not a number".to_string())?;
        if range.contains(&value) {
            Ok(value)
        } else {
            Err(format!("not between {} and {}", range.start(), range.end()))
        }
    }
}

fn obstacle(text: &str) -> Result<Obstacle, String> {
    match text {
        "none" => return Ok(Obstacle::None),
        "sphere" => return Ok(Obstacle::Middle),
        _ => {}
    }
    let numbers: Result<Vec<f32>, _> = text.split(',').map(|number| number.trim().parse()).collect();
    match numbers.as_deref() {
        Ok(&[x, y, z, radius]) => Ok(Obstacle::Sphere(Sphere { center: Vec3::new(x, y, z), radius })),
        _ => Err("neither none, nor sphere, nor a centre and a radius such as 0,-0.1,0,0.08".into()),
    }
}

/// Runs `smoke simulate`.
pub fn run(args: &SimulateArgs) -> anyhow::Result<()> {
    anyhow::ensure!(args.size.min_element() > 0, "a box of {} cells is empty", args.size);
    let shape = GridShape::new(args.size);
    let mut plume = Plume::new(PlumeSettings {
        shape,
        seed: args.seed,
        buoyancy: args.buoyancy,
        vorticity: args.vorticity,
        obstacle: match args.obstacle {
            Obstacle::None => None,
            Obstacle::Middle => Some(Sphere::in_the_middle(shape)),
            Obstacle::Sphere(sphere) => Some(sphere),
        },
    })?;
    fs::create_dir_all(&args.output).with_context(|| format!("cannot make the folder {}", args.output.display()))?;
    let names = (1..=args.frames).map(|frame| args.output.join(format!("plume_{frame:04}.npy")));
    let files = names.map(|path| OutputFile::prepare(&path, &[])).collect::<Result<Vec<_>, _>>()?;
    warn_of_later_frames(&args.output, args.frames)?;

    let started = Instant::now();
    let bar = progress_bar();
    let seconds = 1.0 / args.fps;
    let warmup = (args.warmup / WARMUP_STEP).ceil() as u32;
    let total = u64::from(warmup) + u64::from(args.frames);
    let done = |steps: u64| bar.set_position(steps * BAR_STEPS / total);
    bar.set_message("warming up");
    for step in 0..warmup {
        plume.advance(args.warmup / warmup as f32);
        done(u64::from(step) + 1);
    }
    for (frame, file) in (1..).zip(&files) {
        bar.set_message(format!("frame {frame} of {}", args.frames));
        plume.advance(seconds);
        file.write(&write_npy(&plume.density()))?;
        done(u64::from(warmup) + frame);
    }
    bar.finish_and_clear();
    let (UVec3 { x, y, z }, took) = (args.size, started.elapsed().as_secs_f64());
    print(&format!("{}: {} frames of {x} x {y} x {z} cells, {took:.1} s\n", args.output.display(), args.frames))
}

/// Frames of a longer run before this one would be taken for this one's.
fn warn_of_later_frames(folder: &Path, frames: u32) -> anyhow::Result<()> {
    let entries = fs::read_dir(folder).with_context(|| format!("cannot read the folder {}", folder.display()))?;
    let number = |name: &str| name.strip_prefix("plume_")?.strip_suffix(".npy")?.parse::<u32>().ok();
    let later =
        entries.flatten().filter(|entry| entry.file_name().to_str().and_then(number).is_some_and(|n| n > frames));
    let later = later.count();
    if later > 0 {
        eprintln!(
            "warning: {} also holds {later} frames of a longer run, after the {frames} of this one",
            folder.display()
        );
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::density;

    fn args(output: &Path) -> SimulateArgs {
        SimulateArgs {
            size: UVec3::new(8, 12, 10),
            frames: 2,
            seed: 5,
            output: output.into(),
            fps: 30.0,
            warmup: 0.0,
            buoyancy: 3.0,
            vorticity: 3.0,
            obstacle: Obstacle::Middle,
        }
    }

    #[test]
    fn frames_read_back() {
        let dir = tempfile::tempdir().unwrap();
        let output = dir.path().join("new/plume");
        run(&args(&output)).unwrap();
        let shape = GridShape::new(UVec3::new(8, 12, 10));
        let obstacle = Some(Sphere::in_the_middle(shape));
        let mut plume = Plume::new(PlumeSettings { seed: 5, obstacle, ..PlumeSettings::new(shape) }).unwrap();
        for name in ["plume_0001.npy", "plume_0002.npy"] {
            plume.advance(1.0 / 30.0);
            let read = density::read(output.join(name), None).unwrap();
            assert_eq!(read, plume.density());
            assert!(read.max() > 0.0);
        }
        assert_eq!(fs::read_dir(&output).unwrap().count(), 2);

        // A warm-up of one frame's time makes the first frame the second one; files there already are replaced.
        let second = fs::read(output.join("plume_0002.npy")).unwrap();
        run(&SimulateArgs { warmup: 1.0 / 30.0, frames: 1, ..args(&output) }).unwrap();
        assert_eq!(fs::read(output.join("plume_0001.npy")).unwrap(), second);
    }

    #[test]
    fn refused_before_any_work() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("file");
        fs::write(&file, "no folder").unwrap();
        assert!(run(&args(&file)).unwrap_err().to_string().contains("cannot make the folder"));
        let output = dir.path().join("plume");
        let refusal = |args: SimulateArgs| run(&args).unwrap_err().to_string();
        assert!(refusal(SimulateArgs { size: UVec3::new(4, 96, 48), ..args(&output) }).contains("too small"));
        assert!(refusal(SimulateArgs { size: UVec3::new(0, 96, 48), ..args(&output) }).contains("empty"));
        assert!(refusal(SimulateArgs { size: UVec3::splat(u32::MAX), ..args(&output) }).contains("too large"));
        let at_source = Obstacle::Sphere(Sphere { center: Vec3::new(0.0, -0.4, 0.0), radius: 0.1 });
        assert!(refusal(SimulateArgs { obstacle: at_source, ..args(&output) }).contains("source"));
        assert!(!output.exists());
    }

    #[test]
    fn options_are_parsed() {
        assert_eq!(size("48, 96,48"), Ok(UVec3::new(48, 96, 48)));
        assert!(size("48,96").is_err() && size("48,-96,48").is_err() && size("").is_err());
        assert_eq!(obstacle("none"), Ok(Obstacle::None));
        assert_eq!(obstacle("sphere"), Ok(Obstacle::Middle));
        let sphere = Sphere { center: Vec3::new(-0.1, 0.0, 0.2), radius: 0.1 };
        assert_eq!(obstacle("-0.1,0,.2,0.1"), Ok(Obstacle::Sphere(sphere)));
        assert!(obstacle("1,2,3").is_err() && obstacle("box").is_err());
        assert_eq!(within(0.0..=1.0)("0.5"), Ok(0.5));
        assert!(["-1", "1.1", "nan", "inf", "x"].iter().all(|text| within(0.0..=1.0)(text).is_err()));
    }
}
