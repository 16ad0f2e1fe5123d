// Validity mask: the number of the first sample along every pixel's ray that is in smoke (Navarro et al. 2008, 4.2). Samples
// are where the view pass has them: the i-th ends (i + 1) steps from the eye, and its density is that in its middle.
#import bevy_smoke::march::{empty_samples, ray_through, texture_position}

struct Mask {
    bundle_from_clip: mat4x4<f32>,
    eye: vec4<f32>,
    half_extent: vec3<f32>,
    // Side of a cell in bundle space.
    cell: f32,
    // Pixels.
    size: vec2<u32>,
    // Between samples, in bundle space.
    step: f32,
    // Whether to leave out samples that the distance map says are empty: 0 or 1.
    skip_empty: u32,
}

// Of pixels that show no smoke; as in constellation.wgsl.
const NONE: u32 = 0xffffffffu;

@group(0) @binding(0) var<uniform> mask: Mask;
// Red: distance to smoke, in cells; alpha: scaled density.
@group(0) @binding(1) var volume: texture_3d<f32>;
@group(0) @binding(2) var volume_sampler: sampler;
@group(0) @binding(3) var first_samples: texture_storage_2d<r32uint, write>;

@compute @workgroup_size(8, 8)
fn find_first(@builtin(global_invocation_id) id: vec3<u32>) {
    if any(id.xy >= mask.size) {
        return;
    }
    let uv = (vec2<f32>(id.xy) + 0.5) / vec2<f32>(mask.size);
    let ndc = vec2(2.0 * uv.x - 1.0, 1.0 - 2.0 * uv.y);
    let ray = ray_through(mask.bundle_from_clip, mask.eye, mask.half_extent, ndc);
    var first = NONE;
    if ray.leave > ray.enter {
        let end = u32(ceil(ray.leave / mask.step));
        var i = u32(ray.enter / mask.step);
        while i < end {
            let x = ray.origin + ray.direction * ((f32(i) + 0.5) * mask.step);
            let s = textureSampleLevel(volume, volume_sampler, texture_position(x, mask.half_extent, mask.cell), 0.0);
            if s.a > 0.0 {
                first = i;
                break;
            }
            i++;
            if mask.skip_empty != 0u {
                i += empty_samples(s.r, ray.direction, mask.cell, mask.step);
            }
        }
    }
    textureStore(first_samples, id.xy, vec4(first, 0u, 0u, 0u));
}
