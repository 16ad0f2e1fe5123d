// The diffusion equation at every RBF's centre, as printed (Zhou et al. 2008, Eq. 13): one workgroup a row of A L = b, for
// three colour channels at once. Everything is divided by the density at once, lest its fourth power leave f32.
#import bevy_smoke::frame::{Frame, Rbf}
#import bevy_smoke::sh::SH_COEFFICIENTS
#import bevy_smoke::lighting::Lighting
#import bevy_smoke::paper::{Jet, jet, LINEAR, SMALLEST_DENSITY, UNIT}

const THREADS: u32 = 64u;

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> lighting: Lighting;
@group(0) @binding(2) var<storage, read> rbfs: array<Rbf>;
@group(0) @binding(3) var<storage, read> source: array<vec4<f32>>;
// n x n, three channels an entry.
@group(0) @binding(4) var<storage, read_write> matrix: array<f32>;
@group(0) @binding(5) var<storage, read_write> rhs: array<vec4<f32>>;

// Gradient and value.
var<workgroup> partial: array<vec4<f32>, THREADS>;
var<workgroup> laplacians: array<f32, THREADS>;

@compute @workgroup_size(THREADS)
fn assemble(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let row = group.x;
    let count = frame.rbf_count;
    let x = rbfs[row].center;
    var sum = vec4(0.0);
    var laplacian = 0.0;
    for (var h = thread; h < count; h += THREADS) {
        let b = jet(rbfs[h], x);
        sum += vec4(b.gradient, b.value);
        laplacian += b.laplacian;
    }
    partial[thread] = sum;
    laplacians[thread] = laplacian;
    workgroupBarrier();
    sum = vec4(0.0);
    laplacian = 0.0;
    for (var i = 0u; i < THREADS; i++) {
        sum += partial[i];
        laplacian += laplacians[i];
    }
    workgroupBarrier();
    // A row's own RBF is there, but may be fading.
    let density = max(sum.w, SMALLEST_DENSITY);
    let gradient = sum.xyz / density;
    laplacian /= density;

    let sigma = lighting.sigma_mean * frame.density_scale;
    let albedo = lighting.scatter[0].rgb;
    let scatters = (albedo > vec3(0.0)) & vec3(sum.w >= SMALLEST_DENSITY);
    let transport = (1.0 - albedo * lighting.g) * sigma;
    let absorption = (1.0 - albedo) * sigma;
    var right = vec3(0.0);
    for (var h = thread; h < count; h += THREADS) {
        let b = jet(rbfs[h], x);
        let value = b.value / density;
        let slope = b.gradient / density;
        let diffusion = b.laplacian / density - 3.0 * dot(gradient, slope)
            + (3.0 * dot(gradient, gradient) - laplacian) * value;
        let entry = diffusion / (3.0 * transport * density) - absorption * b.value;
        // A channel that scatters nothing has no equation, nor has a place without smoke.
        let kept = select(vec3(0.0), entry, scatters);
        let at = 3u * (row * count + h);
        matrix[at] = kept.r;
        matrix[at + 1u] = kept.g;
        matrix[at + 2u] = kept.b;
        let divergence = slope - gradient * value;
        let first = h * SH_COEFFICIENTS;
        let mean = source[first].rgb / UNIT;
        let flux = LINEAR * (divergence.x * source[first + 3u].rgb + divergence.y * source[first + 1u].rgb
            - divergence.z * source[first + 2u].rgb);
        right += sigma / transport * flux - sigma / max(albedo, vec3(1e-20)) * b.value * mean;
    }
    partial[thread] = vec4(select(vec3(0.0), right, scatters), 0.0);
    workgroupBarrier();
    if thread == 0u {
        var total = vec4(0.0);
        for (var i = 0u; i < THREADS; i++) {
            total += partial[i];
        }
        rhs[row] = total;
    }
}
