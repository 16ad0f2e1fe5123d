//! Companding: 8-bit residuals with steps that are finer near zero.

/// How a signed byte `q` in −127..=127 stands for a residual: `R(q) = sign(q) · max · (|q| / 127)^exponent`.
///
/// Exponent 1 is linear. A larger exponent spends more of the codes on small residuals, of which there are most, but
/// keeps more cells: what decodes nearest to 0 is dropped. Relative RMS error of the density (and cells kept) at 600 RBFs:
///
/// | exponent | 1 | 1.5 | 2 | 2.5 |
/// |---|---|---|---|---|
/// | a plume of 57×117×58 cells | 0.56 % (134,572) | 0.31 % (177,815) | 0.29 % (204,265) | 0.30 % (206,526) |
/// | OpenVDB's smoke.vdb | 1.39 % (620,672) | 0.55 % (1,136,579) | 0.45 % (1,464,105) | 0.44 % (1,669,939) |
///
/// So the bake takes the smallest exponent whose picture is good enough.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct QuantizationLaw {
    /// Magnitude that ±127 stands for, in units of density: the frame's largest |R|. At least 0.
    pub max: f32,
    /// Exponent of the law, above 0.
    pub exponent: f32,
}

impl QuantizationLaw {
    /// The residual that `q` stands for; −128 reads as −127.
    pub fn decode(&self, q: i8) -> f32 {
        let magnitude = self.max * (f32::from(q).abs().min(127.0) / 127.0).powf(self.exponent);
        magnitude.copysign(f32::from(q))
    }

    /// The byte whose decoded value is nearest to `residual` (ties go to the smaller magnitude);
    /// 0 where `max` is 0.
    pub fn encode(&self, residual: f32) -> i8 {
        // Written so that what is not a number counts as nothing.
        if !(self.max > 0.0 && residual.abs() > 0.0) {
            return 0;
        }
        let magnitude = residual.abs().min(self.max);
        // The inverse lies between two codes; take the one that decodes nearer.
        let code = 127.0 * (magnitude / self.max).powf(1.0 / self.exponent);
        let low = (code.floor() as i8).min(126);
        let (below, above) = (self.decode(low), self.decode(low + 1));
        let q = if magnitude - below <= above - magnitude { low } else { low + 1 };
        if residual < 0.0 { -q } else { q }
    }
}
