//! Single scattering at the RBF centres (Zhou et al. 2008, section 5.3, Eq. 10 and 11).

use glam::DVec3;
use rayon::prelude::*;

use super::DepthTable;
use crate::{
    rbf::Rbf,
    reference::{Medium, incident_light::Lighting, rbf_center},
    sh::{BANDS, Exponential, Sh, ShRgb, henyey_greenstein_factors},
};

/// J_ss(c_l) = Ω [(L_in ∗ τ(c_l)) ⋆ p], as functions of the look direction.
///
/// The paper's Ω/4π and our Ω are the same: its phase function integrates to 4π, ours to 1.
pub fn source_radiance(rbfs: &[Rbf], lighting: &Lighting, medium: &Medium, exponential: Exponential) -> Vec<ShRgb> {
    let table = DepthTable::default();
    let environment = lighting.environment.rotate(lighting.env_from_local.transpose());
    let factors = henyey_greenstein_factors(medium.g);
    rbfs.par_iter()
        .map(|rbf| {
            let transmittance = transmittance(&table, rbfs, rbf_center(rbf), medium.sigma, exponential);
            let direct = environment.product(&Sh(transmittance.0.map(DVec3::splat)));
            Sh(direct.convolve(&factors).0.map(|c| c * medium.albedo))
        })
        .collect()
}

/// τ(x) = exp*(−σ Σ_h w_h T_h(x)), of order 4.
pub fn transmittance(table: &DepthTable, rbfs: &[Rbf], x: DVec3, sigma: f64, exponential: Exponential) -> Sh<f64> {
    exponential.apply(&(table.column(rbfs, x) * -sigma), BANDS)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        optics::{gaussian_column, henyey_greenstein},
        sh::SphereRule,
    };
    use core::f64::consts::PI;
    use glam::DMat3;

    fn rbfs() -> [Rbf; 3] {
        [
            Rbf { center: [0.1, 0.0, -0.2], radius: 0.08, weight: 1.5 },
            Rbf { center: [0.1, 0.1, 0.0], radius: 0.09, weight: 0.7 },
            Rbf { center: [-0.1, -0.1, 0.1], radius: 0.06, weight: 1.0 },
        ]
    }

    #[test]
    fn transmittance_is_the_exponential_of_the_columns() {
        let rbfs = rbfs();
        let table = DepthTable::default();
        let rule = SphereRule::new(40);
        for rbf in &rbfs {
            let x = rbf_center(rbf);
            let column = |dir: DVec3| -> f64 {
                rbfs.iter().map(|h| gaussian_column(x, dir, rbf_center(h), h.radius.into(), h.weight.into())).sum()
            };
            // Projected before the exponential, as the paper does, and only then.
            let projected = Sh::project(&rule, |dir| -4.0 * column(dir));
            let expected = Sh::project(&rule, |dir| projected.evaluate(dir).exp());
            let found = transmittance(&table, &rbfs, x, 4.0, Exponential::Quadrature);
            for k in 0..16 {
                // The table's 5e-5, times σ.
                assert!((found.0[k] - expected.0[k]).abs() < 4e-4, "{k}: {} for {}", found.0[k], expected.0[k]);
            }
        }
    }

    #[test]
    fn source_radiance_is_the_integral_of_light_and_phase() {
        let rbfs = rbfs();
        let environment = ShRgb::constant(DVec3::new(0.4, 0.5, 0.7))
            + ShRgb::zonal(DVec3::new(0.6, 0.0, 0.8), &[1.0, 0.8, 0.5, 0.2], DVec3::new(3.0, 2.0, 1.0));
        let turn = DMat3::from_axis_angle(DVec3::new(0.0, 0.6, 0.8), 1.1);
        let lighting = Lighting { environment, env_from_local: turn };
        let medium = Medium { sigma: 4.0, albedo: DVec3::new(0.9, 0.6, 0.3), g: 0.4 };
        let found = source_radiance(&rbfs, &lighting, &medium, Exponential::Hybrid);
        let table = DepthTable::default();
        let rule = SphereRule::new(48);
        for (rbf, found) in rbfs.iter().zip(found) {
            let tau = transmittance(&table, &rbfs, rbf_center(rbf), medium.sigma, Exponential::Hybrid);
            // Eq. 10 with the phase function itself; the product of two functions of order 4 is cut back to order 4.
            let direct = ShRgb::project(&rule, |w| environment.evaluate(turn * w) * tau.evaluate(w));
            for v in [DVec3::Z, DVec3::new(0.48, -0.6, 0.64)] {
                // Light from w travels along −w, and leaves along −v; the paper's p is 4π times ours.
                let gathered = rule.integrate(|w| direct.evaluate(w) * (4.0 * PI * henyey_greenstein(w.dot(v), 0.4)));
                let expected = medium.albedo / (4.0 * PI) * gathered;
                assert!((found.evaluate(v) - expected).length() < 1e-10, "{} {expected}", found.evaluate(v));
            }
        }
    }
}
