//! A long animation, played for longer than it is: memory must not grow with what has been shown.
//!
//! `cargo test --all-features --test pictures -- --ignored --nocapture endurance`, with `SMOKE_BUNDLE=FILE` to play the
//! frames of a bundle other than the small one that is made for it.

use std::fs::File;
use std::path::Path;
use std::time::{Duration, Instant};

use bevy::math::DVec3;
use bevy::prelude::*;
use bevy::render::render_resource::TextureFormat;
use bevy::time::TimeUpdateStrategy;
use bevy_smoke::bundle::{self, BundleHeader, BundleWriter, PackedFrame, SmokeFrame};
use bevy_smoke::density::{GridShape, Placement};
use bevy_smoke::headless::Headless;
use bevy_smoke::playback::{SmokeStreaming, SmokeStreamingStats};
use bevy_smoke::prelude::*;
use bevy_smoke::rbf::{Rbf, RbfModel};
use bevy_smoke::residual::{HashedResidual, QuantizationLaw};

use crate::scene::{SIZE, camera};

const FRAMES: usize = 1000;
const UPDATES: usize = 2000;
/// One frame of animation an update, and no more updates a second than this.
const STEP: Duration = Duration::from_nanos(1_000_000_000 / 30);

/// Writes a bundle of `FRAMES` frames, which are those of `few` over and over, each time from another one on.
fn repeat(few: &[u8], file: File) {
    let header = BundleHeader::read(few).unwrap();
    let frames: Vec<PackedFrame> = header
        .frames
        .iter()
        .map(|entry| PackedFrame {
            bytes: few[entry.offset as usize..][..entry.length as usize].to_vec(),
            uncompressed: entry.uncompressed,
        })
        .collect();
    let max_density = header.max_density;
    let header = BundleHeader { frames_per_second: 30.0, frames: Vec::new(), ..header };
    let mut writer = BundleWriter::new(file, header, FRAMES).unwrap();
    for frame in 0..FRAMES {
        let count = frames.len();
        writer.push(&frames[(frame + 7 * (frame / count)) % count]).unwrap();
    }
    writer.finish(max_density).unwrap();
}

/// Eight frames of a column that winds upwards.
fn columns() -> Vec<u8> {
    let shape = GridShape::new(UVec3::new(32, 64, 32));
    let frame = |index: usize| {
        let rbf = |i: usize| {
            let height = i as f32 / 40.0;
            let angle = 9.0 * height + index as f32 * std::f32::consts::FRAC_PI_4;
            Rbf { center: [0.1 * angle.cos(), height - 0.5, 0.1 * angle.sin()], radius: 0.08, weight: 0.5 }
        };
        let rbfs = RbfModel { rbfs: (0..40).map(rbf).collect() };
        let density = rbfs.rasterize(shape).into_iter().enumerate();
        let noise = density.map(|(cell, d)| if d > 0.05 { ((cell * 37 + index) % 61) as i8 - 30 } else { 0 });
        let law = QuantizationLaw { max: 0.2, exponent: 1.0 };
        let residual = HashedResidual::build(shape, &noise.collect::<Vec<_>>(), law).unwrap();
        SmokeFrame::new(rbfs, residual)
    };
    let animation = SmokeAnimation {
        shape,
        placement: Placement { center: DVec3::ZERO, voxel_size: 0.05 },
        frames_per_second: 30.0,
        max_density: 2.0,
        frames: (0..8).map(frame).collect::<Vec<_>>().into(),
    };
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
    let given = std::env::var("SMOKE_BUNDLE");
    let few = given.as_ref().map_or_else(|_| columns(), |file| std::fs::read(file).unwrap());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("long.smoke");
    repeat(&few, File::create(&path).unwrap());
    println!("{FRAMES} frames, {:.1} MB", std::fs::metadata(&path).unwrap().len() as f64 / 1e6);
    // Out of sight first: what grows only in sight is the renderer's.
    // Without a GPU, light that scatters more than once among hundreds of RBFs would take an hour.
    let events = if given.is_ok() { ScatteringEvents::Single } else { ScatteringEvents::Auto };
    for in_sight in [false, true] {
        play(folder.path(), in_sight, events);
    }
}

fn play(folder: &Path, in_sight: bool, events: ScatteringEvents) {
    let mut headless =
        Headless::with_assets(SIZE, TextureFormat::Rgba16Float, folder.to_str().unwrap().to_owned()).unwrap();
    let camera = camera(&headless);
    let app = &mut headless.app;
    app.insert_resource(TimeUpdateStrategy::ManualDuration(STEP));
    let animation = app.world().resource::<AssetServer>().load("long.smoke");
    let playing = (
        SmokeVolume::new(animation),
        SmokeMedium { sigma_t: 5.0, ..default() },
        SmokeEnvironment::constant(Vec3::ONE, 1.0),
        SmokeScattering { events, ..default() },
        Transform::from_scale(Vec3::splat(3.0)),
        if in_sight { Visibility::Inherited } else { Visibility::Hidden },
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
    let at_the_end = resident_memory();
    let stats = app.world().resource::<SmokeStreamingStats>();
    println!(
        "{}: {UPDATES} updates in {:.0} s\n\
         resident memory: {after_one_loop:.0} MB after one loop, {at_the_end:.0} MB at the end\n\
         at most {largest_window} frames, {:.1} MB; {} frames read, {} late",
        if in_sight { "in sight" } else { "out of sight" },
        start.elapsed().as_secs_f64(),
        largest_bytes as f64 / 1e6,
        stats.frames_read,
        stats.frames_late,
    );
    let streaming = app.world().resource::<SmokeStreaming>();
    assert!(largest_window <= streaming.frames_ahead + 2 + streaming.max_tasks);
    assert!(stats.frames_late < UPDATES as u64 / 50, "{} frames late", stats.frames_late);
    // What an allocator keeps may vary; a loop of frames kept would be far more.
    assert!(at_the_end < 1.1 * after_one_loop, "memory grows");
}
