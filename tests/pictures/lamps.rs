//! Smoke lit by Bevy's own lights.

use std::f32::consts::PI;

use bevy::camera::visibility::RenderLayers;
use bevy::light::RectLight;
use bevy::prelude::*;
use bevy_smoke::prelude::*;

use crate::scene::*;

/// The smoke under no light but what `spawn` brings.
fn picture(medium: SmokeMedium, environment: SmokeEnvironment, spawn: impl FnOnce(&mut World)) -> Vec<[f32; 4]> {
    let mut app = app();
    app.app.insert_resource(GlobalAmbientLight::NONE);
    let (volume, _, _, transform) = smoke(&mut app);
    app.app.world_mut().spawn((volume, medium, environment, transform));
    spawn(app.app.world_mut());
    let camera = camera(&app);
    app.app.world_mut().spawn(camera);
    draw(&mut app)
}

/// The same of the usual smoke by lamps alone.
fn lit(spawn: impl FnOnce(&mut World)) -> Vec<[f32; 4]> {
    picture(medium(5.0), SmokeEnvironment::Camera, spawn)
}

/// Forward-scattering smoke.
fn medium(sigma_t: f32) -> SmokeMedium {
    SmokeMedium { sigma_t, albedo: LinearRgba::rgb(0.8, 0.7, 0.6), g: 0.4 }
}

fn sun(illuminance: f32) -> (DirectionalLight, Transform) {
    (DirectionalLight { illuminance, ..default() }, toward_smoke(Vec3::new(3.0, 2.0, 1.0)))
}

/// At a place, facing the smoke.
fn toward_smoke(place: Vec3) -> Transform {
    Transform::from_translation(place).looking_at(Vec3::ZERO, Vec3::Y)
}

/// A point light that gives an illuminance at the smoke's centre.
fn point(illuminance: f32, place: Vec3) -> (PointLight, Transform) {
    let intensity = 4.0 * PI * illuminance * place.length_squared();
    (PointLight { intensity, range: 100.0 * place.length(), ..default() }, toward_smoke(place))
}

const OUTSIDE: Vec3 = Vec3::new(2.0, 2.5, 1.5);
const INSIDE: Vec3 = Vec3::new(0.1, 0.2, 0.15);

fn brightness(pixels: &[[f32; 4]]) -> f64 {
    pixels.iter().flat_map(|pixel| &pixel[..3]).map(|&value| f64::from(value)).sum()
}

fn is_black(pixels: &[[f32; 4]]) -> bool {
    assert!(coverage(pixels) > 100.0);
    pixels.iter().all(|pixel| pixel[..3] == [0.0; 3])
}

/// `a + factor * b` in RGB, alpha of `a`.
fn sum(a: &[[f32; 4]], factor: f32, b: &[[f32; 4]]) -> Vec<[f32; 4]> {
    let add = |(a, b): (&[f32; 4], &[f32; 4])| [0, 1, 2, 3].map(|c| if c < 3 { a[c] + factor * b[c] } else { a[c] });
    a.iter().zip(b).map(add).collect()
}

/// Relative RMS difference of RGB.
fn error(a: &[[f32; 4]], b: &[[f32; 4]]) -> f64 {
    let light = |pixels: &[[f32; 4]]| -> Vec<[f32; 4]> { pixels.iter().map(|&[r, g, b, _]| [r, g, b, 0.0]).collect() };
    let (a, b) = (light(a), light(b));
    let error = rms(&a, &b) / rms(&b, &vec![[0.0; 4]; b.len()]);
    println!("relative difference {error:.2e}");
    error
}

#[test]
fn thin_smoke_shows_a_suns_illuminance() {
    // Optical depth 0.05 at most: L = albedo E / (4 pi) alpha, where light scatters evenly and is not dimmed.
    let thin = SmokeMedium { g: 0.0, ..medium(0.02) };
    let pixels = picture(thin, SmokeEnvironment::Camera, |world| {
        world.spawn(sun(1000.0));
    });
    let (light, alpha) = (pixels.iter().map(|p| f64::from(p[0])).sum::<f64>(), coverage(&pixels));
    let found = light / alpha / (0.8 * 1000.0 / (4.0 * f64::from(PI)));
    println!("{found}");
    // What is dimmed on the way from the sun, and what scatters twice, are a percent or two each.
    assert!((found - 1.0).abs() < 0.03, "{found}");
}

#[test]
fn distant_point_lights_and_spots_are_suns() {
    let direction = OUTSIDE.normalize();
    let expected = lit(|world| {
        world.spawn((DirectionalLight { illuminance: 5.0, ..default() }, toward_smoke(direction)));
    });
    assert!(brightness(&expected) > 10.0);
    let far = lit(|world| {
        world.spawn(point(5.0, 1000.0 * direction));
    });
    // 1.5 metres of 1000 nearer or farther: 0.3 % in illuminance; the solver, half a percent.
    assert!(error(&far, &expected) < 8e-3);
    let spot = lit(|world| {
        let (light, at) = point(5.0, 1000.0 * direction);
        let PointLight { intensity, range, .. } = light;
        world.spawn((SpotLight { intensity, range, inner_angle: 0.1, outer_angle: 0.2, ..default() }, at));
    });
    assert!(error(&spot, &far) < 1e-3);
}

#[test]
fn spots_light_what_they_shine_on() {
    let spot = |aim: Vec3, outer_angle: f32| {
        lit(|world| {
            let light = SpotLight { intensity: 1000.0, inner_angle: 0.5 * outer_angle, outer_angle, ..default() };
            world.spawn((light, Transform::from_translation(OUTSIDE).looking_at(aim, Vec3::Y)));
        })
    };
    let (wide, narrow) = (brightness(&spot(Vec3::ZERO, 0.8)), brightness(&spot(Vec3::ZERO, 0.15)));
    assert!(narrow > 0.0 && narrow < 0.5 * wide, "{narrow} {wide}");
    assert!(is_black(&spot(2.0 * OUTSIDE, 0.3)));
}

#[test]
fn radiance_is_linear_in_every_light() {
    let spot = |intensity| (SpotLight { intensity, ..default() }, toward_smoke(OUTSIDE));
    let sky = || SmokeEnvironment::constant(Vec3::ONE, 1.0);
    let dark = picture(medium(5.0), sky(), |_| {});
    let with = |spawn: &dyn Fn(&mut World)| sum(&picture(medium(5.0), sky(), spawn), -1.0, &dark);
    type Spawn = Box<dyn Fn(&mut World, f32) -> Entity>;
    let lights: [(&str, Spawn); 4] = [
        ("sun", Box::new(|world, factor| world.spawn(sun(10.0 * factor)).id())),
        ("point outside", Box::new(|world, factor| world.spawn(point(10.0 * factor, OUTSIDE)).id())),
        ("point inside", Box::new(|world, factor| world.spawn(point(200.0 * factor, INSIDE)).id())),
        ("spot", Box::new(move |world, factor| world.spawn(spot(2000.0 * factor)).id())),
    ];
    for (name, light) in lights {
        let once = with(&|world| _ = light(world, 1.0));
        let twice = with(&|world| _ = light(world, 2.0));
        assert!(brightness(&once) > 0.3 * brightness(&dark), "{name}");
        // Each picture is solved to half a percent, the sky's share included, which is subtracted.
        println!("{name}");
        assert!(error(&twice, &sum(&once, 1.0, &once)) < 0.02, "{name}");
    }
}

#[test]
fn hidden_lights_and_lights_of_other_layers_are_dark() {
    assert!(is_black(&lit(|world| {
        world.spawn(sun(10.0)).insert(Visibility::Hidden);
        world.spawn(point(10.0, INSIDE)).insert(RenderLayers::layer(3));
        world.spawn((SpotLight::default(), toward_smoke(OUTSIDE), RenderLayers::layer(1)));
        let (light, at) = point(10.0, INSIDE);
        let hidden = world.spawn((Visibility::Hidden, Transform::default())).id();
        world.spawn((light, at, ChildOf(hidden)));
    })));
}

#[test]
fn a_point_lights_range_ends_it() {
    let with_range = |range: f32| {
        lit(|world| {
            let (light, at) = point(10.0, 3.0 * OUTSIDE);
            world.spawn((PointLight { range, ..light }, at));
        })
    };
    // 10.6 metres from the centre of a box of at most 2.6 around it.
    assert!(is_black(&with_range(7.0)));
    let (near, far) = (brightness(&with_range(11.0)), brightness(&with_range(1000.0)));
    assert!(near > 0.0 && near < 0.3 * far, "{near} {far}");
}

#[test]
fn ambient_light_is_a_constant_environment() {
    let color = Vec3::new(0.5, 0.25, 1.0);
    let expected = picture(medium(5.0), SmokeEnvironment::constant(color, 3.0), |_| {});
    let ambient = |brightness| GlobalAmbientLight {
        color: Color::linear_rgb(color.x, color.y, color.z),
        brightness,
        ..GlobalAmbientLight::NONE
    };
    let found = lit(|world| world.insert_resource(ambient(3.0)));
    assert!(error(&found, &expected) < 1e-3);
    // A volume's own environment is all of its light from all around.
    let own = picture(medium(5.0), SmokeEnvironment::constant(color, 3.0), |world| world.insert_resource(ambient(9.0)));
    assert_eq!(own, expected);
}

#[test]
fn area_lights_leave_smoke_dark() {
    assert!(is_black(&lit(|world| {
        world.spawn((RectLight::default(), toward_smoke(OUTSIDE)));
    })));
}

#[test]
fn a_lamp_in_the_smoke_glows_where_it_is() {
    let mut app = app();
    app.app.insert_resource(GlobalAmbientLight::NONE);
    let (volume, _, _, transform) = smoke(&mut app);
    app.app.world_mut().spawn((volume, medium(5.0), SmokeEnvironment::Camera, transform));
    let place = Vec3::new(0.325, 0.225, 0.0);
    app.app.world_mut().spawn((PointLight { intensity: 100.0, ..default() }, Transform::from_translation(place)));
    let camera = parallel_camera(&app, Transform::from_xyz(0.0, 0.0, 6.0));
    app.app.world_mut().spawn(camera);
    let pixels = draw(&mut app);
    save_radiance("lamp_in_smoke", SIZE, &pixels);
    let brightest = (0..pixels.len()).max_by(|&a, &b| pixels[a][0].total_cmp(&pixels[b][0])).unwrap();
    // 3.2 metres to 64 pixels.
    let expected = (32.0 * Vec2::new(1.0 + place.x / 1.6, 1.0 - place.y / 1.6)).as_uvec2();
    assert_eq!(UVec2::new(brightest as u32 % SIZE.x, brightest as u32 / SIZE.x), expected);
    // It falls as 1 / b from there: a pixel aside, b is 3.5 times what it is on average over the lamp's.
    assert!(pixels[brightest][0] > 2.0 * pixels[brightest - 1][0]);
}
