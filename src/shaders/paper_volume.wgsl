// Source radiance times density at every cell (Zhou et al. 2008, Eq. 15), padded by one cell on each side:
//     J_D = D / D_model sum_l w_l B_l J_l,   D_model = sum_l w_l B_l,
// and beside it the density D = D_model + R. Where there is no RBF the residual is left out, and with it the smoke.
#import bevy_smoke::frame::{Frame, Rbf, MAX_HALF, bin_index, cell_center}
#import bevy_smoke::paper::{jet, SMALLEST_DENSITY}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> rbfs: array<Rbf>;
@group(0) @binding(2) var<storage, read> bin_offsets: array<u32>;
@group(0) @binding(3) var<storage, read> bin_indices: array<u32>;
@group(0) @binding(4) var<storage, read> outgoing: array<vec4<f32>>;
@group(0) @binding(5) var density: texture_3d<f32>;
// RGB: source radiance times scaled density; alpha: scaled density.
@group(0) @binding(6) var volume: texture_storage_3d<rgba16float, write>;

@compute @workgroup_size(8, 8, 4)
fn reconstruct(@builtin(global_invocation_id) id: vec3<u32>) {
    if any(id >= frame.dims + 2u) {
        return;
    }
    let cell = vec3<i32>(id) - 1;
    if any(cell < vec3(0)) || any(cell >= vec3<i32>(frame.dims)) {
        textureStore(volume, id, vec4(0.0));
        return;
    }
    let x = cell_center(frame, cell);
    let bin = bin_index(frame, cell);
    var emission = vec3(0.0);
    var model = 0.0;
    for (var i = bin_offsets[bin]; i < bin_offsets[bin + 1u]; i++) {
        let l = bin_indices[i];
        let weight = jet(rbfs[l], x).value;
        emission += weight * outgoing[l].rgb;
        model += weight;
    }
    var d = model;
    if model >= SMALLEST_DENSITY {
        d = textureLoad(density, cell, 0).x;
        emission *= d / model;
    }
    let scaled = vec4(emission, d) * frame.density_scale;
    textureStore(volume, id, clamp(scaled, vec4(-MAX_HALF), vec4(MAX_HALF)));
}
