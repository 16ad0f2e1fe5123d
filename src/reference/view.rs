//! View: a camera ray marched through the volume.

use glam::DVec3;

use super::{Ray, cell_size, half_extent, lamp::Cone, volume::Volume};
use crate::{density::GridShape, optics::henyey_greenstein};

/// Media radiance without background, and transmittance, along `ray`.
pub fn march(volume: &Volume, ray: &Ray, sigma: f64) -> (DVec3, f64) {
    march_with(volume.shape, ray, sigma, |x| volume.sample(x))
}

/// [`march`] through any source radiance and density, given as a function of the point, within the box of `shape`.
///
/// Steps are equal and at most half a cell; each emits J(1−e^{−σDΔ}) of the values in its middle.
pub fn march_with(shape: GridShape, ray: &Ray, sigma: f64, sample: impl Fn(DVec3) -> (DVec3, f64)) -> (DVec3, f64) {
    let (mut radiance, mut transmittance) = (DVec3::ZERO, 1.0);
    let Some((start, end)) = ray.clip(half_extent(shape)) else {
        return (radiance, transmittance);
    };
    let steps = ((end - start) / (0.5 * cell_size(shape))).ceil();
    let step = (end - start) / steps;
    for i in 0..steps as usize {
        let (source, density) = sample(ray.at(start + (i as f64 + 0.5) * step));
        let absorbed = 1.0 - (-sigma * density * step).exp();
        radiance += transmittance * absorbed * source;
        transmittance *= 1.0 - absorbed;
    }
    (radiance, transmittance)
}

/// A lamp in or near the smoke as the view pass draws it: the light that cells cannot hold.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Glow {
    /// Where it is.
    pub position: DVec3,
    /// RGB intensity times albedo.
    pub color: DVec3,
    /// Where it shines.
    pub cone: Cone,
    /// What is added to its squared distance in the volume.
    pub softening: f64,
    /// Mean cosine of the phase function.
    pub g: f64,
}

/// How far apart the rays of neighbouring pixels are, along a pixel's diagonal.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Footprint {
    /// Where they start: 0 under a perspective.
    pub width: f64,
    /// Growth per distance: 0 of parallel rays.
    pub spread: f64,
}

/// [`march`] with the glow of lamps, each where the ray is nearest to it.
pub fn march_with_glows(volume: &Volume, ray: &Ray, sigma: f64, glows: &[Glow], footprint: Footprint) -> (DVec3, f64) {
    let (mut radiance, transmittance) = march(volume, ray, sigma);
    let Some((start, end)) = ray.clip(half_extent(volume.shape)) else {
        return (radiance, transmittance);
    };
    let steps = ((end - start) / (0.5 * cell_size(volume.shape))).ceil();
    let step = (end - start) / steps;
    for glow in glows {
        let nearest = (glow.position - ray.origin).dot(ray.dir).clamp(start, end);
        // As much as is left at the beginning of the step in which it is.
        let before = ((nearest - start) / step).floor().min(steps - 1.0) as usize;
        let sample = |i: usize| volume.sample(ray.at(start + (i as f64 + 0.5) * step)).1;
        let depth: f64 = (0..before).map(sample).sum::<f64>() * sigma * step;
        let extinction = sigma * volume.sample(ray.at(nearest)).1;
        radiance += glow_along(glow, ray, (start, end), extinction, footprint) * (-depth).exp();
    }
    (radiance, transmittance)
}

/// A glow between two distances along a ray, where smoke about the nearest point has one extinction σ D and dims the
/// light of the lamp over the distance b to that point:
///
/// Ω I σ D e^{−σ D b} · share of the cone · [`near_light`].
fn glow_along(glow: &Glow, ray: &Ray, (start, end): (f64, f64), extinction: f64, footprint: Footprint) -> DVec3 {
    let offset = glow.position - ray.origin;
    let middle = offset.dot(ray.dir);
    // Averaged over a square pixel of side w, 1/b is 3.53/w where the lamp is in its middle: as if b were 0.28 w, a fifth
    // of the diagonal.
    let blur = 0.2 * (footprint.width + footprint.spread * middle.max(0.0));
    let b = ((offset.length_squared() - middle * middle).max(0.0) + (blur * blur).max(1e-12)).sqrt();
    let toward = (ray.at(middle.clamp(start, end)) - glow.position).normalize_or_zero();
    let share = glow.cone.share(toward);
    let near = near_light(b, start - middle, end - middle, glow.softening, glow.g);
    glow.color * (near * share * extinction * (-extinction * b).exp())
}

/// Steps in which a glow is integrated.
const GLOW_STEPS: usize = 12;

/// What softening leaves out of a lamp's light along a ray that passes it at the distance `b`:
///
/// ∫ p (1/d² − 1/(d² + softening)) dt,   d² = b² + t²,
///
/// between `start` and `end`, measured from where the ray is nearest. In 12 steps of the angle α at the lamp, t = b tan α,
/// each with the phase function in its middle, cos θ = −sin α, and the rest in closed form: with B² = b² + softening,
/// α/b − atan(t/B)/B.
pub fn near_light(b: f64, start: f64, end: f64, softening: f64, g: f64) -> f64 {
    let wide = (b * b + softening).sqrt();
    let (from, to) = ((start / b).atan(), (end / b).atan());
    let angle = |i: f64| from + (to - from) * i / GLOW_STEPS as f64;
    let left_out = |angle: f64| angle / b - (b * angle.tan() / wide).atan() / wide;
    let step = |i: usize| {
        let i = i as f64;
        let phase = henyey_greenstein(-angle(i + 0.5).sin(), g);
        phase * (left_out(angle(i + 1.0)) - left_out(angle(i)))
    };
    (0..GLOW_STEPS).map(step).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::UVec3;

    const SHAPE: GridShape = GridShape::new(UVec3::new(32, 20, 24));
    const J: DVec3 = DVec3::new(3.0, 2.0, 1.0);

    fn slab(ray: &Ray) -> (DVec3, f64) {
        march_with(SHAPE, ray, 4.0, |_| (J, 0.75))
    }

    fn assert_slab(ray: Ray, length: f64) {
        // However it is stepped, a homogeneous medium gives the closed form: J(1 − e^{−σDl}).
        let (radiance, transmittance) = slab(&ray);
        assert!((transmittance - (-3.0 * length).exp()).abs() < 1e-13, "{transmittance}");
        assert!((radiance - J * (1.0 - (-3.0 * length).exp())).length() < 1e-13);
    }

    #[test]
    fn homogeneous_slab() {
        let ray = Ray::new(DVec3::new(-2.0, 0.1, 0.1), DVec3::X);
        assert_slab(ray, 1.0);
        // Slanted through the y faces, 20/32 apart, 0.8 of the way per unit.
        assert_slab(Ray::new(DVec3::new(-0.75, -1.0, 0.0), DVec3::new(0.6, 0.8, 0.0)), 0.625 / 0.8);
        // From inside, and past the box.
        assert_slab(Ray::new(DVec3::new(0.2, 0.0, 0.0), DVec3::X), 0.3);
        assert_slab(Ray::new(DVec3::new(0.6, 0.0, 0.0), DVec3::X), 0.0);
        assert_slab(Ray::new(DVec3::new(-2.0, 0.4, 0.1), DVec3::X), 0.0);
        // Up to an opaque surface within, before and behind.
        assert_slab(Ray { t_max: 1.9, ..ray }, 0.4);
        assert_slab(Ray { t_max: 1.0, ..ray }, 0.0);
        assert_slab(Ray { t_max: 9.0, ..ray }, 1.0);
    }

    #[test]
    fn steps_are_half_a_cell_at_most() {
        let count = core::cell::Cell::new(0);
        let ray = Ray::new(DVec3::new(0.2, 0.0, 0.0), DVec3::X);
        march_with(SHAPE, &ray, 1.0, |x| {
            // 0.3 / (1/64) = 19.2: twenty steps of 0.015.
            let expected = 0.2 + (f64::from(count.get()) + 0.5) * 0.015;
            assert!((x.x - expected).abs() < 1e-12);
            count.set(count.get() + 1);
            (DVec3::ZERO, 0.0)
        });
        assert_eq!(count.get(), 20);
    }

    #[test]
    fn a_ramp_of_radiance_converges_to_its_integral() {
        // ∫ σ D e^{−σDt} t dt over 0..1 with σD = 3: 1/3 − e⁻³(1 + 1/3). 64 steps: second order, (1/64)² / 12 · 3.
        let ray = Ray::new(DVec3::X * -2.0, DVec3::X);
        let (radiance, _) = march_with(SHAPE, &ray, 3.0, |x| (DVec3::splat(x.x + 0.5), 1.0));
        let expected = 1.0 / 3.0 - (-3f64).exp() * (4.0 / 3.0);
        assert!((radiance.x - expected).abs() < 1e-4, "{radiance} {expected}");
    }

    #[test]
    fn a_grid_fades_out_over_its_last_half_cell() {
        let padded = GridShape::new(SHAPE.dims + 2);
        let density = (0..padded.len())
            .map(|i| {
                let cell = padded.cell(i);
                f64::from(cell.cmpge(UVec3::ONE).all() && cell.cmple(SHAPE.dims).all())
            })
            .collect();
        let volume = Volume { shape: SHAPE, radiance: vec![J; padded.len()], density };
        // Through cell centres along x: 31 cells between the outermost centres, and at each end half a cell falling
        // from 1 to 1/2: 31.75 of 32. Along y 19.75 of 20, in units of 1/32.
        for (ray, cells) in [
            (Ray::new(DVec3::new(-2.0, 1.0 / 64.0, 1.0 / 64.0), DVec3::X), 31.75),
            (Ray::new(DVec3::new(1.0 / 64.0, 3.0, 1.0 / 64.0), -DVec3::Y), 19.75),
        ] {
            let (radiance, transmittance) = march(&volume, &ray, 2.0);
            let expected = (-2.0 * cells / 32.0f64).exp();
            // Midpoints are exact on straight pieces, if the steps meet the kinks: 64 or 65 steps (rounding) leave
            // 1e-4.
            assert!((transmittance - expected).abs() < 1e-4, "{transmittance} {expected}");
            assert!((radiance - J * (1.0 - transmittance)).length() < 1e-13);
        }
    }

    /// ∫ p/d^2 dt along a ray that passes at `b`, by 20,000 steps of the angle; what the volume's softened light gives of
    /// it, likewise.
    fn along(b: f64, start: f64, end: f64, softening: f64, g: f64) -> f64 {
        let (n, start, end) = (20_000, (start / b).atan(), (end / b).atan());
        let step = (end - start) / f64::from(n);
        let value = |i: i32| {
            let angle = start + (f64::from(i) + 0.5) * step;
            let (t, slope) = (b * angle.tan(), b / angle.cos().powi(2));
            henyey_greenstein(-angle.sin(), g) / (b * b + t * t + softening) * slope
        };
        (0..n).map(value).sum::<f64>() * step
    }

    #[test]
    fn a_glow_is_what_softening_leaves_out() {
        let softening = 0.03f64.powi(2);
        let mut worst = 0.0f64;
        for (start, end) in [(-0.7, 0.5), (-0.1, 0.02), (0.01, 0.4), (-0.4, -0.01)] {
            for b in [1e-4, 1e-3, 0.01, 0.03, 0.1, 0.3] {
                // Isotropic: ∫ dt/(b² + t²) is the angle under which the lamp sees the ray, over b.
                let angle = f64::atan(end / b) - f64::atan(start / b);
                let exact = angle / b / (4.0 * core::f64::consts::PI);
                assert!((along(b, start, end, 0.0, 0.0) / exact - 1.0).abs() < 1e-8);
                for g in [0.0, 0.6, -0.4] {
                    let exact = along(b, start, end, 0.0, g);
                    let found = near_light(b, start, end, softening, g) + along(b, start, end, softening, g);
                    let error = (found / exact - 1.0).abs();
                    println!("b {b}, {start} to {end}, g {g}: {error:.1e}");
                    worst = worst.max(error);
                }
            }
        }
        println!("worst {worst:.1e}");
        // Exact where light scatters evenly. Forward it is 6e-3 off where b is a thirtieth of the softened distance, and
        // the phase function changes most where the lamp is nearly in line: of 12 steps, in the outermost.
        assert!(worst < 0.01, "{worst}");
    }

    #[test]
    fn a_glow_in_homogeneous_smoke_is_dimmed_on_both_ways() {
        let padded = GridShape::new(SHAPE.dims + 2);
        let volume =
            Volume { shape: SHAPE, radiance: vec![DVec3::ZERO; padded.len()], density: vec![0.5; padded.len()] };
        let (sigma, softening) = (3.0, 0.02f64.powi(2));
        let glow = Glow { position: DVec3::new(0.1, 0.02, 0.0), color: J, cone: Cone::EVERYWHERE, softening, g: 0.3 };
        let ray = Ray::new(DVec3::new(-2.0, 0.0, 0.0), DVec3::X);
        let (found, transmittance) = march_with_glows(&volume, &ray, sigma, &[glow, glow], Footprint::default());
        assert!((transmittance - (-1.5f64).exp()).abs() < 1e-12);
        // Steps of 1/64: 0.6 along the ray is in the 39th, of which 38 are before. b² is at least 1e-12: 3e-9.
        let expected =
            2.0 * J * near_light(0.02, -0.6, 0.4, softening, 0.3) * 1.5 * (-1.5f64 * (0.02 + 38.0 / 64.0)).exp();
        assert!((found / expected - 1.0).abs().max_element() < 1e-8, "{found} for {expected}");
        // A spot that shines away from the ray leaves it dark, and one toward it does not change it.
        let spot = |axis| Glow { cone: Cone { axis, scale: 1.0, offset: 0.0 }, ..glow };
        assert_eq!(march_with_glows(&volume, &ray, sigma, &[spot(DVec3::Y)], Footprint::default()).0, DVec3::ZERO);
        assert!(
            (march_with_glows(&volume, &ray, sigma, &[spot(DVec3::NEG_Y)], Footprint::default()).0 * 2.0 - found)
                .length()
                < 1e-12
        );
        // A surface before the lamp hides what is behind, not what is before.
        let (cut, _) =
            march_with_glows(&volume, &Ray { t_max: 2.1, ..ray }, sigma, &[glow, glow], Footprint::default());
        assert!(cut.x > 0.4 * found.x && cut.x < 0.8 * found.x, "{cut} {found}");
    }

    #[test]
    fn a_pixel_that_holds_the_lamp_has_the_mean_of_one_over_b() {
        // Over a square pixel of side w, the mean of 1/b around its middle is 4 ln(1 + √2) / w.
        let w = 1e-3;
        let ray = Ray::new(DVec3::ZERO, DVec3::X);
        // So small that all of the light along the ray is near; the footprint is the pixel's diagonal.
        let glow = Glow { position: DVec3::X * 2.0, color: DVec3::ONE, cone: Cone::EVERYWHERE, softening: 1e9, g: 0.0 };
        let found =
            glow_along(&glow, &ray, (0.0, 4.0), 1e-9, Footprint { width: 0.0, spread: 2f64.sqrt() * w }).x / 1e-9;
        let expected = 4.0 * (1.0 + 2f64.sqrt()).ln() / (2.0 * w) / 4.0;
        assert!((found / expected - 1.0).abs() < 0.01, "{found} for {expected}");
    }
}
