//! Spheres that are fitted to the mesh beside them while the game runs.

use std::collections::{HashMap, HashSet};

use bevy::asset::AssetEventSystems;
use bevy::ecs::lifecycle::HookContext;
use bevy::ecs::world::DeferredWorld;
use bevy::mesh::skinning::{SkinnedMesh, SkinnedMeshInverseBindposes};
use bevy::prelude::*;
use bevy::tasks::futures::check_ready;
use bevy::tasks::{AsyncComputeTaskPool, Task};

use super::SmokeOccluder;
use super::fit::FitFailure;
use super::mesh::{FitJob, OccluderShape};

/// Beside a [`Mesh3d`], and a [`SkinnedMesh`] if there is one: fits spheres to the mesh once it has loaded, off the main
/// thread, and inserts them as a [`SmokeOccluder`] some frames later; again whenever the mesh, or this, changes. Entities with
/// the same mesh and settings share one fit.
///
/// Removed, it stops what it has begun and leaves the `SmokeOccluder` that it has inserted, which is then the game's own.
/// While it is there, the spheres are replaced by every new fit only, so they may be changed in between.
///
/// [`fit_mesh`](super::fit_mesh) does the same at once, for tools.
#[derive(Component, Clone, Copy, Debug, PartialEq, Eq, Hash, Reflect)]
#[reflect(Component, Default, Debug, Clone, PartialEq, Hash)]
#[require(Fitted)]
#[component(on_remove = forget)]
pub struct SmokeOccluderFit {
    /// How many spheres there are to be at most.
    pub spheres: usize,
    /// What the mesh is to be taken for.
    pub shape: OccluderShape,
}

impl Default for SmokeOccluderFit {
    /// 32 spheres in a solid.
    fn default() -> Self {
        Self { spheres: 32, shape: OccluderShape::Solid }
    }
}

impl SmokeOccluderFit {
    /// So many spheres for the inside of a closed mesh.
    pub fn solid(spheres: usize) -> Self {
        Self { spheres, shape: OccluderShape::Solid }
    }

    /// So many spheres for the ground that a mesh shows from above.
    pub fn ground(spheres: usize) -> Self {
        Self { spheres, shape: OccluderShape::Ground }
    }
}

/// Which fit an entity has.
#[derive(Component, Clone, Copy, Debug, Default, PartialEq)]
struct Fitted(Option<(Key, u64)>);

fn forget(mut world: DeferredWorld, context: HookContext) {
    world.commands().entity(context.entity).try_remove::<Fitted>();
}

/// What a fit depends on.
type Key = (AssetId<Mesh>, Option<AssetId<SkinnedMeshInverseBindposes>>, SmokeOccluderFit);

/// All fits, begun and done.
#[derive(Resource, Default)]
struct Fits {
    known: HashMap<Key, Fit>,
    /// Numbers fits, so that a new one with the same key can be told from the one before.
    begun: u64,
}

struct Fit {
    number: u64,
    state: FitState,
}

enum FitState {
    Running(Task<Result<SmokeOccluder, FitFailure>>),
    Done(SmokeOccluder),
    Failed,
}

/// Fits spheres where a [`SmokeOccluderFit`] asks for them.
pub(crate) struct SmokeOccluderPlugin;

impl Plugin for SmokeOccluderPlugin {
    fn build(&self, app: &mut App) {
        app.register_type::<SmokeOccluder>()
            .register_type::<SmokeOccluderFit>()
            .init_resource::<Fits>()
            .add_systems(PostUpdate, (drop_changed, begin, finish).chain().after(AssetEventSystems));
    }
}

/// Drops the fits of meshes that have changed or gone.
fn drop_changed(
    mut fits: ResMut<Fits>,
    mut meshes: MessageReader<AssetEvent<Mesh>>,
    mut poses: MessageReader<AssetEvent<SkinnedMeshInverseBindposes>>,
) {
    for event in meshes.read() {
        if let AssetEvent::Modified { id } | AssetEvent::Removed { id } = event {
            fits.known.retain(|key, _| key.0 != *id);
        }
    }
    for event in poses.read() {
        if let AssetEvent::Modified { id } | AssetEvent::Removed { id } = event {
            fits.known.retain(|key, _| key.1 != Some(*id));
        }
    }
}

/// Begins the fits that are asked for and not known, and stops those that nothing asks for any more.
fn begin(
    mut fits: ResMut<Fits>,
    meshes: Option<Res<Assets<Mesh>>>,
    poses: Option<Res<Assets<SkinnedMeshInverseBindposes>>>,
    assets: Option<Res<AssetServer>>,
    entities: Query<(&SmokeOccluderFit, &Mesh3d, Option<&SkinnedMesh>)>,
) {
    let Some(meshes) = meshes else { return };
    let wanted: HashSet<Key> = entities.iter().map(|(fit, mesh, skin)| key(fit, mesh, skin)).collect();
    fits.known.retain(|key, fit| wanted.contains(key) || !matches!(fit.state, FitState::Running(_)));
    for key in wanted {
        if fits.known.contains_key(&key) {
            continue;
        }
        let (mesh, skin, settings) = key;
        let Some(loaded) = meshes.get(mesh) else { continue };
        let poses = match skin.map(|skin| poses.as_ref()?.get(skin)) {
            None => None,
            Some(Some(poses)) => Some(&**poses),
            Some(None) => continue,
        };
        let state = match FitJob::new(loaded, poses, settings.shape, settings.spheres) {
            Ok(job) => FitState::Running(AsyncComputeTaskPool::get().spawn(async move { job.run() })),
            Err(failure) => failed(mesh, failure, assets.as_deref()),
        };
        fits.begun += 1;
        let number = fits.begun;
        fits.known.insert(key, Fit { number, state });
    }
}

/// Hands out the fits that are done.
fn finish(
    mut commands: Commands,
    mut fits: ResMut<Fits>,
    assets: Option<Res<AssetServer>>,
    mut entities: Query<(Entity, &SmokeOccluderFit, &Mesh3d, Option<&SkinnedMesh>, &mut Fitted)>,
) {
    for (key, fit) in &mut fits.known {
        if let FitState::Running(task) = &mut fit.state
            && let Some(result) = check_ready(task)
        {
            fit.state = match result {
                Ok(occluder) => FitState::Done(occluder),
                Err(failure) => failed(key.0, failure, assets.as_deref()),
            };
        }
    }
    for (entity, settings, mesh, skin, mut fitted) in &mut entities {
        let key = key(settings, mesh, skin);
        if let Some(Fit { number, state: FitState::Done(occluder) }) = fits.known.get(&key)
            && fitted.0 != Some((key, *number))
        {
            fitted.0 = Some((key, *number));
            commands.entity(entity).try_insert(occluder.clone());
        }
    }
}

fn key(fit: &SmokeOccluderFit, mesh: &Mesh3d, skin: Option<&SkinnedMesh>) -> Key {
    (mesh.id(), skin.map(|skin| skin.inverse_bindposes.id()), *fit)
}

/// Says once for each fit why there is none.
fn failed(mesh: AssetId<Mesh>, failure: FitFailure, assets: Option<&AssetServer>) -> FitState {
    let path = assets.and_then(|assets| assets.get_path(mesh));
    let name = path.map_or_else(|| mesh.to_string(), |path| path.to_string());
    warn!("no smoke occluder can be fitted to mesh {name}: {failure}");
    FitState::Failed
}
