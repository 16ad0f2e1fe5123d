// Adds the light that diffusion found to the light at every RBF's probes, bands 0 and 1: trilinear between the cells that
// hold smoke. One thread a probe.
#import bevy_smoke::frame::{Frame, Rbf}
#import bevy_smoke::sh::SH_COEFFICIENTS
#import bevy_smoke::lighting::{Lighting, probe_position, probe_reach, PROBES}
#import bevy_smoke::diffusion::{Diffusion, index_of, LINEAR, UNIT}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> lighting: Lighting;
@group(0) @binding(2) var<uniform> diffusion: Diffusion;
@group(0) @binding(3) var<storage, read> rbfs: array<Rbf>;
// As `media` in `diffusion_solve.wgsl` leaves them.
@group(0) @binding(4) var<storage, read> terms: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> probes: array<vec4<f32>>;

@compute @workgroup_size(64)
fn scatter(@builtin(global_invocation_id) id: vec3<u32>) {
    let probe = id.x;
    if probe >= frame.rbf_count * PROBES || probe % PROBES >= lighting.probes {
        return;
    }
    let rbf = rbfs[probe / PROBES];
    let reach = probe_reach(rbf, lighting.sigma_mean, frame.density_scale);
    let x = probe_position(rbf.center, reach, probe % PROBES);
    let at = x / diffusion.cell + 0.5 * vec3<f32>(diffusion.dims) - 0.5;
    let low = floor(at);
    let f = at - low;
    var sums = array<vec3<f32>, 4>();
    var total = 0.0;
    for (var i = 0u; i < 8u; i++) {
        let corner = vec3(i & 1u, (i >> 1u) & 1u, i >> 2u);
        let cell = vec3<i32>(low) + vec3<i32>(corner);
        if any(cell < vec3(0)) || any(cell >= vec3<i32>(diffusion.dims)) {
            continue;
        }
        let index = index_of(diffusion, vec3<u32>(cell));
        let share = select(1.0 - f, f, corner == vec3(1u));
        let weight = share.x * share.y * share.z * terms[index].a;
        for (var slot = 0u; slot < 4u; slot++) {
            sums[slot] += weight * terms[slot * diffusion.cell_count + index].rgb;
        }
        total += weight;
    }
    if total <= 0.0 {
        return;
    }
    // As a function of the direction that light comes from, against which it travels.
    let first = probe * SH_COEFFICIENTS;
    probes[first] += vec4(sums[0] * (UNIT / total), 0.0);
    probes[first + 1u] += vec4(sums[2] / (total * LINEAR), 0.0);
    probes[first + 2u] -= vec4(sums[3] / (total * LINEAR), 0.0);
    probes[first + 3u] += vec4(sums[1] / (total * LINEAR), 0.0);
}
