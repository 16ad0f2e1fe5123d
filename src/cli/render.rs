//! `smoke render`: draws a scene, with the real plug-in in a windowless app or by another method.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, bail, ensure};
use bevy::asset::RenderAssetUsages;
use bevy::diagnostic::{DEFAULT_MAX_HISTORY_LENGTH, Diagnostic, DiagnosticPath, DiagnosticsStore};
use bevy::math::{DMat3, DVec3};
use bevy::prelude::*;
use bevy::render::render_resource::{Extent3d, TextureDimension, TextureFormat};
use bevy::render::renderer::RenderAdapterInfo;
use clap::{Args, ValueEnum};
use serde::Serialize;

use super::constellation::{ConstellationArgs, ConstellationStats};
use super::exr_io::{ExrImage, encode_rgba};
use super::input::{Smoke, is_density};
use super::output::OutputFile;
use super::path::{self, PathArgs};
use super::quality::{QualityArgs, QualityStats};
use super::scene::{Environment, Scene, SceneLight};
use super::solve::{PaperStats, SolveArgs, Solver};
use super::surfaces::{cast_shadows, environment_map, spawn_surfaces};
use crate::headless::{Headless, HeadlessError};
use crate::lighting::magnitude;
use crate::prelude::*;
use crate::render::SmokeRenderStats;
use crate::scattering::ScatteringChoice;
use crate::sh::Sh;

/// Arguments of `smoke render`.
#[derive(Args, Debug)]
#[command(after_help = "Examples:\n  smoke render plume.smoke -o plume.exr --scene scene.json --scattering single\n  \
    smoke render plume.vdb -o full.exr --scene scene.json --method path --spp 1024 --halves\n\n\
    An EXR holds linear media radiance without background in R, G, B and 1 - transmittance in A, of the smoke in front of \
    the scene's `plane` and `spheres`; a PNG shows these behind it, else black, sRGB-encoded, without tone mapping. With \
    rbf, spheres shade smoke, and smoke shades plane and spheres; with path, all shade and light each other.")]
pub struct RenderArgs {
    /// The smoke: a .smoke bundle, or a density file (OpenVDB or NumPy) as it is; it overrides the scene's `density`
    pub(super) input: PathBuf,
    /// The picture to write, .exr or .png
    #[arg(short, long)]
    pub(super) output: PathBuf,
    /// Medium, light and camera, as JSON
    #[arg(long)]
    pub(super) scene: PathBuf,
    /// Which frame of the bundle, from 0
    #[arg(long, default_value_t = 0)]
    pub(super) frame: u32,
    /// How often the scene is drawn: more than once to see in --stats what the first frame costs and what the rest do
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    frames: u32,
    /// Turns the light from all around by so many degrees about the vertical in every frame after the first, to see in
    /// --stats what a frame costs in which only the light turned
    #[arg(long, value_name = "DEGREES", default_value_t = 0.0, allow_negative_numbers = true)]
    turn_light: f64,
    /// How source radiance is computed
    #[arg(long, value_enum, default_value_t = Method::Auto)]
    method: Method,
    /// How often light may scatter on its way to the eye
    #[arg(long, value_enum, default_value_t = Scattering::Auto)]
    pub(super) scattering: Scattering,
    /// Picture size, in place of the scene's
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    size: Option<[u32; 2]>,
    /// Rays a pixel. rbf, paper, constellation: a square number from 1 to 256, 16 unless given; the picture is drawn that
    /// much larger and averaged, as a path tracer averages over a pixel's area. path: paths in all, 2 or more, 256 unless
    /// given; the noise falls with their square root
    #[arg(long, value_name = "N")]
    spp: Option<u32>,
    #[command(flatten)]
    pub(super) path: PathArgs,
    #[command(flatten)]
    solve: SolveArgs,
    #[command(flatten)]
    quality: QualityArgs,
    #[command(flatten)]
    constellation: ConstellationArgs,
    /// Writes what was done and what it cost, as JSON
    #[arg(long)]
    stats: Option<PathBuf>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Method {
    /// The cheapest that the scene allows
    Auto,
    /// RBFs with probes: the product's best, on bundles and, with a lattice of RBFs, on raw density
    Rbf,
    /// Zhou et al. 2008 as printed, lit by the environment alone: a baseline
    Paper,
    /// Navarro et al. 2008: single scattering from a light constellation, a ray to each light from every sample
    Constellation,
    /// The path-traced reference, on the CPU: any light, any number of scattering events, and noise
    Path,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Scattering {
    /// What the medium needs
    Auto,
    /// Exactly one scattering event
    Single,
    /// Any number of scattering events
    Multiple,
}

impl From<Scattering> for ScatteringEvents {
    fn from(scattering: Scattering) -> Self {
        match scattering {
            Scattering::Auto => Self::Auto,
            Scattering::Single => Self::Single,
            Scattering::Multiple => Self::Multiple,
        }
    }
}

pub(super) fn parse_size(text: &str) -> Result<[u32; 2], String> {
    let sides = text.split_once(['x', 'X']).and_then(|(w, h)| Some([w.parse().ok()?, h.parse().ok()?]));
    match sides {
        Some([width, height]) if (1..=8192).contains(&width) && (1..=8192).contains(&height) => Ok([width, height]),
        _ => Err("a size is WIDTHxHEIGHT in pixels, each 1 to 8192: 320x240".into()),
    }
}

/// Rays a pixel, from what was asked for.
fn rays(spp: Option<u32>, method: Method) -> anyhow::Result<u32> {
    if method == Method::Path {
        let spp = spp.unwrap_or(256);
        ensure!(spp >= 2, "--spp {spp}: method path takes 2 paths a pixel or more, one for each half");
        return Ok(spp);
    }
    let spp = spp.unwrap_or(16);
    let is_square = (1..=256).contains(&spp) && spp.isqrt().pow(2) == spp;
    ensure!(is_square, "--spp {spp}: rays a pixel are a square number from 1 to 256: 1, 4, 9, 16, ...");
    Ok(spp)
}

/// What `--stats` writes.
#[derive(Serialize)]
struct Stats {
    adapter: String,
    backend: String,
    method: Choice<Method>,
    scattering: Choice<Scattering>,
    /// What the solver of multiple scattering did last; null without one.
    solver: Option<SolverStats>,
    /// What --method paper did; null with another.
    paper: Option<PaperStats>,
    /// How --method constellation drew; null with another.
    constellation: Option<ConstellationStats>,
    size: [u32; 2],
    spp: u32,
    cells: [u32; 3],
    /// Null of raw density, whose RBFs only the GPU knows.
    rbfs: Option<usize>,
    /// That light is computed at.
    probes: Option<usize>,
    /// What the light and the picture of method rbf were computed with; null with another.
    quality: Option<QualityStats>,
    frames: u32,
    /// Median milliseconds of a whole frame after the first, by the clock, GPU work included; null where there were none.
    steady_frame_ms: Option<f64>,
    passes: Vec<PassStats>,
}

/// What was asked for, what was done, and why.
#[derive(Clone, Serialize)]
pub(super) struct Choice<T> {
    pub asked: T,
    pub used: T,
    pub why: String,
}

#[derive(Serialize)]
struct SolverStats {
    method: Solver,
    converged: bool,
    /// transport: sweeps over all pairs of RBFs, without the last; diffusion: steps of conjugate gradients.
    sweeps: u32,
    /// transport: estimated relative error; diffusion: relative residual.
    error: f32,
}

#[derive(Serialize)]
struct PassStats {
    name: &'static str,
    /// Dispatches (draws) of every frame, the first one first.
    dispatches: Vec<u32>,
    /// GPU milliseconds of the first time it ran; null where the adapter has no timestamps.
    first_ms: Option<f64>,
    /// Median of the other times; null where there were none.
    steady_ms: Option<f64>,
}

/// A picture to make: the arguments, checked as far as that goes without the smoke.
pub(super) struct Job {
    pub args: RenderArgs,
    pub method: Choice<Method>,
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Rays a pixel.
    pub spp: u32,
    pub scene: Scene,
    pub kind: PictureKind,
    pub output: OutputFile,
    pub stats: Option<OutputFile>,
    /// The two halves of a picture by [`path`], if asked for.
    pub halves: Option<[OutputFile; 2]>,
}

impl Job {
    fn new(args: RenderArgs) -> anyhow::Result<Self> {
        let method = choose_method(&args)?;
        let spp = rays(args.spp, method.used)?;
        let kind = PictureKind::of(&args.output)?;
        let (scene, warnings) = Scene::read(&args.scene)?;
        for warning in warnings {
            eprintln!("warning: {}: {warning}", args.scene.display());
        }
        let mut taken = vec![args.input.clone(), args.scene.clone()];
        if let Environment::Equirect(path) = &scene.environment {
            taken.push(path.clone());
        }
        let mut prepare = |path: &Path| {
            let output = OutputFile::prepare(path, &taken.iter().map(PathBuf::as_path).collect::<Vec<_>>())?;
            taken.push(path.into());
            anyhow::Ok(output)
        };
        let output = prepare(&args.output)?;
        let stats = args.stats.as_deref().map(&mut prepare).transpose()?;
        let halves = match args.path.half_paths(&args.output) {
            Some([a, b]) => Some([prepare(&a)?, prepare(&b)?]),
            None => None,
        };
        let size = args.size.unwrap_or(scene.camera.size);
        Ok(Self { args, method, size, spp, scene, kind, output, stats, halves })
    }
}

/// Runs the command.
pub fn run(args: RenderArgs) -> anyhow::Result<()> {
    let job = Job::new(args)?;
    match job.method.used {
        Method::Path => path::run(&job),
        _ => draw(job),
    }
}

/// Draws with the plug-in.
fn draw(job: Job) -> anyhow::Result<()> {
    let Job { args, method, size, spp, scene, kind, output, stats: stats_file, .. } = job;
    let smoke = Smoke::read(&args.input, args.frame)?;
    let rays = spp.isqrt();
    let drawn = size.map(|side| side * rays);
    ensure!(
        drawn.iter().all(|side| *side <= MAX_SIDE),
        "{} x {} pixels at {spp} rays each are more than an adapter's {MAX_SIDE} a side: lower --size or --spp",
        size[0],
        size[1],
    );
    let (rbfs, cells) = (smoke.rbfs(), smoke.shape().dims.to_array());
    let mut headless = Headless::new(drawn.into(), TextureFormat::Rgba16Float)?;
    let paper = args.solve.paper(method.used);
    let constellation = args.constellation.component(method.used);
    let scattering =
        SmokeScattering { events: args.scattering.into(), solver: args.solve.solver().into(), ..default() };
    let (volume, unit) = spawn_scene(&mut headless, &scene, smoke, args.solve.lattice(), scattering, kind)?;
    headless.app.world_mut().entity_mut(volume).insert(args.quality.quality());
    if let Some(paper) = paper {
        headless.app.world_mut().entity_mut(volume).insert(paper);
        if scene.has_surfaces() {
            eprintln!(
                "warning: {}: plane, spheres: method paper knows nothing in the smoke's light, they only hide smoke",
                args.scene.display()
            );
        }
    }

    if let Some(constellation) = constellation {
        headless.app.world_mut().entity_mut(volume).insert(constellation);
    }

    // The first frame is the one in which the smoke appears.
    let mut counts = vec![[0; SmokeRenderStats::PASSES.len()]];
    match headless.settle() {
        Err(HeadlessError::NothingDrawn) => {
            eprintln!("warning: {}: the camera does not see the smoke: the picture is empty", args.scene.display());
        }
        result => result?,
    }
    if scene.has_surfaces() {
        // Meshes take a few frames more than smoke does.
        (0..MESH_FRAMES).for_each(|_| headless.app.update());
    }
    counts.push(headless.app.world().resource::<SmokeRenderStats>().dispatches());
    let mut frame_ms = Vec::new();
    for _ in 1..args.frames {
        if args.turn_light != 0.0 {
            turn_light(headless.app.world_mut(), volume, args.turn_light.to_radians());
        }
        let start = Instant::now();
        headless.app.update();
        headless.wait();
        frame_ms.push(1e3 * start.elapsed().as_secs_f64());
        counts.push(headless.app.world().resource::<SmokeRenderStats>().dispatches());
    }
    let pixels = average(&headless.float_pixels(), size, rays, unit);
    output.write(&kind.encode(size, &pixels)?)?;

    if let Some(file) = stats_file {
        // GPU times arrive a few frames late.
        for _ in 0..4 {
            headless.app.update();
        }
        let solver = headless.solver_reports().first().map(|report| SolverStats {
            method: args.solve.solver(),
            converged: report.converged,
            sweeps: report.sweeps,
            error: report.error,
        });
        let world = headless.app.world();
        let choice = world.resource::<SmokeRenderStats>().scattering(volume);
        let quality = world.resource::<SmokeRenderStats>().quality(volume);
        let model = quality.map_or(SmokeModel::FULL, |choice| choice.model);
        let adapter = world.resource::<RenderAdapterInfo>();
        let stats = Stats {
            adapter: adapter.name.clone(),
            backend: adapter.backend.to_string(),
            method,
            scattering: match constellation {
                Some(_) => {
                    let why = "a constellation's light scatters once".into();
                    Choice { asked: args.scattering, used: Scattering::Single, why }
                }
                None => chosen_scattering(args.scattering, choice),
            },
            solver,
            paper: paper.map(|paper| PaperStats::of(&paper, choice.is_some_and(|choice| choice.multiple))),
            size,
            spp,
            cells,
            rbfs,
            // The paper looks from the centres alone, a constellation from nowhere.
            probes: match (constellation, paper) {
                (Some(_), _) => None,
                (_, Some(_)) => rbfs,
                _ => rbfs.map(|rbfs| model.probes as usize * rbfs.min(model.rbfs as usize)),
            },
            quality: quality.filter(|_| paper.is_none() && constellation.is_none()).map(QualityStats::from),
            constellation: constellation.map(Into::into),
            frames: args.frames,
            steady_frame_ms: median(frame_ms),
            passes: pass_stats(&counts, world.resource()),
        };
        file.write(&serde_json::to_vec_pretty(&stats)?)?;
    }
    Ok(())
}

/// Frames until meshes are drawn after they have been spawned.
pub(super) const MESH_FRAMES: usize = 3;

/// The longest side of a texture that every adapter allows.
const MAX_SIDE: u32 = 8192;

/// Means of blocks of `rays` × `rays`, a box filter over each pixel; colours times `unit`.
pub(super) fn average(fine: &[[f32; 4]], [width, height]: [u32; 2], rays: u32, unit: f32) -> Vec<[f32; 4]> {
    let weight = 1.0 / f64::from(rays * rays);
    let mut pixels = Vec::with_capacity((width * height) as usize);
    for (y, x) in (0..height).flat_map(|y| (0..width).map(move |x| (y, x))) {
        let mut sum = [0.0_f64; 4];
        for (j, i) in (0..rays).flat_map(|j| (0..rays).map(move |i| (j, i))) {
            let at = (y * rays + j) * width * rays + x * rays + i;
            for (sum, value) in sum.iter_mut().zip(fine[at as usize]) {
                *sum += f64::from(value);
            }
        }
        let [r, g, b, a] = sum.map(|sum| (sum * weight) as f32);
        pixels.push([r * unit, g * unit, b * unit, a]);
    }
    pixels
}

/// The method to use, of what was asked for.
fn choose_method(args: &RenderArgs) -> anyhow::Result<Choice<Method>> {
    let method = match args.method {
        Method::Auto => {
            let why = match is_density(&args.input) {
                true => "the input is raw density: RBFs are laid through it on a lattice",
                false => "the input is a bundle",
            };
            Choice { asked: Method::Auto, used: Method::Rbf, why: why.into() }
        }
        Method::Paper if is_density(&args.input) => bail!(
            "--method paper: {} is a density file: bake it first (smoke bake {0} -o OUT.smoke)",
            args.input.display()
        ),
        asked => Choice { asked, used: asked, why: "asked for".into() },
    };
    args.solve.check(method.used, is_density(&args.input))?;
    args.quality.check(method.used)?;
    args.constellation.check(method.used)?;
    let traced = method.used == Method::Path;
    ensure!(traced || !args.path.is_given(), "--halves and --seed are for --method path");
    ensure!(!traced || args.frames == 1, "--frames: method path draws a scene once");
    ensure!(args.turn_light.is_finite(), "--turn-light {}: not a number of degrees", args.turn_light);
    Ok(method)
}

/// What the plug-in came to.
fn chosen_scattering(asked: Scattering, choice: Option<ScatteringChoice>) -> Choice<Scattering> {
    match choice {
        Some(choice) => {
            let used = if choice.multiple { Scattering::Multiple } else { Scattering::Single };
            Choice { asked, used, why: choice.to_string() }
        }
        None => Choice { asked, used: asked, why: "no smoke was drawn".into() },
    }
}

/// Spawns the volume, its lights and a camera that shows radiance as it is: exposure 1, no tone mapping, no dithering.
/// Returns the volume and the radiance that 1 in the picture stands for: the picture is f16, the light may be in any unit.
pub(super) fn spawn_scene(
    headless: &mut Headless,
    scene: &Scene,
    smoke: Smoke,
    lattice: u32,
    scattering: SmokeScattering,
    kind: PictureKind,
) -> anyhow::Result<(Entity, f32)> {
    let (center, side) = scene.placement.center_and_side(smoke.shape(), smoke.placement());
    let transform = Transform::from_translation(center.as_vec3()).with_scale(Vec3::splat(side as f32));
    let world = headless.app.world_mut();
    let (environment, unit) = environment(world, scene)?;
    let smoke = smoke.volume(world, lattice);
    let volume = world.spawn((smoke, scattering, medium(scene), environment, transform)).id();
    for light in &scene.lights {
        spawn_light(world, light, unit);
    }

    let camera = spawn_camera(headless, scene);
    if scene.has_surfaces() {
        let world = headless.app.world_mut();
        spawn_surfaces(world, scene, side as f32, kind.shows_surfaces());
        if kind.shows_surfaces() {
            let map = environment_map(world, scene, unit)?;
            // Spheres shade the plane and each other, as in the reference.
            world.entity_mut(camera).insert((map, SmokeShadows { occluders: true, ..default() }));
            cast_shadows(world);
        }
    }
    Ok((volume, unit))
}

/// The scene's light from all around, and the radiance that 1 in the picture stands for.
pub(super) fn environment(world: &mut World, scene: &Scene) -> anyhow::Result<(SmokeEnvironment, f32)> {
    Ok(match &scene.environment {
        Environment::Equirect(path) => {
            let image = world.resource_mut::<Assets<Image>>().add(equirect_texture(path)?);
            (SmokeEnvironment::equirect(image, 1.0), 1.0)
        }
        lobes => {
            let coefficients = lobes.coefficients().expect("lobes have coefficients").0.map(|c| c.as_vec3());
            let unit = magnitude(&coefficients);
            (SmokeEnvironment::Coefficients { coefficients, intensity: 1.0 / unit }, unit)
        }
    })
}

/// What the scene's smoke does to light.
pub(super) fn medium(scene: &Scene) -> SmokeMedium {
    let albedo = scene.albedo.as_vec3();
    SmokeMedium {
        sigma_t: scene.sigma_t as f32,
        albedo: LinearRgba::rgb(albedo.x, albedo.y, albedo.z),
        g: scene.g as f32,
    }
}

/// Spawns the scene's camera, which shows radiance as it is.
pub(super) fn spawn_camera(headless: &mut Headless, scene: &Scene) -> Entity {
    let camera = &scene.camera;
    let projection = PerspectiveProjection { fov: camera.fov_y_deg.to_radians() as f32, near: 1e-3, ..default() };
    let shows = headless.radiance_camera();
    let camera = headless.app.world_mut().spawn((
        shows,
        Projection::Perspective(projection),
        Transform::from_translation(camera.eye.as_vec3()).looking_at(camera.target.as_vec3(), Vec3::Y),
    ));
    camera.id()
}

/// Turns the environment of a volume about the vertical.
pub(super) fn turn_light(world: &mut World, volume: Entity, angle: f64) {
    let Some(mut environment) = world.get_mut::<SmokeEnvironment>(volume) else { return };
    match &mut *environment {
        SmokeEnvironment::Coefficients { coefficients, .. } => {
            let turned = Sh(coefficients.map(|c| c.as_dvec3())).rotate(DMat3::from_rotation_y(angle));
            *coefficients = turned.0.map(|c| c.as_vec3());
        }
        SmokeEnvironment::Equirect { rotation, .. } => *rotation = Quat::from_rotation_y(angle as f32) * *rotation,
        SmokeEnvironment::Camera => {}
    }
}

/// Spawns a light as Bevy's own, in units of `unit`.
pub(super) fn spawn_light(world: &mut World, light: &SceneLight, unit: f32) -> Entity {
    // A colour of which the largest channel is 1, and that channel.
    let split = |rgb: DVec3| {
        let rgb = rgb.as_vec3() / unit;
        let largest = rgb.max_element().max(f32::MIN_POSITIVE);
        let [r, g, b] = (rgb / largest).to_array();
        (Color::linear_rgb(r, g, b), largest)
    };
    // Bevy counts lumens, a sphere's worth of candela; nothing ends the light but the square of its distance.
    let sphere = 4.0 * std::f32::consts::PI;
    let range = 1e6;
    let along = |position: DVec3, direction: DVec3| {
        Transform::from_translation(position.as_vec3())
            .looking_to(direction.as_vec3(), direction.any_orthogonal_vector().as_vec3())
    };
    match *light {
        SceneLight::Sun { direction, irradiance, .. } => {
            let (color, illuminance) = split(irradiance);
            world.spawn((DirectionalLight { color, illuminance, ..default() }, along(DVec3::ZERO, -direction))).id()
        }
        SceneLight::Point { position, intensity } => {
            let (color, candela) = split(intensity);
            let light = PointLight { color, intensity: candela * sphere, range, ..default() };
            world.spawn((light, Transform::from_translation(position.as_vec3()))).id()
        }
        SceneLight::Spot { position, direction, intensity, inner_deg, outer_deg } => {
            let (color, candela) = split(intensity);
            let [inner_angle, outer_angle] = [inner_deg, outer_deg].map(|deg| deg.to_radians() as f32);
            let light = SpotLight { color, intensity: candela * sphere, range, inner_angle, outer_angle, ..default() };
            world.spawn((light, along(position, direction))).id()
        }
    }
}

/// A latitude-longitude image, HDR or EXR: its size and linear texels.
pub(super) fn read_equirect(path: &Path) -> anyhow::Result<([u32; 2], Vec<[f32; 3]>)> {
    let is_exr = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("exr"));
    let (size, rgb) = if is_exr {
        let image = ExrImage::read(path)?;
        (image.size.map(|side| side as u32), image.rgb()?)
    } else {
        let image = image::open(path).with_context(|| format!("cannot read {}", path.display()))?.into_rgb32f();
        ([image.width(), image.height()], image.pixels().map(|pixel| pixel.0).collect())
    };
    let finite = rgb.iter().flatten().all(|value| value.is_finite());
    ensure!(finite, "{} has pixels that are not finite", path.display());
    Ok((size, rgb))
}

/// The same as Bevy's image.
fn equirect_texture(path: &Path) -> anyhow::Result<Image> {
    let ([width, height], rgb) = read_equirect(path)?;
    let data: Vec<u8> = rgb.iter().flat_map(|&[r, g, b]| [r, g, b, 1.0]).flat_map(f32::to_le_bytes).collect();
    Ok(Image::new(
        Extent3d { width, height, depth_or_array_layers: 1 },
        TextureDimension::D2,
        data,
        TextureFormat::Rgba32Float,
        RenderAssetUsages::default(),
    ))
}

#[derive(Clone, Copy)]
pub(super) enum PictureKind {
    Exr,
    Png,
}

impl PictureKind {
    /// Whether surfaces are seen behind the smoke.
    pub fn shows_surfaces(self) -> bool {
        matches!(self, Self::Png)
    }

    fn of(path: &Path) -> anyhow::Result<Self> {
        match path.extension().and_then(|extension| extension.to_str()) {
            Some(e) if e.eq_ignore_ascii_case("exr") => Ok(Self::Exr),
            Some(e) if e.eq_ignore_ascii_case("png") => Ok(Self::Png),
            _ => bail!("{}: a picture is written as .exr or .png", path.display()),
        }
    }

    /// The file's bytes: RGBA pixels in rows, top row first. Values that are not finite are refused.
    pub fn encode(self, [width, height]: [u32; 2], pixels: &[[f32; 4]]) -> anyhow::Result<Vec<u8>> {
        ensure!(
            pixels.iter().flatten().all(|value| value.is_finite()),
            "the picture has pixels that are not finite: this is a fault of bevy_smoke, please report the scene"
        );
        match self {
            Self::Exr => encode_rgba(width as usize, height as usize, pixels),
            Self::Png => {
                let encode = |linear: f32| {
                    let srgb =
                        if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 };
                    (255.0 * srgb).round().clamp(0.0, 255.0) as u8
                };
                let bytes = pixels.iter().flat_map(|&[r, g, b, _]| [r, g, b].map(encode)).collect();
                let image =
                    image::RgbImage::from_raw(width, height, bytes).context("the picture has the wrong size")?;
                let mut png = std::io::Cursor::new(Vec::new());
                image.write_to(&mut png, image::ImageFormat::Png)?;
                Ok(png.into_inner())
            }
        }
    }
}

/// Differences of the running counts, and the GPU spans' times.
fn pass_stats(counts: &[[u32; SmokeRenderStats::PASSES.len()]], diagnostics: &DiagnosticsStore) -> Vec<PassStats> {
    let times = |name: &str| -> Vec<f64> {
        let path = DiagnosticPath::new(format!("render/{name}/elapsed_gpu"));
        diagnostics.get(&path).map(Diagnostic::values).into_iter().flatten().copied().collect()
    };
    (0..)
        .zip(SmokeRenderStats::PASSES)
        .map(|(i, name): (usize, _)| {
            let dispatches = counts.windows(2).map(|pair| pair[1][i] - pair[0][i]).collect();
            let times = times(name);
            let first_ms = times.first().copied();
            // Bevy keeps the last 120 times: once it is full the first is none of them.
            let first_ms = first_ms.filter(|_| times.len() < DEFAULT_MAX_HISTORY_LENGTH);
            let rest = times[usize::from(first_ms.is_some())..].to_vec();
            PassStats { name, dispatches, first_ms, steady_ms: median(rest) }
        })
        .collect()
}

/// The middle one; None where there are none.
pub(super) fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}
