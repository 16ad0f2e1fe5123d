// Rays through a volume's box, in its bundle space, and the texture that holds it.
#define_import_path bevy_smoke::march

struct Ray {
    origin: vec3<f32>,
    direction: vec3<f32>,
    // Where it enters and leaves the box; empty where leave <= enter.
    enter: f32,
    leave: f32,
}

// The part of a ray from a point that is in the box, ahead.
fn ray_in_box(origin: vec3<f32>, direction: vec3<f32>, half_extent: vec3<f32>) -> Ray {
    let inverse = 1.0 / select(direction, vec3(1e-9), abs(direction) < vec3(1e-9));
    let a = (-half_extent - origin) * inverse;
    let b = (half_extent - origin) * inverse;
    let nearer = min(a, b);
    let farther = max(a, b);
    let enter = max(max(nearer.x, nearer.y), max(nearer.z, 0.0));
    let leave = min(farther.x, min(farther.y, farther.z));
    return Ray(origin, direction, enter, leave);
}

// The ray of a point on the screen, in normalised device coordinates; `eye` is in bundle space (w = 1), or w = 0 where rays
// are parallel.
fn ray_through(bundle_from_clip: mat4x4<f32>, eye: vec4<f32>, half_extent: vec3<f32>, ndc: vec2<f32>) -> Ray {
    let near = bundle_from_clip * vec4(ndc, 1.0, 1.0);
    // Depth 0 is the far plane, infinitely far (w = 0) under a perspective.
    let far = bundle_from_clip * vec4(ndc, 0.0, 1.0);
    let origin = select(near.xyz / near.w, eye.xyz, eye.w > 0.0);
    return ray_in_box(origin, normalize(far.xyz * near.w - near.xyz * far.w), half_extent);
}

// uvw of a point in a texture of cells that is padded by one on each side.
fn texture_position(x: vec3<f32>, half_extent: vec3<f32>, cell: f32) -> vec3<f32> {
    return x / (2.0 * half_extent + 2.0 * cell) + 0.5;
}

// How many samples `step` apart along a direction are sure to be empty after one that is. `found` is what a distance map, in
// cells, is there between its texels: up to a cell too much; and a cell from smoke its trilinear density begins. The rest is
// for rounding.
fn empty_samples(found: f32, direction: vec3<f32>, cell: f32, step: f32) -> u32 {
    let along = max(abs(direction.x), max(abs(direction.y), abs(direction.z)));
    return u32(max(found - 2.02, 0.0) * cell / (along * step));
}
