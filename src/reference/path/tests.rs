mod surfaces;

use glam::{UVec3, Vec3};

use super::{tracking::BLOCK, *};
use crate::density::GridShape;
use crate::reference::{cell_size, center, single::single_scattering};
use crate::sh::SphereRule;

const MEDIUM: Medium = Medium { sigma: 6.0, albedo: DVec3::new(0.9, 0.6, 0.3), g: 0.5 };

fn grid(dims: [u32; 3], density: impl Fn(DVec3) -> f64) -> Grid {
    let shape = GridShape::new(UVec3::from(dims));
    Grid { shape, values: (0..shape.len()).map(|i| density(center(shape, shape.cell(i)))).collect() }
}

/// A lopsided blob, well within the box of 20 × 16 × 12 cells: all blocks but some are cut off.
fn blob() -> Grid {
    grid([20, 16, 12], |x| 1.5 * (-(x - DVec3::new(0.1, -0.05, 0.0)).length_squared() / 0.03).exp())
}

fn sky(w: DVec3) -> DVec3 {
    DVec3::new(1.0 + w.y, 1.0, 1.0 - w.x) * (0.7 + 0.5 * w.z)
}

/// Mean and standard error of `n` samples.
fn mean(n: usize, mut sample: impl FnMut(&mut Rng) -> DVec3) -> (DVec3, DVec3) {
    let mut rng = Rng::new(n as u64, 0);
    let (mut sum, mut squares) = (DVec3::ZERO, DVec3::ZERO);
    for _ in 0..n {
        let x = sample(&mut rng);
        sum += x;
        squares += x * x;
    }
    let mean = sum / n as f64;
    (mean, ((squares / n as f64 - mean * mean) / n as f64).map(|v| v.max(0.0).sqrt()))
}

/// Within three standard errors (the seeds are fixed: a pass stays a pass), and a relative `bias` of the expectation.
fn assert_mean(estimate: (DVec3, DVec3), expected: DVec3, bias: f64) {
    let off = (estimate.0 - expected).abs();
    assert!(off.cmple(3.0 * estimate.1 + bias * expected + 1e-12).all(), "{estimate:?} for {expected}");
}

/// By midpoints of 4096 steps through the box: 100 a cell or more, where already 2 are within 1 %, and second order.
fn exact_transmittance(grid: &Grid, sigma: f64, ray: &Ray) -> f64 {
    let Some((start, end)) = ray.clip(half_extent(grid.shape)) else { return 1.0 };
    let step = (end - start) / 4096.0;
    (-sigma * step * (0..4096).map(|i| grid.sample(ray.at(start + (f64::from(i) + 0.5) * step))).sum::<f64>()).exp()
}

fn rays() -> [Ray; 4] {
    [
        Ray::new(DVec3::new(-2.0, 0.01, 0.02), DVec3::X),
        Ray::new(DVec3::new(0.1, -0.05, 2.0), -DVec3::Z),
        Ray::new(DVec3::new(-1.0, -1.2, 0.8), DVec3::new(1.08, 1.1, -0.85).normalize()),
        Ray::new(DVec3::new(0.15, 0.0, 0.05), DVec3::new(-0.6, 0.64, -0.48)),
    ]
}

#[test]
fn majorants_bound_the_extinction() {
    let mut rng = Rng::new(1, 1);
    let noise: Vec<f64> = (0..20 * 9 * 17).map(|_| rng.uniform().powi(4)).collect();
    let grid = Grid { shape: GridShape::new(UVec3::new(20, 9, 17)), values: noise };
    let smoke = Extinction::new(&grid, 6.0);
    assert_eq!(smoke.blocks.dims, UVec3::new(20, 9, 17).map(|cells| cells.div_ceil(BLOCK)));
    for _ in 0..20_000 {
        let cell = DVec3::from([(); 3].map(|()| rng.uniform())) * grid.shape.dims.as_dvec3();
        let x = cell * cell_size(grid.shape) - half_extent(grid.shape);
        let extinction = smoke.sample(x);
        // Values and weights are f32, and the values at most 6.
        assert!((extinction - 6.0 * grid.sample(x)).abs() < 3e-6, "{extinction}");
        assert!(extinction <= smoke.majorants[smoke.blocks.index((cell / f64::from(BLOCK)).as_uvec3())]);
    }
    // Also on the box's very faces and corners, where rounding may leave it.
    for corner in 0..8 {
        let sign = DVec3::new(f64::from(corner & 1), f64::from(corner >> 1 & 1), f64::from(corner >> 2)) * 2.0 - 1.0;
        let x = half_extent(grid.shape) * sign * (1.0 + 1e-15);
        assert!((smoke.sample(x) - 6.0 * grid.sample(x)).abs() < 3e-6);
    }
}

#[test]
fn tracking_gives_transmittance() {
    for grid in [blob(), grid([9, 8, 17], |_| 0.5)] {
        let scene = Scene::new(&grid, MEDIUM, Environment::Function(&sky), &[]);
        for ray in rays() {
            let expected = DVec3::splat(exact_transmittance(&grid, MEDIUM.sigma, &ray));
            let survives = |rng: &mut Rng| DVec3::splat(f64::from(scene.smoke.collide(&ray, rng).is_none()));
            assert_mean(mean(20_000, survives), expected, 1e-5);
            assert_mean(mean(20_000, |rng| DVec3::splat(scene.smoke.transmittance(&ray, rng))), expected, 1e-5);
        }
    }
}

#[test]
fn scattering_has_mean_cosine_g() {
    let dir = DVec3::new(0.48, -0.6, 0.64);
    for g in [-0.7, 0.0, 5e-5, 0.42, 0.9] {
        let (mean, error) = mean(20_000, |rng| {
            let out = scatter(dir, g, rng);
            assert!((out.length() - 1.0).abs() < 1e-14);
            out
        });
        assert!((mean - dir * g).abs().cmple(3.0 * error).all(), "{mean} for g {g}");
    }
}

#[test]
fn forward_scattering_has_closed_forms() {
    // With g = 1 − 1e-7 light goes straight on (99 % within 1e-5): n events have the Poisson probability of the
    // optical depth. From behind, and not from the front: E(+Z) = 2, E(−Z) = 0.
    let grid = grid([16, 16, 16], |_| 1.0);
    let medium = Medium { g: 1.0 - 1e-7, ..MEDIUM };
    let light = |w: DVec3| DVec3::splat(1.0 + w.z);
    let scene = Scene::new(&grid, medium, Environment::Function(&light), &[]);
    let ray = Ray::new(DVec3::new(0.05, 0.02, -2.0), DVec3::Z);
    let depth = -exact_transmittance(&grid, medium.sigma, &ray).ln();
    let once = 2.0 * medium.albedo * depth * (-depth).exp();
    let any = 2.0 * ((medium.albedo * depth).exp() - 1.0) * (-depth).exp();
    assert_mean(mean(40_000, |rng| trace(&scene, &ray, Events::Single, rng)), once, 1e-5);
    assert_mean(mean(40_000, |rng| trace(&scene, &ray, Events::All, rng)), any, 1e-5);
    // The darkest channel alone: here roulette decides from the second event on.
    let scene = Scene::new(&grid, Medium { albedo: DVec3::splat(0.3), ..medium }, Environment::Function(&light), &[]);
    assert_mean(mean(40_000, |rng| trace(&scene, &ray, Events::All, rng)), DVec3::splat(any.z), 1e-5);
    // A surface half way leaves half the depth to the first event, and does not shade what follows.
    let half = Ray { t_max: 2.0, ..ray };
    let once = 2.0 * medium.albedo * 0.5 * depth * (-depth).exp();
    let scene = Scene::new(&grid, medium, Environment::Function(&light), &[]);
    assert_mean(mean(40_000, |rng| trace(&scene, &half, Events::Single, rng)), once, 1e-5);
}

#[test]
fn thin_smoke_scatters_albedo_times_optical_depth() {
    // L = Ω τ under unit light, less what is lost on the way in and out: some 4 % where the cube's side is 0.04.
    let grid = grid([16, 16, 16], |_| 1.0);
    let medium = Medium { sigma: 0.04, g: 0.0, ..MEDIUM };
    let scene = Scene::new(&grid, medium, Environment::Function(&|_| DVec3::ONE), &[]);
    let ray = Ray::new(DVec3::new(0.05, 0.02, -2.0), DVec3::Z);
    let (radiance, error) = mean(200_000, |rng| trace(&scene, &ray, Events::Single, rng));
    let thin = medium.albedo * -exact_transmittance(&grid, medium.sigma, &ray).ln();
    let (ratio, error) = (radiance / thin, error / thin);
    assert!((ratio.cmpgt(0.94 - 3.0 * error) & ratio.cmplt(1.0 + 3.0 * error)).all(), "{ratio} {error}");
}

#[test]
fn white_furnace() {
    // Where nothing is absorbed and light is the same from everywhere, smoke cannot be seen.
    let grid = blob();
    let image = EquirectImage::new(8, vec![Vec3::ONE; 32]);
    for environment in [Environment::Function(&|_| DVec3::ONE), Environment::Image(&image)] {
        let scene = Scene::new(&grid, Medium { sigma: 20.0, albedo: DVec3::ONE, g: 0.5 }, environment, &[]);
        for ray in rays() {
            let seen = DVec3::splat(1.0 - exact_transmittance(&grid, 20.0, &ray));
            assert_mean(mean(10_000, |rng| trace(&scene, &ray, Events::All, rng)), seen, 1e-5);
        }
    }
}

#[test]
fn single_scattering_agrees_with_the_march() {
    let grid = blob();
    let scene = Scene::new(&grid, MEDIUM, Environment::Function(&sky), &[]);
    for ray in rays() {
        let (expected, _) = single_scattering(&grid, &MEDIUM, &ray, 512, sky);
        // The march takes half-cell steps, and the blob is 3.5 cells wide: 3e-3.
        assert_mean(mean(40_000, |rng| trace(&scene, &ray, Events::Single, rng)), expected, 3e-3);
    }
}

#[test]
fn images_depend_on_the_seed_not_on_the_threads() {
    let grid = blob();
    let scene = Scene::new(&grid, MEDIUM, Environment::Function(&sky), &[]);
    let camera = |x: f64, y: f64| Ray::new(DVec3::new(x / 10.0 - 0.5, 0.4 - y / 10.0, 2.0), -DVec3::Z);
    let image = |threads, seed, progress: &(dyn Fn(f64) + Sync)| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| render(&scene, [10, 8], camera, Events::All, 16, seed, progress))
    };
    let rows = AtomicUsize::new(0);
    let first = image(1, 7, &|share| {
        assert_eq!(share * 8.0, (rows.fetch_add(1, Ordering::Relaxed) + 1) as f64);
    });
    assert_eq!(rows.into_inner(), 8);
    assert_eq!(first, image(3, 7, &|_| ()));
    assert_ne!(first, image(3, 8, &|_| ()));
    // Up is up, and every pixel is its own: the blob is below the middle, to the right.
    let brightest = (0..80).max_by(|&a, &b| first[a].y.total_cmp(&first[b].y)).unwrap();
    assert!((4..=7).contains(&(brightest % 10)) && (3..=6).contains(&(brightest / 10)), "{brightest}");
    assert_eq!(first[0], DVec3::ZERO);
}

/// A ray from −X across uniform smoke of 16³ cells (cut off before the outermost half cells, where it fades), with
/// what a light gives along it by `scattered`, a function of the point: its mean over the ray by 2000 midpoints, second
/// order, where the length of everything is some hundred steps.
fn along(scattered: impl Fn(DVec3, f64) -> DVec3) -> (Ray, DVec3) {
    let ray = Ray { t_max: 0.7, ..Ray::new(DVec3::new(-0.4, 0.03, -0.02), DVec3::X) };
    let step = ray.t_max / 2000.0;
    let points = (0..2000).map(|i| (f64::from(i) + 0.5) * step);
    (ray, points.map(|t| scattered(ray.at(t), t) * step).sum())
}

const NIGHT: Environment = Environment::Function(&|_| DVec3::ZERO);

#[test]
fn lamps_give_the_airlight_integral() {
    let grid = grid([16, 16, 16], |_| 1.0);
    let intensity = DVec3::new(1.0, 2.0, 0.5);
    // Beside the ray: nearer than NEAR, further, and so that the ray enters and leaves NEAR at its ends.
    for offset in [DVec3::new(0.1, 0.03, 0.02), DVec3::new(0.0, 0.2, 0.1), DVec3::new(-0.38, -0.05, 0.0)] {
        let position = DVec3::new(0.0, 0.03, -0.02) + offset;
        let lights = [Light::Point { position, intensity }];
        let scene = Scene::new(&grid, MEDIUM, NIGHT, &lights);
        // All within the homogeneous part, where transmittances are exponentials of distances.
        let (ray, expected) = along(|x, t| {
            let (dir, distance) = (position - x).normalize_and_length();
            let phase = henyey_greenstein(dir.x, MEDIUM.g);
            let kept = (-MEDIUM.sigma * (t + distance)).exp();
            intensity * MEDIUM.albedo * (MEDIUM.sigma * phase * kept / (distance * distance))
        });
        let found = mean(40_000, |rng| trace(&scene, &ray, Events::Single, rng));
        assert_mean(found, expected, 1e-4);
        assert!((found.1 / expected).max_element() < 0.03, "{found:?}");
    }
    // Thin smoke has a closed form: I Ω σ/(4π) times the angle that the ray spans at the lamp, over its height. The
    // optical depths are at most 0.01.
    let medium = Medium { sigma: 0.01, g: 0.0, ..MEDIUM };
    let position = DVec3::new(0.1, 0.06, 0.02);
    let lights = [Light::Point { position, intensity }];
    let (ray, _) = along(|_, _| DVec3::ZERO);
    let height = 0.03f64.hypot(0.04);
    let angle = (0.5f64 / height).atan() + (0.2f64 / height).atan();
    let thin = intensity * medium.albedo * (medium.sigma * angle / (4.0 * PI * height));
    let scene = Scene::new(&grid, medium, NIGHT, &lights);
    assert_mean(mean(100_000, |rng| trace(&scene, &ray, Events::Single, rng)), thin, 0.01);
}

#[test]
fn a_lamps_light_all_leaves_white_smoke() {
    // Where nothing is absorbed, all that a lamp in the smoke shines leaves it, 4π I less what never scatters. The flux
    // is counted along lines in all directions through discs that cover the box: ∫ L dA dω.
    let grid = blob();
    let intensity = DVec3::splat(2.0);
    let position = DVec3::new(0.12, -0.04, 0.02);
    let lights = [Light::Point { position, intensity }];
    let medium = Medium { sigma: 8.0, albedo: DVec3::ONE, g: 0.0 };
    let scene = Scene::new(&grid, medium, NIGHT, &lights);
    let unscattered =
        SphereRule::new(24).integrate(|w| exact_transmittance(&grid, medium.sigma, &Ray::new(position, w)));
    let expected = intensity * (4.0 * PI - unscattered);
    // Discs about the lamp (beyond half a unit the blob has 1e-4 of its density), with radii drawn evenly and not areas: radiance goes with one over the radius.
    let radius = 0.5;
    let found = mean(100_000, |rng| {
        let dir = turned(DVec3::Z, 2.0 * rng.uniform() - 1.0, rng.uniform());
        let r = radius * rng.uniform();
        let origin = position + turned(dir, 0.0, rng.uniform()) * r - dir * 2.0;
        trace(&scene, &Ray::new(origin, dir), Events::All, rng) * (4.0 * PI * 2.0 * PI * radius * r)
    });
    assert_mean(found, expected, 1e-3);
    assert!((found.1 / expected).max_element() < 0.05, "{found:?}");
}

#[test]
fn the_sun_single_scatters_like_the_quadrature() {
    let grid = blob();
    let irradiance = DVec3::new(3.0, 2.0, 1.0);
    let direction = DVec3::new(0.3, 0.8, 0.5).normalize();
    for angle in [0.0f64, 0.7] {
        let lights = [Light::Sun { direction, irradiance, angle }];
        let scene = Scene::new(&grid, MEDIUM, NIGHT, &lights);
        // The cap of half-angle 0.35 by 8 rings of 16 points, even in solid angle, weighted to irradiance 1 on a
        // facing surface.
        let mut cap = vec![(direction, 1.0)];
        if angle > 0.0 {
            let edge = (0.5 * angle).cos();
            let (across, up) = direction.any_orthonormal_pair();
            cap = (0..128)
                .map(|i| {
                    let cos = 1.0 - (f64::from(i / 16) + 0.5) / 8.0 * (1.0 - edge);
                    let (y, x) = (2.0 * PI * f64::from(i % 16) / 16.0).sin_cos();
                    (direction * cos + (across * x + up * y) * (1.0 - cos * cos).sqrt(), cos)
                })
                .collect();
        }
        let facing: f64 = cap.iter().map(|(_, cos)| cos).sum();
        let ray = rays()[0];
        let (start, end) = ray.clip(half_extent(grid.shape)).unwrap();
        let steps = if angle > 0.0 { 40 } else { 400 };
        let step = (end - start) / f64::from(steps);
        let expected: DVec3 = (0..steps)
            .map(|i| {
                let t = start + (f64::from(i) + 0.5) * step;
                let x = ray.at(t);
                let arriving: f64 = cap
                    .iter()
                    .map(|&(w, _)| {
                        let kept = scene.smoke.march(&Ray::new(x, w));
                        henyey_greenstein(ray.dir.dot(w), MEDIUM.g) * kept / facing
                    })
                    .sum();
                let reached = scene.smoke.march(&Ray { t_max: t, ..ray });
                irradiance * MEDIUM.albedo * (arriving * reached * MEDIUM.sigma * grid.sample(x) * step)
            })
            .sum();
        // Marches of half cells and, for the disc, steps of half a cell: 3e-3 as in the test above.
        assert_mean(mean(40_000, |rng| trace(&scene, &ray, Events::Single, rng)), expected, 3e-3);
    }
}

#[test]
fn a_wide_sun_is_a_disc_of_the_environment() {
    // Found by next-event estimation as a light, by scattering alone as a function. Half-angle 60°: a facing surface
    // gets π sin² 60° of the radiance.
    let grid = blob();
    let direction = DVec3::new(0.3, 0.8, 0.5).normalize();
    let disc = |w: DVec3| DVec3::splat(if w.dot(direction) > 0.5 { 1.0 } else { 0.0 });
    let lights = [Light::Sun { direction, irradiance: DVec3::splat(0.75 * PI), angle: 2.0 * PI / 3.0 }];
    let as_light = Scene::new(&grid, MEDIUM, NIGHT, &lights);
    let as_environment = Scene::new(&grid, MEDIUM, Environment::Function(&disc), &[]);
    for (events, ray) in [(Events::Single, rays()[0]), (Events::All, rays()[1])] {
        let [a, b] = [&as_light, &as_environment].map(|scene| mean(40_000, |rng| trace(scene, &ray, events, rng)));
        let error = (a.1 * a.1 + b.1 * b.1).map(f64::sqrt);
        assert!((a.0 - b.0).abs().cmple(3.0 * error).all(), "{a:?} {b:?}");
    }
}

#[test]
fn spots_fall_off_as_bevys_do() {
    let (inner, outer) = (0.3, 0.5);
    let light = Light::Spot { position: DVec3::Y, direction: -DVec3::Y, intensity: DVec3::splat(8.0), inner, outer };
    let at = |angle: f64| {
        let x = DVec3::Y + 2.0 * DVec3::new(angle.sin(), -angle.cos(), 0.0);
        light.sample(x, &mut Rng::new(0, 0)).map_or(0.0, |(ray, irradiance)| {
            assert!((ray.t_max - 2.0).abs() < 1e-14 && (ray.at(ray.t_max) - DVec3::Y).length() < 1e-14);
            irradiance.x
        })
    };
    // 8/2² within the inner cone, a quarter of that half way between the cosines, nothing from the edge on.
    assert!((at(0.0) - 2.0).abs() < 1e-14 && (at(0.2999) - 2.0).abs() < 1e-14);
    assert!((at((0.5 * (inner.cos() + outer.cos())).acos()) - 0.5).abs() < 1e-13);
    assert!(at(0.4999) > 0.0 && at(0.4999) < 1e-5);
    assert_eq!((at(0.5001), at(3.0)), (0.0, 0.0));
    // A hard edge rises within 1e-4 of the cosine.
    assert!((spot_falloff(0.4f64.cos() + 1e-4, 0.4, 0.4) - 1.0).abs() < 1e-9);
    assert_eq!(spot_falloff(0.4f64.cos() - 1e-9, 0.4, 0.4), 0.0);
}

#[test]
fn spots_light_what_is_in_their_cone() {
    let grid = grid([16, 16, 16], |_| 1.0);
    let intensity = DVec3::new(1.0, 2.0, 0.5);
    let (position, direction) = (DVec3::new(0.0, 0.3, -0.02), DVec3::new(0.1, -1.0, 0.0).normalize());
    let lights = [Light::Spot { position, direction, intensity, inner: 0.3, outer: 0.6 }];
    let scene = Scene::new(&grid, MEDIUM, NIGHT, &lights);
    let (ray, expected) = along(|x, t| {
        let (dir, distance) = (position - x).normalize_and_length();
        let t_spot = (-direction.dot(dir) - 0.6f64.cos()) / (0.3f64.cos() - 0.6f64.cos());
        let kept = (-MEDIUM.sigma * (t + distance)).exp() * t_spot.clamp(0.0, 1.0).powi(2);
        let phase = henyey_greenstein(dir.x, MEDIUM.g);
        intensity * MEDIUM.albedo * (MEDIUM.sigma * phase * kept / (distance * distance))
    });
    assert_mean(mean(40_000, |rng| trace(&scene, &ray, Events::Single, rng)), expected, 1e-4);
}

/// 32 × 16 texels: a gradient, and one texel 5000 times as bright.
fn sunny() -> EquirectImage {
    let texel = |i: usize| Vec3::new(0.5 + (i % 32) as f32 / 64.0, 0.5, 0.2 + (i / 32) as f32 / 20.0);
    let mut texels: Vec<Vec3> = (0..512).map(texel).collect();
    texels[5 * 32 + 20] = Vec3::new(5000.0, 4000.0, 3000.0);
    EquirectImage::new(32, texels)
}

#[test]
fn images_are_bilinear() {
    let image = sunny();
    let texel = |x: f64, y: f64| {
        let (phi, theta) = (2.0 * PI * x / 32.0, PI * y / 16.0);
        image.radiance(DVec3::new(phi.sin() * theta.sin(), theta.cos(), -phi.cos() * theta.sin()))
    };
    // Centres are themselves; the mean of two lies between them, across the seam too; the poles stay.
    assert!((texel(20.5, 5.5) - DVec3::new(5000.0, 4000.0, 3000.0)).length() < 0.01);
    assert!((texel(3.0, 9.5) - (texel(2.5, 9.5) + texel(3.5, 9.5)) / 2.0).length() < 1e-6);
    assert!((texel(0.0, 9.5) - (texel(0.5, 9.5) + texel(31.5, 9.5)) / 2.0).length() < 1e-6);
    assert!((texel(4.5, 0.1) - texel(4.5, 0.5)).length() < 1e-6);
    assert!((texel(4.5, 15.9) - texel(4.5, 15.5)).length() < 1e-6);
    // The middle looks to +Z, the top row up.
    assert!((image.radiance(DVec3::Z) - texel(16.0, 8.0)).length() < 1e-6);
    assert!(image.radiance(DVec3::Y).z < 0.21);
}

#[test]
fn directions_are_drawn_with_their_density() {
    let image = sunny();
    // E[f/p] = ∫ f: of 1, of the radiance (against midpoints of 1024 × 512, second order) and of a direction.
    let drawn = |f: &dyn Fn(DVec3) -> DVec3| {
        mean(40_000, |rng| {
            let (w, density) = image.sample(rng).unwrap();
            assert!((w.length() - 1.0).abs() < 1e-14 && density == image.density(w));
            f(w) / density
        })
    };
    let integral = |f: &dyn Fn(DVec3) -> DVec3| -> DVec3 {
        (0..1024 * 512)
            .map(|i| {
                let (phi, theta) = (PI * (f64::from(i % 1024) + 0.5) / 512.0, PI * (f64::from(i / 1024) + 0.5) / 512.0);
                let w = DVec3::new(phi.sin() * theta.sin(), theta.cos(), -phi.cos() * theta.sin());
                f(w) * theta.sin() * (PI / 512.0).powi(2)
            })
            .sum()
    };
    assert_mean(drawn(&|_| DVec3::ONE), DVec3::splat(4.0 * PI), 0.0);
    let power = drawn(&|w| image.radiance(w));
    assert_mean(power, integral(&|w| image.radiance(w)), 1e-3);
    // What makes it worth it: light is drawn almost as it shines.
    assert!((power.1 / power.0).max_element() < 0.01, "{power:?}");
    // A black image has nothing to look for.
    let black = EquirectImage::new(4, vec![Vec3::ZERO; 8]);
    assert!(black.sample(&mut Rng::new(0, 0)).is_none());
    assert_eq!((black.density(DVec3::X), black.radiance(DVec3::X)), (0.0, DVec3::ZERO));
}

#[test]
fn looking_for_an_images_sun_changes_the_noise_alone() {
    let grid = blob();
    let image = sunny();
    let looked = |w: DVec3| image.radiance(w);
    for (events, ray, medium) in [
        (Events::Single, rays()[0], MEDIUM),
        (Events::All, rays()[1], MEDIUM),
        (Events::All, rays()[2], Medium { sigma: 12.0, albedo: DVec3::splat(0.95), g: -0.3 }),
    ] {
        let found = Scene::new(&grid, medium, Environment::Image(&image), &[]);
        let met = Scene::new(&grid, medium, Environment::Function(&looked), &[]);
        let a = mean(20_000, |rng| trace(&found, &ray, events, rng));
        let b = mean(200_000, |rng| trace(&met, &ray, events, rng));
        let error = (a.1 * a.1 + b.1 * b.1).map(f64::sqrt);
        assert!((a.0 - b.0).abs().cmple(3.0 * error).all(), "{a:?} {b:?}");
        // A tenth of the samples, and less noise all the same.
        assert!((a.1 / b.1).max_element() < 1.0, "{a:?} {b:?}");
    }
}

#[test]
fn alpha_is_exact_and_halves_are_independent() {
    let grid = blob();
    let scene = Scene::new(&grid, MEDIUM, Environment::Function(&sky), &[]);
    let camera = |x: f64, y: f64| Ray::new(DVec3::new(x / 10.0 - 0.5, 0.4 - y / 10.0, 2.0), -DVec3::Z);
    let alphas = alpha(&scene, [10, 8], camera);
    // A pixel is two cells wide, in parallel rays: 4 × 4 of them resolve it.
    for (x, y) in [(5, 4), (7, 4), (6, 5), (0, 0)] {
        let rays = (0..256)
            .map(|i| camera(x as f64 + (f64::from(i % 16) + 0.5) / 16.0, y as f64 + (f64::from(i / 16) + 0.5) / 16.0));
        let exact = 1.0 - rays.map(|ray| exact_transmittance(&grid, MEDIUM.sigma, &ray)).sum::<f64>() / 256.0;
        assert!((alphas[y * 10 + x] - exact).abs() < 2e-3, "{x} {y}: {} for {exact}", alphas[y * 10 + x]);
    }
    // Deviations of two halves from the truth (many samples) are as likely of the same sign as not: their correlation
    // over n values has a standard deviation of 1/√n.
    let image = |spp, seed| render(&scene, [10, 8], camera, Events::All, spp, seed, &|_| ());
    let (truth, a, b) = (image(4096, 1), image(64, 2), image(64, 3));
    let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
    let lit: Vec<usize> = (0..80).filter(|&i| alphas[i] > 0.02).collect();
    for &i in &lit {
        // One channel: the three of a path go together.
        let (da, db) = (a[i].x - truth[i].x, b[i].x - truth[i].x);
        (ab, aa, bb) = (ab + da * db, aa + da * da, bb + db * db);
    }
    let correlation = ab / (aa * bb).sqrt();
    assert!(correlation.abs() < 3.0 / (lit.len() as f64).sqrt(), "{correlation} over {}", lit.len());
}
