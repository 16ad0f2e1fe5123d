// Source radiance of every RBF toward the eye, looked at through its centre: one thread an RBF.
#import bevy_smoke::frame::{Frame, Rbf}
#import bevy_smoke::sh::{basis, SH_COEFFICIENTS}

@group(0) @binding(0) var<uniform> frame: Frame;
// Bundle space: the eye (w = 1, perspective) or the direction of all rays (w = 0, orthographic).
@group(0) @binding(1) var<uniform> eye: vec4<f32>;
@group(0) @binding(2) var<storage, read> rbfs: array<Rbf>;
@group(0) @binding(3) var<storage, read> source: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> outgoing: array<vec4<f32>>;

@compute @workgroup_size(64)
fn leave(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= frame.rbf_count {
        return;
    }
    let ray = rbfs[id.x].center - eye.xyz;
    let distance = length(ray);
    let look = select(eye.xyz, select(vec3(0.0, 0.0, 1.0), ray / max(distance, 1e-20), distance > 0.0), eye.w > 0.0);
    let y = basis(look);
    var sum = vec4(0.0);
    for (var k = 0u; k < SH_COEFFICIENTS; k++) {
        sum += y[k] * source[id.x * SH_COEFFICIENTS + k];
    }
    outgoing[id.x] = sum;
}
