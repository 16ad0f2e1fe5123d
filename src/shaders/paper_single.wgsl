// Single scattering at every RBF's centre (Zhou et al. 2008, Eq. 10 and 11), one workgroup an RBF:
//     J = Omega g^l (L * exp*(-sigma sum_h w_h r_h T_h)),
// with the optical depths T_h of whole Gaussians, and products of functions of order 4, as spherical harmonics.
#import bevy_smoke::frame::{Frame, Rbf}
#import bevy_smoke::sh::{basis, band, SH_COEFFICIENTS}
#import bevy_smoke::lighting::{Lighting, PI}
#import bevy_smoke::paper::{Paper, Tables, UNIT}

const THREADS: u32 = 64u;
const ANGLES: u32 = 256u;
const NORMS: u32 = 65u;
const NORM_STEP: f32 = 0.25;
const DIRECTIONS: u32 = 50u;
const HALVINGS: u32 = 3u;

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> lighting: Lighting;
@group(0) @binding(2) var<uniform> paper: Paper;
@group(0) @binding(3) var<uniform> tables: Tables;
@group(0) @binding(4) var<storage, read> rbfs: array<Rbf>;
@group(0) @binding(5) var<storage, read> environment: array<vec4<f32>>;
// 16 coefficients an RBF.
@group(0) @binding(6) var<storage, read_write> source: array<vec4<f32>>;

// First every thread's share of the column, then the basis in every direction.
var<workgroup> shares: array<array<f32, 16>, THREADS>;
// The exponent, then its exponential.
var<workgroup> f: array<f32, 16>;
var<workgroup> light: array<vec3<f32>, 16>;
var<workgroup> values: array<vec3<f32>, THREADS>;

// The band factors of a Gaussian's optical depth from a distance in radii.
fn depth_factors(d: f32) -> vec4<f32> {
    // The half-angle that the radius subtends, carried on inside: asin(1/d), or acos(d) + pi/2.
    let outside = atan2(1.0, sqrt(max(d * d - 1.0, 0.0)));
    let inside = atan2(sqrt(max(1.0 - d * d, 0.0)), d) + 0.5 * PI;
    let beta = select(inside, outside, d > 1.0);
    let at = beta / PI * f32(ANGLES - 1u);
    let below = min(u32(at), ANGLES - 2u);
    return mix(tables.depth[below], tables.depth[below + 1u], at - f32(below));
}

// Turns f into f^2.
fn square(thread: u32) {
    workgroupBarrier();
    if thread < DIRECTIONS {
        var value = 0.0;
        for (var k = 0u; k < SH_COEFFICIENTS; k++) {
            value += f[k] * shares[thread][k];
        }
        values[thread] = vec3(value * value * tables.directions[thread].w);
    }
    workgroupBarrier();
    if thread < SH_COEFFICIENTS {
        f[thread] = project(thread).x;
    }
    workgroupBarrier();
}

// Coefficient k of the function with these values in the directions.
fn project(k: u32) -> vec3<f32> {
    var sum = vec3(0.0);
    for (var j = 0u; j < DIRECTIONS; j++) {
        sum += values[j] * shares[j][k];
    }
    return sum;
}

@compute @workgroup_size(THREADS)
fn single(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let l = group.x;
    let x = rbfs[l].center;
    var column: array<f32, 16>;
    for (var h = thread; h < frame.rbf_count; h += THREADS) {
        let rbf = rbfs[h];
        let offset = rbf.center - x;
        let distance = length(offset);
        let factors = rbf.weight * rbf.radius * depth_factors(distance / rbf.radius);
        // In its own centre an RBF is the same in all directions.
        let y = basis(select(vec3(0.0, 0.0, 1.0), offset / max(distance, 1e-20), distance > 0.0));
        for (var k = 0u; k < SH_COEFFICIENTS; k++) {
            column[k] += factors[band(k)] * y[k];
        }
    }
    shares[thread] = column;
    workgroupBarrier();
    if thread < SH_COEFFICIENTS {
        var sum = 0.0;
        for (var i = 0u; i < THREADS; i++) {
            sum += shares[i][thread];
        }
        f[thread] = -lighting.sigma_mean * frame.density_scale * sum;
        var turned = vec3(0.0);
        for (var j = 0u; j < SH_COEFFICIENTS; j++) {
            turned += paper.rotation[4u * thread + j / 4u][j % 4u] * environment[j].rgb;
        }
        let ambient = select(vec3(0.0), lighting.ambient * UNIT, thread == 0u);
        light[thread] = turned * lighting.environment_scale + ambient;
    }
    workgroupBarrier();
    if thread < DIRECTIONS {
        shares[thread] = basis(tables.directions[thread].xyz);
    }
    // exp*(f) = exp(f_0 / sqrt(4 pi)) exp*(the rest).
    let mean = exp(f[0] / UNIT);
    var norm2 = 0.0;
    for (var k = 1u; k < SH_COEFFICIENTS; k++) {
        norm2 += f[k] * f[k];
    }
    workgroupBarrier();
    let one = select(0.0, UNIT, thread == 0u);
    let own = select(f[thread % SH_COEFFICIENTS], 0.0, thread == 0u);
    if paper.hybrid != 0u {
        // 1 + g + g^2 / 2 with g = f / 2^HALVINGS, squared as often.
        let g = own / f32(1u << HALVINGS);
        workgroupBarrier();
        if thread < SH_COEFFICIENTS {
            f[thread] = g;
        }
        square(thread);
        if thread < SH_COEFFICIENTS {
            f[thread] = one + g + 0.5 * f[thread];
        }
        for (var i = 0u; i < HALVINGS; i++) {
            square(thread);
        }
        if thread < SH_COEFFICIENTS {
            f[thread] *= mean;
        }
    } else {
        let at = sqrt(norm2) / NORM_STEP;
        let below = min(u32(at), NORMS - 2u);
        let ab = exp(mix(tables.exponential[below], tables.exponential[below + 1u], at - f32(below)));
        workgroupBarrier();
        if thread < SH_COEFFICIENTS {
            f[thread] = (ab.x * one + ab.y * own) * mean;
        }
    }
    workgroupBarrier();
    if thread < DIRECTIONS {
        var kept = 0.0;
        var arriving = vec3(0.0);
        for (var k = 0u; k < SH_COEFFICIENTS; k++) {
            kept += f[k] * shares[thread][k];
            arriving += light[k] * shares[thread][k];
        }
        values[thread] = arriving * (kept * tables.directions[thread].w);
    }
    workgroupBarrier();
    if thread < SH_COEFFICIENTS {
        source[l * SH_COEFFICIENTS + thread] = vec4(lighting.scatter[band(thread)].rgb * project(thread), 0.0);
    }
}
