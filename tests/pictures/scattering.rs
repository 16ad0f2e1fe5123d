//! Light that scatters more than once.

use bevy::prelude::*;
use bevy_smoke::headless::Headless;
use bevy_smoke::prelude::*;
use bevy_smoke::render::SmokeRenderStats;

use crate::scene::*;

/// The smoke with a way of scattering, and its entity.
fn scene(medium: SmokeMedium, scattering: SmokeScattering) -> (Headless, Entity) {
    let mut app = app();
    let (volume, _, environment, transform) = smoke(&mut app);
    let entity = app.app.world_mut().spawn((volume, medium, scattering, environment, transform)).id();
    let camera = camera(&app);
    app.app.world_mut().spawn(camera);
    (app, entity)
}

fn grey(sigma_t: f32, albedo: f32, g: f32) -> SmokeMedium {
    SmokeMedium { sigma_t, albedo: LinearRgba::rgb(albedo, albedo, albedo), g }
}

/// White smoke in white light cannot be seen: it hides as much as it sends.
#[test]
fn a_white_furnace_is_white() {
    for g in [0.0, 0.6] {
        for sigma_t in [0.04, 4.0, 40.0, 400.0] {
            // Every time from black.
            let (mut app, _) = scene(grey(sigma_t, 1.0, g), SmokeScattering::MULTIPLE);
            let pixels = draw(&mut app);
            // Radiance and transmittance, and light from behind.
            let all = pixels.iter().flat_map(|pixel| pixel[..3].iter().map(|light| light + 1.0 - pixel[3]));
            let (low, high) = all.fold((2.0_f32, 0.0_f32), |(low, high), v| (low.min(v), high.max(v)));
            println!("g {g}, extinction {sigma_t}: {low} to {high}, {:?}", app.solver_reports());
            assert!(high <= 1.005, "g {g}, extinction {sigma_t}: {high}");
            assert!(sigma_t > 40.0 || low >= 0.995, "g {g}, extinction {sigma_t}: {low}");
        }
    }
}

#[test]
fn light_that_scatters_again_adds_to_light_that_scatters_once() {
    for g in [0.0, 0.5] {
        let [single, multiple] = [SmokeScattering::SINGLE, SmokeScattering::MULTIPLE].map(|scattering| {
            let (mut app, _) = scene(grey(5.0, 0.9, g), scattering);
            draw(&mut app)
        });
        let sum = |pixels: &[[f32; 4]]| pixels.iter().map(|pixel| f64::from(pixel[0])).sum::<f64>();
        println!("g {g}: {} times as bright", sum(&multiple) / sum(&single));
        assert!(sum(&multiple) > 1.3 * sum(&single));
        let worst = |above: f32| {
            let pixels = single.iter().zip(&multiple).filter(|(one, _)| one[3] > above);
            pixels.map(|(one, all)| (all[0] - one[0]) / one[3]).fold(f32::INFINITY, f32::min)
        };
        let most = multiple.iter().filter(|all| all[3] > 0.0).map(|all| all[0] / all[3]).fold(0.0, f32::max);
        println!("more by {:?} of the light at least; at most {most} of it", [0.0, 0.02, 0.05, 0.1, 0.2].map(worst));
        // Nowhere brighter than the light. Darker only in wisps of an alpha below 0.05, where fits are followed beyond
        // their probes and fall off too steeply: by 3.5 % of the light at most, times that alpha.
        assert!(worst(0.05) >= 0.0 && worst(0.0) >= -0.05 && most <= 1.005);
    }
}

#[test]
fn auto_scatters_again_where_it_shows() {
    for (medium, expected) in
        [(grey(0.005, 0.9, 0.0), false), (grey(5.0, 0.9, 0.0), true), (grey(5.0, 0.0, 0.0), false)]
    {
        let (mut app, entity) = scene(medium, SmokeScattering::default());
        draw(&mut app);
        let choice = app.app.world().resource::<SmokeRenderStats>().scattering(entity).unwrap();
        println!("{medium:?}: {choice}");
        assert!(choice.auto && choice.multiple == expected, "{choice:?}");
        let dispatches = dispatches(&app);
        // The pair matrix and the solver.
        assert_eq!([dispatches[3] > 0, dispatches[5] > 0], [expected; 2]);
    }
    // And what is asked for is done.
    let (mut app, entity) = scene(grey(0.005, 0.9, 0.0), SmokeScattering::MULTIPLE);
    draw(&mut app);
    let choice = app.app.world().resource::<SmokeRenderStats>().scattering(entity).unwrap();
    assert!(choice.multiple && !choice.auto);
}
