//! What is done with a file: it takes the place of what is shown once it has loaded, and not before.

use std::path::{Path, PathBuf};

use bevy::asset::io::file::FileAssetReader;
use bevy::asset::{AssetPath, LoadState};
use bevy::prelude::*;
use bevy_smoke::cli::frames::natural;
use bevy_smoke::panel::SmokePanel;
use bevy_smoke::prelude::*;

use super::bake::Bakes;

/// Files to be opened.
#[derive(Resource, Default)]
pub struct Queue(Vec<Vec<PathBuf>>);

impl Queue {
    /// Adds files that belong together.
    pub fn add(&mut self, files: Vec<PathBuf>) {
        if !files.is_empty() {
            self.0.push(files);
        }
    }
}

/// Files on their way.
#[derive(Resource, Default)]
struct Loading(Vec<(PathBuf, Asset)>);

enum Asset {
    Smoke(Handle<SmokeAnimation>),
    Image(Handle<Image>),
    Scene(Handle<DynamicWorld>),
}

/// What a file is, by its name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    Bundle,
    Density,
    Image,
    Scene,
}

impl Kind {
    pub fn of(path: &Path) -> Option<Self> {
        let name = path.file_name()?.to_str()?.to_lowercase();
        let ends = |endings: &[&str]| endings.iter().any(|ending| name.ends_with(ending));
        if ends(&[".smoke"]) {
            Some(Self::Bundle)
        } else if ends(&[".vdb", ".npy"]) {
            Some(Self::Density)
        } else if ends(&[".hdr", ".exr"]) {
            Some(Self::Image)
        } else if ends(&[".scn.ron"]) {
            Some(Self::Scene)
        } else {
            None
        }
    }
}

pub struct OpenPlugin;

impl Plugin for OpenPlugin {
    fn build(&self, app: &mut App) {
        app.init_resource::<Queue>().init_resource::<Loading>().add_systems(Update, (open, show).chain());
    }
}

/// How the asset server knows a file: from the assets folder if it is in there, so that a game finds it too.
pub fn asset_path(path: &Path) -> AssetPath<'static> {
    let assets = FileAssetReader::get_base_path().join("assets");
    let absolute = std::path::absolute(path).unwrap_or_else(|_| path.into());
    let inside = absolute.strip_prefix(&assets).map(Path::to_path_buf);
    AssetPath::from_path_buf(match inside {
        Ok(inside) => inside,
        // Not a file as it stands: one of the assets folder's.
        Err(_) if !absolute.exists() => path.into(),
        Err(_) => absolute,
    })
}

fn open(
    mut queue: ResMut<Queue>,
    mut loading: ResMut<Loading>,
    mut bakes: ResMut<Bakes>,
    mut panel: ResMut<SmokePanel>,
    assets: Res<AssetServer>,
) {
    for files in queue.0.drain(..) {
        let mut densities = Vec::new();
        for file in files {
            let asset = match Kind::of(&file) {
                Some(Kind::Bundle) => Asset::Smoke(assets.load(asset_path(&file))),
                Some(Kind::Image) => Asset::Image(assets.load(asset_path(&file))),
                Some(Kind::Scene) => Asset::Scene(assets.load(asset_path(&file))),
                Some(Kind::Density) => {
                    densities.push(file);
                    continue;
                }
                None => {
                    let known = ".smoke, .vdb, .npy, .hdr, .exr or .scn.ron";
                    panel.notice = Some(format!("{}: not a file that is known here ({known})", file.display()));
                    continue;
                }
            };
            loading.0.push((file, asset));
        }
        if !densities.is_empty() {
            // In the order of their numbers.
            densities.sort_by(|a, b| natural(&a.to_string_lossy(), &b.to_string_lossy()));
            bakes.begin(densities);
        }
    }
}

/// Shows what has come, and says what has not.
fn show(
    mut commands: Commands,
    mut loading: ResMut<Loading>,
    mut panel: ResMut<SmokePanel>,
    assets: Res<AssetServer>,
    animations: Res<Assets<SmokeAnimation>>,
    mut volumes: Query<(&mut SmokeVolume, &mut SmokeEnvironment, &mut SmokePlayback, &mut Transform)>,
    before: Query<Entity, Or<(With<SmokeVolume>, With<DirectionalLight>, With<PointLight>, With<SpotLight>)>>,
) {
    if loading.0.is_empty() {
        return;
    }
    loading.0.retain(|(file, asset)| {
        let id = match asset {
            Asset::Smoke(handle) => handle.id().untyped(),
            Asset::Image(handle) => handle.id().untyped(),
            Asset::Scene(handle) => handle.id().untyped(),
        };
        match assets.get_load_state(id) {
            Some(LoadState::Loaded) => {}
            Some(LoadState::Failed(error)) => {
                let error = error.to_string();
                let line = error.lines().next().unwrap_or_default();
                panel.notice = Some(format!("{} cannot be shown: {line}", file.display()));
                return false;
            }
            _ => return true,
        }
        let selected = panel.volume.and_then(|volume| volumes.get_mut(volume).ok());
        match (asset, selected) {
            (Asset::Scene(scene), _) => {
                // It takes the place of the volumes and lights that are there.
                before.iter().for_each(|entity| commands.entity(entity).despawn());
                commands.spawn(DynamicWorldRoot(scene.clone()));
            }
            (Asset::Smoke(animation), Some((mut volume, _, mut playback, mut transform))) => {
                *volume = SmokeVolume::new(animation.clone());
                *playback = SmokePlayback::default();
                let half = animations.get(animation).map_or(0.5, |animation| animation.shape.half_extent().y);
                put_on_ground(&mut transform, half);
            }
            (Asset::Image(image), Some((_, mut environment, ..))) => {
                *environment = SmokeEnvironment::equirect(image.clone(), 1000.0);
            }
            // Until there is a volume.
            (_, None) => return true,
        }
        panel.notice = None;
        false
    });
}

/// Moves a volume so that its box, of a half height in its own units, stands on the ground.
pub fn put_on_ground(transform: &mut Transform, half_height: f32) {
    transform.translation.y = half_height * transform.scale.y;
}
