//! A homogeneous sphere under constant light: where diffusion equations can be told right from wrong.
//!
//! The sphere has radius 1, so that extinction is its optical radius; light of radiance 1 comes from everywhere. All is
//! a function of the distance r to the centre. [`diffusion`] solves the printed (Zhou et al. 2008, Eq. 5) or the
//! corrected equation in shells, [`monte_carlo`] traces paths through the same shells.

use core::f64::consts::PI;

use glam::DVec3;
use rayon::prelude::*;

use super::path::{Rng, scatter};

/// What fills the sphere.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sphere {
    /// σ_t: extinction per radius, above 0.
    pub extinction: f64,
    /// Ω, 0 to 1; above 0 for the printed equation.
    pub albedo: f64,
    /// Mean cosine of the Henyey–Greenstein phase function.
    pub g: f64,
}

/// The source of the diffusion equation −∇·(κ∇L⁰) + σ_a L⁰ = S, with κ = 1/(3σ_tr).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Equation {
    /// As printed by Zhou et al.: S = σ_t/Ω J⁰ − σ_t/σ_tr ∇·J¹.
    Printed,
    /// From the moments of the transport equation: S = σ_t J⁰ − σ_t/(3σ_tr) ∇·J¹.
    Corrected,
}

impl Sphere {
    /// σ_tr = (1 − Ωg) σ_t.
    fn transport(&self) -> f64 {
        (1.0 - self.albedo * self.g) * self.extinction
    }

    /// Single scattering at the distance `r` ≤ 1: its mean J⁰ and the outward part of J¹, of travelling light.
    pub fn source(&self, r: f64) -> (f64, f64) {
        let (mut mean, mut first) = (0.0, 0.0);
        // Midpoints of the cosine between r and where light comes from. Near the surface the light has a kink at the
        // horizon, which costs second order: 1e-6.
        const STEPS: u32 = 1000;
        for i in 0..STEPS {
            let mu = (2.0 * f64::from(i) + 1.0) / f64::from(STEPS) - 1.0;
            let chord = (1.0 - r * r * (1.0 - mu * mu)).max(0.0).sqrt() - r * mu;
            let light = (-self.extinction * chord).exp() / f64::from(STEPS);
            mean += light;
            // Light from mu travels along −mu.
            first -= 3.0 * light * mu;
        }
        (self.albedo * mean, self.albedo * self.g * first)
    }
}

/// Thinner shells within each of [`diffusion`]'s.
const REFINEMENT: usize = 16;

/// L⁰, the mean media radiance in `shells` shells of equal thickness, by finite volumes in shells 16 times thinner.
///
/// At the surface no media radiance enters (Marshak): L⁰ + 2κ ∂L⁰/∂r = 2κ σ_t J¹.
pub fn diffusion(sphere: &Sphere, equation: Equation, shells: usize) -> Vec<f64> {
    let (mean_factor, first_factor) = match equation {
        Equation::Printed => (1.0 / sphere.albedo, sphere.extinction / sphere.transport()),
        Equation::Corrected => (1.0, sphere.extinction / (3.0 * sphere.transport())),
    };
    let source = |r: f64| {
        let (mean, first) = sphere.source(r);
        (mean_factor * sphere.extinction * mean, first_factor * first)
    };
    // 2κ σ_t J¹ at the surface.
    let inflow = 2.0 * sphere.extinction / (3.0 * sphere.transport()) * sphere.source(1.0).1;
    let fine = solve(sphere, source, inflow, REFINEMENT * shells);
    let average = |shell: usize| {
        let range = REFINEMENT * shell..REFINEMENT * (shell + 1);
        range.clone().map(|i| volume(i) * fine[i]).sum::<f64>() / range.map(volume).sum::<f64>()
    };
    (0..shells).map(average).collect()
}

/// The volume of shell `i`, to a constant factor.
fn volume(i: usize) -> f64 {
    ((i + 1).pow(3) - i.pow(3)) as f64
}

/// [`diffusion`] of the source s − ∇·q, where `source` returns s and the outward part of q, and the boundary
/// L⁰ + 2κ ∂L⁰/∂r = `inflow`.
fn solve(sphere: &Sphere, source: impl Fn(f64) -> (f64, f64), inflow: f64, shells: usize) -> Vec<f64> {
    let kappa = 1.0 / (3.0 * sphere.transport());
    let absorption = (1.0 - sphere.albedo) * sphere.extinction;
    let step = 1.0 / shells as f64;
    let [mut below, mut diagonal, mut above, mut rhs] = [(); 4].map(|()| vec![0.0; shells]);
    for i in 0..shells {
        let (inner, outer) = (i as f64 * step, (i + 1) as f64 * step);
        let volume = (outer.powi(3) - inner.powi(3)) / 3.0;
        diagonal[i] += absorption * volume;
        rhs[i] += source(inner + 0.5 * step).0 * volume;
        // The flux through the outer face, r² (−κ ∂L⁰/∂r + q), leaves this shell for the next.
        let (area, q) = (outer * outer, source(outer).1);
        rhs[i] -= area * q;
        if i + 1 < shells {
            let conductance = area * kappa / step;
            diagonal[i] += conductance;
            above[i] -= conductance;
            diagonal[i + 1] += conductance;
            below[i + 1] -= conductance;
            rhs[i + 1] += area * q;
        } else {
            // Half a shell to the surface, where L⁰ = inflow − 2κ ∂L⁰/∂r.
            let conductance = area * kappa / (0.5 * step + 2.0 * kappa);
            diagonal[i] += conductance;
            rhs[i] += conductance * inflow;
        }
    }
    // Thomas's elimination of the tridiagonal system.
    for i in 1..shells {
        let factor = below[i] / diagonal[i - 1];
        diagonal[i] -= factor * above[i - 1];
        rhs[i] -= factor * rhs[i - 1];
    }
    for i in (0..shells).rev() {
        let next = if i + 1 < shells { above[i] * rhs[i + 1] } else { 0.0 };
        rhs[i] = (rhs[i] - next) / diagonal[i];
    }
    rhs
}

/// The same mean media radiance from `paths` random paths: free of approximation, with noise.
pub fn monte_carlo(sphere: &Sphere, shells: usize, paths: usize, seed: u64) -> Vec<f64> {
    const STREAMS: usize = 64;
    let streams: Vec<Vec<f64>> = (0..STREAMS)
        .into_par_iter()
        .map(|stream| {
            let mut rng = Rng::new(seed, stream as u64);
            let mut tally = vec![0.0; shells];
            for _ in stream * paths / STREAMS..(stream + 1) * paths / STREAMS {
                follow(sphere, &mut rng, &mut tally);
            }
            tally
        })
        .collect();
    // Power π · 4π enters; every collision stands for 1/σ_t of path, and fluence is path per volume, 4π L⁰.
    let scale = 4.0 * PI * PI / (paths as f64 * sphere.extinction * 4.0 * PI);
    let unit = 4.0 / 3.0 * PI / (shells as f64).powi(3);
    (0..shells).map(|i| streams.iter().map(|tally| tally[i]).sum::<f64>() * scale / (unit * volume(i))).collect()
}

/// One path from the surface in; counts its collisions from the second on in the shells where they are.
fn follow(sphere: &Sphere, rng: &mut Rng, tally: &mut [f64]) {
    // From a surface point that is as good as any other, cosine-distributed inwards.
    let mut x = DVec3::Z;
    let (sin, angle) = (rng.uniform().sqrt(), 2.0 * PI * rng.uniform());
    let mut dir = DVec3::new(sin * angle.cos(), sin * angle.sin(), -(1.0 - sin * sin).sqrt());
    let mut scattered = false;
    loop {
        x += dir * (rng.exponential() / sphere.extinction);
        let r = x.length();
        if r >= 1.0 {
            return;
        }
        if scattered {
            let shell = (r * tally.len() as f64) as usize;
            tally[shell.min(tally.len() - 1)] += 1.0;
        }
        if rng.uniform() >= sphere.albedo {
            return;
        }
        dir = scatter(dir, sphere.g, rng);
        scattered = true;
    }
}

/// How far a solution is from the true one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Comparison {
    /// Light in the whole sphere over the true amount: 1 is right on average.
    pub mean_ratio: f64,
    /// Root mean square difference over root mean square truth, by volume.
    pub error: f64,
}

/// Compares the mean radiance of shells of equal thickness.
pub fn compare(found: &[f64], truth: &[f64]) -> Comparison {
    let integrate = |f: &dyn Fn(f64, f64) -> f64| -> f64 {
        found.iter().zip(truth).enumerate().map(|(i, (&found, &truth))| volume(i) * f(found, truth)).sum()
    };
    Comparison {
        mean_ratio: integrate(&|found, _| found) / integrate(&|_, truth| truth),
        error: (integrate(&|found, truth| (found - truth).powi(2)) / integrate(&|_, truth| truth * truth)).sqrt(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SPHERE: Sphere = Sphere { extinction: 5.0, albedo: 0.8, g: 0.4 };

    #[test]
    fn single_scattering_has_closed_forms() {
        // In the centre every chord is 1; at the surface, half the sky is clear and the chord of the rest is −2μ:
        // ½ (1 + (1 − e^{−2σ})/2σ), and for J¹ −3/2 (½ + ∫_{−1}^0 e^{2σμ} μ dμ).
        let (mean, first) = SPHERE.source(0.0);
        assert!((mean - 0.8 * (-5f64).exp()).abs() < 1e-14 && first.abs() < 1e-14);
        let (mean, first) = SPHERE.source(1.0);
        let k = 10.0f64;
        assert!((mean - 0.8 * 0.5 * (1.0 + (1.0 - (-k).exp()) / k)).abs() < 1e-5);
        let moment = -(1.0 - (1.0 + k) * (-k).exp()) / (k * k);
        assert!((first + 0.8 * 0.4 * 1.5 * (0.5 + moment)).abs() < 1e-5);
    }

    #[test]
    fn a_constant_source_has_a_closed_form() {
        // s/σ_a (1 − A sinh(k r)/r) with k² = σ_a/κ, and A from L⁰ + 2κ ∂L⁰/∂r = inflow at 1.
        let (kappa, absorption) = (1.0 / (3.0 * SPHERE.transport()), 1.0);
        let k = f64::sqrt(absorption / kappa);
        let (s, inflow) = (0.7, 0.2);
        let a = (1.0 - inflow * absorption / s) / (k.sinh() + 2.0 * kappa * (k * k.cosh() - k.sinh()));
        let error = |shells: usize| {
            let found = solve(&SPHERE, |_| (s, 0.0), inflow, shells);
            let exact = |i: usize| {
                let r = (i as f64 + 0.5) / shells as f64;
                s / absorption * (1.0 - a * (k * r).sinh() / r)
            };
            (0..shells).map(|i| (found[i] - exact(i)).abs()).fold(0.0, f64::max)
        };
        // Second order, from (k/32)² = 1e-2 in the thin outer layer on.
        let (coarse, fine) = (error(32), error(64));
        assert!(fine < 1e-3 && coarse / fine > 3.5, "{coarse} {fine}");
    }

    #[test]
    fn flux_and_source_are_the_same_up_to_the_divergence() {
        // q = r/3 outwards has the divergence 1: with s one larger, and the flux at the surface put into the boundary,
        // L⁰ is as without.
        let with = solve(&SPHERE, |r| (1.5, r / 3.0), 0.1, 64);
        let without = solve(&SPHERE, |_| (0.5, 0.0), 0.1, 64);
        for (a, b) in with.iter().zip(&without) {
            assert!((a - b).abs() < 1e-12, "{a} {b}");
        }
    }

    #[test]
    fn paths_return_the_light_of_a_white_sphere() {
        // Without absorption the radiance is 1 everywhere: what is not direct is media radiance. Fluence of 20,000 paths
        // in 4 shells: 2 % in the innermost, of which 1/64 of the volume.
        let sphere = Sphere { albedo: 1.0, extinction: 3.0, ..SPHERE };
        let found = monte_carlo(&sphere, 4, 40_000, 1);
        for (i, found) in found.iter().enumerate() {
            // The direct light at the middle radius of the shell's volume.
            let r = ((((i + 1).pow(3) + i.pow(3)) as f64) / 128.0).cbrt();
            let expected = 1.0 - sphere.source(r).0;
            assert!((found / expected - 1.0).abs() < 0.06, "{i}: {found} {expected}");
        }
    }

    #[test]
    fn corrected_equations_agree_with_paths_and_printed_ones_do_not() {
        for (albedo, g, printed_ratio) in [(0.66, 0.0, 1.5), (0.66, 0.6, 3.0)] {
            let sphere = Sphere { extinction: 8.0, albedo, g };
            let truth = monte_carlo(&sphere, 8, 60_000, 2);
            let [printed, corrected] = [Equation::Printed, Equation::Corrected]
                .map(|equation| compare(&diffusion(&sphere, equation, 8), &truth).mean_ratio);
            // Diffusion itself is off by 2 %, the paths by 1 %.
            assert!((corrected - 1.0).abs() < 0.05, "{corrected}");
            assert!((printed / printed_ratio - 1.0).abs() < 0.15, "{printed}");
        }
    }
}
