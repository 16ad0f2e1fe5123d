// Light that scatters more than once at every RBF's centre: L0 and, from Eq. 6 as printed (Zhou et al. 2008),
//     L1 = kappa (sigma D J1 - grad L0),   kappa = 1 / (3 sigma_tr D),
// convolved with the phase function and added to single scattering. One workgroup an RBF.
#import bevy_smoke::frame::{Frame, Rbf}
#import bevy_smoke::sh::SH_COEFFICIENTS
#import bevy_smoke::lighting::Lighting
#import bevy_smoke::paper::{jet, LINEAR, SMALLEST_DENSITY, UNIT}

const THREADS: u32 = 64u;

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> lighting: Lighting;
@group(0) @binding(2) var<storage, read> rbfs: array<Rbf>;
@group(0) @binding(3) var<storage, read> solution: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> source: array<vec4<f32>>;

// Of the sum of w B: gradient and value. Of the sum of w B L0: value, and derivatives along x, y and z.
struct Sums {
    density: vec4<f32>,
    value: vec3<f32>,
    dx: vec3<f32>,
    dy: vec3<f32>,
    dz: vec3<f32>,
}

var<workgroup> partial: array<Sums, THREADS>;

@compute @workgroup_size(THREADS)
fn scatter(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let l = group.x;
    let x = rbfs[l].center;
    var sums: Sums;
    for (var h = thread; h < frame.rbf_count; h += THREADS) {
        let b = jet(rbfs[h], x);
        let mean = solution[h].rgb;
        sums.density += vec4(b.gradient, b.value);
        sums.value += b.value * mean;
        sums.dx += b.gradient.x * mean;
        sums.dy += b.gradient.y * mean;
        sums.dz += b.gradient.z * mean;
    }
    partial[thread] = sums;
    workgroupBarrier();
    if thread > 0u {
        return;
    }
    for (var i = 1u; i < THREADS; i++) {
        sums.density += partial[i].density;
        sums.value += partial[i].value;
        sums.dx += partial[i].dx;
        sums.dy += partial[i].dy;
        sums.dz += partial[i].dz;
    }
    // The gradient of Eq. 12.
    let density = max(sums.density.w, SMALLEST_DENSITY);
    let slope = sums.density.xyz / density;
    let mean = sums.value / density;
    let dx = sums.dx / density - slope.x * mean;
    let dy = sums.dy / density - slope.y * mean;
    let dz = sums.dz / density - slope.z * mean;

    let sigma = lighting.sigma_mean * frame.density_scale;
    let kappa = 1.0 / (3.0 * (1.0 - lighting.scatter[0].rgb * lighting.g) * sigma * density);
    let driven = sigma * density * LINEAR;
    let first = l * SH_COEFFICIENTS;
    // As functions of the direction that light comes from, against which it travels.
    let x1 = kappa * (driven * source[first + 3u].rgb - dx);
    let y1 = kappa * (driven * source[first + 1u].rgb - dy);
    let z1 = kappa * (-driven * source[first + 2u].rgb - dz);
    let band1 = lighting.scatter[1].rgb / LINEAR;
    source[first] += vec4(lighting.scatter[0].rgb * UNIT * solution[l].rgb, 0.0);
    source[first + 1u] += vec4(band1 * y1, 0.0);
    source[first + 2u] -= vec4(band1 * z1, 0.0);
    source[first + 3u] += vec4(band1 * x1, 0.0);
}
