//! The reference pictures that errors are measured against: scenes and their path-traced halves.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};

use super::exr_io::ExrImage;
use super::scene::Scene;
use crate::reference::compare::image_error;
use crate::reference::path::Events;

/// The folder that `--references` names; where it is missing, what to do.
pub(super) fn folder(given: Option<&Path>) -> anyhow::Result<&Path> {
    let Some(folder) = given else {
        bail!(
            "the reference pictures are not part of this repository: pass --references DIR, a folder with NAME.json (a scene \
             of smoke render) and NAME/{{single,full}}_{{a,b}}.exr, NAME/alpha.exr (smoke render --method path --halves \
             makes such)"
        )
    };
    ensure!(folder.is_dir(), "--references {}: there is no such folder", folder.display());
    Ok(folder)
}

/// The scenes of a folder, by name.
pub(super) fn names(folder: &Path) -> anyhow::Result<Vec<String>> {
    let entries = std::fs::read_dir(folder).with_context(|| format!("cannot read {}", folder.display()))?;
    let mut names = Vec::new();
    for entry in entries {
        let path = entry?.path();
        if path.extension().is_some_and(|extension| extension == "json") {
            names.extend(path.file_stem().map(|stem| stem.to_string_lossy().into_owned()));
        }
    }
    names.sort();
    Ok(names)
}

/// A scene with its true pictures.
#[derive(Clone)]
pub(super) struct Reference {
    pub name: String,
    pub scene: Scene,
    /// The density file that the scene names.
    pub density: PathBuf,
    single: [Vec<[f32; 3]>; 2],
    full: [Vec<[f32; 3]>; 2],
    pub alpha: Vec<f32>,
}

impl Reference {
    /// Reads a scene of the folder.
    pub fn read(folder: &Path, name: &str) -> anyhow::Result<Self> {
        let file = folder.join(format!("{name}.json"));
        ensure!(
            file.exists(),
            "--references {}: there is no scene {name}.json in it; pass a folder that has it, or other --scenes",
            folder.display()
        );
        let (scene, warnings) = Scene::read(&file)?;
        for warning in warnings {
            eprintln!("warning: {}: {warning}", file.display());
        }
        ensure!(
            !scene.has_surfaces(),
            "{}: it has a plane or spheres, which are not drawn here: leave it out",
            file.display()
        );
        let density = scene.density.clone().with_context(|| format!("{}: it names no density", file.display()))?;
        let size = scene.camera.size.map(|side| side as usize);
        let image = |picture: &str| {
            let path = folder.join(name).join(format!("{picture}.exr"));
            let image = ExrImage::read(&path)?;
            ensure!(image.size == size, "{} is not of the scene's size, {} × {}", path.display(), size[0], size[1]);
            Ok(image)
        };
        let halves = |kind: &str| -> anyhow::Result<_> {
            Ok([image(&format!("{kind}_a"))?.rgb()?, image(&format!("{kind}_b"))?.rgb()?])
        };
        let (single, full) = (halves("single")?, halves("full")?);
        let alpha = image("alpha")?.alpha()?.to_vec();
        Ok(Self { name: name.into(), scene, density, single, full, alpha })
    }

    /// What a picture is best multiplied by, to come as close as its brightness allows.
    pub fn brightness(&self, picture: &[[f32; 3]], events: Events) -> f32 {
        let [a, b] = self.halves(events);
        let (mut product, mut square) = (0.0, 0.0);
        let smoke = |alpha: &f32| *alpha > crate::reference::compare::SMOKE_ALPHA;
        for (i, _) in self.alpha.iter().enumerate().filter(|(_, alpha)| smoke(alpha)) {
            for c in 0..3 {
                let x = f64::from(picture[i][c]);
                product += x * 0.5 * f64::from(a[i][c] + b[i][c]);
                square += x * x;
            }
        }
        if square > 0.0 { (product / square) as f32 } else { 1.0 }
    }

    fn halves(&self, events: Events) -> &[Vec<[f32; 3]>; 2] {
        match events {
            Events::Single => &self.single,
            Events::All => &self.full,
        }
    }

    /// The error of a picture, its own noise and all, but without that of the reference.
    pub fn error(&self, picture: &[[f32; 3]], events: Events) -> anyhow::Result<f64> {
        let [a, b] = self.halves(events);
        Ok(image_error([picture, picture], [a, b], &self.alpha)?.relative)
    }
}
