//! Baking as a step of Bevy's asset pipeline.

use bevy::asset::AsyncWriteExt;
use bevy::asset::io::{AssetReaderError, AssetWriterError, Writer};
use bevy::asset::processor::{Process, ProcessContext, ProcessError};
use bevy::reflect::TypePath;
use serde::{Deserialize, Serialize};

use super::{BakeSettings, bake};
use crate::bundle::{MAX_RBFS, SmokeAnimationLoader};
use crate::density::read_vdb;
use crate::rbf::fit::FitTarget;

/// Bakes the OpenVDB files of an assets folder, so that `assets.load("cloud.vdb")` gives a
/// [`SmokeAnimation`](crate::bundle::SmokeAnimation) of one frame.
///
/// [`SmokePlugin`](crate::SmokePlugin) registers it for `.vdb` where the app processes its assets (`AssetPlugin` with
/// `AssetMode::Processed`, Bevy's feature `asset_processor`). The processed asset keeps its path. Settings are in the
/// `.meta` file beside the source, which the first run writes:
///
/// ```ron
/// (
///     meta_format_version: "1.0",
///     asset: Process(
///         processor: "VdbBaker",
///         settings: (rbfs: 300, error: None, grid: None, frames_per_second: 30.0, seed: 1),
///     ),
/// )
/// ```
#[derive(Clone, Copy, Debug, Default, TypePath)]
pub struct VdbBaker;

/// How [`VdbBaker`] bakes a file: the options of `smoke bake`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct VdbBakerSettings {
    /// Number of Gaussians, 1 to [`MAX_RBFS`].
    pub rbfs: u32,
    /// Error of the fit to reach instead, relative to the density, between 0 and 1.
    pub error: Option<f32>,
    /// The grid's name; `None` takes the one named `density`, or the only one there is.
    pub grid: Option<String>,
    /// Playback speed, above 0. A file is one frame, so it matters to whoever joins several.
    pub frames_per_second: f32,
    /// Seed of the fit's random choices.
    pub seed: u64,
}

impl Default for VdbBakerSettings {
    fn default() -> Self {
        let BakeSettings { frames_per_second, seed, .. } = BakeSettings::default();
        Self { rbfs: 600, error: None, grid: None, frames_per_second, seed }
    }
}

impl VdbBakerSettings {
    fn bake_settings(&self) -> Result<BakeSettings, String> {
        let target = match self.error {
            Some(error) if error > 0.0 && error < 1.0 => FitTarget::Error(error),
            Some(error) => return Err(format!("settings: error {error} is not between 0 and 1")),
            None if (1..=MAX_RBFS).contains(&self.rbfs) => FitTarget::Count(self.rbfs as usize),
            None => return Err(format!("settings: rbfs {} is not from 1 to {MAX_RBFS}", self.rbfs)),
        };
        let frames_per_second = self.frames_per_second;
        if !(frames_per_second > 0.0 && frames_per_second.is_finite()) {
            return Err(format!("settings: frames_per_second {frames_per_second} is not above 0"));
        }
        Ok(BakeSettings { target, seed: self.seed, frames_per_second, ..BakeSettings::default() })
    }

    /// The bytes of a bundle made of a file's bytes.
    fn bake(&self, vdb: &[u8]) -> Result<Vec<u8>, String> {
        let settings = self.bake_settings()?;
        let grid = read_vdb(vdb, self.grid.as_deref()).map_err(|error| error.to_string())?;
        Ok(bake(&grid, &settings, &|_| ()).map_err(|error| error.to_string())?.file)
    }
}

impl Process for VdbBaker {
    type Settings = VdbBakerSettings;
    type OutputLoader = SmokeAnimationLoader;

    async fn process(
        &self,
        context: &mut ProcessContext<'_>,
        settings: &VdbBakerSettings,
        writer: &mut Writer,
    ) -> Result<(), ProcessError> {
        let path = context.path().clone();
        let mut vdb = Vec::new();
        context.asset_reader().read_to_end(&mut vdb).await.map_err(|error| ProcessError::AssetReaderError {
            path: path.clone(),
            err: AssetReaderError::Io(error.into()),
        })?;
        let bundle = settings
            .bake(&vdb)
            .map_err(|problem| ProcessError::AssetTransformError(format!("{path}: {problem}").into()))?;
        writer
            .write_all(&bundle)
            .await
            .map_err(|error| ProcessError::AssetWriterError { path, err: AssetWriterError::Io(error) })
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::Path;
    use std::time::{Duration, Instant};

    use bevy::asset::processor::{AssetProcessor, FileTransactionLogFactory};
    use bevy::prelude::*;

    use super::*;
    use crate::SmokePlugin;
    use crate::bundle::SmokeAnimation;

    /// An app that processes the assets of a folder.
    fn app(folder: &Path) -> App {
        let text = |name: &str| folder.join(name).to_str().unwrap().to_owned();
        let mut app = App::new();
        app.add_plugins((
            MinimalPlugins,
            AssetPlugin {
                mode: AssetMode::Processed,
                file_path: text("assets"),
                processed_file_path: text("processed"),
                use_asset_processor_override: Some(true),
                watch_for_changes_override: Some(false),
                ..default()
            },
            TransformPlugin,
            SmokePlugin,
        ));
        // Its place by default is in the current folder.
        let log = FileTransactionLogFactory { file_path: folder.join("log") };
        app.world().resource::<AssetProcessor>().data().set_log_factory(Box::new(log)).unwrap();
        app
    }

    /// Loads a file of `tests/data/vdb` through the processor, with a `.meta` file; None if that fails.
    fn load(folder: &Path, name: &str, settings: &str) -> Option<SmokeAnimation> {
        let assets = folder.join("assets");
        fs::create_dir_all(&assets).unwrap();
        fs::copy(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/vdb").join(name), assets.join(name)).unwrap();
        let meta =
            format!("(meta_format_version: \"1.0\", asset: Process(processor: \"VdbBaker\", settings: ({settings})))");
        fs::write(assets.join(format!("{name}.meta")), meta).unwrap();
        let mut app = app(folder);
        let handle: Handle<SmokeAnimation> = app.world().resource::<AssetServer>().load(name.to_owned());
        let start = Instant::now();
        loop {
            app.update();
            let server = app.world().resource::<AssetServer>();
            if server.load_state(&handle).is_loaded() {
                return app.world().resource::<Assets<SmokeAnimation>>().get(&handle).cloned();
            }
            if server.load_state(&handle).is_failed() {
                return None;
            }
            assert!(start.elapsed() < Duration::from_secs(60), "it neither loads nor fails");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    #[test]
    fn a_density_file_loads_as_a_bundle() {
        let folder = tempfile::tempdir().unwrap();
        let animation = load(folder.path(), "half_blosc.vdb", "rbfs: 3, frames_per_second: 24.0").unwrap();
        assert_eq!((animation.frames_per_second, animation.frames.len()), (24.0, 1));
        // The processed asset has the path of its source and is what `bake` makes of it.
        let processed = fs::read(folder.path().join("processed/half_blosc.vdb")).unwrap();
        let source = fs::read(folder.path().join("assets/half_blosc.vdb")).unwrap();
        let settings = VdbBakerSettings { rbfs: 3, frames_per_second: 24.0, ..default() };
        assert_eq!(processed, settings.bake(&source).unwrap());
        let frame = crate::bundle::read(&processed).unwrap().frames.get(0).unwrap().clone();
        assert_eq!(frame.rbfs.rbfs.len(), 3);
    }

    #[test]
    fn faults_fail_the_asset() {
        let folder = tempfile::tempdir().unwrap();
        assert!(load(folder.path(), "level_set.vdb", "").is_none());
        let says = |settings: VdbBakerSettings, expected: &str| {
            assert!(settings.bake(b"").unwrap_err().contains(expected), "{expected}");
        };
        says(VdbBakerSettings { rbfs: 0, ..default() }, "rbfs 0 is not from 1");
        says(VdbBakerSettings { error: Some(2.0), ..default() }, "error 2 is not between 0 and 1");
        says(VdbBakerSettings { frames_per_second: f32::NAN, ..default() }, "frames_per_second NaN");
        assert!(VdbBakerSettings::default().bake(b"no vdb").is_err());
    }
}
