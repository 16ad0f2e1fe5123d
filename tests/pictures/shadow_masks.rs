//! Meshes that smoke does not shade.

use bevy::core_pipeline::prepass::{DeferredPrepass, DepthPrepass};
use bevy::light::NotShadowReceiver;
use bevy::mesh::VertexAttributeValues;
use bevy::mesh::skinning::{SkinnedMesh, SkinnedMeshInverseBindposes};
use bevy::pbr::DefaultOpaqueRendererMethod;
use bevy::prelude::*;
use bevy_smoke::headless::Headless;
use bevy_smoke::prelude::*;
use bevy_smoke::render::SmokeRenderStats;

use crate::scene::*;
use crate::shadows::{PICTURE, plume, stage};

/// A stage with a camera, where smoke shades the floor and a box.
struct Scene {
    app: Headless,
    camera: Entity,
    volume: Entity,
    floor: Entity,
    block: Entity,
}

type Picture = Vec<[f32; 4]>;

impl Scene {
    fn new(of_camera: impl Bundle) -> Self {
        let (mut app, camera) = stage();
        let volume = plume(&mut app, Vec3::Y * 1.7);
        let world = app.app.world_mut();
        let floor = world.query_filtered::<Entity, With<Mesh3d>>().single(world).unwrap();
        let block = world.resource_mut::<Assets<Mesh>>().add(Cuboid::new(0.8, 0.8, 0.8));
        let grey = world
            .resource_mut::<Assets<StandardMaterial>>()
            .add(StandardMaterial::from(Color::linear_rgb(0.5, 0.4, 0.3)));
        let at = Transform::from_xyz(1.6, 0.4, 1.2).with_rotation(Quat::from_rotation_y(0.5));
        let block = world.spawn((Mesh3d(block), MeshMaterial3d(grey), at)).id();
        world.entity_mut(camera).insert(of_camera);
        Self { app, camera, volume, floor, block }
    }

    fn deferred() -> Self {
        let mut scene = Self::new((DepthPrepass, DeferredPrepass));
        scene.app.app.insert_resource(DefaultOpaqueRendererMethod::deferred());
        scene
    }

    fn insert(&mut self, entity: Entity, bundle: impl Bundle) {
        self.app.app.world_mut().entity_mut(entity).insert(bundle);
    }

    fn remove<B: Bundle>(&mut self, entity: Entity) {
        self.app.app.world_mut().entity_mut(entity).remove::<B>();
    }

    /// The very next picture.
    fn next(&mut self) -> Picture {
        self.app.app.update();
        self.app.float_pixels()
    }

    /// Masks drawn so far.
    fn masks(&self) -> u32 {
        let at = SmokeRenderStats::PASSES.iter().position(|pass| *pass == "smoke_shadow_mask").unwrap();
        self.app.app.world().resource::<SmokeRenderStats>().dispatches()[at]
    }

    /// The picture that no longer changes: the light in the smoke takes some frames to its last bit.
    fn settled(&mut self) -> Picture {
        let mut picture = draw(&mut self.app);
        for _ in 0..50 {
            let next = self.next();
            if differing(&next, &picture) == 0 {
                return picture;
            }
            picture = next;
        }
        panic!("the picture goes on changing");
    }

    /// With all meshes shaded, and with none.
    fn shaded_and_plain(&mut self) -> (Picture, Picture) {
        // Smoke is lit anew as shadows come and go, from what it was: twice, it is the same to the last bit.
        self.settled();
        self.insert(self.camera, SmokeShadows { smoke: false, ..default() });
        self.settled();
        self.remove::<SmokeShadows>(self.camera);
        let shaded = self.settled();
        self.insert(self.camera, SmokeShadows { smoke: false, ..default() });
        let plain = self.next();
        self.remove::<SmokeShadows>(self.camera);
        assert_eq!(differing(&self.next(), &shaded), 0);
        (shaded, plain)
    }
}

/// How many pixels differ in any bit.
fn differing(a: &Picture, b: &Picture) -> usize {
    a.iter().zip(b).filter(|(a, b)| a.map(f32::to_bits) != b.map(f32::to_bits)).count()
}

fn total(picture: &Picture) -> f64 {
    picture.iter().map(|pixel| f64::from(pixel[1])).sum()
}

/// Sparing one of floor and block leaves it as it is without shadows, to the last bit, and shades the other as before.
fn spares_each(scene: &mut Scene, edges: usize) {
    let (shaded, plain) = scene.shaded_and_plain();
    assert!(total(&shaded) < total(&plain));
    scene.insert(scene.floor, NoSmokeShadow);
    let floor_spared = scene.next();
    scene.insert(scene.block, NotShadowReceiver);
    scene.remove::<NoSmokeShadow>(scene.floor);
    let block_spared = scene.next();
    scene.insert(scene.floor, NoSmokeShadow);
    // Bevy lights what does not receive its shadows anew.
    let neither = scene.next();
    scene.insert(scene.block, NoSmokeShadow);
    scene.remove::<NotShadowReceiver>(scene.block);
    assert_eq!(differing(&scene.next(), &neither), 0);
    assert_eq!(differing(&neither, &plain), 0);

    let of_block = differing(&floor_spared, &plain);
    let of_floor = differing(&block_spared, &plain);
    println!("{of_block} pixels of the block are shaded, {of_floor} of the floor");
    assert!(of_block > 50 && of_floor > 500, "{of_block} {of_floor}");
    let mixed = (0..shaded.len()).filter(|&i| {
        let same = |a: &Picture, b: &Picture| a[i].map(f32::to_bits) == b[i].map(f32::to_bits);
        !(same(&floor_spared, &plain) && same(&block_spared, &shaded)
            || same(&floor_spared, &shaded) && same(&block_spared, &plain))
    });
    let mixed = mixed.count();
    assert!(mixed <= edges, "{mixed} pixels are neither spared nor shaded");

    scene.remove::<NoSmokeShadow>(scene.floor);
    scene.remove::<NoSmokeShadow>(scene.block);
    let masks = scene.masks();
    assert_eq!(differing(&scene.next(), &shaded), 0, "something is left of what is gone");
    assert!(masks > 0 && scene.masks() == masks, "a mask without a use");
}

#[test]
fn meshes_are_spared() {
    spares_each(&mut Scene::new(Msaa::Off), 0);
}

/// Pixels at edges have samples of both meshes.
#[test]
fn meshes_are_spared_with_msaa() {
    spares_each(&mut Scene::new(Msaa::Sample4), 200);
}

#[test]
fn deferred_meshes_are_spared() {
    spares_each(&mut Scene::deferred(), 0);
}

#[test]
fn meshes_are_spared_after_a_prepass() {
    spares_each(&mut Scene::new(DepthPrepass), 0);
}

/// Meshes with unlit materials are spared without being told.
#[test]
fn unlit_meshes_are_spared() {
    let mut scene = Scene::new(());
    let (shaded, _) = scene.shaded_and_plain();
    let set_unlit = |scene: &mut Scene, unlit: bool| {
        for entity in [scene.floor, scene.block] {
            let world = scene.app.app.world_mut();
            let material = world.get::<MeshMaterial3d<StandardMaterial>>(entity).unwrap().0.clone();
            world.resource_mut::<Assets<StandardMaterial>>().get_mut(&material).unwrap().unlit = unlit;
        }
    };
    set_unlit(&mut scene, true);
    let unlit = scene.next();
    scene.insert(scene.camera, SmokeShadows { smoke: false, ..default() });
    assert_eq!(differing(&scene.next(), &unlit), 0);
    scene.remove::<SmokeShadows>(scene.camera);
    set_unlit(&mut scene, false);
    assert_eq!(differing(&scene.next(), &shaded), 0);
}

/// A floor behind spared meshes is shaded where they have holes, or are transparent.
#[test]
fn holes_are_not_spared() {
    let mut scene = Scene::new(());
    let set = |scene: &mut Scene, alpha: f32, alpha_mode: AlphaMode| {
        let base_color = Color::linear_rgba(0.5, 0.5, 0.5, alpha);
        let material = StandardMaterial { base_color, alpha_mode, ..default() };
        let material = scene.app.app.world_mut().resource_mut::<Assets<StandardMaterial>>().add(material);
        scene.insert(scene.block, MeshMaterial3d(material));
    };
    for (alpha, mode) in [(0.0, AlphaMode::Mask(0.5)), (0.3, AlphaMode::Blend)] {
        set(&mut scene, alpha, mode);
        let (shaded, _) = scene.shaded_and_plain();
        scene.insert(scene.block, NoSmokeShadow);
        assert_eq!(differing(&scene.next(), &shaded), 0, "{mode:?}");
        scene.remove::<NoSmokeShadow>(scene.block);
    }
    set(&mut scene, 1.0, AlphaMode::Mask(0.5));
    let (_, plain) = scene.shaded_and_plain();
    scene.insert(scene.floor, NoSmokeShadow);
    let block_shaded = scene.next();
    assert!(differing(&block_shaded, &plain) > 50);
    scene.insert(scene.block, NoSmokeShadow);
    assert_eq!(differing(&scene.next(), &plain), 0);
}

/// A box whose upper half hangs on a second joint.
fn skinned_box() -> Mesh {
    let mut mesh = Cuboid::new(0.5, 2.0, 0.5).mesh().build();
    let Some(VertexAttributeValues::Float32x3(positions)) = mesh.attribute(Mesh::ATTRIBUTE_POSITION) else {
        unreachable!("a cuboid has positions")
    };
    let joints: Vec<[u16; 4]> = positions.iter().map(|position| [u16::from(position[1] > 0.0), 0, 0, 0]).collect();
    let weights = vec![[1.0, 0.0, 0.0, 0.0]; joints.len()];
    mesh.insert_attribute(Mesh::ATTRIBUTE_JOINT_INDEX, VertexAttributeValues::Uint16x4(joints));
    mesh.with_inserted_attribute(Mesh::ATTRIBUTE_JOINT_WEIGHT, weights)
}

/// Skinned meshes are spared where their skins are.
#[test]
fn skinned_meshes_are_spared() {
    for of_deferred in [false, true] {
        let mut scene = if of_deferred { Scene::deferred() } else { Scene::new(Msaa::Sample4) };
        let world = scene.app.app.world_mut();
        let mesh = world.resource_mut::<Assets<Mesh>>().add(skinned_box());
        let inverse_bindposes = vec![Mat4::IDENTITY, Mat4::IDENTITY];
        let inverse_bindposes = world
            .resource_mut::<Assets<SkinnedMeshInverseBindposes>>()
            .add(SkinnedMeshInverseBindposes::from(inverse_bindposes));
        let joints: Vec<_> = [
            Transform::from_xyz(1.6, 1.0, 1.0),
            Transform::from_xyz(2.1, 0.9, 1.2).with_rotation(Quat::from_rotation_z(-0.7)),
        ]
        .map(|joint| world.spawn(joint).id())
        .to_vec();
        let skin = SkinnedMesh { inverse_bindposes, joints };
        scene.insert(scene.block, (Mesh3d(mesh), skin));
        let (_, plain) = scene.shaded_and_plain();
        scene.insert(scene.floor, NoSmokeShadow);
        let block_shaded = scene.next();
        save_radiance("skinned", PICTURE, &block_shaded);
        assert!(differing(&block_shaded, &plain) > 100);
        scene.insert(scene.block, NoSmokeShadow);
        assert_eq!(differing(&scene.next(), &plain), 0);
    }
}

/// Smoke, its shadows, occluders and what is spared come and go without a trace.
#[test]
fn nothing_is_left() {
    for of_deferred in [false, true] {
        let mut scene = if of_deferred { Scene::deferred() } else { Scene::new(Msaa::Sample4) };
        let volume = scene.volume;
        let world = scene.app.app.world_mut();
        let (smoke, medium) =
            (world.get::<SmokeVolume>(volume).unwrap().clone(), *world.get::<SmokeMedium>(volume).unwrap());
        world.entity_mut(volume).remove::<SmokeVolume>();
        for _ in 0..10 {
            scene.next();
        }
        let before = scene.next();
        scene.insert(volume, (smoke, medium));
        scene.insert(scene.camera, SmokeShadows { smoke: true, occluders: true });
        scene.insert(scene.block, (NoSmokeShadow, SmokeOccluder::default()));
        let during = scene.settled();
        assert!(differing(&during, &before) > 500);
        scene.remove::<SmokeVolume>(volume);
        assert_eq!(differing(&scene.next(), &before), 0, "deferred: {of_deferred}");
        scene.remove::<SmokeShadows>(scene.camera);
        scene.remove::<(NoSmokeShadow, SmokeOccluder)>(scene.block);
        assert_eq!(differing(&scene.next(), &before), 0, "deferred: {of_deferred}");
    }
}
