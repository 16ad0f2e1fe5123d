//! Surfaces in the light.

use super::*;
use crate::reference::surface::{Plane, Sphere};

const NO_SMOKE: Medium = Medium { sigma: 0.0, ..MEDIUM };

fn ball(center: DVec3, radius: f64, albedo: f64) -> Sphere {
    Sphere { center, radius, albedo: DVec3::splat(albedo) }
}

fn floor(y: f64, albedo: f64) -> Option<Plane> {
    Some(Plane { y, albedo: DVec3::splat(albedo) })
}

fn one(_: DVec3) -> DVec3 {
    DVec3::ONE
}

/// A ray down to the point (`x`, −0.7, 0) of a floor there.
fn down_to(x: f64) -> Ray {
    Ray::new(DVec3::new(x, -0.3, 0.0), DVec3::NEG_Y)
}

#[test]
fn a_ball_takes_its_form_factor_from_the_sky() {
    // A black ball wholly above the horizon hides π (r/d)² cos θ of a constant sky's π.
    let (grid, center, radius) = (blob(), DVec3::new(0.0, 0.1, 0.0), 0.25);
    let surfaces = Surfaces { plane: floor(-0.7, 0.8), spheres: vec![ball(center, radius, 0.0)] };
    let scene = Scene::new(&grid, NO_SMOKE, Environment::Function(&one), &[]).with_surfaces(surfaces);
    for x in [0.3, 0.5, 1.0] {
        let offset = center - DVec3::new(x, -0.7, 0.0);
        let seen = (radius * radius / offset.length_squared()) * offset.y / offset.length();
        let light = mean(20_000, |rng| trace_surfaces(&scene, &down_to(x), Events::All, rng));
        assert_mean(light, DVec3::splat(0.8 * (1.0 - seen)), 1e-9);
        // There is no smoke.
        assert_eq!(mean(10, |rng| trace(&scene, &down_to(x), Events::All, rng)).0, DVec3::ZERO);
    }
}

#[test]
fn white_surfaces_and_white_smoke_are_invisible() {
    // Light that is the same all around stays so: smoke and the surface behind it are 1 in all.
    let grid = blob();
    let medium = Medium { sigma: 12.0, albedo: DVec3::ONE, g: 0.5 };
    let spheres = vec![ball(DVec3::new(-0.2, 0.0, 0.1), 0.15, 1.0), ball(DVec3::new(0.2, 0.1, 0.2), 0.1, 1.0)];
    let surfaces = Surfaces { plane: floor(-0.3, 1.0), spheres };
    let image = EquirectImage::new(4, vec![Vec3::ONE; 8]);
    for environment in [Environment::Function(&one), Environment::Image(&image)] {
        let scene = Scene::new(&grid, medium, environment, &[]).with_surfaces(surfaces.clone());
        for ray in rays() {
            let depth = -scene.smoke.march(&scene.up_to_surface(&ray).0).ln();
            let smoke = mean(10_000, |rng| trace(&scene, &ray, Events::All, rng));
            // The march is in steps of half a cell, within 1 %.
            assert_mean(smoke, DVec3::splat(1.0 - (-depth).exp()), 0.01);
            let both =
                |rng: &mut Rng| trace(&scene, &ray, Events::All, rng) + trace_surfaces(&scene, &ray, Events::All, rng);
            if scene.surfaces.hit(&ray).is_some() {
                assert_mean(mean(10_000, both), DVec3::ONE, 0.0);
            }
        }
    }
}

#[test]
fn a_floor_lights_thin_smoke_from_below() {
    // Under a constant sky a large floor returns its albedo of the light: (1 + ρ)/2 of what smoke alone would scatter.
    let grid = grid([16, 16, 16], |_| 1.0);
    let medium = Medium { sigma: 0.04, albedo: DVec3::splat(0.9), g: 0.0 };
    let sky = |w: DVec3| if w.y > 0.0 { DVec3::ONE } else { DVec3::ZERO };
    let ray = Ray::new(DVec3::new(0.05, 0.02, -2.0), DVec3::Z);
    let thin = 0.9 * -exact_transmittance(&grid, medium.sigma, &ray).ln();
    for (events, reflected) in [(Events::All, 0.6), (Events::Single, 0.0)] {
        let surfaces = Surfaces { plane: floor(-0.6, 0.6), spheres: Vec::new() };
        let scene = Scene::new(&grid, medium, Environment::Function(&sky), &[]).with_surfaces(surfaces);
        let light = mean(200_000, |rng| trace(&scene, &ray, events, rng));
        // What is lost on the way in and out, and scattered again: some 4 % where the cube's side is 0.04.
        assert_mean(light, DVec3::splat(0.5 * (1.0 + reflected) * thin), 0.04);
    }
}

#[test]
fn lights_cast_sharp_shadows() {
    let grid = blob();
    let ray = rays()[1];
    let sun = Light::Sun { direction: DVec3::X, irradiance: DVec3::ONE, angle: 0.0 };
    let lamp = Light::Point { position: DVec3::new(2.0, -0.05, 0.0), intensity: DVec3::ONE };
    let near = Light::Point { position: DVec3::new(0.15, -0.05, 0.02), intensity: DVec3::ONE };
    // Between the light and all that the ray sees of the smoke, or behind the light.
    let shade = |x: f64| Surfaces { plane: None, spheres: vec![ball(DVec3::new(x, 0.0, 0.0), 0.5, 0.0)] };
    let night = |_: DVec3| DVec3::ZERO;
    for (light, before, behind) in [(sun, 1.2, -1.2), (lamp, 1.2, 2.8)] {
        let lights = [light];
        let lit = |surfaces: Surfaces| {
            let scene = Scene::new(&grid, MEDIUM, Environment::Function(&night), &lights).with_surfaces(surfaces);
            mean(10_000, |rng| trace(&scene, &ray, Events::Single, rng))
        };
        assert_eq!(lit(shade(before)).0, DVec3::ZERO);
        let free = lit(Surfaces::default());
        assert!(free.0.min_element() > 0.0);
        assert_eq!(lit(shade(behind)).0, free.0);
    }
    // Within the distance where events are placed as a lamp sees them.
    let lights = [near];
    let around = Surfaces { plane: None, spheres: vec![ball(DVec3::new(0.15, -0.05, 0.02), 0.03, 0.0)] };
    let scene = Scene::new(&grid, MEDIUM, Environment::Function(&night), &lights).with_surfaces(around);
    assert_eq!(mean(1000, |rng| trace(&scene, &ray, Events::All, rng)).0, DVec3::ZERO);
}

#[test]
fn surfaces_are_lit_by_lamps_and_suns() {
    // A floor of albedo ρ sends back ρ/π of its irradiance: I cos θ / d² and E cos θ.
    let grid = blob();
    let lights = [
        Light::Point { position: DVec3::new(0.4, -0.64, 0.0), intensity: DVec3::splat(0.01) },
        Light::Sun { direction: DVec3::new(0.6, 0.8, 0.0), irradiance: DVec3::splat(3.0), angle: 0.1 },
    ];
    let night = |_: DVec3| DVec3::ZERO;
    let surfaces = Surfaces { plane: floor(-0.7, 0.5), spheres: Vec::new() };
    let scene = Scene::new(&grid, NO_SMOKE, Environment::Function(&night), &lights).with_surfaces(surfaces);
    let light = mean(2000, |rng| trace_surfaces(&scene, &down_to(0.32), Events::All, rng));
    // 0.1 away, at a cosine of 0.6; the sun's disc is symmetric, and all of it is up.
    assert_mean(light, DVec3::splat(0.5 / PI * (0.01 * 0.6 / 0.01 + 3.0 * 0.8)), 1e-3);
}

#[test]
fn images_and_functions_agree_on_surfaces() {
    let grid = blob();
    let image = sunny();
    let looked = |w: DVec3| image.radiance(w);
    let surfaces = Surfaces { plane: floor(-0.35, 0.5), spheres: vec![ball(DVec3::new(0.1, 0.4, 0.0), 0.1, 0.7)] };
    let through = Ray::new(DVec3::new(0.05, -0.1, 2.0), DVec3::new(0.0, -0.1, -1.0).normalize());
    let [found, met] = [Environment::Image(&image), Environment::Function(&looked)]
        .map(|environment| Scene::new(&grid, MEDIUM, environment, &[]).with_surfaces(surfaces.clone()));
    let sample = |scene: &Scene, rng: &mut Rng| {
        trace(scene, &through, Events::All, rng) + trace_surfaces(scene, &through, Events::All, rng)
    };
    let a = mean(40_000, |rng| sample(&found, rng));
    let b = mean(200_000, |rng| sample(&met, rng));
    let error = (a.1 * a.1 + b.1 * b.1).map(f64::sqrt);
    assert!((a.0 - b.0).abs().cmple(3.0 * error).all(), "{a:?} {b:?}");
}

#[test]
fn what_is_behind_a_surface_is_not_seen() {
    // A ball in front of the smoke, one in the middle of it, and one behind.
    let grid = blob();
    let ray = rays()[1];
    let camera = |_: f64, _: f64| ray;
    let alone = Scene::new(&grid, MEDIUM, Environment::Function(&sky), &[]);
    let whole = alpha(&alone, [1, 1], camera)[0];
    let alpha_behind = |z: f64| {
        let surfaces = Surfaces { plane: None, spheres: vec![ball(DVec3::new(0.1, -0.05, z), 0.1, 0.0)] };
        let scene = Scene::new(&grid, MEDIUM, Environment::Function(&sky), &[]).with_surfaces(surfaces);
        alpha(&scene, [1, 1], camera)[0]
    };
    assert_eq!(alpha_behind(1.0), 0.0);
    assert_eq!(alpha_behind(-1.0), whole);
    // The ball ends where the blob is densest: half its depth, of which steps of half a cell make up to 1 %.
    let half = 1.0 - (1.0 - whole).sqrt();
    assert!((alpha_behind(-0.1) / half - 1.0).abs() < 0.01, "{} {half}", alpha_behind(-0.1));
}
