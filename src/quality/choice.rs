//! Choosing a model: the cheapest that is accurate enough, or the most accurate that is cheap enough.

use core::fmt;

use super::coefficients::{CPU_PRICES, ERRORS, GPU_PRICES};
use super::model::{Errors, Milliseconds, Prices, Setting, candidates};
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

/// What work costs where it is done.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Machine {
    prices: Prices,
    /// How many times as long frames take.
    pace: f32,
}

impl Machine {
    /// One that nothing is known of but what draws: a GPU, or a CPU in the place of one, to which passes are not worth the same.
    pub fn of(device: wgpu::DeviceType) -> Self {
        Self::with(if device == wgpu::DeviceType::Cpu { CPU_PRICES } else { GPU_PRICES })
    }

    /// One of these prices.
    pub fn with(prices: Prices) -> Self {
        Self { prices, pace: 1.0 }
    }

    /// Follows what has been measured, in milliseconds, beside what [`price_of`](Self::price_of) said, slowly.
    pub fn follow(&mut self, measured: f32, said: Milliseconds) {
        let ratio = measured / said.total();
        if measured > 0.0 && ratio.is_finite() {
            self.pace += 0.05 * (ratio - self.pace);
        }
    }

    /// Milliseconds before anything was measured.
    pub fn price_of(&self, setting: &Setting, model: &SmokeModel) -> Milliseconds {
        setting.milliseconds(model, &self.prices)
    }

    /// Milliseconds of a frame in which everything changes.
    pub fn milliseconds(&self, setting: &Setting, model: &SmokeModel) -> f32 {
        self.pace * self.price_of(setting, model).total()
    }
}

impl QualityChoice {
    fn of(asked: SmokeQuality, model: SmokeModel, setting: &Setting, machine: &Machine, by: &Errors) -> Self {
        let error = setting.error_with(&model, by);
        let milliseconds = machine.milliseconds(setting, &model);
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

    /// The most that it may be.
    fn limit(&self) -> f32 {
        match self.asked {
            SmokeQuality::Model(_) => f32::MAX,
            SmokeQuality::Error(most) | SmokeQuality::Budget(most) => most,
        }
    }

    /// The best choice there is.
    pub(crate) fn best(asked: SmokeQuality, setting: &Setting, machine: &Machine) -> Self {
        Self::best_with(asked, setting, machine, &ERRORS)
    }

    /// The same by other predictions of the error.
    pub(crate) fn best_with(asked: SmokeQuality, setting: &Setting, machine: &Machine, by: &Errors) -> Self {
        if let SmokeQuality::Model(model) = asked {
            return Self::of(asked, model, setting, machine, by);
        }
        let all = || candidates(setting).map(|model| Self::of(asked, model, setting, machine, by));
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
                write!(f, "more than the {:.1} % asked for", 100.0 * most)
            }
            (SmokeQuality::Budget(most), true) => write!(f, "the most accurate within {most} ms"),
            (SmokeQuality::Budget(most), false) => write!(f, "more than the {most} ms asked for"),
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
    const NEXT_TO_NOTHING: f32 = 1.05;

    pub fn new(best: QualityChoice) -> Self {
        Self { current: best, better_for: 0 }
    }

    /// Follows what is asked for at once, and what is best after a while.
    pub fn update(&mut self, asked: SmokeQuality, setting: &Setting, machine: &Machine) {
        let best = QualityChoice::best(asked, setting, machine);
        if asked != self.current.asked {
            *self = Self::new(best);
            return;
        }
        let mut current = QualityChoice::of(asked, self.current.model, setting, machine, &ERRORS);
        // What is over its limit by next to nothing keeps it.
        current.is_met |= current.limited() < Self::NEXT_TO_NOTHING * current.limit();
        self.current = current;
        let is_beaten = match (best.is_met, current.is_met) {
            (true, true) => current.price() > Self::GAIN * best.price(),
            (true, false) => true,
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

    const MACHINE: Machine = Machine { prices: CPU_PRICES, pace: 1.0 };

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
        QualityChoice::best(asked, setting, &MACHINE)
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
        assert!(!nothing.is_met && nothing.to_string().contains("more than the 0.0 % asked for"), "{nothing}");
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
        let slow = Machine { pace: 4.0, ..MACHINE };
        let choice = QualityChoice::best(asked, &setting(), &slow);
        assert!(choice.is_met && choice.error > best(asked, &setting()).error);
        // Measurements lead there.
        let predicted = Milliseconds { light: 1.0, view: 2.0 };
        let mut machine = MACHINE;
        (0..200).for_each(|_| machine.follow(12.0, predicted));
        assert!((machine.pace - 4.0).abs() < 0.01);
        let before = machine;
        machine.follow(0.0, predicted);
        assert_eq!(machine, before, "nothing was measured");
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
            steady.update(asked, &setting, &MACHINE);
            changes += u32::from(steady.current.model != before);
        }
        assert!(changes <= 1, "{changes}");
        // Far away, something else is best, and is taken after a while; what is asked for, at once.
        let far = Setting { pixels: 1e3, cells_a_pixel: 6.0, optical_radius: 3.0, ..setting() };
        for _ in 0..SteadyChoice::PATIENCE {
            steady.update(asked, &far, &MACHINE);
        }
        assert!(steady.current.price() <= SteadyChoice::GAIN * best(asked, &far).price());
        let asked = SmokeQuality::Error(0.2);
        steady.update(asked, &far, &MACHINE);
        assert_eq!(steady.current, best(asked, &far));
        // A machine that turns out slower does not stay over its budget.
        let asked = SmokeQuality::Budget(best(SmokeQuality::Error(0.01), &setting()).milliseconds);
        let mut steady = SteadyChoice::new(best(asked, &setting()));
        for _ in 0..SteadyChoice::PATIENCE {
            steady.update(asked, &setting(), &Machine { pace: 1.15, ..MACHINE });
        }
        assert!(steady.current.is_met, "{}", steady.current);
    }
}
