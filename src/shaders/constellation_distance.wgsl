// Distance map: how far every cell of the padded grid is from smoke, in cells by the largest of |x|, |y| and |z|, and no
// farther than FARTHEST; beside the density, in the texture that rays are marched through (Navarro et al. 2008, 4.1).
// The distance is exact, and found axis by axis: d(x) = min over r of max(|r|, d'(x + r)), d' that of the axes before.
// Variants: FIRST reads the density, the others the distances along the axes before; LAST packs distance and density.
#import bevy_smoke::frame::{Frame, MAX_HALF}

// As in reference/constellation/distance.rs.
const FARTHEST: i32 = 32;
// Scaled density below this is none: the halves of the texture cannot hold much less.
const EMPTY: f32 = 1e-4;

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var density: texture_3d<f32>;
#ifdef FIRST
@group(0) @binding(2) var distances: texture_storage_3d<r32float, write>;
const AXIS: vec3<i32> = vec3(1, 0, 0);
#else
@group(0) @binding(2) var before: texture_3d<f32>;
#ifdef LAST
// Red: distance; alpha: scaled density.
@group(0) @binding(3) var packed: texture_storage_3d<rgba16float, write>;
const AXIS: vec3<i32> = vec3(0, 0, 1);
#else
@group(0) @binding(3) var distances: texture_storage_3d<r32float, write>;
const AXIS: vec3<i32> = vec3(0, 1, 0);
#endif
#endif

// Of a cell of the padded grid; 0 outside the box.
fn scaled_density(at: vec3<i32>) -> f32 {
    let cell = at - 1;
    if any(cell < vec3(0)) || any(cell >= vec3<i32>(frame.dims)) {
        return 0.0;
    }
    let value = min(textureLoad(density, cell, 0).x * frame.density_scale, MAX_HALF);
    return select(value, 0.0, value < EMPTY);
}

fn distance_before(at: vec3<i32>) -> i32 {
    if any(at < vec3(0)) || any(at >= vec3<i32>(frame.dims) + 2) {
        return FARTHEST;
    }
#ifdef FIRST
    return select(FARTHEST, 0, scaled_density(at) > 0.0);
#else
    return i32(textureLoad(before, at, 0).x);
#endif
}

@compute @workgroup_size(4, 4, 4)
fn sweep(@builtin(global_invocation_id) id: vec3<u32>) {
    if any(id >= frame.dims + 2u) {
        return;
    }
    let at = vec3<i32>(id);
    var found = distance_before(at);
    for (var r = 1; r < found; r++) {
        found = min(found, max(r, min(distance_before(at - r * AXIS), distance_before(at + r * AXIS))));
    }
#ifdef LAST
    textureStore(packed, id, vec4(f32(found), 0.0, 0.0, scaled_density(at)));
#else
    textureStore(distances, id, vec4(f32(found), 0.0, 0.0, 0.0));
#endif
}
