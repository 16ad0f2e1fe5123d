// Projects an environment's radiance to 16 RGB spherical-harmonic coefficients,
//     L_k = sum over texels of L(w) y_k(w) dw,
// in two steps: `project` sums a share of the texels in every workgroup, `reduce` adds the shares.
// Variants: EQUIRECT reads a 2D latitude-longitude image, otherwise a cube map is read.
#import bevy_smoke::radiance::{equirect_direction, equirect_solid_angle, sane}
#import bevy_smoke::sh::{basis, SH_COEFFICIENTS}

// Workgroups of `project`; as in render/environment.rs.
const GROUPS: u32 = 64u;
const THREADS: u32 = 64u;

@group(0) @binding(0) var<storage, read_write> partial_sums: array<vec4<f32>>;
@group(0) @binding(1) var<storage, read_write> coefficients: array<vec4<f32>>;
#ifdef EQUIRECT
@group(0) @binding(2) var radiance_map: texture_2d<f32>;
#else
@group(0) @binding(2) var radiance_map: texture_cube<f32>;
@group(0) @binding(3) var radiance_sampler: sampler;
#endif

struct Texel {
    // Direction in the map's frame, right-handed, y up.
    direction: vec3<f32>,
    radiance: vec3<f32>,
    solid_angle: f32,
}

#ifdef EQUIRECT

fn texel_count() -> u32 {
    let size = textureDimensions(radiance_map);
    return size.x * size.y;
}

fn texel(index: u32) -> Texel {
    let size = textureDimensions(radiance_map);
    let at = vec2<u32>(index % size.x, index / size.x);
    let direction = equirect_direction((vec2<f32>(at) + 0.5) / vec2<f32>(size));
    return Texel(direction, sane(textureLoad(radiance_map, at, 0).rgb), equirect_solid_angle(at.y, size));
}

#else

// Samples along a face's side: one a texel, but enough that the sum is an integral. Smaller maps (Bevy's gradients have
// one texel a face) are what filtering between their texels makes of them.
fn face_side() -> u32 {
    return max(textureDimensions(radiance_map).x, 32u);
}

fn texel_count() -> u32 {
    let side = face_side();
    return 6u * side * side;
}

fn texel(index: u32) -> Texel {
    let side = face_side();
    let face = index / (side * side);
    let within = index % (side * side);
    let uv = (vec2(f32(within % side), f32(within / side)) + 0.5) / f32(side) * 2.0 - 1.0;
    var sample_direction: vec3<f32>;
    switch face {
        case 0u: { sample_direction = vec3(1.0, -uv.y, -uv.x); }
        case 1u: { sample_direction = vec3(-1.0, -uv.y, uv.x); }
        case 2u: { sample_direction = vec3(uv.x, 1.0, uv.y); }
        case 3u: { sample_direction = vec3(uv.x, -1.0, -uv.y); }
        case 4u: { sample_direction = vec3(uv.x, -uv.y, 1.0); }
        default: { sample_direction = vec3(-uv.x, -uv.y, -1.0); }
    }
    // The texel's area over r^3, r^2 = 1 + u^2 + v^2.
    let solid_angle = 4.0 / f32(side * side) * pow(1.0 + dot(uv, uv), -1.5);
    let radiance = sane(textureSampleLevel(radiance_map, radiance_sampler, sample_direction, 0.0).rgb);
    // Cube maps are left-handed: Bevy negates z when it samples them.
    let direction = normalize(sample_direction * vec3(1.0, 1.0, -1.0));
    return Texel(direction, radiance, solid_angle);
}

#endif

var<workgroup> shares: array<array<vec3<f32>, 16>, 64>;

@compute @workgroup_size(64)
fn project(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    var sum: array<vec3<f32>, 16>;
    let count = texel_count();
    for (var i = group.x * THREADS + thread; i < count; i += GROUPS * THREADS) {
        let t = texel(i);
        let y = basis(t.direction);
        for (var k = 0u; k < SH_COEFFICIENTS; k++) {
            sum[k] += t.radiance * (t.solid_angle * y[k]);
        }
    }
    shares[thread] = sum;
    workgroupBarrier();
    if thread < SH_COEFFICIENTS {
        var total = vec3(0.0);
        for (var i = 0u; i < THREADS; i++) {
            total += shares[i][thread];
        }
        partial_sums[group.x * SH_COEFFICIENTS + thread] = vec4(total, 0.0);
    }
}

@compute @workgroup_size(16)
fn reduce(@builtin(local_invocation_index) k: u32) {
    var total = vec4(0.0);
    for (var i = 0u; i < GROUPS; i++) {
        total += partial_sums[i * SH_COEFFICIENTS + k];
    }
    coefficients[k] = total;
}
