//! `smoke study table1`: Table 1 of Navarro et al. 2008, done again: what mask and distance map bring.

use std::path::{Path, PathBuf};

use bevy::prelude::*;
use clap::Args;
use serde::Serialize;

use crate::cli::frame_timer::TimedApp;
use crate::cli::input::Smoke;
use crate::cli::output::print;
use crate::cli::render::{PictureKind, median, parse_size, spawn_scene};
use crate::cli::scene::Scene;
use crate::prelude::*;

/// Options of `smoke study table1`.
#[derive(Args, Debug)]
pub struct Table1Args {
    /// Density files or bundles
    #[arg(required = true, value_name = "SMOKE")]
    inputs: Vec<PathBuf>,
    /// Medium, light from all around and camera, as for `smoke render` [default: smoke 3 m tall whose box covers about half
    /// of the picture, isotropic and grey, under a soft light]
    #[arg(long)]
    scene: Option<PathBuf>,
    /// Picture size, in place of the scene's
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    size: Option<[u32; 2]>,
    /// Lights of the constellation
    #[arg(long, value_name = "N", default_value_t = 16, value_parser = clap::value_parser!(u32).range(1..=256))]
    lights: u32,
    /// Frames that are timed of each, of which the median is told
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=100))]
    frames: u32,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

const DEFAULT_SCENE: &str = r#"{
    "placement": "width", "width_m": 3, "sigma_t": 4, "albedo": [0.8, 0.8, 0.8], "g": 0,
    "env": {
        "kind": "lobes", "ambient": [0.12, 0.15, 0.2],
        "lobes": [
            { "dir": [0.6, 0.75, 0.28], "rgb": [3.0, 2.7, 2.2] },
            { "dir": [-0.8, -0.1, 0.6], "rgb": [0.2, 0.3, 0.5] }
        ]
    },
    "eye": [0, 0, 6], "target": [0, 0, 0], "fov_y_deg": 28, "size": [128, 128]
}"#;

/// The three ways to march, by name, mask and distance map.
const WAYS: [(&str, bool, bool); 3] = [("none", false, false), ("mask", true, false), ("mask + distance", true, true)];

const SHADINGS: [(&str, ConstellationShading); 3] = [
    ("alpha", ConstellationShading::Alpha),
    ("primary", ConstellationShading::Primary),
    ("self-shadow", ConstellationShading::SelfShadow),
];

#[derive(Serialize)]
struct Report {
    adapter: String,
    /// Whether milliseconds are the GPU's, by its timestamps, and not the clock's.
    on_gpu: bool,
    size: [u32; 2],
    lights: u32,
    frames: u32,
    rows: Vec<Row>,
}

#[derive(Serialize)]
struct Row {
    input: String,
    shading: &'static str,
    optimization: &'static str,
    /// Median milliseconds of a frame.
    frame_ms: f64,
    /// Against no optimization.
    speed_up: f64,
    /// Largest difference of a channel from the picture without optimization, over that picture's largest value.
    difference: f64,
}

/// Runs the study.
pub fn run(args: &Table1Args) -> anyhow::Result<()> {
    let (mut scene, warnings) = match &args.scene {
        Some(path) => Scene::read(path)?,
        None => Scene::parse(DEFAULT_SCENE, Path::new(""))?,
    };
    for warning in warnings {
        eprintln!("warning: {warning}");
    }
    scene.camera.size = args.size.unwrap_or(scene.camera.size);
    let mut rows = Vec::new();
    let (mut adapter, mut on_gpu) = (String::new(), false);
    for input in &args.inputs {
        let smoke = Smoke::read(input, 0)?;
        let mut stage = Stage::new(&scene, smoke)?;
        (adapter, on_gpu) = (stage.app.adapter(), stage.app.on_gpu());
        for (shading_name, shading) in SHADINGS {
            let mut plain: Option<(f64, Vec<[f32; 4]>)> = None;
            for (optimization, mask, skip_empty) in WAYS {
                let settings = SmokeConstellation { lights: args.lights, shading, mask, skip_empty, ..default() };
                let (frame_ms, picture) = stage.draw(settings, args.frames)?;
                let (plain_ms, plain) = plain.get_or_insert_with(|| (frame_ms, picture.clone()));
                rows.push(Row {
                    input: input.file_name().unwrap_or_default().to_string_lossy().into_owned(),
                    shading: shading_name,
                    optimization,
                    frame_ms,
                    speed_up: *plain_ms / frame_ms,
                    difference: difference(&picture, plain),
                });
            }
        }
    }
    let report = Report { adapter, on_gpu, size: scene.camera.size, lights: args.lights, frames: args.frames, rows };
    print(&if args.json { serde_json::to_string_pretty(&report)? + "\n" } else { report.table() })
}

impl Report {
    fn table(&self) -> String {
        let [width, height] = self.size;
        let mut table = format!(
            "{}, {width} × {height} pixels, {} lights, median of {} frames, milliseconds {}\n\n\
             | smoke | shading | optimization | frame | speed-up | largest difference |\n\
             |---|---|---|---|---|---|\n",
            self.adapter,
            self.lights,
            self.frames,
            if self.on_gpu { "of the GPU" } else { "by the clock" }
        );
        for row in &self.rows {
            table += &format!(
                "| {} | {} | {} | {:.2} ms | {:.2} | {:.4} % |\n",
                row.input,
                row.shading,
                row.optimization,
                row.frame_ms,
                row.speed_up,
                100.0 * row.difference
            );
        }
        table
    }
}

/// A windowless app with one volume.
struct Stage {
    app: TimedApp,
    volume: Entity,
    /// Frames drawn so far.
    drawn: u32,
}

impl Stage {
    fn new(scene: &Scene, smoke: Smoke) -> anyhow::Result<Self> {
        let mut app = TimedApp::new(scene.camera.size.into())?;
        let lattice = LiveDensity::new(Handle::default()).lattice;
        let (volume, _) =
            spawn_scene(&mut app.headless, scene, smoke, lattice, SmokeScattering::SINGLE, PictureKind::Exr)?;
        // So that nothing else is drawn before the first constellation.
        let alpha = SmokeConstellation { shading: ConstellationShading::Alpha, ..default() };
        app.world_mut().entity_mut(volume).insert(alpha);
        app.headless.settle()?;
        Ok(Self { app, volume, drawn: 0 })
    }

    /// Median milliseconds of a frame, and the picture.
    fn draw(&mut self, settings: SmokeConstellation, frames: u32) -> anyhow::Result<(f64, Vec<[f32; 4]>)> {
        self.app.world_mut().entity_mut(self.volume).insert(settings);
        self.update();
        let times = (0..frames).map(|_| self.update()).collect();
        if !self.drawn.is_multiple_of(2) {
            // The same place for all pictures.
            self.update();
        }
        Ok((median(times).unwrap_or_default(), self.app.headless.float_pixels()))
    }

    /// Draws a frame, to its end; milliseconds. The camera moves next to nothing, so that masks are made anew.
    fn update(&mut self) -> f64 {
        self.drawn += 1;
        let nudge = if self.drawn.is_multiple_of(2) { 1e-5 } else { -1e-5 };
        let world = self.app.world_mut();
        let mut cameras = world.query_filtered::<&mut Transform, With<Camera3d>>();
        for mut transform in cameras.iter_mut(world) {
            transform.translation.x += nudge;
        }
        self.app.frame()
    }
}

fn difference(a: &[[f32; 4]], b: &[[f32; 4]]) -> f64 {
    let largest = b.iter().flatten().fold(f32::MIN_POSITIVE, |largest, value| largest.max(*value));
    let off = a.iter().flatten().zip(b.iter().flatten()).fold(0.0f32, |off, (a, b)| off.max((a - b).abs()));
    f64::from(off / largest)
}
