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
//! Every row is scaled to sum 1 (K̂) and multiplied by 1 − τ̄, the share of directions that end in smoke. No boundary
//! conditions are needed.
//!
//! Where light is the same all around, white smoke (albedo 1) has that radiance too. It would not if L_m were just
//! (1 − τ̄) G: L_d is brightest from where the smoke is thin, G from where the Gaussians are, and the two do not add up to
//! the same light all around. What is missing for a J of 1 everywhere is known, and is added in proportion to the mean of
//! G (see `scattered_before`). So energy is exact, for any phase function.
//!
//! Everything is a function of the look direction v, which is also the direction ω that light comes from.
//!
//! Forward peaks are taken out of the phase function first: [`DeltaM`].

use core::f64::consts::PI;

use glam::DVec3;
use rayon::prelude::*;

use super::surroundings::Surroundings;
use super::{
    Grid, Medium, PROBES,
    incident_light::{Incident, Lighting, incident_light},
    lamp::{Lamps, with_lamps},
    rbf_center,
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

/// Source radiance of light that scatters once at the probes of every RBF, by the look direction: J_k = Ω g^l L_d,k.
pub fn single_scattering(rbfs: &[Rbf], coarse: &Grid, lighting: &Lighting, medium: &Medium) -> Vec<[ShRgb; PROBES]> {
    let factors = henyey_greenstein_factors(medium.g);
    let incident = incident_light(rbfs, coarse, lighting, DVec3::splat(medium.sigma));
    incident.iter().map(|probes| probes.map(|probe| scatter(&probe.light, medium.albedo, &factors))).collect()
}

/// Source radiance of light that scatters any number of times, for the same next pass. Light of `lamps` is in it once it
/// has scattered before: what they add the first time is [`shine`](super::lamp::shine)'s.
pub fn multiple_scattering(
    rbfs: &[Rbf],
    coarse: &Grid,
    lighting: &Lighting,
    lamps: &Lamps,
    medium: &Medium,
) -> Vec<[ShRgb; PROBES]> {
    let sigma = DeltaM::new(medium).sigma;
    let incident = incident_light(rbfs, coarse, lighting, sigma);
    let pairs = pair_matrix(rbfs, coarse, sigma.element_sum() / 3.0);
    let gathered = scattered_light(
        rbfs,
        &pairs,
        &with_lamps(&incident, rbfs, coarse, lamps, sigma, &Surroundings::default()),
        medium,
    );
    source_radiance(&incident, &gathered, &surroundings(rbfs, &pairs), medium)
}

/// J_k = Ω g^l (L_d,k + L_m,k) at the probes of every RBF, from G ([`scattered_light`]) and H ([`surroundings`]).
pub fn source_radiance(
    incident: &[[Incident; PROBES]],
    gathered: &[ShRgb],
    surroundings: &[Sh<f64>],
    medium: &Medium,
) -> Vec<[ShRgb; PROBES]> {
    source_radiance_of_order(incident, gathered, surroundings, medium, BANDS)
}

/// The same where only so many bands of light that has scattered before are kept.
pub fn source_radiance_of_order(
    incident: &[[Incident; PROBES]],
    gathered: &[ShRgb],
    surroundings: &[Sh<f64>],
    medium: &Medium,
    order: usize,
) -> Vec<[ShRgb; PROBES]> {
    let factors = henyey_greenstein_factors(medium.g);
    let bands = kept([1.0; BANDS], order);
    let rbf = |((probes, gathered), surroundings): ((&[Incident; PROBES], &ShRgb), &Sh<f64>)| {
        let light = |probe: &Incident| probe.light + scattered_before(probe, gathered, surroundings).convolve(&bands);
        probes.map(|probe| scatter(&light(&probe), medium.albedo, &factors))
    };
    incident.iter().zip(gathered).zip(surroundings).map(rbf).collect()
}

/// The factors of the bands that are kept; the others are 0.
fn kept(mut factors: [f64; BANDS], order: usize) -> [f64; BANDS] {
    factors[order..].fill(0.0);
    factors
}

/// Ω g^l L: light, scattered.
fn scatter(light: &ShRgb, albedo: DVec3, factors: &[f64; BANDS]) -> ShRgb {
    Sh(light.convolve(factors).0.map(|c| albedo * c))
}

/// L_m: light that has scattered before and arrives at a point.
///
/// L_m,0 = (1 − τ̄) G_0, and L_m,k = (1 − τ̄) G_k + (−T_k − (1 − e) H_k) G_0/√(4π) with e = T_0/√(4π). The bracket is what
/// would be missing of no light at all (k ≥ 1) between L_d + (1 − τ̄) G where J and the sky are 1 everywhere.
fn scattered_before(incident: &Incident, gathered: &ShRgb, surroundings: &Sh<f64>) -> ShRgb {
    let unit = (4.0 * PI).sqrt();
    let (enclosed, grey) = (1.0 - incident.escape, 1.0 - incident.passing.0[0] / unit);
    let mean = gathered.0[0] / unit;
    Sh(core::array::from_fn(|k| {
        let missing = if k == 0 { 0.0 } else { -incident.passing.0[k] - grey * surroundings.0[k] };
        enclosed * gathered.0[k] + missing * mean
    }))
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

/// H at every RBF: what G is where J is 1 everywhere, H_k = Σ_h K̂_lh 4π a_k y_k(d) but for band 0, which is that of 1.
pub fn surroundings(rbfs: &[Rbf], pairs: &[f64]) -> Vec<Sh<f64>> {
    let lobes = lobes(rbfs);
    // Chunks of no length would be an error; there are no rows then.
    let rows = pairs.chunks(rbfs.len().max(1)).zip(lobes.chunks(rbfs.len().max(1)));
    rows.map(|(pairs, lobes)| {
        let mut sum = Sh::constant(1.0);
        for (share, lobe) in pairs.iter().zip(lobes) {
            for (sum, along) in sum.0.iter_mut().zip(lobe.along).skip(1) {
                *sum += share * 4.0 * PI * along;
            }
        }
        sum
    })
    .collect()
}

/// G at every RBF: the light scattered elsewhere, in the steady state J_k = Ω' g'_l (L̄_d,k + L_m,k), G = K̂ J, with
/// means over the probes (`scattered_before` has L_m).
pub fn scattered_light(rbfs: &[Rbf], pairs: &[f64], incident: &[[Incident; PROBES]], medium: &Medium) -> Vec<ShRgb> {
    scattered_light_of_order(rbfs, pairs, incident, medium, BANDS)
}

/// The same of source radiance of which only so many bands are kept.
pub fn scattered_light_of_order(
    rbfs: &[Rbf],
    pairs: &[f64],
    incident: &[[Incident; PROBES]],
    medium: &Medium,
    order: usize,
) -> Vec<ShRgb> {
    let DeltaM { albedo, factors, .. } = DeltaM::new(medium);
    let factors = kept(factors, order);
    let incident: Vec<Incident> = incident.iter().map(mean).collect();
    let lobes = (medium.g != 0.0).then(|| lobes(rbfs));
    let surroundings = surroundings(rbfs, pairs);
    let mut gathered = vec![ShRgb::default(); rbfs.len()];
    for _ in 0..MAX_SWEEPS {
        let light = |l: usize| incident[l].light + scattered_before(&incident[l], &gathered[l], &surroundings[l]);
        let source: Vec<ShRgb> = (0..rbfs.len()).map(|l| scatter(&light(l), albedo, &factors)).collect();
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

/// The mean of an RBF's probes.
fn mean(probes: &[Incident; PROBES]) -> Incident {
    let share = 1.0 / PROBES as f64;
    let mut mean = Incident::default();
    for probe in probes {
        mean.light = mean.light + probe.light * share;
        mean.escape += probe.escape * share;
        mean.passing = mean.passing + probe.passing * share;
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
