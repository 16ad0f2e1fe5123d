//! The `smoke` command: thin, each subcommand a few calls into the library.
//!
//! Exit status 0 is done; 2 is bad usage or bad input, with one clear line on standard error.

pub mod bake;
pub mod chart;
pub mod compare;
pub mod constellation;
pub mod exr_io;
mod frame_timer;
pub mod frames;
pub mod info;
mod input;
pub mod join;
pub mod output;
pub mod path;
pub mod quality;
mod references;
pub mod render;
pub mod scene;
pub mod simulate;
pub mod solve;
pub mod study;
pub mod surfaces;

use std::ffi::OsString;
use std::process::ExitCode;

use clap::Parser;

/// Smoke for Bevy: bake density files into bundles, look at bundles, draw them, measure pictures.
#[derive(Parser, Debug)]
#[command(name = "smoke", version, arg_required_else_help = false, after_help = OVERVIEW)]
enum Cli {
    /// Bake density files (OpenVDB or NumPy) into a .smoke bundle
    #[command(after_help = bake::EXAMPLES)]
    Bake(bake::BakeArgs),
    /// Join the bundles of a sequence's segments into one
    #[command(after_help = join::EXAMPLES)]
    Join(join::JoinArgs),
    /// Show what a .smoke bundle holds, and check it for damage
    #[command(after_help = info::EXAMPLES)]
    Info(info::InfoArgs),
    /// Draw a scene to an image, as the plug-in draws it in a game or path-traced
    Render(render::RenderArgs),
    /// Measure the error of an image against a reference
    #[command(after_help = compare::EXAMPLES)]
    Compare(compare::CompareArgs),
    /// Simulate a plume of smoke, to have something to bake
    #[command(after_help = simulate::EXAMPLES)]
    Simulate(simulate::SimulateArgs),
    /// Run a numerical study behind the method again
    #[command(after_help = study::EXAMPLES)]
    #[command(subcommand)]
    Study(study::Study),
    /// Chart accuracy against speed: every method with its settings, against path-traced references
    #[command(after_help = chart::EXAMPLES)]
    Chart(chart::ChartArgs),
}

const OVERVIEW: &str = "\
From a simulation to a picture with a known error:
  smoke simulate -o frames
  smoke bake frames/plume_0050.npy -o plume.smoke --rbfs 600
  smoke info plume.smoke
  smoke render plume.smoke -o plume.exr --scene scene.json
  smoke compare plume.exr full_a.exr full_b.exr --alpha alpha.exr

Exit status: 0 done; 2 bad usage or bad input, said in one line on standard error.";

/// Exit status of bad usage and bad input.
const REFUSED: u8 = 2;

/// Runs the command with the process's arguments.
pub fn main() -> ExitCode {
    run(std::env::args_os())
}

fn run(arguments: impl IntoIterator<Item = OsString>) -> ExitCode {
    let cli = match Cli::try_parse_from(arguments) {
        Ok(cli) => cli,
        // --help and --version arrive as errors that belong on standard output.
        Err(message) if !message.use_stderr() => {
            let _ = message.print();
            return ExitCode::SUCCESS;
        }
        Err(error) => return refuse(&usage_line(&error.render().to_string())),
    };
    let result = match cli {
        Cli::Bake(args) => bake::run(&args),
        Cli::Join(args) => join::run(&args),
        Cli::Info(args) => info::run(&args),
        Cli::Render(args) => render::run(args),
        Cli::Compare(args) => compare::run(&args),
        Cli::Simulate(args) => simulate::run(&args),
        Cli::Study(what) => study::run(&what),
        Cli::Chart(args) => chart::run(&args),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => refuse(&with_causes(&error)),
    }
}

/// The error and its causes, joined by colons; causes that the message before them already ends with are left out.
fn with_causes(error: &anyhow::Error) -> String {
    let mut message = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if message.is_empty() {
            message = cause;
        } else if !message.ends_with(&cause) {
            message = format!("{message}: {cause}");
        }
    }
    message
}

fn refuse(message: &str) -> ExitCode {
    eprintln!("error: {}", one_line(message));
    ExitCode::from(REFUSED)
}

/// Clap's message without its usage block, which takes several lines.
fn usage_line(message: &str) -> String {
    let start = message.trim_start_matches("error: ");
    let end = ["\n\nUsage:", "\n\nFor more information"].iter().filter_map(|mark| start.find(mark)).min();
    format!("{} (see smoke --help)", one_line(&start[..end.unwrap_or(start.len())]))
}

fn one_line(message: &str) -> String {
    message.split_whitespace().collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn causes_are_said_once() {
        let file = std::io::Error::other("disk full");
        let error = anyhow::Error::from(file).context("cannot write: disk full").context("scene a.json");
        assert_eq!(with_causes(&error), "scene a.json: cannot write: disk full");
    }

    fn usage(arguments: &[&str]) -> String {
        let error = Cli::try_parse_from(arguments).unwrap_err();
        assert!(error.use_stderr());
        usage_line(&error.render().to_string())
    }

    #[test]
    fn usage_errors_are_one_line() {
        for (arguments, expected) in [
            (&["smoke"][..], "subcommand"),
            (&["smoke", "bkae"], "bkae"),
            (&["smoke", "bake", "-o", "x.smoke"], "FRAMES"),
            (&["smoke", "bake", "x.vdb"], "--output"),
            (&["smoke", "bake", "x.vdb", "-o", "x.smoke", "--rbfs", "0"], "--rbfs"),
            (&["smoke", "bake", "x.vdb", "-o", "x.smoke", "--fps", "nan"], "--fps"),
            (&["smoke", "bake", "x.vdb", "-o", "x.smoke", "--error", "2"], "--error"),
            (&["smoke", "bake", "x.vdb", "-o", "x.smoke", "--error", "0.1", "--rbfs", "9"], "cannot be used with"),
            (&["smoke", "simulate"], "--output"),
            (&["smoke", "simulate", "-o", "x", "--size", "48,96"], "--size"),
            (&["smoke", "simulate", "-o", "x", "--frames", "0"], "--frames"),
            (&["smoke", "simulate", "-o", "x", "--warmup=-1"], "--warmup"),
            (&["smoke", "simulate", "-o", "x", "--fps", "0"], "--fps"),
            (&["smoke", "simulate", "-o", "x", "--obstacle", "cube"], "--obstacle"),
            (&["smoke", "study", "cube"], "cube"),
            (&["smoke", "study", "sphere", "--paths", "0"], "--paths"),
            (&["smoke", "study", "spheres", "--spheres", "8,0"], "--spheres"),
            (&["smoke", "study", "flicker", "a.smoke"], "--density"),
            (&["smoke", "study", "shadows"], "BUNDLE"),
            (&["smoke", "chart", "--methods", "fogg"], "fogg"),
            (&["smoke", "study", "flicker", "a.smoke", "--density", "a.vdb"], "2 values required"),
        ] {
            let line = usage(arguments);
            assert!(line.contains(expected) && !line.contains('\n'), "{line}");
        }
    }
}
