//! `smoke study shadows`: shadows between smoke and meshes as the plug-in draws them, against a truth.
//!
//! A floor under the smoke: what it receives of the sky, and of the sky and a sun, in parts of what it would without smoke, as
//! seen by a camera with parallel rays between the two. The truth is a sum of exact columns. And smoke behind which a ball
//! stands in the light, against path tracing, with a ball that is black as the plug-in's all are, and one that is not.

mod ball;
mod floor;

use std::path::{Path, PathBuf};

use clap::Args;
use glam::DVec3;
use serde::Serialize;

use self::ball::BallRow;
use self::floor::FloorRow;
use super::flicker::DEFAULT_SCENE;
use crate::bundle::SmokeAnimation;
use crate::cli::input::read_bundle;
use crate::cli::output::print;
use crate::cli::render::parse_size;
use crate::cli::scene::Scene;
use crate::reference::Grid;

/// Options of `smoke study shadows`.
#[derive(Args, Debug)]
pub struct ShadowArgs {
    /// The smoke
    #[arg(value_name = "BUNDLE.smoke")]
    bundle: PathBuf,
    /// Which frame of it, from 0
    #[arg(long, default_value_t = 0)]
    frame: u32,
    /// Medium, smooth light from all around and camera, as for `smoke render`; without lights, plane and spheres [default:
    /// the scene of a plume 3 m tall, isotropic and grey, under a soft light]
    #[arg(long)]
    scene: Option<PathBuf>,
    /// Points a side of the floor
    #[arg(long, value_name = "N", default_value_t = 64, value_parser = clap::value_parser!(u32).range(8..=512))]
    points: u32,
    /// Size of the pictures of smoke, in place of the scene's
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    size: Option<[u32; 2]>,
    /// Paths a pixel: noise falls with their square root
    #[arg(long, value_name = "N", default_value_t = 1024, value_parser = clap::value_parser!(u32).range(2..=1_000_000))]
    spp: u32,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Report {
    floor: Vec<FloorRow>,
    ball: Vec<BallRow>,
}

/// Smoke, and where it is.
struct Smoke {
    animation: SmokeAnimation,
    /// What the bundle decodes to.
    density: Grid,
    /// Of its box, in metres.
    center: DVec3,
    side: f64,
}

/// Runs the study.
pub fn run(args: &ShadowArgs) -> anyhow::Result<()> {
    let mut scene = read_scene(args)?;
    scene.camera.size = args.size.unwrap_or(scene.camera.size);
    let animation = read_bundle(&args.bundle, args.frame)?;
    let values = animation.frames.get(0).expect("the one asked for").decode().into_iter().map(f64::from).collect();
    let (center, side) = scene.placement.center_and_side(animation.shape, animation.placement);
    let smoke = Smoke { density: Grid { shape: animation.shape, values }, animation, center, side };
    let report =
        Report { floor: floor::study(&scene, &smoke, args.points)?, ball: ball::study(&scene, &smoke, args.spp)? };
    if args.json {
        return print(&format!("{}\n", serde_json::to_string_pretty(&report)?));
    }
    print(&table(&report))
}

fn read_scene(args: &ShadowArgs) -> anyhow::Result<Scene> {
    let (scene, warnings) = match &args.scene {
        Some(path) => Scene::read(path)?,
        None => Scene::parse(DEFAULT_SCENE, Path::new(""))?,
    };
    let name = args.scene.as_deref().unwrap_or(Path::new("the default scene")).display();
    for warning in warnings {
        eprintln!("warning: {name}: {warning}");
    }
    anyhow::ensure!(
        scene.environment.coefficients().is_some(),
        "{name}: env: this study is for smooth light, \"lobes\" or \"constant\""
    );
    anyhow::ensure!(
        scene.lights.is_empty() && !scene.has_surfaces(),
        "{name}: lights, plane, spheres: this study brings its own"
    );
    Ok(scene)
}

fn table(report: &Report) -> String {
    let mut table = String::from(
        "| floor under | points in shadow | darkest | error of irradiance | of the shadow | worst point |\n\
         |---|---|---|---|---|---|\n",
    );
    for FloorRow { light, points, darkest, error, error_of_shadow, worst } in &report.floor {
        let [darkest, error, shadow, worst] = [darkest, error, error_of_shadow, worst].map(|share| 100.0 * share);
        table += &format!("| {light} | {points} | {darkest:.1} % | {error:.2} % | {shadow:.1} % | {worst:.2} % |\n");
    }
    table += "\n| ball | scattering | light left | error |\n|---|---|---|---|\n";
    for BallRow { ball, scattering, left, error } in &report.ball {
        let [left, error] = [left, error].map(|share| 100.0 * share);
        table += &format!("| {ball} | {scattering} | {left:.1} % | {error:.2} % |\n");
    }
    table
}

#[cfg(test)]
mod tests;
