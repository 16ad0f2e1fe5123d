// Keeps the GPU busy for some milliseconds, so that what is timed next is timed at its full clock: threads that add up, one
// step waiting for the other.

@group(0) @binding(0) var<storage, read_write> sums: array<f32>;

const STEPS: u32 = 1u << 20u;

@compute @workgroup_size(64)
fn warm_up(@builtin(global_invocation_id) id: vec3<u32>) {
    var sum = f32(id.x);
    for (var i = 0u; i < STEPS; i++) {
        sum = fma(sum, 0.999, 1.0);
    }
    sums[id.x] = sum;
}
