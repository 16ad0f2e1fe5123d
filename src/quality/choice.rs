//! Choosing a model: the cheapest that is accurate enough, or the most accurate that is cheap enough.

use core::fmt;

use super::coefficients::COEFFICIENTS;
use super::model::{Coefficients, Milliseconds, Setting, candidates};
use super::{SmokeModel, SmokeQuality};

/// The model that a volume is drawn with, and why.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct QualityChoice {
    /// What was asked for.
    pub asked: SmokeQuality,
    /// What it was asked for in.
    pub setting: Setting,
    /// What is drawn.
    pub model: SmokeModel,
    /// Predicted relative RMS error over the smoke's pixels.
    pub error: f32,
    /// Predicted milliseconds of the GPU in a frame in which everything changes.
    pub milliseconds: f32,
    /// Whether a model was found that is as accurate, or as cheap, as asked for.
    pub is_met: bool,
}

/// How many times as long as on the GPU that prices are from frames take on the one at hand.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Pace(pub f32);

impl Default for Pace {
    fn default() -> Self {
        Self(1.0)
    }
}

impl Pace {
    /// Follows what has been measured, in milliseconds, beside what was predicted, slowly.
    pub fn toward(self, measured: f32, predicted: Milliseconds) -> Self {
        let ratio = measured / predicted.total();
        if measured > 0.0 && ratio.is_finite() { Self(self.0 + 0.05 * (ratio - self.0)) } else { self }
    }

    fn of(&self, predicted: Milliseconds) -> f32 {
        self.0 * predicted.total()
    }
}

impl QualityChoice {
    fn of(asked: SmokeQuality, model: SmokeModel, setting: &Setting, pace: &Pace, by: &Coefficients) -> Self {
        let error = setting.error_with(&model, by);
        let milliseconds = pace.of(setting.milliseconds_with(&model, by));
        let is_met = match asked {
            SmokeQuality::Model(_) => true,
            SmokeQuality::Error(most) => error <= most,
            SmokeQuality::Budget(most) => milliseconds <= most,
        };
        Self { asked, setting: *setting, model, error, milliseconds, is_met }
    }

    /// What to keep small, where the limit is kept.
    fn price(&self) -> f32 {
        match self.asked {
            SmokeQuality::Budget(_) => self.error,
            _ => self.milliseconds,
        }
    }

    /// What is limited.
    fn limited(&self) -> f32 {
        match self.asked {
            SmokeQuality::Budget(_) => self.milliseconds,
            _ => self.error,
        }
    }

    /// The best choice there is.
    pub(crate) fn best(asked: SmokeQuality, setting: &Setting, pace: &Pace) -> Self {
        Self::best_with(asked, setting, pace, &COEFFICIENTS)
    }

    /// The same by other coefficients.
    pub(crate) fn best_with(asked: SmokeQuality, setting: &Setting, pace: &Pace, by: &Coefficients) -> Self {
        if let SmokeQuality::Model(model) = asked {
            return Self::of(asked, model, setting, pace, by);
        }
        let all = || candidates(setting).map(|model| Self::of(asked, model, setting, pace, by));
        all()
            .filter(|choice| choice.is_met)
            .min_by(|a, b| a.price().total_cmp(&b.price()))
            .or_else(|| all().min_by(|a, b| a.limited().total_cmp(&b.limited())))
            .expect("there is a full model")
    }
}

impl fmt::Display for QualityChoice {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let SmokeModel { rbfs, probes, order, directions, step, half_resolution, .. } = self.model;
        match rbfs {
            u32::MAX => write!(f, "all RBFs")?,
            limit => write!(f, "{limit} RBFs")?,
        }
        let resolution = if half_resolution { "half" } else { "full" };
        write!(
            f,
            ", {probes} probe(s) in {directions} directions, order {order}, steps of {step} cells at {resolution} resolution: \
             predicted error {:.1} % and {:.2} ms; ",
            100.0 * self.error,
            self.milliseconds
        )?;
        match (self.asked, self.is_met) {
            (SmokeQuality::Model(_), _) => write!(f, "asked for"),
            (SmokeQuality::Error(most), true) => write!(f, "the cheapest within {:.1} %", 100.0 * most),
            (SmokeQuality::Error(most), false) => {
                write!(f, "nothing is within {:.1} %: the most accurate", 100.0 * most)
            }
            (SmokeQuality::Budget(most), true) => write!(f, "the most accurate within {most} ms"),
            (SmokeQuality::Budget(most), false) => write!(f, "nothing is within {most} ms: the cheapest"),
        }
    }
}

/// A choice that stays the same while it is about as good as the best.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SteadyChoice {
    pub current: QualityChoice,
    /// Frames in which another has been better.
    better_for: u32,
}

impl SteadyChoice {
    /// So many frames another has to be better.
    const PATIENCE: u32 = 20;
    /// And by so much.
    const GAIN: f32 = 1.2;

    pub fn new(best: QualityChoice) -> Self {
        Self { current: best, better_for: 0 }
    }

    /// Follows what is asked for at once, and what is best after a while.
    pub fn update(&mut self, asked: SmokeQuality, setting: &Setting, pace: &Pace) {
        let best = QualityChoice::best(asked, setting, pace);
        if asked != self.current.asked {
            *self = Self::new(best);
            return;
        }
        self.current = QualityChoice::of(asked, self.current.model, setting, pace, &COEFFICIENTS);
        let current = self.current;
        let is_beaten = match best.is_met {
            true if current.is_met || current.limited() < best.limited() * 1.05 => {
                current.price() > Self::GAIN * best.price()
            }
            _ => current.limited() > Self::GAIN * best.limited(),
        };
        self.better_for = if is_beaten { self.better_for + 1 } else { 0 };
        if self.better_for >= Self::PATIENCE {
            *self = Self::new(best);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn setting() -> Setting {
        Setting {
            rbfs: 600.0,
            is_reducible: true,
            can_halve: true,
            optical_radius: 0.1,
            g: 0.0,
            multiple: true,
            cells: 1e6,
            pixels: 4e5,
            cells_along: 100.0,
            cells_a_pixel: 0.3,
        }
    }

    fn best(asked: SmokeQuality, setting: &Setting) -> QualityChoice {
        QualityChoice::best(asked, setting, &Pace::default())
    }

    #[test]
    fn what_is_asked_for_is_met_and_costs_no_more_than_it_must() {
        let full = best(SmokeQuality::default(), &setting());
        assert_eq!(full.model, SmokeModel::FULL);
        let mut before = f32::MAX;
        for most in [0.015, 0.02, 0.05, 0.1, 0.3] {
            let choice = best(SmokeQuality::Error(most), &setting());
            println!("{choice}");
            assert!(choice.is_met && choice.error <= most && choice.milliseconds <= before.min(full.milliseconds));
            before = choice.milliseconds;
            // As much time buys no less.
            let again = best(SmokeQuality::Budget(choice.milliseconds), &setting());
            assert!(again.is_met && again.error <= choice.error);
        }
        assert!(before < 0.5 * full.milliseconds);
        let nothing = best(SmokeQuality::Error(0.0), &setting());
        assert!(!nothing.is_met && nothing.to_string().contains("nothing is within"), "{nothing}");
        let nothing = best(SmokeQuality::Budget(0.0), &setting());
        assert!(!nothing.is_met && nothing.milliseconds < 0.5 * full.milliseconds);
    }

    #[test]
    fn what_cannot_be_is_not_chosen() {
        let full = Setting { can_halve: false, is_reducible: false, ..setting() };
        let choice = best(SmokeQuality::Budget(0.0), &full);
        assert!(!choice.model.half_resolution && choice.model.rbfs == u32::MAX);
    }

    #[test]
    fn a_slow_gpu_gets_less() {
        let asked = SmokeQuality::Budget(best(SmokeQuality::default(), &setting()).milliseconds);
        let slow = Pace(4.0);
        let choice = QualityChoice::best(asked, &setting(), &slow);
        assert!(choice.is_met && choice.error > best(asked, &setting()).error);
        // Measurements lead there.
        let predicted = Milliseconds { light: 1.0, view: 2.0 };
        let pace = (0..200).fold(Pace::default(), |pace, _| pace.toward(12.0, predicted));
        assert!((pace.0 - 4.0).abs() < 0.01);
        assert_eq!(pace.toward(0.0, predicted), pace, "nothing was measured");
    }

    #[test]
    fn a_choice_does_not_flicker() {
        let asked = SmokeQuality::Error(0.03);
        let mut steady = SteadyChoice::new(best(asked, &setting()));
        let mut changes = 0;
        for frame in 0..600 {
            // The camera goes to and fro about a place.
            let near = 1.0 + 0.03 * (frame as f32 * 0.7).sin();
            let setting = Setting { pixels: 4e5 * near * near, cells_a_pixel: 0.3 / near, ..setting() };
            let before = steady.current.model;
            steady.update(asked, &setting, &Pace::default());
            changes += u32::from(steady.current.model != before);
        }
        assert!(changes <= 1, "{changes}");
        // Far away, something else is best, and is taken after a while; what is asked for, at once.
        let far = Setting { pixels: 1e3, cells_a_pixel: 6.0, optical_radius: 3.0, ..setting() };
        for _ in 0..SteadyChoice::PATIENCE {
            steady.update(asked, &far, &Pace::default());
        }
        assert!(steady.current.price() <= SteadyChoice::GAIN * best(asked, &far).price());
        let asked = SmokeQuality::Error(0.2);
        steady.update(asked, &far, &Pace::default());
        assert_eq!(steady.current, best(asked, &far));
    }
}
