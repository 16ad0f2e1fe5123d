// The solution of one frame as the start of the next: Eq. 12 (Zhou et al. 2008) of the old RBFs at the centres of the new
// ones, zero where there were none. One thread a new RBF.
#import bevy_smoke::frame::{Frame, Rbf}
#import bevy_smoke::paper::jet

@group(0) @binding(0) var<uniform> old_frame: Frame;
@group(0) @binding(1) var<storage, read> old_rbfs: array<Rbf>;
@group(0) @binding(2) var<storage, read> old_solution: array<vec4<f32>>;
@group(0) @binding(3) var<uniform> frame: Frame;
@group(0) @binding(4) var<storage, read> rbfs: array<Rbf>;
@group(0) @binding(5) var<storage, read_write> solution: array<vec4<f32>>;

@compute @workgroup_size(64)
fn carry_over(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= frame.rbf_count {
        return;
    }
    var sum = vec3(0.0);
    var density = 0.0;
    for (var h = 0u; h < old_frame.rbf_count; h++) {
        let weight = jet(old_rbfs[h], rbfs[id.x].center).value;
        sum += weight * old_solution[h].rgb;
        density += weight;
    }
    solution[id.x] = vec4(select(vec3(0.0), sum / max(density, 1e-30), density > 0.0), 0.0);
}
