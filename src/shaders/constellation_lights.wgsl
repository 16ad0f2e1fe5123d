// Median cut (Debevec 2005): a grid of radiance becomes a constellation of distant lights of about the same energy. Starting
// with the whole sphere, the region with the most energy is cut in two again and again, along its longer side (that of
// longitude times the cosine of its latitude), where both parts have most nearly the same energy. A region's light comes from
// its centroid, weighted by energy, and has all of its radiance times solid angle.
// One workgroup; a thread a region, or a place to cut.
#import bevy_smoke::radiance::{equirect_direction, equirect_solid_angle, PI}

const GRID: vec2<u32> = vec2(128u, 64u);
const THREADS: u32 = 256u;
// Energies this close, and cuts this close to the middle, are as good as each other: rounding must not decide.
const CLOSE: f32 = 1e-4;

struct Cut {
    // Radiance from everywhere, on top of the environment.
    ambient: vec3<f32>,
    // Multiplies the environment's radiance.
    scale: f32,
    // At most THREADS.
    light_count: u32,
}

struct Light {
    // Toward the light, in the environment's axes.
    direction: vec3<f32>,
    // Irradiance on a surface that faces it.
    color: vec3<f32>,
}

struct Constellation {
    // Radiance, the mean over all directions.
    mean: vec3<f32>,
    lights: array<Light, THREADS>,
}

@group(0) @binding(0) var<uniform> cut: Cut;
@group(0) @binding(1) var<storage, read> grid: array<vec4<f32>>;
// Energy of all texels above and to the left of a corner, GRID + 1 corners.
@group(0) @binding(2) var<storage, read_write> sums: array<f32>;
@group(0) @binding(3) var<storage, read_write> constellation: Constellation;

fn irradiance(at: vec2<u32>) -> vec3<f32> {
    let radiance = grid[at.x + GRID.x * at.y].rgb * cut.scale + cut.ambient;
    return radiance * equirect_solid_angle(at.y, GRID);
}

fn luminance(color: vec3<f32>) -> f32 {
    return dot(color, vec3(0.2126, 0.7152, 0.0722));
}

fn corner(x: u32, y: u32) -> u32 {
    return x + (GRID.x + 1u) * y;
}

// Columns x to z, rows y to w.
fn energy_of(region: vec4<u32>) -> f32 {
    let sum = sums[corner(region.z, region.w)] - sums[corner(region.x, region.w)]
        - sums[corner(region.z, region.y)] + sums[corner(region.x, region.y)];
    return max(sum, 0.0);
}

// Whether a region is to be cut across its columns.
fn is_wide(region: vec4<u32>) -> bool {
    let size = vec2<f32>(region.zw - region.xy);
    // A row is as high as a column is wide on the equator.
    let width = size.x * sin(PI * 0.5 * f32(region.y + region.w) / f32(GRID.y));
    return size.y < 2.0 || (size.x > 1.0 && width >= size.y);
}

var<workgroup> regions: array<vec4<u32>, THREADS>;
var<workgroup> values: array<f32, THREADS>;
var<workgroup> places: array<u32, THREADS>;
var<workgroup> totals: array<vec3<f32>, THREADS>;

// Leaves in places[0] a place of the largest value, the lower of two that are within a margin.
fn find_largest(thread: u32, margin: f32) {
    places[thread] = thread;
    for (var reach = THREADS / 2u; reach > 0u; reach /= 2u) {
        workgroupBarrier();
        if thread < reach && values[thread + reach] > values[thread] + margin {
            values[thread] = values[thread + reach];
            places[thread] = places[thread + reach];
        }
    }
    workgroupBarrier();
}

@compute @workgroup_size(THREADS)
fn median_cut(@builtin(local_invocation_index) thread: u32) {
    // Sums along the rows, then down the columns.
    for (var y = thread; y <= GRID.y; y += THREADS) {
        var sum = 0.0;
        sums[corner(0u, y)] = 0.0;
        for (var x = 0u; x < GRID.x; x++) {
            if y > 0u {
                sum += luminance(irradiance(vec2(x, y - 1u)));
            }
            sums[corner(x + 1u, y)] = sum;
        }
    }
    storageBarrier();
    for (var x = thread; x <= GRID.x; x += THREADS) {
        var sum = 0.0;
        for (var y = 0u; y <= GRID.y; y++) {
            sum += sums[corner(x, y)];
            sums[corner(x, y)] = sum;
        }
    }
    storageBarrier();

    regions[thread] = vec4(0u, 0u, GRID);
    workgroupBarrier();
    let all = energy_of(regions[0]);
    for (var count = 1u; count < cut.light_count; count++) {
        let mine = regions[thread];
        let can_be_cut = thread < count && any(mine.zw - mine.xy > vec2(1u));
        values[thread] = select(-1.0, energy_of(mine), can_be_cut);
        find_largest(thread, CLOSE * all / f32(count));
        let chosen = places[0];
        let region = regions[chosen];
        let wide = is_wide(region);
        let energy = energy_of(region);
        // The part before a cut, for a cut a thread.
        let at = region.xy + thread + 1u;
        let first = select(vec4(region.xyz, at.y), vec4(region.xy, at.x, region.w), wide);
        let exists = select(at.y < region.w, at.x < region.z, wide);
        workgroupBarrier();
        values[thread] = -1e38;
        if exists {
            values[thread] = -abs(energy_of(first) - 0.5 * energy);
        }
        find_largest(thread, CLOSE * energy);
        if thread == places[0] {
            regions[chosen] = first;
            regions[count] = select(vec4(region.x, at.y, region.zw), vec4(at.x, region.yzw), wide);
        }
        workgroupBarrier();
    }

    var color = vec3(0.0);
    if thread < cut.light_count {
        let region = regions[thread];
        var towards = vec3(0.0);
        for (var y = region.y; y < region.w; y++) {
            for (var x = region.x; x < region.z; x++) {
                let part = irradiance(vec2(x, y));
                color += part;
                towards += equirect_direction((vec2(f32(x), f32(y)) + 0.5) / vec2<f32>(GRID)) * luminance(part);
            }
        }
        // Dark regions, and light from all around, have no centroid.
        let middle = equirect_direction(0.5 * vec2<f32>(region.xy + region.zw) / vec2<f32>(GRID));
        let length = length(towards);
        let direction = select(middle, towards / max(length, 1e-30), length > 1e-4 * luminance(color));
        constellation.lights[thread] = Light(direction, color);
    }
    totals[thread] = color;
    for (var reach = THREADS / 2u; reach > 0u; reach /= 2u) {
        workgroupBarrier();
        if thread < reach {
            totals[thread] += totals[thread + reach];
        }
    }
    if thread == 0u {
        constellation.mean = totals[0] / (4.0 * PI);
    }
}
