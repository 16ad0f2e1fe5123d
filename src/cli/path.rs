//! `smoke render --method path`: traces a scene on the CPU, in two independent halves.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::ensure;
use clap::Args;
use glam::{DVec3, Vec3};
use serde::Serialize;

use super::bake::{BAR_STEPS, progress_bar, warn_of_lost_smoke};
use super::input::{is_density, read_bundle};
use super::render::{Choice, Job, Method, Scattering, read_equirect};
use super::scene::{Environment, Scene, SceneLight, SceneSphere};
use crate::density::{self, GridShape, Placement};
use crate::reference::path::{self, EquirectImage, Events, Light, alpha};
use crate::reference::surface::{Plane, Sphere, Surfaces};
use crate::reference::{Grid, Medium, Ray};

/// Optical depth over the box's longest side that is traced at most: in white smoke paths scatter about that often.
const MAX_DEPTH: f64 = 1e5;

/// Options of `smoke render` that only this method has.
#[derive(Args, Debug)]
pub struct PathArgs {
    /// path: beside NAME.exr, which is their mean, also writes two independent halves of the paths, NAME_a.exr and
    /// NAME_b.exr, for `smoke compare` to tell error from noise
    #[arg(long)]
    halves: bool,
    /// path: seed of the random paths; the same seed gives the same picture [default: 1]
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
}

impl PathArgs {
    /// Whether any of them is.
    pub(super) fn is_given(&self) -> bool {
        self.halves || self.seed.is_some()
    }

    /// Where the halves of a picture go, if they are asked for.
    pub(super) fn half_paths(&self, output: &Path) -> Option<[PathBuf; 2]> {
        let half = |suffix| {
            let mut name = output.file_stem().unwrap_or_default().to_owned();
            name.push(suffix);
            name.push(output.extension().unwrap_or_default());
            output.with_file_name(name)
        };
        self.halves.then(|| ["_a.", "_b."].map(half))
    }
}

/// What `--stats` writes.
#[derive(Serialize)]
struct Stats {
    method: Choice<Method>,
    scattering: Choice<Scattering>,
    size: [u32; 2],
    /// Paths a pixel, of both halves together.
    spp: u32,
    seed: u64,
    cells: [u32; 3],
    threads: usize,
    /// Seconds spent tracing, without reading and writing files.
    seconds: f64,
}

/// What is traced: a scene and its density where the box has its longest side 1 and its centre in the origin.
pub(super) struct Stage<'a> {
    scene: &'a Scene,
    density: &'a Grid,
    center: DVec3,
    side: f64,
    image: Option<EquirectImage>,
    lobes: Box<dyn Fn(DVec3) -> DVec3 + Sync + 'a>,
    lights: Vec<Light>,
}

impl<'a> Stage<'a> {
    /// Reads what the scene names; refuses smoke so dense that paths in it do not end.
    pub fn new(scene: &'a Scene, density: &'a Grid, placement: Placement) -> anyhow::Result<Self> {
        let (center, side) = scene.placement.center_and_side(density.shape, placement);
        let image = match &scene.environment {
            Environment::Equirect(path) => {
                let ([width, _], texels) = read_equirect(path)?;
                Some(EquirectImage::new(width as usize, texels.into_iter().map(Vec3::from).collect()))
            }
            Environment::Lobes { .. } => None,
        };
        let deepest = scene.sigma_t * side * density.values.iter().copied().fold(0.0, f64::max);
        ensure!(
            deepest <= MAX_DEPTH,
            "sigma_t {}: the densest smoke has an optical depth of {deepest:.1e} over the box's length, where paths do not \
             end; {MAX_DEPTH:.0e} is the most that can be traced",
            scene.sigma_t
        );
        let lobes = Box::new(|w| scene.environment.radiance(w).unwrap_or_default());
        let lights = scene.lights.iter().map(|light| in_bundle_space(light, center, side)).collect();
        Ok(Self { scene, density, center, side, image, lobes, lights })
    }

    /// The scene as the path tracer takes it.
    pub fn scene(&self) -> path::Scene<'_> {
        let Self { scene, center, side, .. } = self;
        let environment = match &self.image {
            Some(image) => path::Environment::Image(image),
            None => path::Environment::Function(&*self.lobes),
        };
        let medium = Medium { sigma: scene.sigma_t * side, albedo: scene.albedo, g: scene.g };
        let surfaces = surfaces_in_bundle_space(scene, *center, *side);
        path::Scene::new(self.density, medium, environment, &self.lights).with_surfaces(surfaces)
    }

    /// The camera's ray through a point of a picture of such a size.
    pub fn ray(&self, size: [u32; 2], x: f64, y: f64) -> Ray {
        Ray::new((self.scene.camera.eye - self.center) / self.side, self.scene.camera.direction(size, x, y))
    }
}

/// Traces a picture.
pub(super) fn run(job: &Job) -> anyhow::Result<()> {
    let Job { args, scene, size, spp, .. } = job;
    let (size, spp) = (*size, *spp);
    let (density, placement) = read_density(&args.input, args.frame)?;
    let shape = density.shape;
    let stage = Stage::new(scene, &density, placement)?;
    let smoke = stage.scene();
    let camera = |x, y| stage.ray(size, x, y);
    let asked = job.args.scattering;
    let (used, why) = match asked {
        Scattering::Auto => (Scattering::Multiple, "a path tracer needs to leave nothing out"),
        asked => (asked, "asked for"),
    };
    let events = if used == Scattering::Single { Events::Single } else { Events::All };
    let seed = args.path.seed.unwrap_or(1);

    let started = Instant::now();
    let alphas = alpha(&smoke, size, camera);
    if alphas.iter().all(|&alpha| alpha == 0.0) {
        eprintln!("warning: {}: the camera does not see the smoke: the picture is empty", args.scene.display());
    }
    let bar = progress_bar();
    bar.set_message("path tracing");
    let counts = [spp.div_ceil(2), spp / 2];
    let trace = |half: usize| {
        let progress = |share: f64| {
            let done = (half as f64 * f64::from(counts[0]) + share * f64::from(counts[half])) / f64::from(spp);
            bar.set_position((done * BAR_STEPS as f64) as u64);
        };
        // Of every seed two others, which no other seed makes.
        let seed = seed.wrapping_mul(2).wrapping_add(half as u64);
        let mut image = path::render(&smoke, size, camera, events, counts[half], seed, &progress);
        if job.kind.shows_surfaces() && scene.has_surfaces() {
            // Of these, too, paths of their own.
            let seed = seed.wrapping_add(1 << 63);
            let behind = path::render_surfaces(&smoke, size, camera, events, counts[half], seed, &|_| ());
            image.iter_mut().zip(behind).for_each(|(pixel, behind)| *pixel += behind);
        }
        image
    };
    let halves = [trace(0), trace(1)];
    bar.finish_and_clear();
    let seconds = started.elapsed().as_secs_f64();

    let [a, b] = counts.map(|count| f64::from(count) / f64::from(spp));
    let mean: Vec<DVec3> = halves[0].iter().zip(&halves[1]).map(|(x, y)| *x * a + *y * b).collect();
    let encode = |radiance: &[DVec3]| {
        let pixels: Vec<[f32; 4]> =
            radiance.iter().zip(&alphas).map(|(rgb, alpha)| rgb.as_vec3().extend(*alpha as f32).to_array()).collect();
        job.kind.encode(size, &pixels)
    };
    job.output.write(&encode(&mean)?)?;
    for (file, half) in job.halves.iter().flatten().zip(&halves) {
        file.write(&encode(half)?)?;
    }
    if let Some(file) = &job.stats {
        let stats = Stats {
            method: job.method.clone(),
            scattering: Choice { asked, used, why: why.into() },
            size,
            spp,
            seed,
            cells: shape.dims.to_array(),
            threads: rayon::current_num_threads(),
            seconds,
        };
        file.write(&serde_json::to_vec_pretty(&stats)?)?;
    }
    Ok(())
}

/// The density of a frame of a bundle, or of a density file, and where the file places it.
fn read_density(path: &Path, frame: u32) -> anyhow::Result<(Grid, Placement)> {
    let grid = |shape: GridShape, values: Vec<f32>| Grid { shape, values: values.into_iter().map(f64::from).collect() };
    if is_density(path) {
        ensure!(frame == 0, "--frame {frame}: {} is a single frame, 0", path.display());
        let density = density::read(path, None)?;
        warn_of_lost_smoke(&density);
        return Ok((grid(density.shape, density.values), density.placement));
    }
    let animation = read_bundle(path, frame)?;
    Ok((grid(animation.shape, animation.frames.get(0).expect("the one asked for").decode()), animation.placement))
}

/// A light of the scene where the smoke's box has its longest side 1 and its centre in the origin.
pub(super) fn in_bundle_space(light: &SceneLight, center: DVec3, side: f64) -> Light {
    // Irradiance is the same, I/d², so that the intensity goes with the square of the length.
    let (place, dim) = (|x: DVec3| (x - center) / side, side.powi(-2));
    match *light {
        SceneLight::Sun { direction, irradiance, angle_deg } => {
            Light::Sun { direction, irradiance, angle: angle_deg.to_radians() }
        }
        SceneLight::Point { position, intensity } => {
            Light::Point { position: place(position), intensity: intensity * dim }
        }
        SceneLight::Spot { position, direction, intensity, inner_deg, outer_deg } => Light::Spot {
            position: place(position),
            direction,
            intensity: intensity * dim,
            inner: inner_deg.to_radians(),
            outer: outer_deg.to_radians(),
        },
    }
}

/// The scene's surfaces in the same space.
pub(super) fn surfaces_in_bundle_space(scene: &Scene, center: DVec3, side: f64) -> Surfaces {
    let sphere = |sphere: &SceneSphere| Sphere {
        center: (sphere.center - center) / side,
        radius: sphere.radius / side,
        albedo: sphere.albedo,
    };
    Surfaces {
        plane: scene.plane.map(|plane| Plane { y: (plane.y - center.y) / side, albedo: plane.albedo }),
        spheres: scene.spheres.iter().map(sphere).collect(),
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::cli::bake::tests::blob;
    use crate::cli::exr_io::ExrImage;
    use crate::cli::render::{RenderArgs, run};

    #[derive(Parser)]
    struct Command {
        #[command(flatten)]
        args: RenderArgs,
    }

    const SCENE: &str = r#"{
        "placement": "width", "width_m": 2, "sigma_t": 4, "albedo": [0.9, 0.8, 0.7], "g": 0.3,
        "env": { "kind": "constant", "rgb": [0.1, 0.2, 0.3] },
        "lights": [{ "kind": "point", "pos": [0, 0, 3], "intensity": 9 }],
        "eye": [0, 0, 6], "target": [0, 0, 0], "fov_y_deg": 20, "size": [12, 10]
    }"#;

    /// Runs `smoke render` in a folder that holds a scene, with the words of `line`.
    fn render(folder: &Path, line: &str) -> anyhow::Result<()> {
        let scene = folder.join("scene.json");
        if !scene.exists() {
            std::fs::write(&scene, SCENE)?;
        }
        let files = ["npy", "smoke", "exr", "png"];
        let word = |word: &str| match word.rsplit_once('.') {
            Some((_, end)) if files.contains(&end) => folder.join(word).into_os_string(),
            _ => word.into(),
        };
        let words = ["render", "--scene"].map(Into::into).into_iter().chain([scene.into_os_string()]);
        run(Command::try_parse_from(words.chain(line.split_whitespace().map(word)))?.args)
    }

    #[test]
    fn halves_mean_and_statistics() {
        let dir = tempfile::tempdir().unwrap();
        blob(dir.path());
        let stats = dir.path().join("stats.json");
        let line = format!("blob.npy -o out.exr --method path --spp 9 --halves --seed 5 --stats {}", stats.display());
        render(dir.path(), &line).unwrap();
        let [mean, a, b] = ["out.exr", "out_a.exr", "out_b.exr"].map(|n| ExrImage::read(&dir.path().join(n)).unwrap());
        assert_eq!(mean.size, [12, 10]);
        assert_eq!((mean.alpha().unwrap(), a.alpha().unwrap()), (b.alpha().unwrap(), b.alpha().unwrap()));
        let [m, x, y] = [&mean, &a, &b].map(|image| image.rgb().unwrap());
        assert_ne!(x, y);
        for i in 0..120 {
            // 5 paths and 4.
            let expected = (5.0 * x[i][1] + 4.0 * y[i][1]) / 9.0;
            assert!((m[i][1] - expected).abs() < 1e-5 * expected.max(1.0));
        }
        let stats: serde_json::Value = serde_json::from_slice(&std::fs::read(&stats).unwrap()).unwrap();
        assert_eq!((&stats["spp"], &stats["seed"], &stats["method"]["used"]), (&9.into(), &5.into(), &"path".into()));
        assert_eq!(stats["scattering"]["used"], "multiple");
        assert_eq!(stats["cells"], serde_json::json!([12, 10, 8]));

        // The same again from the seed alone, another picture from another; single scattering is darker.
        render(dir.path(), "blob.npy -o same.exr --method path --spp 9 --seed 5").unwrap();
        render(dir.path(), "blob.npy -o other.exr --method path --spp 9 --seed 6").unwrap();
        let read = |name| ExrImage::read(&dir.path().join(name)).unwrap();
        assert_eq!(read("same.exr"), mean);
        assert_ne!(read("other.exr"), mean);
        let total = |name| read(name).rgb().unwrap().iter().map(|rgb| rgb[1]).sum::<f32>();
        render(dir.path(), "blob.npy -o full.exr --method path --spp 400").unwrap();
        render(dir.path(), "blob.npy -o single.exr --method path --spp 400 --scattering single").unwrap();
        assert!(total("single.exr") < 0.9 * total("full.exr"));
        render(dir.path(), "blob.npy -o out.png --method path --spp 2 --size 7x5").unwrap();
        let png = image::open(dir.path().join("out.png")).unwrap();
        assert_eq!((png.width(), png.height()), (7, 5));
    }

    #[test]
    fn a_bundle_is_traced_as_what_it_decodes_to() {
        let dir = tempfile::tempdir().unwrap();
        let input = blob(dir.path());
        let bundle = dir.path().join("blob.smoke");
        let grid = density::read(&input, None).unwrap();
        let target = crate::rbf::fit::FitTarget::Count(3);
        let settings = crate::bake::BakeSettings { target, ..Default::default() };
        std::fs::write(&bundle, crate::bake::bake(&grid, &settings, &|_| ()).unwrap().file).unwrap();
        render(dir.path(), "blob.npy -o density.exr --method path --spp 2").unwrap();
        render(dir.path(), "blob.smoke -o bundle.exr --method path --spp 2").unwrap();
        let [a, b] = ["density.exr", "bundle.exr"].map(|name| ExrImage::read(&dir.path().join(name)).unwrap());
        let worst = a.alpha().unwrap().iter().zip(b.alpha().unwrap()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        // Quantised to 8 bits.
        assert!(worst < 5e-3, "{worst}");
        assert!(a.alpha().unwrap().iter().any(|alpha| *alpha > 0.5));
    }

    #[test]
    fn refusals() {
        let dir = tempfile::tempdir().unwrap();
        blob(dir.path());
        for (line, expected) in [
            ("blob.npy -o out.exr --method path --spp 1", "2 paths a pixel or more"),
            ("blob.npy -o out.exr --method path --frame 1", "is a single frame, 0"),
            ("blob.npy -o out.exr --method path --frames 2", "draws a scene once"),
            ("none.npy -o out.exr --method path", "none.npy"),
            ("blob.npy -o blob.npy --method path", "written as .exr or .png"),
            ("blob.npy -o out.exr --method paper", "bake it first"),
            ("blob.npy -o out.exr --method path --lights 4", "are for --method constellation"),
            ("blob.smoke -o out.exr --method rbf --spp 5", "a square number"),
            ("blob.smoke -o out.exr --halves", "are for --method path"),
        ] {
            let message = format!("{:#}", render(dir.path(), line).unwrap_err());
            assert!(message.contains(expected), "{line}: {message}");
        }
        std::fs::write(dir.path().join("scene.json"), SCENE.replace("\"sigma_t\": 4", "\"sigma_t\": 1e40")).unwrap();
        let message = render(dir.path(), "blob.npy -o out.exr --method path").unwrap_err().to_string();
        assert!(message.starts_with("sigma_t 1"), "{message}");
        assert!(!dir.path().join("out.exr").exists());
    }

    #[test]
    fn halves_are_named_after_the_picture() {
        let args = PathArgs { halves: true, seed: None };
        let expected = Some(["out/plume.v2_a.exr", "out/plume.v2_b.exr"].map(PathBuf::from));
        assert_eq!(args.half_paths(Path::new("out/plume.v2.exr")), expected);
        assert_eq!(PathArgs { halves: false, seed: None }.half_paths(Path::new("out.exr")), None);
    }

    #[test]
    fn lamps_scale_with_the_smoke() {
        // From 2 m away with the box 4 m long: half a unit. The same irradiance either way.
        let lamp = SceneLight::Point { position: DVec3::new(1.0, 3.0, 0.0), intensity: DVec3::splat(8.0) };
        let Light::Point { position, intensity } = in_bundle_space(&lamp, DVec3::X, 4.0) else { panic!() };
        assert_eq!((position, intensity), (DVec3::Y * 0.75, DVec3::splat(0.5)));
        assert_eq!(intensity / position.length_squared(), DVec3::splat(8.0 / 9.0));
    }
}
