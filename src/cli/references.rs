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

/// A scene with its true pictures.
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

    /// The error of a picture, given as two independent halves, or one twice.
    pub fn error(&self, picture: [&[[f32; 3]]; 2], events: Events) -> anyhow::Result<f64> {
        let [a, b] = match events {
            Events::Single => &self.single,
            Events::All => &self.full,
        };
        Ok(image_error(picture, [a, b], &self.alpha)?.relative)
    }
}
