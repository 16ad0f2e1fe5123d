// Radiance that leaves every RBF's probes toward the eye, kept as a mean and a gradient:
//     J_i = sum_k Omega g^l y_k(v_i) (L_d,ik + (1 - escape_i) G_k),   Jbar = mean J_i,   G = 3 / (4 rho r) sum_i J_i t_i^T,
// with what the probes get straight from the environment and what the RBF sees of the others. Taking v at each probe,
// not at the centre, lets the gradient follow the look direction too. The columns to the lamps are fitted likewise.
#import bevy_smoke::frame::{Frame, Rbf}
#import bevy_smoke::sh::{basis, band, SH_COEFFICIENTS}
#import bevy_smoke::lighting::{Lighting, Outgoing, Shade, probe_position, tetrahedron, MAX_LAMPS, RHO}

struct Look {
    // Bundle space: the eye (w = 1, perspective) or the direction of all rays (w = 0, orthographic).
    eye: vec4<f32>,
}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> lighting: Lighting;
@group(0) @binding(2) var<uniform> look: Look;
@group(0) @binding(3) var<storage, read> rbfs: array<Rbf>;
@group(0) @binding(4) var<storage, read> probes: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> gathered: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> columns: array<f32>;
@group(0) @binding(7) var<storage, read_write> outgoing: array<Outgoing>;
// Two an RBF.
@group(0) @binding(8) var<storage, read_write> shades: array<Shade>;

@compute @workgroup_size(64)
fn leave(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= frame.rbf_count {
        return;
    }
    let rbf = rbfs[id.x];
    let slope = 3.0 / (4.0 * RHO * rbf.radius);
    var o: Outgoing;
    var shade: array<Shade, 2>;
    for (var i = 0u; i < 4u; i++) {
        var v = look.eye.xyz;
        if look.eye.w > 0.0 {
            let ray = probe_position(rbf.center, rbf.radius, i) - look.eye.xyz;
            // An eye on the probe sees no direction in particular.
            v = ray / max(length(ray), 1e-9);
        }
        let y = basis(v);
        let probe = id.x * 4u + i;
        let first = probe * SH_COEFFICIENTS;
        let trapped = 1.0 - vec3(probes[first].a, probes[first + 1u].a, probes[first + 2u].a);
        var radiance = vec3(0.0);
        for (var k = 0u; k < SH_COEFFICIENTS; k++) {
            var light = probes[first + k].rgb;
            if k < lighting.coefficients {
                light += trapped * gathered[id.x * lighting.coefficients + k].rgb;
            }
            radiance += y[k] * lighting.scatter[band(k)].rgb * light;
        }
        let t = tetrahedron(i);
        o.mean += 0.25 * radiance;
        o.dx += slope * t.x * radiance;
        o.dy += slope * t.y * radiance;
        o.dz += slope * t.z * radiance;
        for (var s = 0u; 4u * s < lighting.lamp_count; s++) {
            let at = probe * MAX_LAMPS + 4u * s;
            let column = vec4(columns[at], columns[at + 1u], columns[at + 2u], columns[at + 3u]);
            shade[s].mean += 0.25 * column;
            shade[s].dx += slope * t.x * column;
            shade[s].dy += slope * t.y * column;
            shade[s].dz += slope * t.z * column;
        }
    }
    outgoing[id.x] = o;
    for (var s = 0u; 4u * s < lighting.lamp_count; s++) {
        shades[2u * id.x + s] = shade[s];
    }
}
