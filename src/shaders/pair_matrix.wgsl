// How much of what RBF l sees when it looks around is RBF h: one workgroup a row. Up to a factor that cancels,
//     K_lh = w_h r_h F(u) tau_lh,   F(u) = (sqrt(pi) / 2) Daw(u) / u,   u = |c_l - c_h| / r_h,
//     K_ll = w_l r_l (sqrt(pi) / 2) erfcx(sigma D(c_l) r_l / 2),
// with tau_lh the transmittance between the centres through the coarse density. Rows are scaled to sum 1, which makes
// energy exact: how much is seen at all is known better from the probes. With the row goes what it makes of radiance that
// is 1 everywhere, H_k = sum_h Khat_lh 4 pi a_k y_k(d), and the row's weight in the balance of energy.
#import bevy_smoke::frame::{Frame, Rbf}
#import bevy_smoke::lighting::{Lighting, PI}
#import bevy_smoke::sh::{basis, band, SH_COEFFICIENTS}
#import bevy_smoke::footprint::{Footprints, pair_entry, pair_footprint, self_entry, self_footprint}

const SAMPLES: u32 = 4u;
const HALF_SQRT_PI: f32 = 0.886226925452758;

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> lighting: Lighting;
@group(0) @binding(2) var<uniform> footprints: Footprints;
@group(0) @binding(3) var<storage, read> rbfs: array<Rbf>;
@group(0) @binding(4) var coarse: texture_3d<f32>;
@group(0) @binding(5) var coarse_sampler: sampler;
// Row l, column h.
@group(0) @binding(6) var<storage, read_write> matrix: array<f32>;
// 16 a row: its weight in the balance, then H_1 .. H_15.
@group(0) @binding(7) var<storage, read_write> rows: array<f32>;

fn density(x: vec3<f32>) -> f32 {
    let padded = vec3<f32>(frame.coarse_dims + 2u) * (frame.coarse_ratio * frame.cell);
    return textureSampleLevel(coarse, coarse_sampler, x / padded + 0.5, 0.0).x;
}

fn pair(l: u32, h: u32) -> f32 {
    let to = rbfs[l];
    let source = rbfs[h];
    let strength = source.weight * source.radius;
    if l == h {
        let x = 0.5 * lighting.sigma_mean * density(to.center) * to.radius;
        let at = self_entry(x);
        let below = u32(at);
        let found = mix(footprints.selves[below].x, footprints.selves[below + 1u].x, fract(at));
        return strength * HALF_SQRT_PI * self_footprint(found, x);
    }
    let offset = source.center - to.center;
    var sum = 0.0;
    for (var i = 0u; i < SAMPLES; i++) {
        sum += density(to.center + offset * ((f32(i) + 0.5) / f32(SAMPLES)));
    }
    let distance = length(offset);
    let depth = lighting.sigma_mean * sum * distance / f32(SAMPLES);
    let u = distance / source.radius;
    let at = pair_entry(u);
    let below = u32(at);
    let found = mix(footprints.pairs[below], footprints.pairs[below + 1u], fract(at));
    return strength * pair_footprint(found, u) * exp(-depth);
}

var<workgroup> sums: array<f32, 64>;
var<workgroup> views: array<array<f32, 16>, 64>;

@compute @workgroup_size(64)
fn relate(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let l = group.x;
    let count = frame.rbf_count;
    // Of live smoke, the CPU knows only how many there may be.
    if l >= count {
        return;
    }
    var sum = 0.0;
    for (var h = thread; h < count; h += 64u) {
        let k = pair(l, h);
        matrix[l * count + h] = k;
        sum += k;
    }
    sums[thread] = sum;
    workgroupBarrier();
    for (var half = 32u; half > 0u; half /= 2u) {
        if thread < half {
            sums[thread] += sums[thread + half];
        }
        workgroupBarrier();
    }
    let total = sums[0];
    let to = rbfs[l];
    var seen: array<f32, 16>;
    for (var h = thread; h < count; h += 64u) {
        // A row of nothing sees itself.
        let alone = select(0.0, 1.0, h == l);
        let k = select(alone, matrix[l * count + h] / total, total > 1e-30);
        matrix[l * count + h] = k;
        if h == l || lighting.coefficients <= 1u {
            continue;
        }
        let offset = rbfs[h].center - to.center;
        let distance = length(offset);
        let at = pair_entry(distance / rbfs[h].radius);
        let below = u32(at);
        let a = mix(footprints.pairs[below], footprints.pairs[below + 1u], fract(at));
        let y = basis(offset / max(distance, 1e-20));
        for (var i = 1u; i < lighting.coefficients; i++) {
            seen[i] += select(4.0 * PI * k * a[band(i)] * y[i], 0.0, distance == 0.0);
        }
    }
    views[thread] = seen;
    workgroupBarrier();
    if thread < SH_COEFFICIENTS {
        // What l sees of h and h of l belong together as their masses do: the weights for which rows and columns balance.
        var sum = to.weight * frame.density_scale * to.radius * to.radius * to.radius * total * frame.density_scale;
        if thread > 0u {
            sum = 0.0;
            for (var j = 0u; j < 64u; j++) {
                sum += views[j][thread];
            }
        }
        rows[l * SH_COEFFICIENTS + thread] = sum;
    }
}
