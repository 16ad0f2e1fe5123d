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
    /// The mesh has changed since it was read. A fit that runs is let run all the same: of a mesh that changes all the time
    /// there is one at a time.
    stale: bool,
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
        app.register_type::<SmokeOccluder>().register_type::<SmokeOccluderFit>().init_resource::<Fits>().add_systems(
            PostUpdate,
            (mark_changed, begin, finish)
                .chain()
                .after(AssetEventSystems)
                // Tools bake in apps that have no meshes.
                .run_if(resource_exists::<Assets<Mesh>>)
                .run_if(resource_exists::<Assets<SkinnedMeshInverseBindposes>>),
        );
    }
}

/// Marks the fits of meshes that have changed, and drops those of meshes that are gone.
fn mark_changed(
    mut fits: ResMut<Fits>,
    mut meshes: MessageReader<AssetEvent<Mesh>>,
    mut poses: MessageReader<AssetEvent<SkinnedMeshInverseBindposes>>,
) {
    for event in meshes.read() {
        match event {
            AssetEvent::Modified { id } => fits.mark(|key| key.0 == *id),
            AssetEvent::Removed { id } => fits.known.retain(|key, _| key.0 != *id),
            _ => {}
        }
    }
    for event in poses.read() {
        match event {
            AssetEvent::Modified { id } => fits.mark(|key| key.1 == Some(*id)),
            AssetEvent::Removed { id } => fits.known.retain(|key, _| key.1 != Some(*id)),
            _ => {}
        }
    }
}

impl Fits {
    fn mark(&mut self, is_changed: impl Fn(&Key) -> bool) {
        self.known.iter_mut().filter(|(key, _)| is_changed(key)).for_each(|(_, fit)| fit.stale = true);
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
    fits.known.retain(|key, fit| match fit.state {
        FitState::Running(_) => wanted.contains(key),
        FitState::Done(_) | FitState::Failed => !fit.stale,
    });
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
        fits.known.insert(key, Fit { number, state, stale: false });
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
        if let Some(Fit { number, state: FitState::Done(occluder), .. }) = fits.known.get(&key)
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

#[cfg(test)]
mod tests {
    use super::*;
    use bevy::asset::RenderAssetUsages;
    use bevy::mesh::{Indices, PrimitiveTopology, VertexAttributeValues};
    use std::time::{Duration, Instant};

    fn app() -> App {
        let mut app = App::new();
        app.add_plugins((MinimalPlugins, AssetPlugin::default(), TransformPlugin, SmokeOccluderPlugin))
            .init_asset::<Mesh>()
            .init_asset::<SkinnedMeshInverseBindposes>();
        app
    }

    fn add_mesh(app: &mut App, mesh: impl Into<Mesh>) -> Handle<Mesh> {
        app.world_mut().resource_mut::<Assets<Mesh>>().add(mesh.into())
    }

    /// Updates until nothing is being fitted.
    fn settle(app: &mut App) {
        let start = Instant::now();
        loop {
            app.update();
            let fits = app.world().resource::<Fits>();
            if fits.begun > 0 && fits.known.values().all(|fit| !matches!(fit.state, FitState::Running(_))) {
                break;
            }
            assert!(start.elapsed() < Duration::from_secs(60), "fits end");
            std::thread::sleep(Duration::from_millis(1));
        }
        // Commands, and changes of assets, are there by the next.
        app.update();
    }

    #[test]
    fn spheres_come_once_and_follow_the_mesh() {
        let mut app = app();
        let mesh = add_mesh(&mut app, Cuboid::new(1.0, 2.0, 1.0));
        let spawn = |app: &mut App| app.world_mut().spawn((Mesh3d(mesh.clone()), SmokeOccluderFit::solid(6))).id();
        let entities = [spawn(&mut app), spawn(&mut app)];
        settle(&mut app);
        let spheres = |app: &App, entity| app.world().get::<SmokeOccluder>(entity).cloned();
        let first = spheres(&app, entities[0]).unwrap();
        assert_eq!(first.spheres.len(), 6);
        assert_eq!(spheres(&app, entities[1]), Some(first.clone()));
        assert_eq!(app.world().resource::<Fits>().begun, 1, "both share one fit");

        // What a game changes stays until the next fit.
        app.world_mut().get_mut::<SmokeOccluder>(entities[0]).unwrap().spheres.clear();
        app.update();
        assert_eq!(spheres(&app, entities[0]).unwrap().spheres, []);
        // Without its order an entity keeps what it has, whatever becomes of the mesh.
        app.world_mut().entity_mut(entities[1]).remove::<SmokeOccluderFit>();
        *app.world_mut().resource_mut::<Assets<Mesh>>().get_mut(&mesh).unwrap() = Cuboid::new(2.0, 4.0, 2.0).into();
        app.update();
        settle(&mut app);
        let second = spheres(&app, entities[0]).unwrap();
        let widest = |occluder: &SmokeOccluder| occluder.spheres.iter().map(|sphere| sphere.radius).fold(0.0, f32::max);
        assert!((widest(&second) / widest(&first) - 2.0).abs() < 0.1, "{first:?} {second:?}");
        assert_eq!(spheres(&app, entities[1]), Some(first.clone()));
        // Ordered again it gets them.
        app.world_mut().entity_mut(entities[1]).insert(SmokeOccluderFit::solid(6));
        settle(&mut app);
        assert_eq!(spheres(&app, entities[1]), Some(second));
        assert_eq!(app.world().resource::<Fits>().begun, 2);
    }

    #[test]
    fn a_mesh_that_changes_all_the_time_is_fitted_again_and_again() {
        let mut app = app();
        let mesh = add_mesh(&mut app, Cuboid::new(1.0, 2.0, 1.0));
        let entity = app.world_mut().spawn((Mesh3d(mesh.clone()), SmokeOccluderFit::solid(2))).id();
        let start = Instant::now();
        let mut updates = 0;
        while app.world().get::<SmokeOccluder>(entity).is_none() || app.world().resource::<Fits>().begun < 2 {
            app.world_mut().resource_mut::<Assets<Mesh>>().get_mut(&mesh).unwrap().compute_normals();
            app.update();
            updates += 1;
            assert!(start.elapsed() < Duration::from_secs(60), "fits end");
            std::thread::sleep(Duration::from_millis(1));
        }
        assert!(updates > 3, "the first fit was not begun anew with every change");
    }

    #[test]
    fn nobody_waits_for_what_nobody_wants() {
        let mut app = app();
        let mesh = add_mesh(&mut app, Sphere::new(1.0));
        let entity = app.world_mut().spawn((Mesh3d(mesh), SmokeOccluderFit::solid(300))).id();
        app.update();
        assert_eq!(app.world().resource::<Fits>().known.len(), 1);
        app.world_mut().despawn(entity);
        app.update();
        assert_eq!(app.world().resource::<Fits>().known.len(), 0);
    }

    #[test]
    fn ground_and_sheets_are_told_apart() {
        let mut app = app();
        let mesh = add_mesh(&mut app, Plane3d::default().mesh().size(8.0, 8.0));
        let solid = app.world_mut().spawn((Mesh3d(mesh.clone()), SmokeOccluderFit::solid(4))).id();
        let ground = app.world_mut().spawn((Mesh3d(mesh), SmokeOccluderFit::ground(4))).id();
        settle(&mut app);
        assert!(app.world().get::<SmokeOccluder>(solid).is_none());
        let occluder = app.world().get::<SmokeOccluder>(ground).unwrap();
        assert_eq!(occluder.spheres.len(), 4);
        assert!(occluder.spheres.iter().all(|sphere| sphere.center.y < -4.0), "{occluder:?}");
    }

    #[test]
    fn meshes_on_the_gpu_only_are_refused() {
        let mut mesh = Mesh::from(Cuboid::default());
        let job = |mesh: &Mesh, poses: Option<&[Mat4]>| FitJob::new(mesh, poses, OccluderShape::Solid, 4).err();
        assert_eq!(job(&mesh, None), None);
        assert_eq!(job(&mesh, Some(&[Mat4::IDENTITY])), Some(FitFailure::BadSkin));
        mesh.remove_attribute(Mesh::ATTRIBUTE_POSITION);
        assert_eq!(job(&mesh, None), Some(FitFailure::NoPositions));
        let lines = Mesh::new(PrimitiveTopology::LineList, RenderAssetUsages::default())
            .with_inserted_attribute(Mesh::ATTRIBUTE_POSITION, vec![[0.0; 3]; 2]);
        assert_eq!(job(&lines, None), Some(FitFailure::NoTriangles));
        let mut taken = Mesh::from(Cuboid::default());
        taken.take_gpu_data().unwrap();
        assert_eq!(job(&taken, None), Some(FitFailure::NotInMainWorld));
    }

    /// An upright bar of two joints, the upper one of which turns: spheres go where the skin's vertices go.
    #[test]
    fn spheres_follow_joints_as_vertices_do() {
        let mut app = app();
        let bar = crate::occluder::shapes::box_grid(Vec3::new(0.5, 4.0, 0.5), [1, 8, 1]);
        let upper = |position: &Vec3| u16::from(position.y > 0.0);
        let joints = bar.positions.iter().map(|position| [upper(position), 0, 0, 0]).collect();
        let mesh = Mesh::new(PrimitiveTopology::TriangleList, RenderAssetUsages::default())
            .with_inserted_attribute(Mesh::ATTRIBUTE_POSITION, bar.positions.clone())
            .with_inserted_attribute(Mesh::ATTRIBUTE_JOINT_INDEX, VertexAttributeValues::Uint16x4(joints))
            .with_inserted_attribute(Mesh::ATTRIBUTE_JOINT_WEIGHT, vec![[1.0, 0.0, 0.0, 0.0]; bar.positions.len()])
            .with_inserted_indices(Indices::U32(bar.triangles.as_flattened().to_vec()));
        let mesh = add_mesh(&mut app, mesh);
        let rest = [Transform::from_xyz(0.0, -2.0, 0.0), Transform::from_xyz(0.0, 2.0, 0.0)];
        let poses = vec![Mat4::from_translation(Vec3::new(0.0, 2.0, 0.0)), Mat4::IDENTITY];
        let inverse_bindposes =
            app.world_mut().resource_mut::<Assets<SkinnedMeshInverseBindposes>>().add(poses.clone());
        let lower = app.world_mut().spawn(rest[0]).id();
        let upper = app.world_mut().spawn((rest[1], ChildOf(lower))).id();
        let skin = SkinnedMesh { inverse_bindposes, joints: vec![lower, upper] };
        let entity = app.world_mut().spawn((Mesh3d(mesh), skin, SmokeOccluderFit::solid(10), Transform::IDENTITY)).id();
        settle(&mut app);

        let placed = |app: &App| -> Vec<Vec4> {
            let entity = app.world().entity(entity);
            let transform_of = |joint| Some(app.world().get::<GlobalTransform>(joint)?.affine());
            let occluder = entity.get::<SmokeOccluder>().unwrap();
            occluder.place(entity.get().unwrap(), entity.get(), transform_of).collect()
        };
        let before = placed(&app);
        assert!(
            before.iter().any(|sphere| sphere.y > 1.0) && before.iter().any(|sphere| sphere.y < -1.0),
            "{before:?}"
        );
        app.world_mut().get_mut::<Transform>(upper).unwrap().rotation = Quat::from_rotation_z(1.5);
        app.update();
        let after = placed(&app);
        let joint = |joint| app.world().get::<GlobalTransform>(joint).unwrap().to_matrix();
        let spheres = &app.world().get::<SmokeOccluder>(entity).unwrap().spheres;
        for ((before, after), sphere) in before.iter().zip(&after).zip(spheres) {
            // Where a vertex at the sphere's centre would go that follows the same joint, which is the one on its side.
            let index = usize::from(sphere.joint.unwrap());
            assert!(if index == 0 { before.y < 0.2 } else { before.y > -0.2 }, "joint {index} has {before}");
            let vertex = (joint([lower, upper][index]) * poses[index]).transform_point3(before.truncate());
            assert!(after.truncate().abs_diff_eq(vertex, 1e-4), "{before} went to {after}, not {vertex}");
            assert!((before.w - after.w).abs() < 1e-5);
        }
    }
}
