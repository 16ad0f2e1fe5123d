// Light that reaches every RBF's probes through the smoke, straight from where it comes from: one thread a direction, so
// that a workgroup of 64 has room for one probe that looks in 64 of them, or for the same probe of 64 / DIRECTIONS RBFs. Each thread takes the environment's radiance along its direction, attenuated by the
// optical depth through the coarse density grid; the workgroup projects the result to SH:
//     L_d,k = (4 pi / N) sum_j L(w_j) exp(-tau_j) y_k(w_j).
// Around the smoke, other smoke adds to the optical depth, and spheres hide a part of the cone about each direction.
// Beside it: the share of light from all around that gets through, mean exp(-tau_j), a grey exp(-tau) as SH, and the
// density columns to the lamps.
#import bevy_smoke::casters::{crossing, optical_depth}
#import bevy_smoke::frame::{Frame, Rbf}
#import bevy_smoke::sh::{basis, SH_COEFFICIENTS}
#import bevy_smoke::lighting::{Lighting, arriving_from, probe_position, probe_reach, MAX_LAMPS, PI, PROBES}

#import bevy_smoke::occluders::{Surroundings, hides}

// Directions each probe looks in: 16, 32 or 64.
const DIRECTIONS: u32 = #{DIRECTIONS}u;
const THREADS: u32 = 64u;
const MARCH_STEPS: u32 = 20u;
// Steps through other smoke.
const OTHER_STEPS: u32 = 16u;
const GOLDEN_ANGLE: f32 = 2.39996322972865;

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> lighting: Lighting;
@group(0) @binding(2) var<storage, read> rbfs: array<Rbf>;
@group(0) @binding(3) var<storage, read> environment: array<vec4<f32>>;
@group(0) @binding(4) var coarse: texture_3d<f32>;
@group(0) @binding(5) var coarse_sampler: sampler;
// Room for 16 coefficients a probe: light, and grey transmittance in alpha.
@group(0) @binding(6) var<storage, read_write> probes: array<vec4<f32>>;
// The share that gets through, one a probe.
@group(0) @binding(7) var<storage, read_write> escapes: array<vec4<f32>>;
// Scaled density times bundle length, MAX_LAMPS a probe; other smoke's as if it were this. Below 0 where a sphere hides the
// lamp.
@group(0) @binding(8) var<storage, read_write> columns: array<f32>;
@group(0) @binding(9) var<uniform> surroundings: Surroundings;
@group(0) @binding(10) var<storage, read> spheres: array<vec4<f32>>;
// The casters' densities.
@group(0) @binding(11) var densities: texture_3d<f32>;

// Fibonacci directions, y up.
fn direction(j: u32) -> vec3<f32> {
    let height = 1.0 - (2.0 * f32(j) + 1.0) / f32(DIRECTIONS);
    let radius = sqrt(max(0.0, 1.0 - height * height));
    let phi = f32(j) * GOLDEN_ANGLE;
    return vec3(radius * cos(phi), height, radius * sin(phi));
}

// Integral of the coarse density from `from_point` to a lamp or the exit of the grid, in bundle units.
fn column(from_point: vec3<f32>, towards: vec3<f32>, distance: f32) -> f32 {
    let coarse_cell = frame.coarse_ratio * frame.cell;
    // Beyond half a cell outside the grid the trilinear density is zero.
    let half_extent = 0.5 * (vec3<f32>(frame.coarse_dims) + 1.0) * coarse_cell;
    let inverse = 1.0 / select(towards, vec3(1e-9), abs(towards) < vec3(1e-9));
    let a = (-half_extent - from_point) * inverse;
    let b = (half_extent - from_point) * inverse;
    let nearer = min(a, b);
    let farther = max(a, b);
    let begin = max(max(nearer.x, nearer.y), max(nearer.z, 0.0));
    let end = min(min(farther.x, distance), min(farther.y, farther.z));
    if end <= begin {
        return 0.0;
    }
    let step = (end - begin) / f32(MARCH_STEPS);
    let padded = vec3<f32>(frame.coarse_dims + 2u);
    var sum = 0.0;
    for (var i = 0u; i < MARCH_STEPS; i++) {
        let x = from_point + towards * (begin + (f32(i) + 0.5) * step);
        let uvw = x / (coarse_cell * padded) + 0.5;
        sum += textureSampleLevel(coarse, coarse_sampler, uvw, 0.0).x;
    }
    return sum * step;
}

fn environment_radiance(towards: vec3<f32>) -> vec3<f32> {
    let y = basis(lighting.environment_from_bundle * towards);
    let sun = basis(lighting.sun_direction);
    var radiance = vec3(0.0);
    for (var k = 0u; k < SH_COEFFICIENTS; k++) {
        radiance += y[k] * (environment[k].rgb - sun[k] * lighting.sun_irradiance);
    }
    return radiance * lighting.environment_scale + lighting.ambient;
}

// Optical depth of other smoke.
fn other_depth(point: vec3<f32>, towards: vec3<f32>, distance: f32) -> f32 {
    var tau = 0.0;
    for (var i = 0u; i < surroundings.caster_count; i++) {
        let caster = surroundings.casters[i];
        tau += optical_depth(caster, densities, coarse_sampler, crossing(caster, point, towards, distance), OTHER_STEPS);
    }
    return tau;
}

// From the middle of a direction's cone to that of a quarter of it.
const QUARTER: f32 = 0.13 * sqrt(64.0 / f32(DIRECTIONS));

// The share of a direction's cone that no sphere hides, in quarters.
fn unhidden(point: vec3<f32>, towards: vec3<f32>) -> f32 {
    let x = normalize(select(cross(towards, vec3(1.0, 0.0, 0.0)), cross(towards, vec3(0.0, 1.0, 0.0)), abs(towards.x) > 0.7));
    let y = cross(towards, x);
    let quarters = array<vec3<f32>, 4>(
        normalize(towards + QUARTER * x),
        normalize(towards + QUARTER * y),
        normalize(towards - QUARTER * x),
        normalize(towards - QUARTER * y),
    );
    var seen = vec4(1.0);
    for (var i = 0u; i < surroundings.sphere_count; i++) {
        let sphere = spheres[i];
        for (var j = 0u; j < 4u; j++) {
            seen[j] = select(seen[j], 0.0, hides(sphere, point, quarters[j], 1e30));
        }
    }
    return dot(seen, vec4(0.25));
}

fn is_hidden(point: vec3<f32>, towards: vec3<f32>, distance: f32) -> bool {
    for (var i = 0u; i < surroundings.sphere_count; i++) {
        if hides(spheres[i], point, towards, distance) {
            return true;
        }
    }
    return false;
}

// Light in a direction, and grey transmittance in alpha.
var<workgroup> arriving: array<vec4<f32>, THREADS>;
var<workgroup> escaping: array<vec3<f32>, THREADS>;
var<workgroup> bases: array<array<f32, 16>, THREADS>;

@compute @workgroup_size(THREADS)
fn gather(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    // Of live smoke, the CPU knows only how many there may be.
    if group.x * (THREADS / DIRECTIONS) >= frame.rbf_count {
        return;
    }
    // What there is none of looks like the last, and is not written.
    let l = group.x * (THREADS / DIRECTIONS) + thread / DIRECTIONS;
    let is_there = l < frame.rbf_count;
    let rbf = rbfs[min(l, frame.rbf_count - 1u)];
    let first = thread - thread % DIRECTIONS;
    let own = thread % DIRECTIONS;
    let reach = probe_reach(rbf, lighting.sigma_mean, frame.density_scale);
    let point = probe_position(rbf.center, reach, group.y);
    let probe = l * PROBES + group.y;
    let towards = direction(own);
    let met = column(point, towards, 1e30);
    let kept = exp(-lighting.sigma * met);
    var radiance = environment_radiance(towards) * kept * exp(-other_depth(point, towards, 1e30));
    if surroundings.sphere_count > 0u {
        radiance *= unhidden(point, towards);
    }
    arriving[thread] = vec4(radiance, exp(-lighting.sigma_mean * met));
    escaping[thread] = kept;
    bases[thread] = basis(towards);
    if own < lighting.lamp_count && is_there {
        let light = arriving_from(lighting.lamps[own], point, lighting.softening);
        var to_lamp = column(point, light.direction, light.distance);
        if surroundings.caster_count > 0u {
            to_lamp += other_depth(point, light.direction, light.distance) / max(lighting.sigma_mean, 1e-6);
        }
        let hidden = is_hidden(point, light.direction, light.distance);
        columns[probe * MAX_LAMPS + own] = select(to_lamp, -max(to_lamp, 1e-20), hidden);
    }
    workgroupBarrier();
    if !is_there {
        return;
    }
    if own < lighting.light_coefficients {
        var sum = vec4(0.0);
        for (var j = first; j < first + DIRECTIONS; j++) {
            sum += arriving[j] * bases[j][own];
        }
        probes[probe * SH_COEFFICIENTS + own] = sum * (4.0 * PI / f32(DIRECTIONS));
    }
    if own == DIRECTIONS - 1u {
        var escape = vec3(0.0);
        for (var j = first; j < first + DIRECTIONS; j++) {
            escape += escaping[j];
        }
        escapes[probe] = vec4(escape / f32(DIRECTIONS), 0.0);
    }
}
