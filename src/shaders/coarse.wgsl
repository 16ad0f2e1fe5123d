// Box-averages the density to the coarse grid that optical depths are marched through: a coarse
// value is the integral of the piecewise-constant density over the coarse cell, over its volume.
// The coarse grid is centred on the box; outside the box the density is zero.
#import bevy_smoke::frame::{Frame, MAX_HALF}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var density: texture_3d<f32>;
// Padded by one empty cell on each side, so that trilinear reads fade to zero.
@group(0) @binding(2) var coarse: texture_storage_3d<rgba16float, write>;

@compute @workgroup_size(4, 4, 4)
fn average(@builtin(global_invocation_id) id: vec3<u32>) {
    let padded = frame.coarse_dims + 2u;
    if any(id >= padded) {
        return;
    }
    var sum = 0.0;
    if all(id >= vec3(1u)) && all(id <= frame.coarse_dims) {
        let ratio = frame.coarse_ratio;
        // The coarse cell's span, in fine cells from the box's corner.
        let corner = 0.5 * (vec3<f32>(frame.dims) - vec3<f32>(frame.coarse_dims) * ratio);
        let low = corner + vec3<f32>(id - 1u) * ratio;
        let high = low + ratio;
        let first = vec3<i32>(max(floor(low), vec3(0.0)));
        let last = vec3<i32>(min(ceil(high), vec3<f32>(frame.dims)));
        for (var z = first.z; z < last.z; z++) {
            let depth = min(high.z, f32(z + 1)) - max(low.z, f32(z));
            for (var y = first.y; y < last.y; y++) {
                let height = min(high.y, f32(y + 1)) - max(low.y, f32(y));
                for (var x = first.x; x < last.x; x++) {
                    let width = min(high.x, f32(x + 1)) - max(low.x, f32(x));
                    sum += max(width, 0.0) * max(height, 0.0) * max(depth, 0.0)
                        * textureLoad(density, vec3(x, y, z), 0).x;
                }
            }
        }
        sum = min(sum * frame.density_scale / (ratio * ratio * ratio), MAX_HALF);
    }
    textureStore(coarse, id, vec4(sum, 0.0, 0.0, 0.0));
}
