//! `smoke chart`: accuracy against speed, for every method and its settings, on this machine.

mod draw;
mod fog;
mod reading;
mod settings;
mod stage;

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, ensure};
use clap::{Args, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use serde::{Deserialize, Serialize};

use self::settings::Setting;
use self::stage::{Inputs, Stage};
use super::output::{OutputFile, print};
use super::references::{self, Reference};
use crate::bake::{BakeSettings, bake};
use crate::bundle::SmokeAnimation;
use crate::density::{self, DensityGrid};
use crate::rbf::fit::FitTarget;
use crate::reference::path::Events;

pub(super) const EXAMPLES: &str = "\
Draws every scene by every method with every setting, and charts the error against the time of a frame in which everything
changes: smoke moves and light turns. Writes OUT.svg, and OUT.json with all that was measured.
  smoke chart --references DIR -o chart.svg
  smoke chart --references DIR --scenes plume_paper --methods rbf,paper -o two.svg
  smoke chart --redraw chart.json -o chart.svg";

/// Options of `smoke chart`.
#[derive(Args, Debug)]
pub struct ChartArgs {
    /// The folder of reference scenes and pictures: NAME.json and NAME/{single,full}_{a,b}.exr, NAME/alpha.exr
    #[arg(long, value_name = "DIR")]
    references: Option<PathBuf>,
    /// The chart to write; the figures go to a .json beside it
    #[arg(short, long, default_value = "chart.svg")]
    output: PathBuf,
    /// Scenes of the folder
    #[arg(long, value_delimiter = ',', default_value = "plume_paper,plume_hg042,smoke_real")]
    scenes: Vec<String>,
    /// Methods; all unless given
    #[arg(long, value_delimiter = ',', value_enum)]
    methods: Vec<Method>,
    /// Frames of which a time is the median: more where they are short, fewer where they take seconds
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=100))]
    frames: u32,
    /// Draws the chart of figures measured before, a .json that this command has written
    #[arg(long, value_name = "JSON", conflicts_with_all = ["references", "scenes", "methods", "frames"])]
    redraw: Option<PathBuf>,
}

/// What draws.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// RBFs with probes, baked
    Rbf,
    /// The same with what the plug-in chooses for an error that is asked for
    Auto,
    /// The same with a lattice of RBFs through raw density
    Live,
    /// Zhou et al. 2008 as printed
    Paper,
    /// Navarro et al. 2008
    Constellation,
    /// Bevy's own volumetric fog with the same density, lit by a sun and an ambient colour in the place of the light from all
    /// around, of which it sees none, and as bright as suits it best
    Fog,
    /// The path tracer, on the CPU
    Path,
}

/// All that was measured, and what follows.
#[derive(Serialize, Deserialize)]
struct Chart {
    adapter: String,
    /// Width and height of the pictures whose time is measured.
    size: [u32; 2],
    /// Whether milliseconds are the GPU's, by its timestamps, and not the clock's. The path tracer's always are the clock's.
    #[serde(default)]
    on_gpu: bool,
    /// Seconds that measuring took.
    seconds: f64,
    panels: Vec<Panel>,
    reading: Vec<String>,
}

/// One scene, with light that scatters once or any number of times.
#[derive(Serialize, Deserialize)]
struct Panel {
    scene: String,
    scattering: Scattering,
    points: Vec<Point>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Scattering {
    Single,
    Full,
}

impl Scattering {
    fn events(self) -> Events {
        match self {
            Self::Single => Events::Single,
            Self::Full => Events::All,
        }
    }
}

/// A method with a setting.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Point {
    method: Method,
    setting: String,
    /// RBFs there are, where the CPU knows.
    rbfs: Option<usize>,
    /// Relative: 0.01 is one per cent.
    error: f64,
    /// Milliseconds of a frame, less those of a frame without smoke; of the path tracer, of all its paths.
    ms: f64,
}

/// Runs `smoke chart`.
pub fn run(args: &ChartArgs) -> anyhow::Result<()> {
    let taken: Vec<&Path> = args.redraw.iter().map(PathBuf::as_path).collect();
    let svg = OutputFile::prepare(&args.output, &taken)?;
    ensure!(args.output.extension().is_some_and(|e| e == "svg"), "{}: a chart is an .svg", args.output.display());
    let chart = match &args.redraw {
        Some(path) => {
            let text = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
            let mut chart: Chart = serde_json::from_slice(&text)
                .with_context(|| format!("{} is not what smoke chart writes", path.display()))?;
            chart.reading = reading::read(&chart.panels);
            chart
        }
        None => {
            let folder = references::folder(args.references.as_deref())?;
            let scenes: Vec<PathBuf> = args.scenes.iter().map(|name| folder.join(format!("{name}.json"))).collect();
            let taken: Vec<&Path> = scenes.iter().map(PathBuf::as_path).chain([args.output.as_path()]).collect();
            let json = OutputFile::prepare(&args.output.with_extension("json"), &taken)?;
            measure(args, folder, &json)?
        }
    };
    svg.write(draw::svg(&chart)?.as_bytes())?;
    print(&format!("{}\n", chart.reading.join("\n")))
}

/// The smoke of a scene as the methods take it, by numbers of RBFs; scenes share it.
struct Smoke {
    grid: DensityGrid,
    baked: HashMap<usize, SmokeAnimation>,
}

impl Smoke {
    /// Reads a density, and bakes it with all numbers of RBFs: before anything is timed, so that nothing disturbs that.
    fn bake(density: &Path, counts: impl Iterator<Item = usize>, bar: &ProgressBar) -> anyhow::Result<Self> {
        let grid = density::read(density, None)?;
        let mut baked = HashMap::new();
        for count in counts.collect::<HashSet<_>>() {
            bar.set_message(format!("baking {count} RBFs"));
            let settings = BakeSettings { target: FitTarget::Count(count), ..BakeSettings::default() };
            let done = bake(&grid, &settings, &|_| {}).with_context(|| density.display().to_string())?;
            baked.insert(count, done.animation);
        }
        Ok(Self { grid, baked })
    }
}

/// Measures all there is to, and keeps what has been measured in a file, scene by scene.
fn measure(args: &ChartArgs, folder: &Path, json: &OutputFile) -> anyhow::Result<Chart> {
    let started = Instant::now();
    let references =
        args.scenes.iter().map(|name| Reference::read(folder, name)).collect::<anyhow::Result<Vec<_>>>()?;
    ensure!(!references.is_empty(), "--scenes: name one at least");
    let size = references[0].scene.camera.size;
    ensure!(references.iter().all(|r| r.scene.camera.size == size), "--scenes: their pictures differ in size");
    let wanted = |setting: &&Setting| args.methods.is_empty() || args.methods.contains(&setting.method());
    let all = Setting::all();
    let settings: Vec<&Setting> = all.iter().filter(wanted).collect();
    let plan: Vec<(&Reference, Scattering, &Setting)> = references
        .iter()
        .flat_map(|reference| [Scattering::Single, Scattering::Full].map(|scattering| (reference, scattering)))
        .flat_map(|(reference, scattering)| settings.iter().map(move |setting| (reference, scattering, *setting)))
        .filter(|(reference, scattering, setting)| setting.applies(&reference.scene, *scattering))
        .collect();

    let bar = ProgressBar::new(plan.len() as u64);
    let style = "{spinner} {msg} [{bar:30}] {pos}/{len}, {elapsed} of about {duration}";
    bar.set_style(ProgressStyle::with_template(style).expect("a constant").progress_chars("=> "));
    let mut smoke: HashMap<&Path, Smoke> = HashMap::new();
    for reference in &references {
        if !smoke.contains_key(reference.density.as_path()) {
            let counts = settings.iter().filter_map(|setting| setting.baked_rbfs());
            smoke.insert(&reference.density, Smoke::bake(&reference.density, counts, &bar)?);
        }
    }
    let mut stage = Stage::new(size)?;
    let mut chart = Chart {
        adapter: stage.app.adapter(),
        size: stage.size().to_array(),
        on_gpu: stage.app.on_gpu(),
        seconds: 0.0,
        panels: Vec::new(),
        reading: Vec::new(),
    };
    let save = |chart: &mut Chart| {
        chart.seconds = started.elapsed().as_secs_f64();
        chart.reading = reading::read(&chart.panels);
        json.write(&serde_json::to_vec_pretty(chart)?)
    };
    for (reference, scattering, setting) in plan {
        bar.set_message(format!("{} {}", reference.name, setting.name()));
        let Smoke { grid, baked } = &smoke[reference.density.as_path()];
        let animation = setting.baked_rbfs().and_then(|rbfs| baked.get(&rbfs));
        let inputs = Inputs { scene: &reference.scene, grid, animation };
        let mut drawn = stage.draw(setting, &inputs, scattering.events(), args.frames)?;
        if setting.method() == Method::Fog {
            // Its light is turned up or down until the picture is as close as it gets, as an artist would.
            drawn.scale(reference.brightness(&drawn.pixels, scattering.events()));
        }
        let error = reference.error(&drawn.pixels, scattering.events())?;
        let point = Point {
            method: setting.method(),
            setting: setting.name(),
            rbfs: inputs.animation.and_then(|a| Some(a.frames.get(0)?.rbfs.rbfs.len())),
            error,
            ms: drawn.ms,
        };
        match chart.panels.last_mut() {
            Some(panel) if panel.scene == reference.name && panel.scattering == scattering => panel.points.push(point),
            _ => {
                save(&mut chart)?;
                chart.panels.push(Panel { scene: reference.name.clone(), scattering, points: vec![point] });
            }
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    save(&mut chart)?;
    Ok(chart)
}
