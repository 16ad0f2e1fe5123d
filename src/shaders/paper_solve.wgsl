// Conjugate gradients on A^T A x = A^T b (Zhou et al. 2008, section 5.4), three colour channels in lock-step, from what x
// is. `start`, `residual`, `transpose` and `begin` start it; `multiply`, `transpose` and `advance` are a step.
#import bevy_smoke::frame::Frame

const THREADS: u32 = 64u;
const ALL_THREADS: u32 = 256u;

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> matrix: array<f32>;
@group(0) @binding(2) var<storage, read> rhs: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> solution: array<vec4<f32>>;
// Four vectors of n: the residual r of the normal equations, the direction p, y = A p, and z = A^T y.
@group(0) @binding(4) var<storage, read_write> vectors: array<vec4<f32>>;
// r . r.
@group(0) @binding(5) var<storage, read_write> power: array<vec4<f32>>;

var<workgroup> partial: array<vec3<f32>, ALL_THREADS>;

fn entry(row: u32, column: u32) -> vec3<f32> {
    let at = 3u * (row * frame.rbf_count + column);
    return vec3(matrix[at], matrix[at + 1u], matrix[at + 2u]);
}

// Where the four vectors begin.
fn residual_at() -> u32 { return 0u; }
fn direction_at() -> u32 { return frame.rbf_count; }
fn image_at() -> u32 { return 2u * frame.rbf_count; }
fn normal_at() -> u32 { return 3u * frame.rbf_count; }

// The sum over `threads` threads, a power of two.
fn add_up(value: vec3<f32>, thread: u32, threads: u32) -> vec3<f32> {
    workgroupBarrier();
    partial[thread] = value;
    workgroupBarrier();
    for (var half = threads / 2u; half > 0u; half /= 2u) {
        if thread < half {
            partial[thread] += partial[thread + half];
        }
        workgroupBarrier();
    }
    return partial[0];
}

// RBFs start from what those at their places in the list ended with; new ones at 0, as will those that come where others
// go. What is not a number must not outlive its moment.
@compute @workgroup_size(THREADS)
fn start(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x < frame.rbf_capacity {
        let before = solution[id.x];
        solution[id.x] = select(vec4(0.0), before, (abs(before) < vec4(1e30)) & vec4(id.x < frame.rbf_count));
    }
}

// y = b - A x, one workgroup a row.
@compute @workgroup_size(THREADS)
fn residual(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    var sum = vec3(0.0);
    for (var h = thread; h < frame.rbf_count; h += THREADS) {
        sum += entry(group.x, h) * solution[h].rgb;
    }
    sum = add_up(sum, thread, THREADS);
    if thread == 0u {
        vectors[image_at() + group.x] = vec4(rhs[group.x].rgb - sum, 0.0);
    }
}

// y = A p, one workgroup a row.
@compute @workgroup_size(THREADS)
fn multiply(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    var sum = vec3(0.0);
    for (var h = thread; h < frame.rbf_count; h += THREADS) {
        sum += entry(group.x, h) * vectors[direction_at() + h].rgb;
    }
    sum = add_up(sum, thread, THREADS);
    if thread == 0u {
        vectors[image_at() + group.x] = vec4(sum, 0.0);
    }
}

// z = A^T y, one workgroup a column.
@compute @workgroup_size(THREADS)
fn transpose_multiply(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    var sum = vec3(0.0);
    for (var h = thread; h < frame.rbf_count; h += THREADS) {
        sum += entry(h, group.x) * vectors[image_at() + h].rgb;
    }
    sum = add_up(sum, thread, THREADS);
    if thread == 0u {
        vectors[normal_at() + group.x] = vec4(sum, 0.0);
    }
}

// r = p = z, one workgroup.
@compute @workgroup_size(ALL_THREADS)
fn begin(@builtin(local_invocation_index) thread: u32) {
    var sum = vec3(0.0);
    for (var h = thread; h < frame.rbf_count; h += ALL_THREADS) {
        let z = vectors[normal_at() + h];
        vectors[residual_at() + h] = z;
        vectors[direction_at() + h] = z;
        sum += z.rgb * z.rgb;
    }
    sum = add_up(sum, thread, ALL_THREADS);
    if thread == 0u {
        power[0] = vec4(sum, 0.0);
    }
}

// a / b, and zero where there is nothing left to do.
fn ratio(a: vec3<f32>, b: vec3<f32>) -> vec3<f32> {
    return select(vec3(0.0), a / max(b, vec3(1e-37)), b > vec3(1e-37));
}

// x += a p, r -= a z with a = r.r / y.y, then p = r + (r.r / r.r before) p, one workgroup.
@compute @workgroup_size(ALL_THREADS)
fn advance(@builtin(local_invocation_index) thread: u32) {
    let before = power[0].rgb;
    var sum = vec3(0.0);
    for (var h = thread; h < frame.rbf_count; h += ALL_THREADS) {
        let y = vectors[image_at() + h].rgb;
        sum += y * y;
    }
    let step = ratio(before, add_up(sum, thread, ALL_THREADS));
    sum = vec3(0.0);
    for (var h = thread; h < frame.rbf_count; h += ALL_THREADS) {
        solution[h] += vec4(step * vectors[direction_at() + h].rgb, 0.0);
        let r = vectors[residual_at() + h].rgb - step * vectors[normal_at() + h].rgb;
        vectors[residual_at() + h] = vec4(r, 0.0);
        sum += r * r;
    }
    let after = add_up(sum, thread, ALL_THREADS);
    let turn = ratio(after, before);
    for (var h = thread; h < frame.rbf_count; h += ALL_THREADS) {
        let p = vectors[direction_at() + h].rgb;
        vectors[direction_at() + h] = vec4(vectors[residual_at() + h].rgb + turn * p, 0.0);
    }
    if thread == 0u {
        power[0] = vec4(after, 0.0);
    }
}
