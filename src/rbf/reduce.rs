//! Fewer Gaussians for the same smoke: the level of detail that light is computed at.

use glam::Vec3;

use super::Rbf;

/// Times that Gaussians are shared out anew among those that are kept.
const ROUNDS: usize = 2;

/// How much nearer ones are preferred to share a Gaussian's mass: the exponent of their likelihoods. The larger the less those
/// that are kept run into each other; so large that mass still passes from one to the other smoothly. By measurement.
const SHARPNESS: f32 = 2.0;

/// Logarithm of a likelihood that is as good as certain over one as good as none.
const NOTHING: f32 = 16.0;

/// The share of those kept that fade in: see [`reduced`].
const FADING: f32 = 0.5;

/// How early what fades in gives way to its neighbours: [`Kept::reluctance`] where it is half there.
const HALF_THERE: f32 = 3.0;

/// At most `limit` Gaussians that stand for all: those of the largest masses w r³, each with its share of the mass that is
/// left out, its centre and radius such that first and second moments are kept (the reduction of a mixture of Gaussians;
/// Vasconcelos and Lippman 1998). In the order of the list; all as they are where there are no more than `limit`.
///
/// Continuous in the list, so that nothing pops as time goes on: the lighter one of those kept is, down to the heaviest of
/// those left out, the less it counts, and none at all there. What changes places across the limit, comes or goes counts
/// nothing at that moment.
pub fn reduced(rbfs: &[Rbf], limit: usize) -> Vec<Rbf> {
    if rbfs.len() <= limit {
        return rbfs.to_vec();
    }
    let masses: Vec<f32> = rbfs.iter().map(mass).collect();
    let mut heaviest: Vec<usize> = (0..rbfs.len()).collect();
    heaviest.sort_unstable_by(|&a, &b| masses[b].total_cmp(&masses[a]).then(a.cmp(&b)));
    let cut = masses[heaviest[limit]];
    let whole = masses[heaviest[((1.0 - FADING) * limit as f32) as usize]];
    let reluctance = |mass: f32| {
        // Where all are as heavy, any will do.
        let presence = if whole == cut { 1.0 } else { ((mass - cut) / (whole - cut)).clamp(1e-6, 1.0) };
        HALF_THERE * (1.0 / presence - 1.0)
    };
    let widen = (rbfs.len() as f32 / limit.max(1) as f32).cbrt();
    heaviest.truncate(limit);
    heaviest.sort_unstable();
    let mut kept: Vec<Kept> = heaviest
        .into_iter()
        .map(|i| Kept {
            reluctance: reluctance(masses[i]),
            center: rbfs[i].center.into(),
            square: (rbfs[i].radius * widen).powi(2),
            mass: masses[i],
        })
        .collect();
    for _ in 0..ROUNDS {
        kept = share_out(rbfs, &masses, &kept);
    }
    kept.iter()
        .map(|kept| {
            let radius = kept.square.sqrt();
            Rbf { center: kept.center.into(), radius, weight: kept.mass / radius.powi(3) }
        })
        .collect()
}

/// The integral of a Gaussian, without the factor that all have.
fn mass(rbf: &Rbf) -> f32 {
    rbf.weight * rbf.radius.powi(3)
}

/// A Gaussian that is kept.
#[derive(Clone, Copy)]
struct Kept {
    /// What is taken off the logarithms of its likelihoods: 0 of those wholly there, without end of those that are not.
    reluctance: f32,
    center: Vec3,
    /// Of the radius.
    square: f32,
    mass: f32,
}

/// Gives every Gaussian's mass to those that are kept near it, and these the moments of what they have been given.
fn share_out(rbfs: &[Rbf], masses: &[f32], kept: &[Kept]) -> Vec<Kept> {
    let mut given = vec![(0.0_f32, Vec3::ZERO, 0.0_f32); kept.len()];
    let mut logs = vec![0.0_f32; kept.len()];
    for (rbf, mass) in rbfs.iter().zip(masses) {
        let center = Vec3::from(rbf.center);
        let mut largest = f32::MIN;
        for (log, kept) in logs.iter_mut().zip(kept) {
            let distance2 = center.distance_squared(kept.center) + 1.5 * rbf.radius * rbf.radius;
            *log = -SHARPNESS * (distance2 / kept.square + 1.5 * kept.square.ln()) - kept.reluctance;
            largest = largest.max(*log);
        }
        let mut total = 0.0;
        for log in &mut logs {
            // The exponentials are what takes time; most are next to nothing.
            *log = if *log > largest - NOTHING { (*log - largest).exp() } else { 0.0 };
            total += *log;
        }
        for ((share, given), kept) in logs.iter().zip(&mut given).zip(kept) {
            let part = mass * share / total;
            let offset = center - kept.center;
            given.0 += part;
            given.1 += part * offset;
            given.2 += part * (offset.length_squared() + 1.5 * rbf.radius * rbf.radius);
        }
    }
    kept.iter()
        .zip(given)
        .map(|(kept, (mass, moment, square))| {
            if mass <= 0.0 {
                return Kept { mass: 0.0, ..*kept };
            }
            let shift = moment / mass;
            // The variance along an axis is r² / 2.
            let square = (square / mass - shift.length_squared()) / 1.5;
            Kept { center: kept.center + shift, square, mass, ..*kept }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Gaussians along a helix, of various sizes.
    fn helix(count: usize) -> Vec<Rbf> {
        let gaussian = |i: usize| {
            let t = i as f32 / count as f32;
            let (sin, cos) = (40.0 * t).sin_cos();
            let weight = 0.2 + 0.8 * (i * 7919 % 101) as f32 / 101.0;
            Rbf { center: [0.3 * cos, t - 0.5, 0.3 * sin], radius: 0.02 + 0.03 * (i * 31 % 17) as f32 / 17.0, weight }
        };
        (0..count).map(gaussian).collect()
    }

    fn moments(rbfs: &[Rbf]) -> (f32, Vec3, f32) {
        let (mut sum, mut first, mut second) = (0.0, Vec3::ZERO, 0.0);
        for rbf in rbfs {
            let (mass, center) = (mass(rbf), Vec3::from(rbf.center));
            sum += mass;
            first += mass * center;
            second += mass * (center.length_squared() + 1.5 * rbf.radius * rbf.radius);
        }
        (sum, first, second)
    }

    #[test]
    fn few_stay_as_they_are() {
        let all = helix(50);
        assert_eq!(reduced(&all, 50), all);
        assert_eq!(reduced(&all, usize::MAX), all);
        assert!(reduced(&[], 1).is_empty());
    }

    #[test]
    fn moments_are_kept() {
        let all = helix(300);
        let (sum, first, second) = moments(&all);
        for limit in [1, 2, 10, 100, 299] {
            let few = reduced(&all, limit);
            assert!(few.len() <= limit && few.iter().all(|rbf| rbf.radius > 0.0 && rbf.weight >= 0.0));
            let found = moments(&few);
            assert!((found.0 / sum - 1.0).abs() < 1e-4, "{limit}: {found:?} for {sum}");
            assert!((found.1 - first).length() < 1e-4 * sum && (found.2 / second - 1.0).abs() < 1e-4);
        }
    }

    #[test]
    fn of_equal_ones_some_are_kept() {
        let all = vec![Rbf { center: [0.0; 3], radius: 0.1, weight: 1.0 }; 9];
        let few = reduced(&all, 3);
        assert_eq!(few.len(), 3);
        assert!(few.iter().all(|rbf| rbf.radius.is_finite() && rbf.weight.is_finite()));
        assert!((moments(&few).0 / moments(&all).0 - 1.0).abs() < 1e-4);
    }

    #[test]
    fn nothing_pops_as_ranks_change() {
        // One grows from nothing to the heaviest: the density nowhere jumps.
        let mut all = helix(120);
        all[60].radius = 0.05;
        let density = |weight: f32| {
            let mut all = all.clone();
            all[60].weight = weight;
            let few = reduced(&all, 30);
            let probe = |i: usize| Vec3::from(all[i].center) * 0.9;
            let at = |x: Vec3| few.iter().map(|rbf| rbf.weight * rbf.basis(x)).sum::<f32>();
            (0..120).map(|i| at(probe(i))).collect::<Vec<_>>()
        };
        let largest = density(0.5).iter().copied().fold(0.0, f32::max);
        // The most that a step changes, of so many.
        let most = |steps: u32| {
            let at = |step: u32| density(2.0 * step as f32 / steps as f32);
            let change = |(now, before): (&f32, &f32)| (now - before).abs();
            let changes = |step| at(step).iter().zip(&at(step - 1)).map(change).fold(0.0, f32::max);
            (1..=steps).map(changes).fold(0.0, f32::max) / largest
        };
        // Shares pass from one to the other fast, while its weight grows from 0.34 to 0.4; but a jump would stay as high
        // however small the steps.
        let (coarse, fine) = (most(500), most(4000));
        println!("most that changes a step, of the largest: {coarse:.4} of 500, {fine:.4} of 4000");
        assert!(fine < 0.1 && fine < 0.4 * coarse, "{coarse} {fine}");
    }
}
