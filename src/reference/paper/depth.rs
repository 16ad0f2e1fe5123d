//! Optical depth through the RBFs, as spherical harmonics (Zhou et al. 2008, section 5.3 and Fig. 5).

use core::f64::consts::PI;

use glam::DVec3;

use crate::{
    optics::gaussian_column,
    rbf::Rbf,
    reference::rbf_center,
    sh::{BANDS, Sh, zonal_factors_between},
};

/// Entries of the table, uniform in β from 0 to π.
pub const ANGLES: usize = 256;

/// The angle β that stands for a distance of `d` radii from an RBF's centre: the half-angle that its radius subtends,
/// carried on from π/2 to π inside.
pub fn beta(d: f64) -> f64 {
    if d > 1.0 { (1.0 / d).asin() } else { d.acos() + 0.5 * PI }
}

/// The distance in radii of an angle β: the inverse of [`beta`].
fn distance(beta: f64) -> f64 {
    if beta < 0.5 * PI { 1.0 / beta.sin() } else { beta.sin() }
}

/// T(β): the optical depth through a Gaussian of radius and weight 1 from a point outside or inside it, as the band
/// factors of a zonal function about the direction to its centre.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthTable {
    factors: Vec<[f64; BANDS]>,
}

impl Default for DepthTable {
    fn default() -> Self {
        let entry = |i: usize| match i {
            // Infinitely far away.
            0 => [0.0; BANDS],
            _ => depth_factors(distance(PI * i as f64 / (ANGLES - 1) as f64)),
        };
        Self { factors: (0..ANGLES).map(entry).collect() }
    }
}

impl DepthTable {
    /// The factors at every angle.
    pub fn entries(&self) -> &[[f64; BANDS]] {
        &self.factors
    }

    /// The factors at a distance of `d` radii, linear in β between entries.
    pub fn factors(&self, d: f64) -> [f64; BANDS] {
        let position = beta(d) / PI * (ANGLES - 1) as f64;
        let index = (position as usize).min(ANGLES - 2);
        let t = position - index as f64;
        let [low, high] = [self.factors[index], self.factors[index + 1]];
        core::array::from_fn(|l| low[l] + t * (high[l] - low[l]))
    }

    /// Σ_h w_h T_h(x): the density between `x` and infinity by direction, in bundle units. Times the extinction it is
    /// the optical depth. The Gaussians are whole, not cut off at three radii.
    pub fn column(&self, rbfs: &[Rbf], x: DVec3) -> Sh<f64> {
        rbfs.iter().fold(Sh::default(), |sum, rbf| {
            let (to_center, radius) = (rbf_center(rbf) - x, f64::from(rbf.radius));
            let factors = self.factors(to_center.length() / radius);
            // In its own centre an RBF is the same in all directions.
            let axis = to_center.normalize_or(DVec3::Z);
            sum + Sh::zonal(axis, &factors, f64::from(rbf.weight) * radius)
        })
    }
}

/// The exact factors at a distance of `d` radii.
fn depth_factors(d: f64) -> [f64; BANDS] {
    let column = |t: f64| {
        gaussian_column(DVec3::ZERO, DVec3::new((1.0 - t * t).max(0.0).sqrt(), 0.0, t), DVec3::Z * d, 1.0, 1.0)
    };
    // From afar all is in a peak exp(−d²(1−t²)), which has fallen to e⁻³⁶ at the seam.
    let seam = if d > 5.0 { 1.0 - 18.0 / (d * d) } else { 0.0 };
    let (back, front) = (zonal_factors_between(-1.0, seam, column), zonal_factors_between(seam, 1.0, column));
    core::array::from_fn(|l| back[l] + front[l])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sh::SphereRule;

    #[test]
    fn beta_is_monotonic_and_has_an_inverse() {
        assert_eq!(beta(0.0), PI);
        assert!((beta(1.0) - 0.5 * PI).abs() < 1e-15 && (beta(1.0 + 1e-12) - 0.5 * PI).abs() < 2e-6);
        assert!((beta(2.0) - PI / 6.0).abs() < 1e-15);
        let distances: Vec<f64> = (1..400).map(|i| 0.01 * f64::from(i)).collect();
        assert!(distances.windows(2).all(|d| beta(d[0]) > beta(d[1])));
        for d in distances {
            assert!((distance(beta(d)) - d).abs() < 1e-12, "{d}");
        }
    }

    #[test]
    fn entries_are_integrals_over_the_sphere() {
        // By a rule of 20,000 directions, in a frame of its own.
        let rule = SphereRule::new(100);
        let axis = DVec3::new(0.48, -0.6, 0.64);
        for d in [0.0, 0.3, 1.0, 2.5, 7.0] {
            let expected = Sh::project(&rule, |dir| gaussian_column(-axis * d, dir, DVec3::ZERO, 1.0, 1.0));
            let found = Sh::zonal(axis, &depth_factors(d), 1.0);
            for k in 0..16 {
                assert!((found.0[k] - expected.0[k]).abs() < 1e-10, "d {d}: {} for {}", found.0[k], expected.0[k]);
            }
        }
        // In its centre: √π/2 in all directions. From afar the mass π^1.5 seen under 1/d² in one direction; the next
        // term is 1/d² smaller.
        assert!((depth_factors(0.0)[0] - 2.0 * PI.powf(1.5)).abs() < 1e-13);
        let far = depth_factors(60.0);
        assert!(far.iter().all(|f| (f * 3600.0 / PI.powf(1.5) - 1.0).abs() < 2e-3), "{far:?}");
    }

    #[test]
    fn columns_add_up_and_scale_with_radius_and_weight() {
        let rbfs = [
            Rbf { center: [0.1, 0.0, -0.2], radius: 0.08, weight: 1.5 },
            Rbf { center: [0.1, 0.15, 0.1], radius: 0.05, weight: 0.7 },
        ];
        let table = DepthTable::default();
        let rule = SphereRule::new(60);
        for x in [rbf_center(&rbfs[0]), DVec3::new(0.12, 0.1, 0.05), DVec3::new(-0.1, 0.0, 0.0)] {
            let column =
                |dir: DVec3, rbf: &Rbf| gaussian_column(x, dir, rbf_center(rbf), rbf.radius.into(), rbf.weight.into());
            let expected = Sh::project(&rule, |dir| rbfs.iter().map(|rbf| column(dir, rbf)).sum::<f64>());
            let found = table.column(&rbfs, x);
            for k in 0..16 {
                // Linear between 256 entries: curvature times (π/255)²/8 = 2e-5, of w r T up to 1.3.
                assert!((found.0[k] - expected.0[k]).abs() < 5e-5, "{k}: {} for {}", found.0[k], expected.0[k]);
            }
        }
    }
}
