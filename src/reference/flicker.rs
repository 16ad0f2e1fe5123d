//! How much a drawn animation flickers: change from frame to frame that is not the truth's.

use super::compare::SMOKE_ALPHA;

/// A frame as drawn and as it should be: linear RGB media radiance without background, without noise. All of one size.
#[derive(Clone, Copy, Debug)]
pub struct DrawnFrame<'a> {
    /// What was drawn.
    pub picture: &'a [[f32; 3]],
    /// What is true.
    pub truth: &'a [[f32; 3]],
    /// 1 − transmittance of the truth.
    pub alpha: &'a [f32],
}

/// Root mean square change from one frame to the next, over the pixels where either has a true alpha above
/// [`SMOKE_ALPHA`], in the pictures' units.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Change {
    /// Of the error, picture − truth.
    pub error: f64,
    /// Of the truth.
    pub truth: f64,
}

impl Change {
    /// From `before` to `after`; none where there is no smoke.
    pub fn between(before: DrawnFrame, after: DrawnFrame) -> Self {
        let (mut error, mut truth, mut values) = (0.0, 0.0, 0);
        let is_smoke = |pixel: &usize| before.alpha[*pixel].max(after.alpha[*pixel]) > SMOKE_ALPHA;
        for pixel in (0..after.alpha.len()).filter(is_smoke) {
            for channel in 0..3 {
                let change = |before: &[[f32; 3]], after: &[[f32; 3]]| {
                    f64::from(after[pixel][channel]) - f64::from(before[pixel][channel])
                };
                let true_change = change(before.truth, after.truth);
                error += (change(before.picture, after.picture) - true_change).powi(2);
                truth += true_change.powi(2);
                values += 1;
            }
        }
        let mean = |sum: f64| (sum / f64::from(values.max(1))).sqrt();
        Self { error: mean(error), truth: mean(truth) }
    }
}

/// The error's mean change over the truth's: 0 for a picture that is off by as much in every frame, 1 where the error
/// changes as much as the smoke does. `None` where the truth does not change.
pub fn flicker(changes: &[Change]) -> Option<f64> {
    let sum = |of: fn(&Change) -> f64| changes.iter().map(of).sum::<f64>();
    let truth = sum(|change| change.truth);
    (truth > 0.0).then(|| sum(|change| change.error) / truth)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_changes() {
        // Two pixels with smoke in one of the frames or in both, and one without.
        let truth = [[[1.0; 3], [2.0; 3], [0.0; 3]], [[1.0; 3], [5.0; 3], [9.0; 3]]];
        let picture = [[[1.5; 3], [2.0; 3], [7.0; 3]], [[1.5; 3], [4.0; 3], [0.0; 3]]];
        let alpha = [[0.5, 0.0, 0.0], [0.5, 0.03, 0.02]];
        let frame = |i: usize| DrawnFrame { picture: &picture[i], truth: &truth[i], alpha: &alpha[i] };
        let change = Change::between(frame(0), frame(1));
        // Errors 0.5 and 0.5; 0 and −1. The truth: 0 and 3.
        assert_eq!(change, Change { error: 0.5f64.sqrt(), truth: 4.5f64.sqrt() });
        assert_eq!(Change::between(frame(1), frame(0)), change, "there and back");
        assert!((flicker(&[change]).unwrap() - 1.0 / 3.0).abs() < 1e-15);
        // A mean of changes over a mean of changes, not a mean of ratios.
        let still = Change { error: 0.5f64.sqrt(), truth: 0.0 };
        assert!((flicker(&[change, still]).unwrap() - 2.0 / 3.0).abs() < 1e-15);
        assert_eq!(flicker(&[still]), None);
    }

    #[test]
    fn a_constant_error_does_not_flicker() {
        let truth = [[[1.0, 2.0, 3.0]], [[2.0, 2.0, 4.0]]];
        let picture = truth.map(|frame| frame.map(|rgb: [f32; 3]| rgb.map(|value| value + 0.5)));
        let frame = |i: usize| DrawnFrame { picture: &picture[i], truth: &truth[i], alpha: &[1.0] };
        assert_eq!(flicker(&[Change::between(frame(0), frame(1))]), Some(0.0));
        // No smoke, no change.
        let empty = DrawnFrame { alpha: &[0.0], ..frame(0) };
        assert_eq!(Change::between(empty, empty), Change::default());
    }
}
