// Reconstructs the density of every cell: D = max(0, sum_l w_l exp(-|x - c_l|^2 / r_l^2) + (1 - t) R_a + t R_b), the sum
// over the RBFs of the cell's bin, the residuals of two baked frames from their perfect spatial hashes.
#import bevy_smoke::frame::{Frame, Rbf, bin_index, cell_center}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> rbfs: array<Rbf>;
@group(0) @binding(2) var<storage, read> bin_offsets: array<u32>;
@group(0) @binding(3) var<storage, read> bin_indices: array<u32>;
// The residuals as `render/baked.rs` packs them, arrays laid out as `residual::HashedResidual` says. Header: quantisation
// law R = sign(q) max (|q| / 127)^exponent, side of the offset table, length of the hash table, where each begins.
@group(0) @binding(4) var<storage, read> residual_from: array<u32>;
@group(0) @binding(5) var<storage, read> residual_to: array<u32>;
@group(0) @binding(6) var density: texture_storage_3d<r32float, write>;

// An RBF ends at three radii, u^2 = 9.
const SUPPORT2: f32 = 9.0;
const STRIDE: u32 = 0x9E3779B1u;
// Words of the header; then comes occupancy.
const HEADER: u32 = 8u;

// A word of the first or the second residual.
fn word(second: bool, at: u32) -> u32 {
    if second {
        return residual_to[at];
    }
    return residual_from[at];
}

fn residual(second: bool, cell: vec3<u32>) -> f32 {
    let index = cell.x + frame.dims.x * (cell.y + frame.dims.y * cell.z);
    if ((word(second, HEADER + (index >> 5u)) >> (index & 31u)) & 1u) == 0u {
        return 0.0;
    }
    let side = word(second, 2u);
    let p = cell % side;
    let bucket = p.x + side * (p.y + side * p.z);
    let number = (word(second, word(second, 4u) + (bucket >> 1u)) >> (16u * (bucket & 1u))) & 0xFFFFu;
    // (home + displacement) mod slots; both are below slots, at most 2^28.
    let slots = word(second, 3u);
    let slot = (index % slots + (number * STRIDE) % slots) % slots;
    let q = extractBits(i32(word(second, word(second, 5u) + (slot >> 2u))), 8u * (slot & 3u), 8u);
    let law = vec2(bitcast<f32>(word(second, 0u)), bitcast<f32>(word(second, 1u)));
    let magnitude = law.x * pow(abs(f32(q)) / 127.0, law.y);
    return select(magnitude, -magnitude, q < 0);
}

@compute @workgroup_size(8, 8, 4)
fn reconstruct(@builtin(global_invocation_id) id: vec3<u32>) {
    if any(id >= frame.dims) {
        return;
    }
    let cell = vec3<i32>(id);
    let x = cell_center(frame, cell);
    let bin = bin_index(frame, cell);
    var sum = residual(false, id);
    if frame.blend > 0.0 {
        sum = mix(sum, residual(true, id), frame.blend);
    }
    for (var i = bin_offsets[bin]; i < bin_offsets[bin + 1u]; i++) {
        let rbf = rbfs[bin_indices[i]];
        let offset = x - rbf.center;
        let u2 = dot(offset, offset) / (rbf.radius * rbf.radius);
        if u2 < SUPPORT2 {
            sum += rbf.weight * exp(-u2);
        }
    }
    textureStore(density, id, vec4(max(sum, 0.0), 0.0, 0.0, 0.0));
}
