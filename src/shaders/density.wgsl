// Reconstructs the density of every cell: D = max(0, sum_l w_l exp(-|x - c_l|^2 / r_l^2) + R), the sum over the RBFs
// of the cell's bin, the residual R from the perfect spatial hash.
#import bevy_smoke::frame::{Frame, Rbf, bin_index, cell_center}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> rbfs: array<Rbf>;
@group(0) @binding(2) var<storage, read> bin_offsets: array<u32>;
@group(0) @binding(3) var<storage, read> bin_indices: array<u32>;
// The residual's arrays, laid out as `residual::HashedResidual` says.
@group(0) @binding(4) var<storage, read> occupancy: array<u32>;
@group(0) @binding(5) var<storage, read> hash_offsets: array<u32>;
@group(0) @binding(6) var<storage, read> hash_table: array<u32>;
@group(0) @binding(7) var density: texture_storage_3d<r32float, write>;

// An RBF ends at three radii, u^2 = 9.
const SUPPORT2: f32 = 9.0;
const STRIDE: u32 = 0x9E3779B1u;

// The stored byte of a cell, 0 where none is.
fn quantized(cell: vec3<u32>) -> i32 {
    let index = cell.x + frame.dims.x * (cell.y + frame.dims.y * cell.z);
    if ((occupancy[index >> 5u] >> (index & 31u)) & 1u) == 0u {
        return 0;
    }
    let p = cell % frame.offset_side;
    let bucket = p.x + frame.offset_side * (p.y + frame.offset_side * p.z);
    let number = (hash_offsets[bucket >> 1u] >> (16u * (bucket & 1u))) & 0xFFFFu;
    // (home + displacement) mod slots; both are below slots, at most 2^28.
    let slot = (index % frame.table_len + (number * STRIDE) % frame.table_len) % frame.table_len;
    return extractBits(i32(hash_table[slot >> 2u]), 8u * (slot & 3u), 8u);
}

fn residual(cell: vec3<u32>) -> f32 {
    let q = quantized(cell);
    if q == 0 {
        return 0.0;
    }
    let magnitude = frame.residual_max * pow(abs(f32(q)) / 127.0, frame.residual_exponent);
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
    var sum = residual(id);
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
