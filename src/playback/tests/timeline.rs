//! The arithmetic of time. Counters go in quarters of frames: such sums and quotients are exact, and so are the tests.

use proptest::prelude::*;

use crate::playback::PlaybackMode;
use crate::playback::timeline::{Head, Passed, Position, Timeline};

const MODES: [PlaybackMode; 3] = [PlaybackMode::Loop, PlaybackMode::Once, PlaybackMode::PingPong];

fn timeline(first: u32, last: u32, mode: PlaybackMode) -> Timeline {
    Timeline { first, last, mode }
}

fn head(frame: f64) -> Head {
    Head { frame, returning: false }
}

fn timelines() -> impl Strategy<Value = Timeline> {
    (0_u32..5, 0_u32..20, prop::sample::select(&MODES[..]))
        .prop_map(|(first, more, mode)| timeline(first, first + more, mode))
}

fn quarters(range: std::ops::Range<i32>) -> impl Strategy<Value = f64> {
    range.prop_map(|quarters| f64::from(quarters) / 4.0)
}

#[test]
fn whole_frames_are_shown_as_they_are() {
    for mode in MODES {
        let timeline = timeline(3, 7, mode);
        let at = |frame| timeline.position(frame);
        assert_eq!(at(5.0), Position { index: 5, blend: 0.0 });
        assert_eq!(at(5.000_9), Position { index: 5, blend: 0.0 });
        assert_eq!(at(4.999_1), Position { index: 5, blend: 0.0 });
        assert_eq!(at(5.25), Position { index: 5, blend: 0.25 });
        assert_eq!(at(7.0), Position { index: 7, blend: 0.0 });
    }
}

/// The last frame of a loop is shown for one frame's time, and the end of a loop is its start.
#[test]
fn loops_hold_their_last_frame() {
    let timeline = timeline(3, 7, PlaybackMode::Loop);
    let at = |frame| timeline.position(frame);
    assert_eq!(at(7.5), Position { index: 7, blend: 0.0 });
    assert_eq!(at(7.998), Position { index: 7, blend: 0.0 });
    assert_eq!(at(7.999_5), Position { index: 3, blend: 0.0 });
    assert_eq!(timeline.advance(head(7.5), 0.75), (head(3.25), Passed { loops: 1, finished: false }));
    assert_eq!(timeline.advance(head(3.25), -0.75), (head(7.5), Passed { loops: 1, finished: false }));
    assert_eq!(timeline.advance(head(3.0), 23.5), (head(6.5), Passed { loops: 4, finished: false }));
}

#[test]
fn ping_pong_turns_at_both_ends() {
    let timeline = timeline(0, 4, PlaybackMode::PingPong);
    let back = |frame| Head { frame, returning: true };
    let none = Passed::default();
    assert_eq!(timeline.advance(head(3.5), 1.0), (back(3.5), none));
    assert_eq!(timeline.advance(back(3.5), -1.0), (head(3.5), none));
    assert_eq!(timeline.advance(back(0.5), 1.0), (head(0.5), Passed { loops: 1, finished: false }));
    assert_eq!(timeline.ahead(back(1.0), true).take(4).collect::<Vec<_>>(), [1, 0, 1, 2]);
    assert_eq!(timeline.ahead(head(2.5), true).take(5).collect::<Vec<_>>(), [2, 3, 4, 3, 2]);
    assert_eq!(timeline.ahead(head(0.5), false).take(4).collect::<Vec<_>>(), [1, 0, 1, 2]);
}

/// Once, whatever the steps, and not again while it stands there.
#[test]
fn once_ends_once() {
    let timeline = timeline(2, 5, PlaybackMode::Once);
    let end = Passed { loops: 0, finished: true };
    assert_eq!(timeline.advance(head(2.0), 100.0), (head(5.0), end));
    assert_eq!(timeline.advance(head(5.0), 1.0), (head(5.0), Passed::default()));
    assert_eq!(timeline.advance(head(5.0), -100.0), (head(2.0), end));
    // A clock in nanoseconds falls short of the end by rounding.
    assert_eq!(timeline.advance(head(4.0), 0.999_999_99), (head(5.0), end));
    assert_eq!(timeline.ahead(head(3.5), true).collect::<Vec<_>>(), [3, 4, 5]);
    assert_eq!(timeline.ahead(head(3.5), false).collect::<Vec<_>>(), [4, 3, 2]);
}

#[test]
fn one_frame_stands_still() {
    for mode in MODES {
        let timeline = timeline(4, 4, mode);
        assert_eq!(timeline.advance(head(4.0), 2.5), (head(4.0), Passed::default()));
        assert_eq!(timeline.position(4.7), Position { index: 4, blend: 0.0 });
        assert_eq!(timeline.ahead(head(4.0), true).collect::<Vec<_>>(), [4]);
    }
}

proptest! {
    /// Whatever the counter and the steps, what is shown is within the range.
    #[test]
    fn moments_are_within_the_range(
        timeline in timelines(),
        frame in prop_oneof![any::<f64>(), -10.0..40.0],
        returning: bool,
        steps in prop::collection::vec(prop_oneof![-1e9..1e9, -3.0..3.0, Just(f64::MAX), Just(-1e-300)], 1..20),
    ) {
        let mut head = Head { frame, returning };
        for step in std::iter::once(0.0).chain(steps) {
            head = timeline.advance(head, step).0;
            let Position { index, blend } = timeline.position(head.frame);
            let (first, last) = (timeline.first as usize, timeline.last as usize);
            prop_assert!((first..=last).contains(&index));
            prop_assert!((0.0..1.0).contains(&blend));
            prop_assert!(blend == 0.0 || index < last, "{index} and {blend} of {timeline:?}");
        }
    }

    #[test]
    fn forwards_then_backwards_returns(timeline in timelines(), start in quarters(0..80), steps in quarters(0..400)) {
        // A head that is within the range.
        let start = timeline.advance(head(f64::from(timeline.first)), start).0;
        let (there, onward) = timeline.advance(start, steps);
        let (back, backward) = timeline.advance(there, -steps);
        if timeline.mode != PlaybackMode::Once {
            prop_assert_eq!(back, start);
            prop_assert_eq!(onward.loops, backward.loops);
        }
    }

    /// Small steps pass the same ends as one large one.
    #[test]
    fn no_end_is_missed(timeline in timelines(), start in quarters(0..80), steps in prop::collection::vec(quarters(0..30), 1..20)) {
        let start = timeline.advance(head(f64::from(timeline.first)), start).0;
        let (there, all) = timeline.advance(start, steps.iter().sum());
        let mut at = start;
        let (mut loops, mut finished) = (0, 0);
        for step in steps {
            let (next, passed) = timeline.advance(at, step);
            at = next;
            loops += passed.loops;
            finished += u32::from(passed.finished);
        }
        prop_assert_eq!(at, there);
        prop_assert_eq!(loops, all.loops);
        prop_assert_eq!(finished, u32::from(all.finished));
    }

    /// A frame that is shown after some frames' time is that near the front of those to be read.
    #[test]
    fn frames_ahead_are_those_shown_next(
        timeline in timelines(),
        start in quarters(0..80),
        backwards: bool,
        later in quarters(0..60),
    ) {
        let start = timeline.advance(head(f64::from(timeline.first)), start).0;
        let to = timeline.advance(start, if backwards { -later } else { later }).0;
        let ahead: Vec<usize> = timeline.ahead(start, !backwards).take(later.ceil() as usize + 2).collect();
        let Position { index, blend } = timeline.position(to.frame);
        prop_assert!(ahead.contains(&index), "{index} in {ahead:?} of {timeline:?}");
        prop_assert!(blend == 0.0 || ahead.contains(&(index + 1)), "{index} + 1 in {ahead:?} of {timeline:?}");
    }
}
