// Radiance that leaves every RBF's probes toward the eye, kept as a mean and a gradient:
//     J_i = sum_k J_ik y_k(v_i),   Jbar = mean J_i,   G = 3 / (4 rho r) sum_i J_i t_i^T.
// Taking v at each probe, not at the centre, lets the gradient follow the look direction too.
#import bevy_smoke::frame::{Frame, Rbf}
#import bevy_smoke::sh::{basis, SH_COEFFICIENTS}
#import bevy_smoke::lighting::{Outgoing, probe_position, tetrahedron, RHO}

struct Look {
    // Bundle space: the eye (w = 1, perspective) or the direction of all rays (w = 0, orthographic).
    eye: vec4<f32>,
}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> look: Look;
@group(0) @binding(2) var<storage, read> rbfs: array<Rbf>;
@group(0) @binding(3) var<storage, read> probes: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> outgoing: array<Outgoing>;

@compute @workgroup_size(64)
fn leave(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= frame.rbf_count {
        return;
    }
    let rbf = rbfs[id.x];
    var o: Outgoing;
    for (var i = 0u; i < 4u; i++) {
        var v = look.eye.xyz;
        if look.eye.w > 0.0 {
            let ray = probe_position(rbf.center, rbf.radius, i) - look.eye.xyz;
            // An eye on the probe sees no direction in particular.
            v = ray / max(length(ray), 1e-9);
        }
        let y = basis(v);
        var radiance = vec3(0.0);
        for (var k = 0u; k < SH_COEFFICIENTS; k++) {
            radiance += y[k] * probes[(id.x * 4u + i) * SH_COEFFICIENTS + k].rgb;
        }
        let slope = radiance * (3.0 / (4.0 * RHO * rbf.radius));
        let t = tetrahedron(i);
        o.mean += 0.25 * radiance;
        o.dx += slope * t.x;
        o.dy += slope * t.y;
        o.dz += slope * t.z;
    }
    outgoing[id.x] = o;
}
