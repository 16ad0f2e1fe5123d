//! A long animation, played for longer than it is: memory must not grow with what has been shown.
//!
//! `cargo test --all-features --test pictures -- --ignored --nocapture endurance`, with `SMOKE_BUNDLE=FILE` to play the
//! frames of a bundle other than the plume's.

use std::path::Path;
use std::time::{Duration, Instant};

use bevy::prelude::*;
use bevy::render::render_resource::TextureFormat;
use bevy::time::TimeUpdateStrategy;
use bevy_smoke::bundle::{self, BundleHeader, SmokeFrame};
use bevy_smoke::headless::Headless;
use bevy_smoke::playback::{SmokeStreaming, SmokeStreamingStats};
use bevy_smoke::prelude::*;

use crate::scene::{SIZE, camera};

const FRAMES: usize = 1000;
const UPDATES: usize = 2000;
/// One frame of animation an update, and no more updates a second than this.
const STEP: Duration = Duration::from_nanos(1_000_000_000 / 30);

/// A bundle of `FRAMES` frames, which are those of `few` over and over, each time in another order. Their bytes are
/// copied as they are behind a new header (`docs/format.md`).
fn repeated(few: &[u8]) -> Vec<u8> {
    let header = BundleHeader::read(few).unwrap();
    let length = BundleHeader::FIXED_BYTES + 32 * FRAMES + 4;
    let mut bytes = few[..BundleHeader::FIXED_BYTES].to_vec();
    bytes[16..20].copy_from_slice(&(length as u32).to_le_bytes());
    bytes[20..24].copy_from_slice(&(FRAMES as u32).to_le_bytes());
    bytes[36..40].copy_from_slice(&30_f32.to_le_bytes());
    let mut payloads: Vec<u8> = Vec::new();
    for frame in 0..FRAMES {
        let count = header.frames.len();
        let entry = header.frames[(frame % count + 7 * (frame / count)) % count];
        bytes.extend(((length + payloads.len()) as u64).to_le_bytes());
        bytes.extend(entry.length.to_le_bytes());
        bytes.extend(entry.uncompressed.to_le_bytes());
        bytes.extend(entry.crc32.to_le_bytes());
        bytes.extend([0; 4]);
        payloads.extend(&few[entry.offset as usize..][..entry.length as usize]);
    }
    bytes.extend(crc32fast::hash(&bytes).to_le_bytes());
    bytes.extend(payloads);
    bytes
}

/// The plume in eight sizes, of a hundred RBFs to keep the GPU's share short.
fn plumes() -> Vec<u8> {
    let bytes = std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/plume.smoke")).unwrap();
    let mut animation = bundle::read(&bytes).unwrap();
    let mut frame: SmokeFrame = (**animation.frames.get(0).unwrap()).clone();
    frame.rbfs.rbfs.truncate(100);
    frame.ids.truncate(100);
    let frames = (1..=8).map(|size| {
        let mut frame = frame.clone();
        frame.rbfs.rbfs.iter_mut().for_each(|rbf| rbf.weight *= size as f32 / 8.0);
        frame
    });
    animation.frames = frames.collect::<Vec<_>>().into();
    bundle::write(&animation).unwrap()
}

/// Memory of this process, in MB.
fn resident_memory() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").expect("this is Linux");
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).expect("it is one of the lines");
    line.trim().trim_end_matches(" kB").parse::<f64>().unwrap() / 1024.0
}

#[test]
#[ignore = "takes minutes"]
fn endurance() {
    let few = std::env::var("SMOKE_BUNDLE").map_or_else(|_| plumes(), |file| std::fs::read(file).unwrap());
    let folder = tempfile::tempdir().unwrap();
    let file = repeated(&few);
    let megabytes = file.len() as f64 / 1e6;
    std::fs::write(folder.path().join("long.smoke"), &file).unwrap();
    drop(file);

    let mut headless =
        Headless::with_assets(SIZE, TextureFormat::Rgba16Float, folder.path().to_str().unwrap().to_owned()).unwrap();
    let camera = camera(&headless);
    let app = &mut headless.app;
    app.insert_resource(TimeUpdateStrategy::ManualDuration(STEP));
    let animation = app.world().resource::<AssetServer>().load("long.smoke");
    let playing = (
        SmokeVolume::new(animation),
        SmokeMedium { sigma_t: 5.0, ..default() },
        SmokeEnvironment::constant(Vec3::ONE, 1.0),
        Transform::from_scale(Vec3::splat(3.0)),
    );
    let volume = app.world_mut().spawn(playing).id();
    app.world_mut().spawn(camera);
    let start = Instant::now();
    while app.world().get::<SmokePlayback>(volume).unwrap().frame() == 0.0 {
        assert!(start.elapsed() < Duration::from_secs(20), "nothing is shown");
        app.update();
        std::thread::sleep(Duration::from_millis(2));
    }

    let mut after_one_loop = 0.0;
    let (mut largest_window, mut largest_bytes) = (0, 0);
    let start = Instant::now();
    for update in 1..=UPDATES {
        let begun = Instant::now();
        app.update();
        let stats = app.world().resource::<SmokeStreamingStats>();
        largest_window = largest_window.max(stats.resident_frames);
        largest_bytes = largest_bytes.max(stats.resident_bytes);
        if update == FRAMES {
            after_one_loop = resident_memory();
        }
        std::thread::sleep(STEP.saturating_sub(begun.elapsed()));
    }
    let seconds = start.elapsed().as_secs_f64();
    let at_the_end = resident_memory();
    let stats = app.world().resource::<SmokeStreamingStats>();
    println!(
        "{FRAMES} frames, {megabytes:.1} MB; {UPDATES} updates in {seconds:.0} s\n\
         resident memory: {after_one_loop:.0} MB after one loop, {at_the_end:.0} MB at the end\n\
         at most {largest_window} frames, {:.1} MB; {} frames read, {} late",
        largest_bytes as f64 / 1e6,
        stats.frames_read,
        stats.frames_late,
    );
    let streaming = app.world().resource::<SmokeStreaming>();
    assert!(largest_window <= streaming.frames_ahead + 2 + streaming.max_tasks);
    // What an allocator keeps may vary; the file has some hundred frames a loop more than that.
    assert!(at_the_end < after_one_loop + 0.1 * after_one_loop.max(100.0), "memory grows");
    assert!(stats.frames_late < UPDATES as u64 / 50, "{} frames late", stats.frames_late);
}
