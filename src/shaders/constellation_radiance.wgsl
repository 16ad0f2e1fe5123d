// Resamples an environment to a latitude-longitude grid, in the environment's own axes: the mean radiance over each texel's
// solid angle, so that no light is lost. One thread a texel.
// Variants: EQUIRECT reads a 2D latitude-longitude image, COEFFICIENTS 16 spherical-harmonic coefficients, whose negative
// lobes are dark; otherwise a cube map is read.
#import bevy_smoke::radiance::{equirect_direction, sane, PI}
#ifdef COEFFICIENTS
#import bevy_smoke::sh::{basis, SH_COEFFICIENTS}
#endif

// Texels of the grid; as in constellation_lights.wgsl and render/constellation/lights.rs.
const GRID: vec2<u32> = vec2(128u, 64u);

@group(0) @binding(0) var<storage, read_write> grid: array<vec4<f32>>;
#ifdef EQUIRECT
@group(0) @binding(1) var radiance_map: texture_2d<f32>;
#else
#ifdef COEFFICIENTS
@group(0) @binding(1) var<storage, read> environment: array<vec4<f32>>;
#else
@group(0) @binding(1) var radiance_map: texture_cube<f32>;
@group(0) @binding(2) var radiance_sampler: sampler;
#endif
#endif

#ifdef EQUIRECT

// The texels of the image that are under the texel of the grid, each by the part of it that is.
fn mean_radiance(at: vec2<u32>) -> vec3<f32> {
    let size = textureDimensions(radiance_map);
    let scale = vec2<f32>(size) / vec2<f32>(GRID);
    let low = vec2<f32>(at) * scale;
    let high = vec2<f32>(at + 1u) * scale;
    let first = vec2<u32>(low);
    let last = min(vec2<u32>(ceil(high)), size);
    var sum = vec3(0.0);
    var weights = 0.0;
    for (var y = first.y; y < last.y; y++) {
        // Solid angle goes with the height, cos theta: cos a - cos b = 2 sin((a + b) / 2) sin((b - a) / 2).
        let top = max(low.y, f32(y)) * PI / f32(size.y);
        let bottom = min(high.y, f32(y + 1u)) * PI / f32(size.y);
        let band = 2.0 * sin(0.5 * (top + bottom)) * sin(0.5 * max(bottom - top, 0.0));
        for (var x = first.x; x < last.x; x++) {
            let weight = band * max(min(high.x, f32(x + 1u)) - max(low.x, f32(x)), 0.0);
            sum += weight * sane(textureLoad(radiance_map, vec2(x, y), 0).rgb);
            weights += weight;
        }
    }
    return sum / weights;
}

#else

// The samples' mean, each weighted by its solid angle.
fn mean_radiance(at: vec2<u32>) -> vec3<f32> {
#ifdef COEFFICIENTS
    // Four bands are smooth over a texel of 3 degrees.
    let samples = 2u;
#else
    // About one a texel of the cube map, whose faces see 90 degrees.
    let samples = clamp((textureDimensions(radiance_map).x + 31u) / 32u, 2u, 64u);
#endif
    var sum = vec3(0.0);
    var weights = 0.0;
    for (var y = 0u; y < samples; y++) {
        for (var x = 0u; x < samples; x++) {
            let uv = (vec2<f32>(at) + (vec2(f32(x), f32(y)) + 0.5) / f32(samples)) / vec2<f32>(GRID);
            let direction = equirect_direction(uv);
            let weight = sin(PI * uv.y);
            sum += weight * radiance_from(direction);
            weights += weight;
        }
    }
    return sum / weights;
}

fn radiance_from(direction: vec3<f32>) -> vec3<f32> {
#ifdef COEFFICIENTS
    let y = basis(direction);
    var radiance = vec3(0.0);
    for (var k = 0u; k < SH_COEFFICIENTS; k++) {
        radiance += y[k] * environment[k].rgb;
    }
    return max(radiance, vec3(0.0));
#else
    // Cube maps are left-handed: Bevy negates z when it samples them.
    return sane(textureSampleLevel(radiance_map, radiance_sampler, direction * vec3(1.0, 1.0, -1.0), 0.0).rgb);
#endif
}

#endif

@compute @workgroup_size(8, 8)
fn resample(@builtin(global_invocation_id) id: vec3<u32>) {
    grid[id.x + GRID.x * id.y] = vec4(mean_radiance(id.xy), 0.0);
}
