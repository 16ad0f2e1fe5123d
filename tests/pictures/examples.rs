//! The examples' own scenes, drawn without a window.

use bevy::prelude::*;
use bevy::render::render_resource::TextureFormat;
use bevy_smoke::headless::Headless;

use crate::scene::save;

#[allow(dead_code)]
#[path = "../../examples/demo.rs"]
mod demo;
#[allow(dead_code)]
#[path = "../../examples/minimal.rs"]
mod minimal;

fn picture<M>(
    name: &str,
    size: UVec2,
    setup: impl IntoScheduleConfigs<bevy::ecs::system::ScheduleSystem, M>,
) -> Vec<[u8; 4]> {
    let mut headless = Headless::new(size, TextureFormat::Rgba8UnormSrgb).unwrap();
    headless.draw_cameras_to_image();
    headless.app.add_systems(Startup, setup);
    headless.settle().unwrap();
    for _ in 0..3 {
        headless.app.update();
    }
    let pixels = headless.pixels();
    save(name, size, &pixels);
    pixels.as_chunks().0.to_vec()
}

#[test]
fn minimal_shows_smoke() {
    let size = UVec2::new(160, 120);
    let pixels = picture("minimal", size, minimal::setup);
    let background = pixels[0];
    let smoke = pixels.iter().filter(|pixel| pixel[1] > background[1].saturating_add(30)).count();
    // A column about a third as wide as the view is high.
    assert!(smoke * 100 > pixels.len() * 5, "{smoke} of {} pixels show smoke", pixels.len());
}

#[test]
fn demo_shows_smoke_and_meshes() {
    let size = UVec2::new(480, 360);
    let pixels = picture("demo", size, demo::setup);
    let count = |is: &dyn Fn([u8; 4]) -> bool| pixels.iter().filter(|pixel| is(**pixel)).count();
    let red = count(&|[r, g, b, _]| u32::from(r) > 2 * u32::from(g) && u32::from(r) > 2 * u32::from(b));
    let blue = count(&|[r, g, b, _]| u32::from(b) * 2 > 3 * u32::from(r) && u32::from(b) * 4 > 5 * u32::from(g));
    assert!(red > 300, "the sphere in front of the smoke: {red} pixels");
    assert!(blue > 300, "the wall behind it: {blue} pixels");
}
