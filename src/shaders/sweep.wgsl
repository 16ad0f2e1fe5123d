// One sweep of transport between the RBFs: one workgroup gathers what an RBF sees of all others,
//     G_k = sum_h Khat_lh ((1 - a_k) J_h,k + 4 pi a_k y_k(d) sum_j a_j y_j(d) J_h,j),   d from l to h,
// and scatters it: J_l,k = S_l,k + Omega' g'^l ((1 - escape_l) G_k + C_k G_0), as functions of the look direction. An RBF near by is seen
// in many directions (a_k = 0), one far away in one (a_k = 1). What an RBF sees of itself is solved for at once (Jacobi's
// method), since where smoke is thick that is most of it.
#import bevy_smoke::frame::{Frame, Rbf}
#import bevy_smoke::sh::{basis, band, SH_COEFFICIENTS}
#import bevy_smoke::lighting::{Lighting, PI}
#import bevy_smoke::footprint::{Footprints, pair_entry}
#import bevy_smoke::scattering::{Control, Step, source_stride}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> lighting: Lighting;
@group(0) @binding(2) var<uniform> footprints: Footprints;
@group(0) @binding(3) var<uniform> plan: Step;
@group(0) @binding(4) var<storage, read> rbfs: array<Rbf>;
@group(0) @binding(5) var<storage, read> matrix: array<f32>;
@group(0) @binding(6) var<storage, read> sources: array<vec4<f32>>;
// Several solutions: source radiance of every RBF, `coefficients` each; a slot has room for 16,
// for as many RBFs as there may be: where one's first solution is does not change with their number.
@group(0) @binding(7) var<storage, read_write> states: array<vec4<f32>>;
// What every RBF sees of the others.
@group(0) @binding(8) var<storage, read_write> gathered: array<vec4<f32>>;
@group(0) @binding(9) var<storage, read> control: Control;

fn slot(index: u32) -> u32 {
    return index * frame.rbf_capacity * SH_COEFFICIENTS;
}

// Stores what follows from what is seen of the others: color for coefficient 0 and k, and their share in all that is seen.
fn scatter(l: u32, k: u32, others_0: vec3<f32>, others_k: vec3<f32>, share: f32) {
    let coefficients = lighting.coefficients;
    let source = l * source_stride(coefficients);
    let escape = sources[source + coefficients].rgb;
    let itself = 1.0 - share;
    // 1 - albedo (1 - escape) Khat_ll, from what is left of 1 each time: exact however thick and white the smoke is.
    let albedo = lighting.inner[0].rgb;
    let kept_0 = (1.0 - albedo) + albedo * (escape + (1.0 - escape) * share);
    var radiance = (sources[source].rgb + albedo * (1.0 - escape) * others_0) / max(kept_0, vec3(1e-30));
    var seen = others_0 + itself * radiance;
    if k > 0u {
        let again = lighting.inner[band(k)].rgb;
        let light = sources[source + k];
        let kept = (1.0 - again) + again * (escape + (1.0 - escape) * share);
        let scattered = light.rgb + again * ((1.0 - escape) * others_k + light.a * seen);
        radiance = scattered / max(kept, vec3(1e-30));
        seen = others_k + itself * radiance;
    }
    let at = l * coefficients + k;
    states[slot(plan.to_slot) + at] = vec4(radiance, 0.0);
    gathered[at] = vec4(seen, 0.0);
}

// What RBF l sees of another.
fn strength(l: u32, h: u32) -> f32 {
    return select(matrix[l * frame.rbf_count + h], 0.0, l == h);
}

fn is_skipped() -> bool {
    return control.done != 0u && plan.always == 0u;
}

// Colour, and share, of what a thread has seen.
var<workgroup> partial: array<vec4<f32>, 64>;

// The same for all directions: only the mean is kept.
@compute @workgroup_size(64)
fn sweep_isotropic(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let l = group.x;
    let count = frame.rbf_count;
    if is_skipped() || l >= count {
        return;
    }
    let from_slot = slot(plan.from_slot);
    var sum = vec4(0.0);
    for (var h = thread; h < count; h += 64u) {
        sum += strength(l, h) * vec4(states[from_slot + h].rgb, 1.0);
    }
    partial[thread] = sum;
    workgroupBarrier();
    for (var half = 32u; half > 0u; half /= 2u) {
        if thread < half {
            partial[thread] += partial[thread + half];
        }
        workgroupBarrier();
    }
    if thread == 0u {
        scatter(l, 0u, partial[0].rgb, partial[0].rgb, partial[0].a);
    }
}

const TILE: u32 = 64u;

// A tile of RBFs as seen from the workgroup's: 4 pi Khat sum_j a_j y_j J_j, with Khat in alpha; band weights; directions.
var<workgroup> facing: array<vec4<f32>, TILE>;
var<workgroup> weights: array<vec4<f32>, TILE>;
var<workgroup> bases: array<array<f32, 16>, TILE>;

// 64 threads: first one an RBF of the tile, then one a coefficient and part of the tile; of 9 coefficients one is left over.
@compute @workgroup_size(TILE)
fn sweep(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let l = group.x;
    let count = frame.rbf_count;
    if is_skipped() || l >= count {
        return;
    }
    let from_slot = slot(plan.from_slot);
    let coefficients = lighting.coefficients;
    let k = thread % coefficients;
    let part = thread / coefficients;
    let parts = TILE / coefficients;
    let center = rbfs[l].center;
    var seen = vec4(0.0);
    for (var tile = 0u; tile < count; tile += TILE) {
        let h = tile + thread;
        if h < count {
            let offset = rbfs[h].center - center;
            let distance = length(offset);
            let at = pair_entry(distance / rbfs[h].radius);
            let below = u32(at);
            let bands = mix(footprints.pairs[below].yzw, footprints.pairs[below + 1u].yzw, fract(at));
            // From its own centre an RBF looks the same all around.
            let a = select(vec4(1.0, bands), vec4(1.0, 0.0, 0.0, 0.0), distance == 0.0);
            let y = basis(offset / max(distance, 1e-20));
            var toward = vec3(0.0);
            for (var j = 0u; j < coefficients; j++) {
                toward += a[band(j)] * y[j] * states[from_slot + h * coefficients + j].rgb;
            }
            let share = strength(l, h);
            facing[thread] = vec4(toward * (4.0 * PI * share), share);
            weights[thread] = a;
            bases[thread] = y;
        }
        workgroupBarrier();
        let end = select(0u, min(TILE, count - tile), part < parts);
        for (var i = part; i < end; i += parts) {
            let a = weights[i][band(k)];
            let spread = states[from_slot + (tile + i) * coefficients + k].rgb;
            seen += vec4(facing[i].a * (1.0 - a) * spread + a * bases[i][k] * facing[i].rgb, facing[i].a);
        }
        workgroupBarrier();
    }
    partial[thread] = seen;
    workgroupBarrier();
    if part == 0u {
        var all = partial[k];
        var mean = partial[0];
        for (var other = 1u; other < parts; other++) {
            all += partial[k + other * coefficients];
            mean += partial[other * coefficients];
        }
        scatter(l, k, mean.rgb, all.rgb, all.a);
    }
}
