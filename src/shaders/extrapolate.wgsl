// After sweeps x_0 .. x_M, the combination of them whose residual is smallest: with u_j = x_{j+1} - x_j and
// d_j = u_j - u_{j-1},
//     x = x_M + sum_j xi_j u_j,   xi = argmin |u_{M-1} + sum_j xi_j d_j|.
// This is reduced-rank extrapolation (Eddy 1979), which gives what GMRES gives from the same start (Sidi 1988) and needs
// no more than the sweeps. It finds in a few sweeps the slow modes of thick smoke that absorbs nothing, where sweeps alone
// crawl. The slowest of all, smoke that is as bright everywhere, is set right by the balance of energy: as much must leave
// the smoke or be absorbed as comes in. One workgroup; the channels are systems of their own.
#import bevy_smoke::frame::Frame
#import bevy_smoke::sh::SH_COEFFICIENTS
#import bevy_smoke::lighting::Lighting
#import bevy_smoke::scattering::{Control, Step, source_stride}
#import bevy_smoke::sum::{add_up, THREADS}

// Sweeps between extrapolations; as in `render/scattering.rs`.
const M: u32 = 5u;
// Differences d_1 .. d_N.
const N: u32 = 4u;
// Products d_i d_j (i <= j), d_i u_{M-1}, u_{M-1}^2, u_{M-2}^2, x_M^2.
const SUMS: u32 = 17u;
const MIXED: u32 = 10u;
const LAST: u32 = 14u;
const BEFORE: u32 = 15u;
const SOLUTION: u32 = 16u;

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> lighting: Lighting;
@group(0) @binding(2) var<uniform> plan: Step;
@group(0) @binding(3) var<storage, read> matrix: array<f32>;
@group(0) @binding(4) var<storage, read> rows: array<f32>;
@group(0) @binding(5) var<storage, read> sources: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> states: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> control: Control;

var<workgroup> totals: array<vec3<f32>, SUMS>;
// Factors xi_j of each channel, and the channel's estimated relative error.
var<workgroup> factors: array<vec4<f32>, 3>;
var<workgroup> errors: array<f32, 3>;

// Place of the product d_i d_j, i <= j, among the sums; both from 0.
fn pair(i: u32, j: u32) -> u32 {
    return i * N - i * (i + 1u) / 2u + j;
}

// The factors of a channel, and its estimated error.
fn solve(channel: u32) {
    let scale = totals[SOLUTION][channel];
    let last = totals[LAST][channel];
    factors[channel] = vec4(0.0);
    errors[channel] = 0.0;
    // The last sweep changed nothing that single precision holds, or there is no light at all.
    if !(last > 1e-13 * scale) {
        return;
    }
    // The least-squares problem in differences of length 1, whose products form the matrix; the ridge is what rounding
    // can tell apart.
    var lengths: array<f32, N>;
    var matrix: array<array<f32, 5>, N>;
    for (var i = 0u; i < N; i++) {
        lengths[i] = max(sqrt(totals[pair(i, i)][channel]), 1e-30);
    }
    for (var i = 0u; i < N; i++) {
        for (var j = 0u; j < N; j++) {
            let product = totals[pair(min(i, j), max(i, j))][channel] / lengths[i] / lengths[j];
            matrix[i][j] = select(product, 1.0 + 1e-6, i == j);
        }
        matrix[i][4] = -totals[MIXED + i][channel] / lengths[i];
    }
    let right = vec4(matrix[0][4], matrix[1][4], matrix[2][4], matrix[3][4]);
    // The matrix is positive definite: elimination needs no pivots.
    for (var i = 0u; i < N; i++) {
        for (var row = i + 1u; row < N; row++) {
            let factor = matrix[row][i] / matrix[i][i];
            for (var j = i; j < 5u; j++) {
                matrix[row][j] -= factor * matrix[i][j];
            }
        }
    }
    var xi = vec4(0.0);
    for (var back = 0u; back < N; back++) {
        let i = N - 1u - back;
        var value = matrix[i][4];
        for (var j = i + 1u; j < N; j++) {
            value -= matrix[i][j] * xi[j];
        }
        xi[i] = value / matrix[i][i];
    }
    let residual = last - dot(right, xi);
    let scaled = xi / vec4(lengths[0], lengths[1], lengths[2], lengths[3]);
    // Anything else is rounding: keep the last sweep.
    let usable = residual < last && all(abs(scaled) < vec4(1e6));
    if usable {
        factors[channel] = scaled;
    }
    // What remains shrinks by about as much a sweep as the last one did, at worst.
    let rate = clamp(sqrt(last / max(totals[BEFORE][channel], 1e-30)), 0.0, 0.999);
    let left = select(last, max(residual, 1e-14 * scale), usable);
    errors[channel] = sqrt(left / scale) * rate / (1.0 - rate);
}

@compute @workgroup_size(THREADS)
fn extrapolate(@builtin(local_invocation_index) thread: u32) {
    if control.done != 0u {
        return;
    }
    let slot = frame.rbf_capacity * SH_COEFFICIENTS;
    let used = frame.rbf_count * lighting.coefficients;
    var sums: array<vec3<f32>, SUMS>;
    for (var at = thread; at < used; at += THREADS) {
        var u: array<vec3<f32>, M>;
        var x = states[at].rgb;
        for (var j = 0u; j < M; j++) {
            let next = states[(j + 1u) * slot + at].rgb;
            u[j] = next - x;
            x = next;
        }
        for (var i = 0u; i < N; i++) {
            let d = u[i + 1u] - u[i];
            for (var j = i; j < N; j++) {
                sums[pair(i, j)] += d * (u[j + 1u] - u[j]);
            }
            sums[MIXED + i] += d * u[M - 1u];
        }
        sums[LAST] += u[M - 1u] * u[M - 1u];
        sums[BEFORE] += u[M - 2u] * u[M - 2u];
        sums[SOLUTION] += x * x;
    }
    for (var s = 0u; s < SUMS; s++) {
        let total = add_up(sums[s], thread);
        if thread == 0u {
            totals[s] = total;
        }
    }
    workgroupBarrier();
    if thread < 3u {
        solve(thread);
    }
    workgroupBarrier();
    // The balance: what the combination gains too much, over what leaves or is absorbed for each unit of radiance.
    let coefficients = lighting.coefficients;
    let albedo = lighting.inner[0].rgb;
    var gain = vec3(0.0);
    var loss = vec3(0.0);
    var weight = 0.0;
    for (var l = thread; l < frame.rbf_count; l += THREADS) {
        let escape = sources[l * source_stride(coefficients) + coefficients].rgb;
        let others = 1.0 - matrix[l * frame.rbf_count + l];
        let kept = (1.0 - albedo) + albedo * (escape + (1.0 - escape) * others);
        let importance = rows[l * SH_COEFFICIENTS];
        gain += importance * kept * residual(l * coefficients, slot);
        loss += importance * ((1.0 - albedo) + albedo * escape);
        weight += importance;
    }
    gain = add_up(gain, thread);
    loss = add_up(loss, thread);
    weight = add_up(vec3(weight), thread).x;
    // Where next to nothing leaves, rounding is all that the sums hold.
    let balance = select(vec3(0.0), gain / max(loss, vec3(1e-30)), loss > vec3(1e-5 * weight));

    var change = vec3(0.0);
    for (var at = thread; at < used; at += THREADS) {
        var best = states[M * slot + at].rgb;
        for (var j = 0u; j < N; j++) {
            let u = states[(j + 2u) * slot + at].rgb - states[(j + 1u) * slot + at].rgb;
            best += factor(j) * u;
        }
        if at % coefficients == 0u {
            best += balance;
        }
        // Light that is the same in all directions is never negative.
        if coefficients == 1u {
            best = max(best, vec3(0.0));
        }
        change += (best - states[at].rgb) * (best - states[at].rgb);
        states[at] = vec4(best, 0.0);
    }
    change = add_up(change, thread);
    if thread == 0u {
        let relative = sqrt(change / max(totals[SOLUTION], vec3(1e-30)));
        let moved = max(relative.x, max(relative.y, relative.z));
        // Two estimates, each an upper one: from the residual, and from how fast the changes shrink.
        let shrinks = clamp(moved / max(control.change, 1e-30), 0.1, 0.95);
        let by_change = select(1e30, moved * shrinks / (1.0 - shrinks), control.change > 0.0);
        let error = min(max(errors[0], max(errors[1], errors[2])), by_change);
        control.sweeps += M;
        control.error = error;
        control.change = moved;
        control.done = u32(error <= plan.tolerance);
    }
}

fn factor(j: u32) -> vec3<f32> {
    return vec3(factors[0][j], factors[1][j], factors[2][j]);
}

// What a sweep would still change in the combination, before the sweep that it contains.
fn residual(at: u32, slot: u32) -> vec3<f32> {
    var sum = states[M * slot + at].rgb - states[(M - 1u) * slot + at].rgb;
    for (var j = 0u; j < N; j++) {
        let u = states[(j + 1u) * slot + at].rgb - states[j * slot + at].rgb;
        let next = states[(j + 2u) * slot + at].rgb - states[(j + 1u) * slot + at].rgb;
        sum += factor(j) * (next - u);
    }
    return sum;
}
