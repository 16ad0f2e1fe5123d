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
    /// Predicted relative RMS error over the smoke's pixels, what is left out taken for a little worse than is likely.
    pub error: f32,
    /// Predicted milliseconds of the GPU in a frame in which everything changes.
    pub milliseconds: f32,
    /// Whether a model was found that is as accurate, or as cheap, as asked for.
    pub is_met: bool,
}

/// What predictions rest on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Predictor {
    prices: Prices,
    errors: Errors,
    /// How many times as long frames take.
    pace: f32,
}

impl Predictor {
    /// Where nothing is known but what draws: a GPU, or a CPU in the place of one, to which passes are not worth the same.
    pub fn of(device: wgpu::DeviceType) -> Self {
        Self::with(if device == wgpu::DeviceType::Cpu { CPU_PRICES } else { GPU_PRICES }, ERRORS)
    }

    /// By these numbers.
    pub fn with(prices: Prices, errors: Errors) -> Self {
        Self { prices, errors, pace: 1.0 }
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

    /// What is predicted of a model.
    fn choice(&self, asked: SmokeQuality, setting: &Setting, model: SmokeModel) -> QualityChoice {
        let error = setting.error(&model, &self.errors);
        let milliseconds = self.pace * self.price_of(setting, &model).total();
        let is_met = match asked {
            SmokeQuality::Model(_) => true,
            SmokeQuality::Error(most) => error <= most,
            SmokeQuality::Budget(most) => milliseconds <= most,
        };
        QualityChoice { asked, setting: *setting, model, error, milliseconds, is_met }
    }

    /// The best choice there is.
    pub fn best(&self, asked: SmokeQuality, setting: &Setting) -> QualityChoice {
        self.best_below(asked, setting, f32::MAX)
    }

    /// The best of those of a lower [price](Self::price_of), if there are any.
    fn best_below(&self, asked: SmokeQuality, setting: &Setting, price: f32) -> QualityChoice {
        if let SmokeQuality::Model(model) = asked {
            return self.choice(asked, setting, model);
        }
        let all = || candidates(setting).map(|model| self.choice(asked, setting, model));
        let best = |is_enough: &dyn Fn(&QualityChoice) -> bool| {
            all().filter(is_enough).min_by(|a, b| a.objective().total_cmp(&b.objective()))
        };
        best(&|choice| choice.is_met && choice.milliseconds < self.pace * price)
            .or_else(|| {
                // What cannot be had is not worth the last few percent toward it.
                let least = all().map(|choice| choice.limited()).fold(f32::MAX, f32::min);
                best(&|choice| choice.limited() <= SLIGHTLY * least)
            })
            .expect("what is least is among them")
    }
}

/// So much more is next to nothing.
const SLIGHTLY: f32 = 1.05;

impl QualityChoice {
    /// What to keep small, where the limit is kept.
    fn objective(&self) -> f32 {
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
    /// What has been dearer than this has turned out to be over the budget, at the pace of then: it would come and go.
    too_dear: f32,
    /// So many frames on, it is tried again.
    try_in: u32,
}

impl SteadyChoice {
    /// So many frames another has to be better.
    const PATIENCE: u32 = 20;
    /// And by so much.
    const GAIN: f32 = 1.2;
    /// What was too dear, perhaps for something that has passed, is tried again after so many frames, half a minute or so.
    const RETRY: u32 = 1800;

    pub fn new(best: QualityChoice) -> Self {
        Self { current: best, better_for: 0, too_dear: f32::MAX, try_in: 0 }
    }

    /// Follows what is asked for at once, and what is best after a while.
    pub fn update(&mut self, asked: SmokeQuality, setting: &Setting, predictor: &Predictor) {
        if asked != self.current.asked {
            *self = Self::new(predictor.best(asked, setting));
            return;
        }
        self.try_in = self.try_in.saturating_sub(1);
        if self.try_in == 0 {
            self.too_dear = f32::MAX;
        }
        let best = predictor.best_below(asked, setting, self.too_dear);
        let mut current = predictor.choice(asked, setting, self.current.model);
        // What is over its limit by next to nothing keeps it.
        current.is_met |= current.limited() <= SLIGHTLY * current.limit();
        self.current = current;
        let is_over = current.limited() > SLIGHTLY * current.limit().max(best.limited());
        let is_beaten = is_over || current.objective() > Self::GAIN * best.objective();
        self.better_for = if is_beaten { self.better_for + 1 } else { 0 };
        if self.better_for >= Self::PATIENCE {
            if is_over && matches!(asked, SmokeQuality::Budget(_)) {
                (self.too_dear, self.try_in) = (current.limit() / predictor.pace, Self::RETRY);
            }
            *self = Self { current: best, better_for: 0, ..*self };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MACHINE: Predictor = Predictor { prices: CPU_PRICES, errors: ERRORS, pace: 1.0 };

    fn setting() -> Setting {
        Setting {
            rbfs: 600.0,
            is_reducible: true,
            can_halve: true,
            optical_radius: 0.1,
            g: 0.0,
            multiple: true,
            lamps: 0.0,
            cells: 1e6,
            pixels: 4e5,
            cells_along: 100.0,
            cells_a_pixel: 0.3,
        }
    }

    fn best(asked: SmokeQuality, setting: &Setting) -> QualityChoice {
        MACHINE.best(asked, setting)
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
        let slow = Predictor { pace: 4.0, ..MACHINE };
        let choice = slow.best(asked, &setting());
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
        assert!(steady.current.objective() <= SteadyChoice::GAIN * best(asked, &far).objective());
        let asked = SmokeQuality::Error(0.2);
        steady.update(asked, &far, &MACHINE);
        assert_eq!(steady.current, best(asked, &far));
        // A machine that turns out slower does not stay over its budget.
        let asked = SmokeQuality::Budget(best(SmokeQuality::Error(0.01), &setting()).milliseconds);
        let mut steady = SteadyChoice::new(best(asked, &setting()));
        for _ in 0..SteadyChoice::PATIENCE {
            steady.update(asked, &setting(), &Predictor { pace: 1.15, ..MACHINE });
        }
        assert!(steady.current.is_met, "{}", steady.current);
    }
    #[test]
    fn a_slow_second_is_made_up_for() {
        let full = MACHINE.best(SmokeQuality::default(), &setting());
        let asked = SmokeQuality::Budget(0.7 * full.milliseconds);
        let mut machine = MACHINE;
        let mut steady = SteadyChoice::new(machine.best(asked, &setting()));
        let first = steady.current.model;
        let mut worst: f32 = 0.0;
        for frame in 0..2400 {
            let said = machine.price_of(&setting(), &steady.current.model);
            machine.follow(said.total() * if frame < 60 { 4.0 } else { 1.0 }, said);
            steady.update(asked, &setting(), &machine);
            worst = worst.max(steady.current.error);
        }
        let error = MACHINE.best(asked, &setting()).error;
        assert!(
            worst > 1.5 * error && steady.current.error <= SteadyChoice::GAIN * error,
            "{first:?} {}",
            steady.current
        );
    }

    #[test]
    fn smoke_denser_than_any_that_was_measured_gets_no_less() {
        for optical_radius in [0.5, 3.0, 100.0] {
            let choice = best(SmokeQuality::Error(0.01), &Setting { optical_radius, ..setting() });
            assert!(!choice.is_met && choice.error < 0.05, "{choice}");
            let SmokeModel { rbfs, probes, directions, step, .. } = choice.model;
            assert!(rbfs == u32::MAX && probes == 7 && directions >= 32 && step <= 1.0, "{choice}");
        }
    }

    #[test]
    fn what_has_turned_out_over_budget_does_not_come_and_go() {
        let price = |model: &SmokeModel| MACHINE.price_of(&setting(), model).total();
        let full = MACHINE.best(SmokeQuality::default(), &setting());
        for share in [0.3, 0.4, 0.5, 0.6, 0.7, 0.8] {
            let budget = share * full.milliseconds;
            let asked = SmokeQuality::Budget(budget);
            // Dear models are slower than predicted, cheap ones faster: each speaks for the other.
            let truth = |model: &SmokeModel| price(model) * if price(model) > 0.7 * budget { 1.6 } else { 0.8 };
            let mut machine = MACHINE;
            let mut steady = SteadyChoice::new(machine.best(asked, &setting()));
            let mut changes = Vec::new();
            for frame in 0..1800 {
                let before = steady.current.model;
                machine.follow(truth(&before), MACHINE.price_of(&setting(), &before));
                steady.update(asked, &setting(), &machine);
                if steady.current.model != before {
                    changes.push(frame);
                }
            }
            // It settles within seconds.
            assert!(changes.iter().all(|&frame| frame < 300), "{share}: {changes:?}");
            assert!(truth(&steady.current.model) <= SLIGHTLY * budget, "{share}: {}", steady.current);
        }
    }
}
