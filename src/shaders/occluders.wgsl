// What stands between a volume's smoke and its light: other smoke, and the spheres of occluders. In the volume's bundle
// space. Filled by `Surroundings` (render/surroundings.rs).
#define_import_path bevy_smoke::occluders
#import bevy_smoke::casters::{Caster, MAX_CASTERS}

struct Surroundings {
    caster_count: u32,
    sphere_count: u32,
    casters: array<Caster, MAX_CASTERS>,
}

// Whether a sphere (centre, radius) hides from a point what is `distance` away. A point within a sphere counts as one on its
// surface, which hides half of all directions; a sphere that holds what is looked at hides nothing of it.
fn hides(sphere: vec4<f32>, point: vec3<f32>, towards: vec3<f32>, distance: f32) -> bool {
    let offset = sphere.xyz - point;
    let along = dot(offset, towards);
    let beside = dot(offset, offset) - along * along;
    let half_chord = sqrt(max(sphere.w * sphere.w - beside, 0.0));
    return along > 0.0 && half_chord > 0.0 && along + half_chord < distance;
}
