//! The arithmetic of playback: where a frame counter gets to, and which frames it needs on its way.

use super::PlaybackMode;

/// A counter this near a whole frame is at that frame: clocks that tick in nanoseconds miss it by 10⁻⁸ of a frame or
/// so a tick, and a blend of 10⁻³ could not be seen.
const EXACT: f64 = 1e-3;

/// The frames of a bundle that are played, and how.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Timeline {
    /// The first frame played.
    pub first: u32,
    /// The last frame played, at least `first`.
    pub last: u32,
    pub mode: PlaybackMode,
}

/// Where playback is: a counter in frames of the bundle, and which way it goes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Head {
    /// Frames from the bundle's first.
    pub frame: f64,
    /// Whether `PingPong` is on its way back.
    pub returning: bool,
}

/// What happened on the way.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Passed {
    /// How often playback started over.
    pub loops: u32,
    /// Whether `Once` reached its end.
    pub finished: bool,
}

/// A frame, or a place between it and the next.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Position {
    pub index: usize,
    /// From 0, where the frame is shown as it is, to below 1, where nearly the next one is.
    pub blend: f32,
}

impl Position {
    /// Frames from the bundle's first.
    pub fn frame(self) -> f64 {
        self.index as f64 + f64::from(self.blend)
    }
}

impl Timeline {
    /// Frames from the first to the last.
    fn length(&self) -> f64 {
        f64::from(self.last - self.first)
    }

    /// Frames past `first`. Outside the range it is the nearest frame of it; only `Loop` has something after its last
    /// frame, the time for which that is shown.
    fn offset(&self, frame: f64) -> f64 {
        // `max` also turns what is not a number into the first frame.
        let offset = (frame - f64::from(self.first)).max(0.0);
        let end = if self.mode == PlaybackMode::Loop { self.length() + 1.0 } else { self.length() };
        if offset < end { offset } else { self.length() }
    }

    /// The same from the bundle's first frame: `frame` itself if it is within the range.
    pub fn clamp(&self, frame: f64) -> f64 {
        let (first, offset) = (f64::from(self.first), self.offset(frame));
        if frame - first == offset { frame } else { first + offset }
    }

    /// Moves by so many frames, backwards where negative.
    pub fn advance(&self, head: Head, frames: f64) -> (Head, Passed) {
        let (offset, length) = (self.offset(head.frame), self.length());
        let at = |offset: f64, returning| Head { frame: f64::from(self.first) + offset, returning };
        if length == 0.0 {
            return (at(0.0, false), Passed::default());
        }
        match self.mode {
            PlaybackMode::Loop => {
                let (offset, loops) = wrap(offset + frames, length + 1.0);
                (at(offset, false), Passed { loops, finished: false })
            }
            PlaybackMode::PingPong => {
                // There and back unfolded into one loop.
                let way = if head.returning { 2.0 * length - offset } else { offset };
                let (way, loops) = wrap(way + frames, 2.0 * length);
                let returning = way > length;
                let offset = if returning { 2.0 * length - way } else { way };
                (at(offset, returning), Passed { loops, finished: false })
            }
            PlaybackMode::Once => {
                // How far it is to the end, before and after. Rounding must not keep it from being reached.
                let left = |offset: f64| if frames < 0.0 { offset } else { length - offset };
                let reached = |offset: f64| left(offset) <= EXACT;
                let to = (offset + frames).clamp(0.0, length);
                let end = if frames < 0.0 { 0.0 } else { length };
                let finished = frames != 0.0 && reached(to) && !reached(offset);
                (at(if frames != 0.0 && reached(to) { end } else { to }, false), Passed { loops: 0, finished })
            }
        }
    }

    /// What is shown there. The last frame of a loop is shown for its whole time: the first one does not go on from it,
    /// and a blend of the two would be smoke that was never there.
    pub fn position(&self, frame: f64) -> Position {
        let offset = self.offset(frame);
        let nearest = offset.round();
        let (offset, blend) = if (offset - nearest).abs() <= EXACT {
            // The end of a loop is its start.
            (if nearest > self.length() { 0.0 } else { nearest }, 0.0)
        } else if offset > self.length() {
            (self.length(), 0.0)
        } else {
            (offset.floor(), offset.fract() as f32)
        };
        Position { index: self.first as usize + offset as usize, blend }
    }

    /// The frames that will be shown from there on, in the order in which they will be; each once, or over and over.
    pub fn ahead(&self, head: Head, forwards: bool) -> impl Iterator<Item = usize> + use<> {
        let Self { first, last, mode } = *self;
        let (first, last) = (first as usize, last as usize);
        let position = self.position(head.frame);
        let forwards = forwards != (head.returning && mode == PlaybackMode::PingPong);
        // Between two frames, both are shown: going backwards, the later one first.
        let start = if !forwards && position.blend > 0.0 { position.index + 1 } else { position.index };
        std::iter::successors(Some((start, forwards)), move |&(index, forwards)| {
            let end = if forwards { last } else { first };
            if index != end {
                return Some((if forwards { index + 1 } else { index - 1 }, forwards));
            }
            match mode {
                _ if first == last => None,
                PlaybackMode::Once => None,
                PlaybackMode::Loop => Some((if forwards { first } else { last }, forwards)),
                PlaybackMode::PingPong => Some((if forwards { index - 1 } else { index + 1 }, !forwards)),
            }
        })
        .map(|(index, _)| index)
    }
}

/// `x` in [0, `period`), and how many periods away that is.
fn wrap(x: f64, period: f64) -> (f64, u32) {
    let periods = (x / period).floor();
    let within = x - periods * period;
    // Where `x` is next to nothing below 0, or so large that periods are lost in rounding.
    let within = if (0.0..period).contains(&within) { within } else { 0.0 };
    (within, periods.abs() as u32)
}
