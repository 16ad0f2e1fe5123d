//! Time between frames, drawn from a baked animation.

use std::time::Duration;

use bevy::prelude::*;
use bevy_smoke::prelude::*;

use crate::scene::{app, camera, draw, rms};

const FRAMES_PER_SECOND: f64 = 30.0;
/// Steps from one baked frame to the next.
const STEPS: usize = 4;
const FIRST: u32 = 24;

/// A quarter of a frame on, pictures change by about a quarter of what they change by from frame to frame: nothing jumps
/// where one pair of frames ends and the next begins, nor in between.
#[test]
fn slow_motion_is_smooth() {
    let mut app = app();
    let animation = app.app.world().resource::<AssetServer>().load("billow.smoke");
    let smoke = (
        SmokeVolume::new(animation),
        SmokePlayback::at_frame(FIRST),
        SmokeMedium { sigma_t: 9.0, ..default() },
        SmokeScattering { events: ScatteringEvents::Single, ..default() },
        SmokeEnvironment::constant(Vec3::ONE, 1.0),
        Transform::from_scale(Vec3::splat(3.0)),
    );
    let volume = app.app.world_mut().spawn(smoke).id();
    let camera = camera(&app);
    app.app.world_mut().spawn(camera);
    let exact = draw(&mut app);
    let pictures: Vec<_> = (0..=2 * STEPS)
        .map(|step| {
            let frame = f64::from(FIRST) + step as f64 / STEPS as f64;
            let mut playback = app.app.world_mut().get_mut::<SmokePlayback>(volume).unwrap();
            playback.seek(frame / FRAMES_PER_SECOND);
            // Frames are read on other threads.
            for _ in 0..10 {
                app.app.update();
                std::thread::sleep(Duration::from_millis(3));
            }
            app.float_pixels()
        })
        .collect();
    assert_eq!(pictures[0], exact, "a frame that is sought is the frame");
    let changes: Vec<f64> = pictures.windows(2).map(|pair| rms(&pair[0], &pair[1])).collect();
    for (pair, changes) in changes.chunks(STEPS).enumerate() {
        let whole = rms(&pictures[STEPS * pair], &pictures[STEPS * (pair + 1)]);
        assert!(whole > 1e-3, "frames {} and the next look the same", FIRST as usize + pair);
        // Even steps would be 1 / STEPS of it each.
        for change in changes {
            let share = change / whole * STEPS as f64;
            assert!((0.5..1.6).contains(&share), "{changes:?} of {whole}");
        }
    }
}
