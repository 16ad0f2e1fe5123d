//! Multiple scattering at the RBF centres by diffusion, as printed (Zhou et al. 2008, section 5.4).

use glam::DVec3;

use super::{Jet, Optics, conjugate_gradients, jet, system};
use crate::{
    rbf::Rbf,
    reference::{Medium, rbf_center, taylor::Taylor},
    sh::{Sh, ShRgb, henyey_greenstein_factors},
};

/// What the diffusion solver found at every RBF's centre.
#[derive(Clone, Debug, PartialEq)]
pub struct Multiple {
    /// L⁰_m: mean media radiance per colour channel. May be negative.
    pub mean: Vec<DVec3>,
    /// J_ms: source radiance as a function of the look direction, bands 0 and 1.
    pub source: Vec<ShRgb>,
}

/// Solves Eq. 13 for every colour channel in `steps` steps of conjugate gradients from `start`, then evaluates Eq. 6
/// and convolves with the phase function.
///
/// `start` is L⁰_m at the centres: zeros, or the solution under another light or medium, or of the same RBFs a
/// moment before. A channel that scatters nothing has no source and stays black.
pub fn multiple(rbfs: &[Rbf], single: &[ShRgb], medium: &Medium, start: &[DVec3], steps: usize) -> Multiple {
    let mut media = vec![[Taylor::default(); 3]; rbfs.len()];
    for channel in (0..3).filter(|&channel| medium.albedo[channel] > 0.0) {
        let optics = Optics { extinction: medium.sigma, albedo: medium.albedo[channel], g: medium.g };
        let source: Vec<Taylor> = single.iter().map(|sh| Taylor::of(sh, channel)).collect();
        let system = system(rbfs, &source, optics);
        let start = start.iter().map(|radiance| radiance[channel]).collect();
        let mean = conjugate_gradients(&system.matrix, &system.rhs, start, steps);
        for (l, media) in media.iter_mut().enumerate() {
            let first = first_order(rbfs, &mean, l, source[l].first, optics);
            media[channel] = Taylor { mean: mean[l], first };
        }
    }
    let factors = henyey_greenstein_factors(medium.g);
    let scatter = |media: &[Taylor; 3]| {
        let scattered = Taylor::sh(*media).convolve(&factors);
        Sh(scattered.0.map(|c| c * medium.albedo))
    };
    Multiple {
        mean: media.iter().map(|rgb| DVec3::from(rgb.map(|taylor| taylor.mean))).collect(),
        source: media.iter().map(scatter).collect(),
    }
}

/// Eq. 6 at centre `l`, printed without the factor 3 that the moments give: L¹ = κ (−∇L⁰ + σ_t D J¹).
fn first_order(rbfs: &[Rbf], mean: &[f64], l: usize, source: DVec3, optics: Optics) -> DVec3 {
    let jets: Vec<Jet> = rbfs.iter().map(|rbf| jet(rbf, rbf_center(&rbfs[l]))).collect();
    let density = jets.iter().fold(Jet::default(), |sum, &jet| sum + jet);
    // ∇ of Eq. 12.
    let gradient: DVec3 = jets
        .iter()
        .zip(mean)
        .map(|(b, &mean)| (b.gradient * density.value - density.gradient * b.value) * (mean / density.value.powi(2)))
        .sum();
    let kappa = 1.0 / (3.0 * optics.transport() * density.value);
    kappa * (optics.extinction * density.value * source - gradient)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rbfs() -> Vec<Rbf> {
        let at = |x, y, z, radius, weight| Rbf { center: [x, y, z], radius, weight };
        vec![at(0.0, 0.0, 0.0, 0.09, 1.0), at(0.06, 0.02, -0.03, 0.07, 0.6), at(-0.05, 0.05, 0.0, 0.08, 1.3)]
    }

    fn single() -> Vec<ShRgb> {
        let lobe = |s: f64| ShRgb::zonal(DVec3::new(0.6, 0.0, 0.8), &[1.0, 0.6, 0.2, 0.1], DVec3::new(s, 0.5, 1.0 - s));
        [0.9, 0.5, 0.2].map(lobe).to_vec()
    }

    const MEDIUM: Medium = Medium { sigma: 30.0, albedo: DVec3::new(0.9, 0.0, 0.6), g: 0.4 };

    #[test]
    fn channels_are_solved_each_with_its_albedo() {
        let (rbfs, single) = (rbfs(), single());
        let found = multiple(&rbfs, &single, &MEDIUM, &[DVec3::ZERO; 3], 50);
        for channel in [0, 2] {
            let optics = Optics { extinction: 30.0, albedo: MEDIUM.albedo[channel], g: 0.4 };
            let source: Vec<Taylor> = single.iter().map(|sh| Taylor::of(sh, channel)).collect();
            let system = system(&rbfs, &source, optics);
            let mean: Vec<f64> = found.mean.iter().map(|rgb| rgb[channel]).collect();
            // Three unknowns: the residual of the system itself is rounding, times its condition number of about 100.
            for (a, b) in system.matrix.multiply(&mean).iter().zip(&system.rhs) {
                assert!((a - b).abs() < 1e-9 * b.abs(), "{a} {b}");
            }
            for l in 0..3 {
                let scattered = Taylor::of(&found.source[l], channel);
                assert!((scattered.mean - optics.albedo * mean[l]).abs() < 1e-12);
                // Eq. 6 with the gradient by central differences of Eq. 12.
                let x = rbf_center(&rbfs[l]);
                let mean_at = |x: DVec3| {
                    let weights: Vec<f64> = rbfs.iter().map(|rbf| jet(rbf, x).value).collect();
                    weights.iter().zip(&mean).map(|(w, m)| w * m).sum::<f64>() / weights.iter().sum::<f64>()
                };
                let gradient =
                    DVec3::from(DVec3::AXES.map(|axis| (mean_at(x + axis * 1e-5) - mean_at(x - axis * 1e-5)) / 2e-5));
                let density: f64 = rbfs.iter().map(|rbf| jet(rbf, x).value).sum();
                let kappa = 1.0 / (3.0 * optics.transport() * density);
                let first = kappa * (optics.extinction * density * source[l].first - gradient);
                let expected = first * (optics.albedo * 0.4);
                assert!((scattered.first - expected).length() < 1e-6 * expected.length().max(1e-3));
            }
        }
        assert!(found.mean.iter().all(|rgb| rgb.y == 0.0) && found.source.iter().all(|sh| sh.0[0].y == 0.0));
        assert_eq!(multiple(&[], &[], &MEDIUM, &[], 20), Multiple { mean: vec![], source: vec![] });
    }

    #[test]
    fn a_start_saves_steps() {
        let (rbfs, single) = (rbfs(), single());
        let solve = |start: &[DVec3], steps| multiple(&rbfs, &single, &MEDIUM, start, steps).mean;
        let converged = solve(&[DVec3::ZERO; 3], 50);
        let error = |mean: Vec<DVec3>| -> f64 { mean.iter().zip(&converged).map(|(a, b)| (*a - *b).length()).sum() };
        let near: Vec<DVec3> = converged.iter().map(|rgb| *rgb * 1.001).collect();
        assert!(error(solve(&near, 0)) < 0.01 * error(solve(&[DVec3::ZERO; 3], 0)));
        assert!(error(solve(&converged, 0)) == 0.0);
    }
}
