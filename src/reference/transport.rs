//! Transport: light that scatters more than once, exchanged between the centres of the RBFs.
//!
//! What reaches the centre c_l after scattering elsewhere, L_m, comes from the other Gaussians in proportion to the mean
//! optical depth they cover as seen from there, attenuated on the way:
//!
//! ```text
//! K_lh = w_h r_h (√π/2) Daw(u)/u · τ_lh          u = |c_l − c_h| / r_h
//! K_ll = w_l r_l (√π/2) erfcx(σ D(c_l) r_l / 2)
//! ```
//!
//! Every row is scaled to sum 1 (K̂) and multiplied by 1 − τ̄, the share of directions that end in smoke. So energy is
//! exact: where light is the same all around, white smoke (albedo 1) that scatters evenly has that radiance too, and the
//! spectral radius is at most Ω max(1 − τ̄). No boundary conditions are needed.
//!
//! Everything is a function of the look direction v, which is also the direction ω that light comes from.
//!
//! Forward peaks are taken out of the phase function first: [`DeltaM`].

use core::f64::consts::PI;

use glam::DVec3;
use rayon::prelude::*;

use super::{
    DIRECTIONS, Grid, Medium, rbf_center,
    source_radiance::{Incident, Lighting, incident, probes},
};
use crate::{
    optics::{dawson, erfcx, gaussian_bands, transmittance},
    rbf::Rbf,
    sh::{BANDS, COEFFICIENTS, Sh, ShRgb, band, basis, henyey_greenstein_factors},
};

/// Samples of the coarse density between two centres.
pub const PAIR_STEPS: usize = 4;
/// Sweeps end when nothing changes by more than this share of the largest coefficient.
const TOLERANCE: f64 = 1e-12;
/// Sweeps at most: white smoke that nothing leaves has no steady state.
const MAX_SWEEPS: usize = 20_000;

/// The medium with the forward peak of its phase function counted as no scattering at all (delta-M, Wiscombe 1977):
/// f = max(g, 0)⁴ is the first band that order 4 drops.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DeltaM {
    /// σ' = σ (1 − Ω f), per channel.
    pub sigma: DVec3,
    /// Ω' = Ω (1 − f) / (1 − Ω f), per channel.
    pub albedo: DVec3,
    /// g'_l = (g^l − f) / (1 − f), the phase function's band factors.
    pub factors: [f64; BANDS],
}

impl DeltaM {
    /// The similar medium; the same where g ≤ 0.
    pub fn new(medium: &Medium) -> Self {
        let f = medium.g.max(0.0).powi(4);
        let kept = 1.0 - f * medium.albedo;
        Self {
            sigma: medium.sigma * kept,
            albedo: medium.albedo * (1.0 - f) / kept,
            factors: henyey_greenstein_factors(medium.g).map(|factor| (factor - f) / (1.0 - f)),
        }
    }
}

/// Source radiance of all scattering for the four probes of every RBF, J_k = Ω g^l (L_d,k + (1 − τ̄) G_k): the
/// counterpart of [`source_radiance`](super::source_radiance::source_radiance), for the same next pass.
pub fn multiple_scattering(rbfs: &[Rbf], coarse: &Grid, lighting: &Lighting, medium: &Medium) -> Vec<[ShRgb; 4]> {
    let sigma = DeltaM::new(medium).sigma;
    let incident = incident_light(rbfs, coarse, lighting, sigma);
    let pairs = pair_matrix(rbfs, coarse, sigma.element_sum() / 3.0);
    let gathered = scattered_light(rbfs, &pairs, &incident, medium);
    let factors = henyey_greenstein_factors(medium.g);
    let probe = |incident: Incident, gathered| scatter(&incident, gathered, medium.albedo, &factors);
    incident.iter().zip(&gathered).map(|(probes, g)| probes.map(|incident| probe(incident, g))).collect()
}

/// L_d and τ̄ at the four probes of every RBF; `sigma` is extinction per channel.
pub fn incident_light(rbfs: &[Rbf], coarse: &Grid, lighting: &Lighting, sigma: DVec3) -> Vec<[Incident; 4]> {
    rbfs.par_iter().map(|rbf| probes(rbf).map(|p| incident(p, coarse, lighting, sigma, DIRECTIONS))).collect()
}

/// K̂, row by row: entry `l * n + h` is the share of RBF `h` in what RBF `l` sees of the others and itself.
pub fn pair_matrix(rbfs: &[Rbf], coarse: &Grid, sigma: f64) -> Vec<f64> {
    let row = |l: usize| {
        let to = rbf_center(&rbfs[l]);
        let mut row: Vec<f64> = rbfs
            .iter()
            .enumerate()
            .map(|(h, rbf)| {
                let (from, radius, weight) = (rbf_center(rbf), f64::from(rbf.radius), f64::from(rbf.weight));
                let shape = if h == l {
                    erfcx(0.5 * sigma * coarse.sample(to) * radius)
                } else {
                    mean_depth(to.distance(from) / radius) * transmittance(sigma * column_between(to, from, coarse))
                };
                // The common factor σ √π/2 is lost in the scaling.
                weight * radius * shape
            })
            .collect();
        let sum: f64 = row.iter().sum();
        row.iter_mut().for_each(|entry| *entry /= sum);
        row
    };
    (0..rbfs.len()).into_par_iter().flat_map_iter(row).collect()
}

/// Daw(u)/u: the mean optical depth of a Gaussian over all directions from `u` radii away, 1 at its centre.
fn mean_depth(u: f64) -> f64 {
    if u > 0.0 { dawson(u) / u } else { 1.0 }
}

/// ∫ of the coarse density from `a` to `b`.
fn column_between(a: DVec3, b: DVec3, coarse: &Grid) -> f64 {
    let sample = |i| coarse.sample(a.lerp(b, (i as f64 + 0.5) / PAIR_STEPS as f64));
    (0..PAIR_STEPS).map(sample).sum::<f64>() * (a.distance(b) / PAIR_STEPS as f64)
}

/// G at every RBF: the light scattered elsewhere, L_m = (1 − τ̄) G, of the steady state
/// J_k = Ω' g'_l (L̄_d,k + (1 − τ̄) G_k), G = K̂ J, with means over the four probes.
pub fn scattered_light(rbfs: &[Rbf], pairs: &[f64], incident: &[[Incident; 4]], medium: &Medium) -> Vec<ShRgb> {
    let DeltaM { albedo, factors, .. } = DeltaM::new(medium);
    let incident: Vec<Incident> = incident.iter().map(mean).collect();
    let lobes = (medium.g != 0.0).then(|| lobes(rbfs));
    let mut gathered = vec![ShRgb::default(); rbfs.len()];
    for _ in 0..MAX_SWEEPS {
        let source: Vec<ShRgb> =
            incident.iter().zip(&gathered).map(|(incident, g)| scatter(incident, g, albedo, &factors)).collect();
        let next = match &lobes {
            Some(lobes) => gather(pairs, lobes, &source),
            None => gather_isotropic(pairs, &source),
        };
        let values = || next.iter().zip(&gathered).flat_map(|(a, b)| a.0.iter().zip(&b.0));
        let change = values().map(|(&a, &b)| (a - b).abs().max_element()).fold(0.0, f64::max);
        let largest = values().map(|(a, _)| a.abs().max_element()).fold(0.0, f64::max);
        gathered = next;
        if change <= TOLERANCE * largest {
            break;
        }
    }
    gathered
}

/// Light once scattered at a point: Ω g^l (L_d,k + (1 − τ̄) G_k).
fn scatter(incident: &Incident, gathered: &ShRgb, albedo: DVec3, factors: &[f64; BANDS]) -> ShRgb {
    let enclosed = 1.0 - incident.escape;
    let light = Sh(core::array::from_fn(|k| albedo * (incident.light.0[k] + enclosed * gathered.0[k])));
    light.convolve(factors)
}

/// The mean of an RBF's four probes.
fn mean(probes: &[Incident; 4]) -> Incident {
    let mut mean = Incident::default();
    for probe in probes {
        mean.light = mean.light + probe.light * 0.25;
        mean.escape += 0.25 * probe.escape;
    }
    mean
}

/// How an RBF looks from another's centre: the shape of its optical depth over directions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lobe {
    /// a_l, per band: see [`gaussian_bands`].
    bands: [f64; BANDS],
    /// a_l y_k(d), d towards its centre.
    along: [f64; COEFFICIENTS],
}

/// The lobes of all pairs, in the order of [`pair_matrix`]. An RBF around its own or a coincident centre looks the same
/// in all directions.
pub fn lobes(rbfs: &[Rbf]) -> Vec<Lobe> {
    let lobe = |to: &Rbf, from: &Rbf| {
        let offset = rbf_center(from) - rbf_center(to);
        let bands = gaussian_bands(offset.length() / f64::from(from.radius));
        let y = basis(offset.normalize_or(DVec3::Z));
        Lobe { bands, along: core::array::from_fn(|k| bands[band(k)] * y[k]) }
    };
    rbfs.par_iter().flat_map_iter(|to| rbfs.iter().map(move |from| lobe(to, from))).collect()
}

/// G = K̂ J of order 4: G_l,k = Σ_h K̂_lh [(1 − a_k) J_h,k + 4π a_k y_k(d) Σ_j a_j y_j(d) J_h,j].
///
/// The RBF is taken as bright as its lobe sees it, and its light arrives spread over that lobe; what is left of a wide
/// lobe keeps its own directions.
pub fn gather(pairs: &[f64], lobes: &[Lobe], source: &[ShRgb]) -> Vec<ShRgb> {
    let n = source.len();
    (0..n)
        .into_par_iter()
        .map(|l| {
            let row = l * n..(l + 1) * n;
            let mut sum = ShRgb::default();
            for ((&share, lobe), source) in pairs[row.clone()].iter().zip(&lobes[row]).zip(source) {
                let seen: DVec3 = lobe.along.iter().zip(source.0).map(|(&along, j)| along * j).sum();
                for (k, sum) in sum.0.iter_mut().enumerate() {
                    *sum += share * ((1.0 - lobe.bands[band(k)]) * source.0[k] + 4.0 * PI * lobe.along[k] * seen);
                }
            }
            sum
        })
        .collect()
}

/// G = K̂ J of sources that are the same in all directions, as where the phase function is: band 0 of [`gather`]. The
/// others, which such a phase function does not see, are left out.
pub fn gather_isotropic(pairs: &[f64], source: &[ShRgb]) -> Vec<ShRgb> {
    let row = |row: &[f64]| {
        let mut sum = ShRgb::default();
        sum.0[0] = row.iter().zip(source).map(|(&share, source)| share * source.0[0]).sum();
        sum
    };
    // Chunks of no length would be an error; there are no rows then.
    pairs.par_chunks(source.len().max(1)).map(row).collect()
}

#[cfg(test)]
mod tests;
