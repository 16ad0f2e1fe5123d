//! How often light scatters in a volume, and what is seen of it.

use bevy::prelude::*;

/// How often light may scatter in a volume of smoke on its way to the eye.
#[derive(Component, Clone, Copy, Debug, PartialEq, Reflect)]
#[reflect(Component, Default, Debug, Clone, PartialEq)]
pub struct SmokeScattering {
    /// Which light is drawn.
    pub events: ScatteringEvents,
    /// How closely light that scatters more than once is solved for: the estimated error, relative to the root mean
    /// square over the smoke, at which the solver stops. 1e-5 to 1.
    pub tolerance: f32,
    /// How it is solved for.
    pub solver: ScatteringSolver,
}

/// How light that scatters more than once is solved for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Reflect)]
#[reflect(Default, Debug, Clone, PartialEq, Hash)]
pub enum ScatteringSolver {
    /// Transport from RBF to RBF: the most accurate, in smoke of any thickness and phase function; its cost grows with
    /// the square of the number of RBFs.
    #[default]
    Transport,
    /// Diffusion on a grid of at most 32 cells a side, whose cost hardly depends on the number of RBFs. In images of the
    /// reference scenes it is 1 to 6 % off, but 13 to 27 % in a dense puff a quarter of the box wide. It keeps two bands
    /// of spherical harmonics, and takes no notice of where lamps are inside smoke.
    Diffusion,
}

/// Which light is drawn, by how often it has scattered.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Reflect)]
#[reflect(Default, Debug, Clone, PartialEq, Hash)]
pub enum ScatteringEvents {
    /// [`Multiple`](Self::Multiple) where it would be seen, [`Single`](Self::Single) where smoke is too thin or too dark
    /// for light to scatter twice.
    #[default]
    Auto,
    /// Light that has scattered exactly once.
    Single,
    /// Light that has scattered at least once.
    Multiple,
}

impl SmokeScattering {
    /// Exactly one scattering event.
    pub const SINGLE: Self = Self {
        events: ScatteringEvents::Single,
        tolerance: Self::DEFAULT_TOLERANCE,
        solver: ScatteringSolver::Transport,
    };
    /// Any number of scattering events.
    pub const MULTIPLE: Self = Self { events: ScatteringEvents::Multiple, ..Self::SINGLE };
    /// Half a percent.
    pub const DEFAULT_TOLERANCE: f32 = 0.005;

    /// The tolerance inside its range; what is not a number becomes the default.
    pub(crate) fn clamped_tolerance(&self) -> f32 {
        if self.tolerance.is_nan() { Self::DEFAULT_TOLERANCE } else { self.tolerance.clamp(1e-5, 1.0) }
    }
}

impl Default for SmokeScattering {
    fn default() -> Self {
        Self { events: ScatteringEvents::Auto, ..Self::SINGLE }
    }
}

/// What [`ScatteringEvents::Auto`] came to, and why.
#[derive(Clone, Copy, Debug, PartialEq, Reflect)]
pub struct ScatteringChoice {
    /// Whether light that scatters more than once is drawn.
    pub multiple: bool,
    /// Whether that was left to the plug-in.
    pub auto: bool,
    /// Estimated radiance of that light over that of light that scatters once; None where nothing is known of the density,
    /// which is live.
    pub share: Option<f32>,
}

impl ScatteringChoice {
    /// Above this share `Auto` turns multiple scattering on.
    pub const ON: f32 = 0.02;
    /// Below this share it turns it off. Between the two it stays as it is, so that it does not flicker.
    pub const OFF: f32 = 0.014;

    /// Chooses for a medium whose light scatters again with probability `chance` (before it leaves the smoke or is
    /// absorbed, albedo not counted; if not known, it may be any) and albedo at most `albedo`; `before` is the choice so far.
    pub(crate) fn new(events: ScatteringEvents, albedo: f32, chance: Option<f32>, before: Option<bool>) -> Self {
        // Of light that has scattered, the share q scatters again, and of that q again.
        let share = |chance: f32| {
            let q = (albedo * chance).clamp(0.0, 1.0);
            q / (1.0 - q).max(1e-6)
        };
        let bound = share(chance.unwrap_or(1.0));
        let multiple = match events {
            ScatteringEvents::Single => false,
            ScatteringEvents::Multiple => true,
            ScatteringEvents::Auto => bound > if before == Some(true) { Self::OFF } else { Self::ON },
        };
        Self { multiple, auto: events == ScatteringEvents::Auto, share: chance.map(share) }
    }

    /// Whether that light is known to add less than this share.
    pub(crate) fn is_below(&self, share: f32) -> bool {
        self.share.is_some_and(|known| known < share)
    }
}

impl core::fmt::Display for ScatteringChoice {
    fn fmt(&self, f: &mut core::fmt::Formatter) -> core::fmt::Result {
        if !self.auto {
            return write!(f, "asked for");
        }
        let Some(share) = self.share else {
            let how_much = if self.multiple { "much" } else { "little" };
            return write!(f, "the density is live: for the albedo, light may scatter more than once {how_much}");
        };
        let percent = 100.0 * share;
        let (compare, limit) = if self.multiple { ("above", Self::OFF) } else { ("below", Self::ON) };
        write!(
            f,
            "light that scatters more than once adds an estimated {percent:.1} % to single scattering, {compare} {:.1} %",
            100.0 * limit
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn auto(albedo: f32, chance: f32, before: Option<bool>) -> bool {
        ScatteringChoice::new(ScatteringEvents::Auto, albedo, Some(chance), before).multiple
    }

    #[test]
    fn auto_follows_what_would_be_seen() {
        // q = 0.66 · 0.4 = 0.264: a third more light. Thin: q = 0.009. Dark: q = 0.008.
        assert!(auto(0.66, 0.4, None));
        assert!(!auto(0.9, 0.01, None));
        assert!(!auto(0.01, 0.8, None));
        let share = |albedo, chance| ScatteringChoice::new(ScatteringEvents::Auto, albedo, Some(chance), None).share;
        assert!((share(0.5, 0.5).unwrap() - 1.0 / 3.0).abs() < 1e-6);
        assert!(share(1.0, 1.0).unwrap().is_finite());
        // What is not known may be much, unless nothing scatters at all.
        let live = |albedo| ScatteringChoice::new(ScatteringEvents::Auto, albedo, None, None);
        assert!(live(0.3).multiple && live(0.3).share.is_none() && !live(0.01).multiple);
    }

    #[test]
    fn auto_does_not_flip_on_the_threshold() {
        // A share that wanders between the two limits keeps what was chosen before.
        let between = 0.017 / 1.017;
        assert!(auto(1.0, between, Some(true)));
        assert!(!auto(1.0, between, Some(false)) && !auto(1.0, between, None));
        let mut flips = 0;
        let mut before = None;
        for i in 0..100 {
            let chance = 0.0165 + if i % 2 == 0 { 0.002 } else { -0.002 };
            let now = auto(1.0, chance, before);
            flips += u32::from(before.is_some_and(|b| b != now));
            before = Some(now);
        }
        assert_eq!(flips, 0);
    }

    #[test]
    fn what_is_asked_for_is_done() {
        assert!(!ScatteringChoice::new(ScatteringEvents::Single, 1.0, Some(1.0), Some(true)).multiple);
        assert!(ScatteringChoice::new(ScatteringEvents::Multiple, 0.0, Some(0.0), Some(false)).multiple);
    }

    #[test]
    fn tolerances_are_clamped() {
        let with = |tolerance| SmokeScattering { tolerance, ..default() }.clamped_tolerance();
        assert_eq!(with(f32::NAN), 0.005);
        assert_eq!((with(0.0), with(9.0), with(0.01)), (1e-5, 1.0, 0.01));
    }
}
