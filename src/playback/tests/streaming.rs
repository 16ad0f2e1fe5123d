//! What volumes show of frames that come from a file, when, and what is in memory meanwhile.

use super::*;
use crate::bundle::{BundleHeader, SmokeFrames};

#[test]
fn plays_every_frame_exactly_over_and_over() {
    let mut theatre = Theatre::new(file(12, 0.0));
    let volume = theatre.play(SmokePlayback::default());
    theatre.wait();
    assert_eq!(theatre.heard(), Heard { ready: 1, ..default() });
    assert_eq!(theatre.shown(volume), Some(0.0));
    for frame in 1..=36 {
        theatre.step(1.0);
        assert_eq!(theatre.shown(volume), Some((frame % 12) as f32));
        theatre.wait();
    }
    assert_eq!(theatre.stats().frames_late, 0);
    // The clock is in nanoseconds: the third loop ends some of them later.
    theatre.step(0.01);
    assert_eq!(theatre.heard(), Heard { ready: 1, looped: 3, finished: 0 });
    let total = 12.0 / f64::from(FPS);
    assert!((theatre.playback(volume).clone().time(&animation(12, 0.0)) - 0.01 / 12.0 * total).abs() < 1e-6);
}

#[test]
fn slow_motion_blends() {
    let mut theatre = Theatre::new(file(4, 0.0));
    let volume = theatre.play(SmokePlayback::default().with_speed(0.25));
    theatre.wait();
    for quarter in 1..12 {
        theatre.step(1.0);
        let shown = theatre.shown(volume).unwrap();
        // Weights are interpolated in f32, by a clock in nanoseconds.
        assert!((shown - 0.25 * quarter as f32).abs() < 1e-4, "{shown} after {quarter} quarters");
        theatre.wait();
    }
}

/// The loader reads the header alone, and playback the frames that it nears.
#[test]
fn reads_no_more_than_it_needs() {
    let bytes = file(100, 0.0);
    let header = BundleHeader::read(&bytes).unwrap();
    let table = header.frames[0].offset as usize;
    let mut theatre = Theatre::new(bytes);
    let handle = theatre.load();
    theatre.wait_until("it is loaded", |world| world.resource::<AssetServer>().is_loaded(&handle));
    let read = |theatre: &Theatre| theatre.archive.0.bytes_read.load(Ordering::Relaxed);
    assert_eq!(read(&theatre), table);
    theatre.play(SmokePlayback::at_frame(40));
    theatre.wait();
    let frames: u64 = header.frames[40..50].iter().map(|frame| frame.length).sum();
    assert_eq!(read(&theatre), table + frames as usize);
    let stats = theatre.stats();
    let size: u64 = header.frames[40..50].iter().map(|frame| frame.uncompressed).sum();
    assert_eq!((stats.resident_frames, stats.frames_read, stats.resident_bytes), (10, 10, size));
}

#[test]
fn sources_that_cannot_seek_are_held() {
    let mut theatre = Theatre::new(file(30, 0.0));
    theatre.archive.0.sequential.store(true, Ordering::Relaxed);
    let volume = theatre.play(SmokePlayback::at_frame(17));
    theatre.wait();
    assert_eq!(theatre.shown(volume), Some(17.0));
    let handle = theatre.load();
    let SmokeFrames::Stream(stream) =
        &theatre.app.world().resource::<Assets<SmokeAnimation>>().get(&handle).unwrap().frames
    else {
        panic!("it is streamed");
    };
    assert_eq!(stream.held_bytes(), file(30, 0.0).len());
    assert_eq!(theatre.archive.0.bytes_read.load(Ordering::Relaxed), stream.held_bytes(), "it is read once");
}

/// A disk that is slow stops neither time nor the app, and never makes smoke vanish.
#[test]
fn late_frames_hold_the_last_one() {
    let mut theatre = Theatre::new(file(100, 0.0));
    let volume = theatre.play(SmokePlayback::default());
    theatre.wait();
    theatre.archive.shut(true);
    for frame in 1..=30 {
        theatre.step(1.0);
        // 9 frames had been read ahead.
        assert_eq!(theatre.shown(volume), Some(frame.min(9) as f32));
    }
    assert_eq!(theatre.stats().frames_late, 21);
    assert_eq!(theatre.stats().tasks, 4);
    theatre.archive.shut(false);
    theatre.wait();
    assert_eq!(theatre.shown(volume), Some(30.0));
}

/// Where playback outruns the disk, frames that come too late are shown all the same if they are nearer.
#[test]
fn a_slow_disk_makes_a_slide_show() {
    let mut theatre = Theatre::new(file(1000, 0.0));
    let volume = theatre.play(SmokePlayback::default().with_speed(20.0));
    theatre.wait();
    let mut before = 0.0;
    for update in 1..=20 {
        theatre.archive.shut(true);
        theatre.step(1.0);
        theatre.step(1.0);
        theatre.archive.shut(false);
        theatre.wait_until("something is read", |world| world.resource::<SmokeStreamingStats>().tasks == 0);
        let shown = theatre.shown(volume).unwrap();
        assert!(shown > before, "{shown} in update {update}");
        before = shown;
    }
}

/// The window stays as small as it is over many loops, there and back.
#[test]
fn memory_is_bounded() {
    for playback in [SmokePlayback::default().with_speed(1.3), SmokePlayback::ping_pong().with_speed(-0.7)] {
        let mut theatre = Theatre::new(file(40, 0.0));
        theatre.app.insert_resource(SmokeStreaming { frames_ahead: 3, max_tasks: 2 });
        theatre.play(playback);
        theatre.wait();
        for _ in 0..400 {
            theatre.step(1.0);
            let stats = theatre.stats();
            // Each task may bring one frame that is wanted no more.
            assert!(stats.resident_frames <= 3 + 2 + 2 && stats.tasks <= 2, "{stats:?}");
        }
        theatre.wait();
        assert!(theatre.stats().resident_frames <= 5);
        assert!(theatre.stats().frames_read > 100);
    }
}

#[test]
fn volumes_share_an_animation_at_their_own_times() {
    let mut theatre = Theatre::new(file(100, 0.0));
    theatre.app.insert_resource(SmokeStreaming { frames_ahead: 2, max_tasks: 3 });
    let one = theatre.play(SmokePlayback::default());
    let other = theatre.play(SmokePlayback::once().with_speed(-1.0).starting_at(50.0 / f64::from(FPS)));
    let beside = theatre.play(SmokePlayback::default().starting_at_frame(1));
    theatre.wait();
    for frame in 1..=5 {
        theatre.step(1.0);
        let frame = frame as f32;
        assert_eq!(
            [one, other, beside].map(|volume| theatre.shown(volume).unwrap()),
            [frame, 50.0 - frame, frame + 1.0]
        );
        theatre.wait();
    }
    // Frames 5 to 9 and 42 to 45.
    assert_eq!(theatre.stats().resident_frames, 5 + 4);
    theatre.app.world_mut().despawn(other);
    theatre.wait();
    assert_eq!(theatre.stats().resident_frames, 5);
}

#[test]
fn a_damaged_frame_is_passed_over_and_read_once() {
    let mut bytes = file(6, 0.0);
    let entry = BundleHeader::read(&bytes).unwrap().frames[3];
    bytes[entry.offset as usize + 5] ^= 1;
    let mut theatre = Theatre::new(bytes);
    let volume = theatre.play(SmokePlayback::default());
    theatre.wait();
    for _ in 0..3 {
        for frame in [1.0, 2.0, 2.0, 4.0, 5.0, 0.0] {
            theatre.step(1.0);
            assert_eq!(theatre.shown(volume), Some(frame));
            theatre.wait();
        }
    }
    assert_eq!(theatre.stats().frames_damaged, 1);
    assert!(theatre.stats().frames_late >= 3);

    // Mended, it is shown.
    theatre.archive.put(file(6, 0.0));
    theatre.playback(volume).seek_frame(3);
    theatre.app.world().resource::<AssetServer>().reload("smoke.smoke");
    theatre.wait_until("the frame is there", |world| {
        world.get::<SmokeMoment>(volume).unwrap().0.as_ref().is_some_and(|moment| moment.rbfs().rbfs[0].weight == 4.0)
    });
    assert_eq!(theatre.stats().frames_damaged, 1);
}

/// What is damaged from the start does not keep the rest from being seen.
#[test]
fn a_damaged_first_frame_does_not_keep_smoke_away() {
    let mut bytes = file(6, 0.0);
    let entry = BundleHeader::read(&bytes).unwrap().frames[0];
    bytes[entry.offset as usize + 5] ^= 1;
    let mut theatre = Theatre::new(bytes);
    let volume = theatre.play(SmokePlayback::default());
    theatre.wait();
    assert_eq!(theatre.shown(volume), Some(1.0));
    theatre.step(2.0);
    assert_eq!(theatre.shown(volume), Some(2.0));
}

#[test]
fn files_cut_short_are_not_loaded() {
    let bytes = file(6, 0.0);
    for length in [0, 50, 120, bytes.len() - 1] {
        let mut theatre = Theatre::new(bytes[..length].to_vec());
        let handle = theatre.load();
        theatre.wait_until("loading fails", |world| world.resource::<AssetServer>().load_state(&handle).is_failed());
    }
}

/// A changed file is taken up, and what was shown stays until it is there.
#[test]
fn reload() {
    let mut theatre = Theatre::new(file(10, 0.0));
    let volume = theatre.play(SmokePlayback::at_frame(7));
    theatre.wait();
    assert_eq!(theatre.shown(volume), Some(7.0));
    theatre.archive.put(file(6, 0.5));
    theatre.app.world().resource::<AssetServer>().reload("smoke.smoke");
    let mut seen = Vec::new();
    theatre.wait_until("the new frame is there", |world| {
        seen.push(world.get::<SmokeMoment>(volume).unwrap().0.as_ref().map(|moment| moment.rbfs().rbfs[0].weight));
        // The last frame there is now.
        seen.last() == Some(&Some(6.5))
    });
    let old = seen.len() - 1;
    assert!(seen[..old].iter().all(|weight| *weight == Some(8.0)), "{seen:?}");

    // An asset changed by hand, too; from memory it is there at once.
    let handle = theatre.load();
    let mut animations = theatre.app.world_mut().resource_mut::<Assets<SmokeAnimation>>();
    animations.insert(&handle, animation(3, 0.25)).unwrap();
    theatre.step(0.0);
    assert_eq!(theatre.shown(volume), Some(2.25));
    assert_eq!(theatre.stats().resident_frames, 0);
    assert_eq!(theatre.heard(), Heard { ready: 1, ..default() });
}

#[test]
fn another_animation_is_ready_anew() {
    let mut theatre = Theatre::new(file(10, 0.0));
    let volume = theatre.play(SmokePlayback::default());
    theatre.wait();
    theatre.step(2.0);
    let other = theatre.app.world_mut().resource_mut::<Assets<SmokeAnimation>>().add(animation(5, 0.5));
    theatre.app.world_mut().get_mut::<SmokeVolume>(volume).unwrap().density =
        crate::volume::SmokeDensity::Animation(other);
    theatre.step(1.0);
    assert_eq!((theatre.shown(volume), theatre.heard().ready), (Some(2.5), 2));
    theatre.step(1.0);
    assert_eq!(theatre.shown(volume), Some(3.5));
}

#[test]
fn once_ends_with_an_event() {
    let mut theatre = Theatre::new(file(5, 0.0));
    let volume = theatre.play(SmokePlayback::once().with_range(1..=3));
    theatre.wait();
    assert_eq!(theatre.shown(volume), Some(1.0));
    for _ in 0..5 {
        theatre.step(1.0);
    }
    assert_eq!((theatre.shown(volume), theatre.heard().finished), (Some(3.0), 1));
    theatre.playback(volume).speed = -1.0;
    for _ in 0..5 {
        theatre.step(1.0);
    }
    // At its end it wanted no other frame: those before it have to be read again.
    theatre.wait();
    assert_eq!((theatre.shown(volume), theatre.heard().finished), (Some(1.0), 2));
    // Past the end; frames that far away have to be read again.
    theatre.playback(volume).seek(1.0);
    theatre.wait();
    assert_eq!((theatre.shown(volume), theatre.heard()), (Some(3.0), Heard { ready: 1, looped: 0, finished: 2 }));
}

/// Time starts with the first frame: nothing of an explosion is missed while it loads.
#[test]
fn playback_starts_when_smoke_appears() {
    let mut theatre = Theatre::new(file(50, 0.0));
    let volume = theatre.play(SmokePlayback::once());
    theatre.wait_until("it is loaded", |world| {
        world.resource::<AssetServer>().is_loaded(world.get::<SmokeVolume>(volume).unwrap().animation().unwrap())
            || !world.resource::<Assets<SmokeAnimation>>().is_empty()
    });
    for _ in 0..3 {
        theatre.step(1.0);
        if theatre.shown(volume).is_some() {
            break;
        }
        assert_eq!(theatre.playback(volume).frame(), 0.0);
    }
    theatre.app.world_mut().resource_mut::<Time<Virtual>>().pause();
    theatre.wait();
    assert!(theatre.shown(volume).unwrap() <= 1.0);
    assert_eq!(theatre.stats().frames_late, 0);
}

/// The game's pause is the smoke's; and what stands still is left alone.
#[test]
fn nothing_changes_while_time_stands_still() {
    let mut theatre = Theatre::new(file(8, 0.0));
    let volume = theatre.play(SmokePlayback::default().with_frames_per_second(2.0 * FPS));
    theatre.wait();
    theatre.step(1.0);
    assert_eq!(theatre.shown(volume), Some(2.0));
    theatre.app.world_mut().resource_mut::<Time<Virtual>>().pause();
    let changes = theatre.app.world().resource::<Changes>().0;
    theatre.step(1.0);
    theatre.app.world_mut().resource_mut::<Time<Virtual>>().unpause();
    theatre.playback(volume).paused = true;
    theatre.step(1.0);
    theatre.playback(volume).paused = false;
    for silly in [f32::NAN, f32::INFINITY] {
        theatre.playback(volume).speed = silly;
        theatre.step(1.0);
    }
    theatre.playback(volume).speed = 1.0;
    for silly in [0.0, -1.0, f32::NAN] {
        theatre.playback(volume).frames_per_second = Some(silly);
        theatre.step(1.0);
    }
    theatre.playback(volume).seek(f64::NAN);
    theatre.step(1.0);
    assert_eq!(theatre.shown(volume), Some(2.0));
    assert_eq!(theatre.app.world().resource::<Changes>().0, changes);
}

#[test]
fn one_frame_is_shown_once() {
    let mut theatre = Theatre::new(file(1, 0.0));
    let volume = theatre.play(SmokePlayback::default());
    theatre.wait();
    let changes = theatre.app.world().resource::<Changes>().0;
    for _ in 0..10 {
        theatre.step(1.7);
    }
    assert_eq!(theatre.shown(volume), Some(0.0));
    assert_eq!(theatre.app.world().resource::<Changes>().0, changes);
    assert_eq!(theatre.heard(), Heard { ready: 1, ..default() });
}
