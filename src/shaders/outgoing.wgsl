// Radiance that leaves every RBF's probes toward the eye, kept as a quadratic fit (see `Fit`):
//     J_i = sum_k Omega g^l y_k(v_i) (L_d,ik + L_m,ik),
// with what probe i gets straight from the environment, and what it gets of light that has scattered before, from what the
// RBF sees of the others, G, and the transmittance T_i around the probe (see `scattering_source.wgsl`):
//     L_m,i0 = (1 - escape_i) G_0,   L_m,ik = (1 - escape_i) G_k + (-T_ik - (1 - T_i0 / sqrt(4 pi)) H_k) G_0 / sqrt(4 pi).
// Taking v at each probe, not at the centre, lets the fit follow the look direction too. The columns to the lamps are
// fitted likewise.
#import bevy_smoke::frame::{Frame, Rbf}
#import bevy_smoke::sh::{basis, band, SH_COEFFICIENTS}
#import bevy_smoke::lighting::{Lighting, Fit, probe_position, probe_reach, MAX_LAMPS, PI, PROBES}

struct Look {
    // Bundle space: the eye (w = 1, perspective) or the direction of all rays (w = 0, orthographic).
    eye: vec4<f32>,
}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> lighting: Lighting;
@group(0) @binding(2) var<uniform> look: Look;
@group(0) @binding(3) var<storage, read> rbfs: array<Rbf>;
@group(0) @binding(4) var<storage, read> probes: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> escapes: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> gathered: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read> rows: array<f32>;
@group(0) @binding(8) var<storage, read> columns: array<f32>;
@group(0) @binding(9) var<storage, read_write> outgoing: array<Fit>;
// Two an RBF, each of four lamps.
@group(0) @binding(10) var<storage, read_write> shades: array<Fit>;

// Light at a probe that is not straight from the environment: coefficient k.
fn scattered(l: u32, probe: u32, k: u32) -> vec3<f32> {
    let seen = l * lighting.coefficients;
    let mean = gathered[seen].rgb;
    let trapped = 1.0 - escapes[probe].rgb;
    if k == 0u {
        return trapped * mean;
    }
    let root = sqrt(4.0 * PI);
    let first = probe * SH_COEFFICIENTS;
    let correction = -probes[first + k].a - (1.0 - probes[first].a / root) * rows[l * SH_COEFFICIENTS + k];
    return trapped * gathered[seen + k].rgb + correction / root * mean;
}

// The quadratic through the values at the probes of an RBF; the value at its centre where that is all there is.
fn fit(values: ptr<function, array<vec4<f32>, PROBES>>, r: f32) -> Fit {
    let center = (*values)[0];
    var f: Fit;
    f.center = center;
    if lighting.probes < PROBES {
        return f;
    }
    f.dx = ((*values)[1] - (*values)[2]) / (2.0 * r);
    f.dy = ((*values)[3] - (*values)[4]) / (2.0 * r);
    f.dz = ((*values)[5] - (*values)[6]) / (2.0 * r);
    f.qx = ((*values)[1] + (*values)[2] - 2.0 * center) / (2.0 * r * r);
    f.qy = ((*values)[3] + (*values)[4] - 2.0 * center) / (2.0 * r * r);
    f.qz = ((*values)[5] + (*values)[6] - 2.0 * center) / (2.0 * r * r);
    return f;
}

@compute @workgroup_size(64)
fn leave(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= frame.rbf_count {
        return;
    }
    let l = id.x;
    let rbf = rbfs[l];
    let reach = probe_reach(rbf, lighting.sigma_mean, frame.density_scale);
    var radiance: array<vec4<f32>, PROBES>;
    var low = vec3(3e38);
    var high = vec3(-3e38);
    for (var i = 0u; i < lighting.probes; i++) {
        var v = look.eye.xyz;
        if look.eye.w > 0.0 {
            let ray = probe_position(rbf.center, reach, i) - look.eye.xyz;
            // An eye on the probe sees no direction in particular.
            v = ray / max(length(ray), 1e-9);
        }
        let y = basis(v);
        let probe = l * PROBES + i;
        var sum = vec3(0.0);
        for (var k = 0u; k < lighting.light_coefficients; k++) {
#ifdef SCATTERED_ONLY
            var light = vec3(0.0);
#else
            var light = probes[probe * SH_COEFFICIENTS + k].rgb;
#endif
            if k < lighting.coefficients {
                light += scattered(l, probe, k);
            }
            sum += y[k] * lighting.scatter[band(k)].rgb * light;
        }
        radiance[i] = vec4(sum, 0.0);
        low = min(low, sum);
        high = max(high, sum);
    }
    var f = fit(&radiance, reach);
    // Beyond the probes the quadratic is a guess, which may go no farther than this.
    low *= 0.5;
    high *= 2.0;
    f.center.w = low.x;
    f.dx.w = low.y;
    f.dy.w = low.z;
    f.dz.w = high.x;
    f.qx.w = high.y;
    f.qy.w = high.z;
    outgoing[l] = f;
    for (var s = 0u; 4u * s < lighting.lamp_count; s++) {
        var column: array<vec4<f32>, PROBES>;
        for (var i = 0u; i < lighting.probes; i++) {
            let at = (l * PROBES + i) * MAX_LAMPS + 4u * s;
            // What hides a lamp is looked for at every cell, not here.
            column[i] = abs(vec4(columns[at], columns[at + 1u], columns[at + 2u], columns[at + 3u]));
        }
        shades[2u * l + s] = fit(&column, reach);
    }
}
