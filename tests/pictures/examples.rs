//! The examples' own scenes, drawn without a window.

use std::time::Duration;

use bevy::prelude::*;
use bevy::render::render_resource::TextureFormat;
use bevy::time::TimeUpdateStrategy;
use bevy_smoke::headless::Headless;
use bevy_smoke::prelude::*;

use crate::scene::save;

#[allow(dead_code)]
#[path = "../../examples/character/main.rs"]
mod character;
#[allow(dead_code)]
#[path = "../../examples/demo.rs"]
mod demo;
#[cfg(feature = "egui")]
#[allow(dead_code)]
#[path = "../../examples/lab/main.rs"]
mod lab;
#[allow(dead_code)]
#[path = "../../examples/lamps.rs"]
mod lamps;
#[allow(dead_code)]
#[path = "../../examples/live.rs"]
pub mod live;
#[allow(dead_code)]
#[path = "../../examples/minimal.rs"]
mod minimal;
#[allow(dead_code)]
#[path = "../../examples/playback.rs"]
mod playback;
#[allow(dead_code)]
#[path = "../../examples/terrain.rs"]
mod terrain;

/// The scene with its smoke, and without it.
fn pictures<M>(
    name: &str,
    size: UVec2,
    setup: impl IntoScheduleConfigs<bevy::ecs::system::ScheduleSystem, M>,
) -> [Vec<[u8; 4]>; 2] {
    let mut headless = Headless::new(size, TextureFormat::Rgba8UnormSrgb).unwrap();
    headless.draw_cameras_to_image();
    // As they start, however long drawing takes.
    headless.app.insert_resource(TimeUpdateStrategy::ManualDuration(Duration::ZERO));
    headless.app.add_systems(Startup, setup);
    headless.settle().unwrap();
    let draw = |headless: &mut Headless| {
        for _ in 0..3 {
            headless.app.update();
        }
        headless.pixels()
    };
    let with = draw(&mut headless);
    save(name, size, &with);
    let world = headless.app.world_mut();
    let volumes: Vec<Entity> = world.query_filtered::<Entity, With<SmokeVolume>>().iter(world).collect();
    assert_eq!(volumes.len(), 1);
    world.despawn(volumes[0]);
    let without = draw(&mut headless);
    [with, without].map(|pixels| pixels.as_chunks().0.to_vec())
}

/// Pixels that smoke changes by more than a little.
fn smoky([with, without]: &[Vec<[u8; 4]>; 2]) -> usize {
    let differs = |(a, b): &(&[u8; 4], &[u8; 4])| a.iter().zip(*b).any(|(a, b)| a.abs_diff(*b) > 10);
    with.iter().zip(without).filter(differs).count()
}

#[test]
fn minimal_shows_smoke() {
    let size = UVec2::new(256, 192);
    let pictures = pictures("minimal", size, minimal::setup);
    let (smoke, all) = (smoky(&pictures), pictures[0].len());
    // A column a quarter as wide as the view is high.
    assert!((all / 20..all / 2).contains(&smoke), "{smoke} of {all} pixels show smoke");
}

#[test]
fn demo_shows_smoke_and_meshes() {
    let size = UVec2::new(480, 360);
    let pictures = pictures("demo", size, demo::setup);
    let (smoke, all) = (smoky(&pictures), pictures[0].len());
    assert!((all / 40..all / 2).contains(&smoke), "{smoke} of {all} pixels show smoke");
    let count = |is: &dyn Fn([u8; 4]) -> bool| pictures[0].iter().filter(|pixel| is(**pixel)).count();
    let red = count(&|[r, g, b, _]| u32::from(r) > 2 * u32::from(g) && u32::from(r) > 2 * u32::from(b));
    let blue = count(&|[r, g, b, _]| 2 * u32::from(b) > 3 * u32::from(r) && 2 * u32::from(b) > 3 * u32::from(g));
    assert!(red > 1000, "the sphere in front of the smoke: {red} pixels");
    assert!(blue > 1000, "the wall behind it: {blue} pixels");
}

#[test]
fn character_walks_through_smoke() {
    let size = UVec2::new(320, 200);
    let mut headless = Headless::new(size, TextureFormat::Rgba8UnormSrgb).unwrap();
    headless.draw_cameras_to_image();
    headless.app.add_systems(Startup, character::setup).add_systems(Update, character::walk);
    character::ready(&mut headless);
    let pixels = |headless: &Headless| -> Vec<[u8; 4]> { headless.pixels().as_chunks().0.to_vec() };
    let first = pixels(&headless);
    save("character", size, first.as_flattened());
    // Half a step later another pixels are the figure's, and as many.
    headless.app.insert_resource(TimeUpdateStrategy::ManualDuration(Duration::from_millis(300)));
    headless.app.update();
    let later = pixels(&headless);
    let is_figure = |[r, _, b, _]: &[u8; 4]| u32::from(*r) > 2 * u32::from(*b);
    let [before, after] = [&first, &later].map(|pixels| pixels.iter().filter(|pixel| is_figure(pixel)).count());
    assert!(before > 300 && after > 300, "the figure covers {before} and then {after} pixels");
    let moved = first.iter().zip(&later).filter(|(a, b)| is_figure(a) != is_figure(b)).count();
    assert!(moved > 200, "{moved} pixels became the figure's or ceased to be");
}

#[test]
fn lamps_show_fire_and_beam() {
    let size = UVec2::new(384, 288);
    let pictures = pictures("lamps", size, lamps::setup);
    let (smoke, all) = (smoky(&pictures), pictures[0].len());
    assert!((all / 40..all / 2).contains(&smoke), "{smoke} of {all} pixels show smoke");
    // Of the pixels that smoke changes: orange about the fire, and blue where the beam meets smoke, higher up.
    let mean_row = |is: &dyn Fn(&[u8; 4]) -> bool| {
        let both = pictures[0].iter().zip(&pictures[1]).enumerate();
        let rows: Vec<usize> = both
            .filter(|(_, (with, without))| (0..3).any(|c| with[c] > without[c].saturating_add(10)) && is(with))
            .map(|(i, _)| i / size.x as usize)
            .collect();
        assert!(rows.len() > 300, "{} pixels", rows.len());
        rows.iter().sum::<usize>() / rows.len()
    };
    let fire = mean_row(&|[r, _, b, _]| u32::from(*r) > 2 * u32::from(*b));
    let beam = mean_row(&|[r, _, b, _]| b > r);
    assert!(beam + 30 < fire, "the beam is at row {beam}, the fire at row {fire}");
}

#[test]
fn playback_shows_smoke() {
    let size = UVec2::new(256, 192);
    let pictures = pictures("playback", size, playback::setup);
    let (smoke, all) = (smoky(&pictures), pictures[0].len());
    // The first frame is a puff.
    assert!((all / 40..all / 2).contains(&smoke), "{smoke} of {all} pixels show smoke");
}

#[test]
fn terrain_shows_smoke_over_mountains() {
    let options = terrain::Options { coupled: false, ..default() };
    let size = UVec2::new(320, 180);
    let setup = (terrain::setup(options), terrain::light_day).chain();
    let pictures = pictures("terrain", size, setup);
    let (smoke, all) = (smoky(&pictures), pictures[0].len());
    assert!((all / 40..all / 2).contains(&smoke), "{smoke} of {all} pixels show smoke");
    // A bright sky above, mountains below.
    let blue = |row: u32| {
        let row = &pictures[1][(row * size.x) as usize..((row + 1) * size.x) as usize];
        row.iter().map(|pixel| u32::from(pixel[2])).sum::<u32>() / size.x
    };
    assert!(blue(10) > blue(170) + 60, "{} above, {} below", blue(10), blue(170));
}

/// The keys step through frames, turn playback around and change what happens at the end.
#[test]
fn playback_obeys_keys() {
    let mut app = App::new();
    app.init_resource::<ButtonInput<KeyCode>>().add_systems(Update, playback::control);
    let volume = app.world_mut().spawn(SmokePlayback::default()).id();
    let mut press = |key| {
        let mut keys = app.world_mut().resource_mut::<ButtonInput<KeyCode>>();
        keys.reset_all();
        keys.press(key);
        app.update();
        app.world().get::<SmokePlayback>(volume).unwrap().clone()
    };
    assert!(press(KeyCode::Space).paused);
    assert_eq!(press(KeyCode::ArrowRight).frame(), 1.0);
    assert_eq!(press(KeyCode::ArrowRight).frame(), 2.0);
    assert_eq!(press(KeyCode::ArrowLeft).frame(), 1.0);
    assert_eq!(press(KeyCode::ArrowUp).speed, 2.0);
    let slower = [1.0, 0.5, 0.25, 0.1, -0.1].map(|_| press(KeyCode::ArrowDown).speed);
    assert_eq!(slower, [1.0, 0.5, 0.25, 0.1, -0.1]);
    assert_eq!(press(KeyCode::KeyM).mode, PlaybackMode::PingPong);
}

#[cfg(feature = "egui")]
#[test]
fn the_lab_opens_what_it_knows_and_names_what_it_does_not() {
    use bevy_smoke::panel::{SmokePanel, SmokePanelPlugin};

    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    let assets = AssetPlugin::default().file_path;
    let mut headless = Headless::with_plugins(UVec2::new(480, 300), TextureFormat::Rgba8UnormSrgb, assets, |app| {
        app.add_plugins((SmokePanelPlugin, lab::open::OpenPlugin, lab::bake::BakePlugin, lab::camera::OrbitPlugin));
    })
    .unwrap();
    headless.draw_cameras_to_image();
    headless.app.add_systems(Startup, lab::setup);
    headless.app.update();

    let open = |headless: &mut Headless, files: &[std::path::PathBuf]| {
        headless.app.world_mut().resource_mut::<lab::open::Queue>().add(files.to_vec());
    };
    let wait = |headless: &mut Headless, what: &str, until: &dyn Fn(&SmokeVolume, Option<&str>) -> bool| {
        for _ in 0..600 {
            headless.app.update();
            let world = headless.app.world_mut();
            let notice = world.resource::<SmokePanel>().notice.clone();
            let mut volumes = world.query::<&SmokeVolume>();
            if volumes.iter(world).any(|volume| until(volume, notice.as_deref())) {
                return;
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        panic!("{what}: {:?}", headless.app.world().resource::<SmokePanel>().notice);
    };
    let plays = |volume: &SmokeVolume, name: &str| {
        volume.animation().and_then(|animation| animation.path()).is_some_and(|path| path.to_string().ends_with(name))
    };
    open(&mut headless, &["plume.smoke".into()]);
    wait(&mut headless, "a bundle plays", &|volume, _| plays(volume, "plume.smoke"));
    headless.settle().unwrap();
    save("lab", UVec2::new(480, 300), &headless.pixels());

    // What goes wrong is said, and what was there stays.
    std::fs::write(file("broken.smoke"), b"no bundle at all").unwrap();
    std::fs::write(file("broken.vdb"), b"no grid at all").unwrap();
    for (name, says) in [
        ("notes.txt", "not a file that is known here"),
        ("broken.smoke", "cannot be shown"),
        ("missing.hdr", "cannot be shown"),
        ("broken.vdb", "Not baked"),
    ] {
        open(&mut headless, &[file(name)]);
        wait(&mut headless, name, &|volume, notice| {
            notice.is_some_and(|notice| notice.contains(name) && notice.contains(says) && !notice.contains('\n'))
                && plays(volume, "plume.smoke")
        });
    }

    // Density is shown as it is, and then baked.
    std::fs::copy(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/vdb/float_zip.vdb"), file("cloud.vdb")).unwrap();
    open(&mut headless, &[file("cloud.vdb")]);
    wait(&mut headless, "density", &|volume, _| !plays(volume, "plume.smoke"));
    wait(&mut headless, "a bake", &|volume, _| plays(volume, "cloud.smoke"));
    assert!(file("cloud.smoke").exists());

    // An image lights it.
    let texels = [[1.0_f32, 0.5, 0.25]; 8];
    let mut hdr = Vec::new();
    image::codecs::hdr::HdrEncoder::new(&mut hdr).encode(&texels.map(image::Rgb), 4, 2).unwrap();
    std::fs::write(file("sky.hdr"), hdr).unwrap();
    open(&mut headless, &[file("sky.hdr")]);
    for _ in 0..200 {
        headless.app.update();
        std::thread::sleep(Duration::from_millis(5));
        let world = headless.app.world_mut();
        if world.query::<&SmokeEnvironment>().iter(world).any(|e| matches!(e, SmokeEnvironment::Equirect { .. })) {
            return;
        }
    }
    panic!("the image does not light the smoke");
}
