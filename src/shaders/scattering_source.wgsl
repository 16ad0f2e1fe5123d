// What starts multiple scattering: the mean source radiance of every RBF's probes due to light that has not scattered
// yet, the environment's and the lamps' (projected to SH), and how much of what the RBF sees is not smoke:
//     S_k = Omega' g'^l mean_i (L_d,ik + sum_lamps E_i exp(-tau_i) y_k(w_i)),   escape = mean_i escape_i.
// Near a lamp, where 1 / d^2 changes much within an RBF, its mean is not the probes' but the Gaussian's own,
// (2 / r^2) Daw(u) / u.
// The RBFs around tell roughly in which directions smoke is seen, H_k; the probes' transmittance T_k tells exactly. The
// difference, times the mean radiance seen G_0, is light too:
//     C_k = (-T_k - (1 - T_0 / sqrt(4 pi)) H_k) / sqrt(4 pi),   k >= 1.
// Also readies the solution before to start from: RBFs are known by their place in the list.
#import bevy_smoke::frame::{Frame, Rbf}
#import bevy_smoke::sh::{basis, band, SH_COEFFICIENTS}
#import bevy_smoke::lighting::{Lamp, Lighting, arriving_from, probe_position, probe_reach, MAX_LAMPS, PI, PROBES}
#import bevy_smoke::footprint::{Footprints, pair_entry, pair_footprint}
#import bevy_smoke::scattering::{Control, source_stride}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> lighting: Lighting;
@group(0) @binding(2) var<uniform> footprints: Footprints;
@group(0) @binding(3) var<storage, read> rbfs: array<Rbf>;
@group(0) @binding(4) var<storage, read> probes: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> escapes: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> columns: array<f32>;
@group(0) @binding(7) var<storage, read> rows: array<f32>;
// S_k, with C_k in alpha; after the coefficients, escape.
@group(0) @binding(8) var<storage, read_write> sources: array<vec4<f32>>;
@group(0) @binding(9) var<storage, read_write> states: array<vec4<f32>>;
@group(0) @binding(10) var<storage, read_write> control: Control;

const INVERSE_SQRT_PI: f32 = 0.564189583547756;

// The sum over an RBF's probes of a lamp's light: coefficient k.
fn lamp_light(l: u32, rbf: Rbf, lamp: Lamp, j: u32, k: u32) -> vec3<f32> {
    var light = vec3(0.0);
    var inverse_squares = 0.0;
    for (var i = 0u; i < lighting.probes; i++) {
        let reach = probe_reach(rbf, lighting.sigma_mean, frame.density_scale);
        let point = probe_position(rbf.center, reach, i);
        let seen = arriving_from(lamp, point, lighting.softening);
        let column = columns[(l * PROBES + i) * MAX_LAMPS + j];
        let kept = select(exp(-lighting.sigma * column), vec3(0.0), column < 0.0);
        light += seen.irradiance * kept * basis(seen.direction)[k];
        inverse_squares += 1.0 / (seen.distance * seen.distance + lighting.softening);
    }
    if lamp.is_sun != 0u {
        return light;
    }
    let u = distance(lamp.position, rbf.center) / rbf.radius;
    let at = pair_entry(u);
    let below = u32(at);
    let found = mix(footprints.pairs[below], footprints.pairs[below + 1u], fract(at));
    let mean = 4.0 * INVERSE_SQRT_PI * pair_footprint(found, u) / (rbf.radius * rbf.radius);
    return light * (mean * f32(lighting.probes) / inverse_squares);
}

@compute @workgroup_size(64)
fn start(@builtin(global_invocation_id) id: vec3<u32>) {
    let coefficients = lighting.coefficients;
    let l = id.x / coefficients;
    let k = id.x % coefficients;
    if id.x == 0u {
        control = Control();
    }
    if l >= frame.rbf_count {
        // Those that come later start from black, not from what was there before.
        if l < frame.rbf_capacity {
            states[id.x] = vec4(0.0);
        }
        return;
    }
    let rbf = rbfs[l];
    var light = vec3(0.0);
    var escape = vec3(0.0);
    // Transmittance: coefficients 0 and k.
    var passing = vec2(0.0);
    for (var i = 0u; i < lighting.probes; i++) {
        let probe = l * PROBES + i;
        let found = probes[probe * SH_COEFFICIENTS + k];
        light += found.rgb;
        escape += escapes[probe].rgb;
        passing += vec2(probes[probe * SH_COEFFICIENTS].a, found.a);
    }
    for (var j = 0u; j < lighting.lamp_count; j++) {
        light += lamp_light(l, rbf, lighting.lamps[j], j, k);
    }
    let mean = 1.0 / f32(lighting.probes);
    passing *= mean;
    let root = sqrt(4.0 * PI);
    let view = rows[l * SH_COEFFICIENTS + k];
    let correction = select((-passing.y - (1.0 - passing.x / root) * view) / root, 0.0, k == 0u);
    let source = l * source_stride(coefficients);
    sources[source + k] = vec4(mean * light * lighting.inner[band(k)].rgb, correction);
    if k == 0u {
        sources[source + coefficients] = vec4(mean * escape, 0.0);
    }
    // What is not a number must not outlive its moment.
    let before = states[id.x];
    states[id.x] = select(vec4(0.0), before, abs(before) < vec4(1e30));
}
