// Single scattering and extinction in the cells of diffusion: `fit` fits bands 0 and 1 of the source radiance at every
// RBF's probes, `spread` blends the fits in every cell as `volume.wgsl` does, and averages the density.
#import bevy_smoke::frame::{Frame, Rbf, bin_index}
#import bevy_smoke::sh::{basis, band, SH_COEFFICIENTS}
#import bevy_smoke::lighting::{Lighting, Fit, arriving_from, probe_position, probe_reach, value_of, weight_at, MAX_LAMPS, PROBES, REACH}
#import bevy_smoke::diffusion::{Cell, Diffusion, cell_at, LINEAR, UNIT}

// Bands 0 and 1.
const KEPT: u32 = 4u;
// Cells of a smaller optical thickness are empty.
const EMPTY: f32 = 1e-3;

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> lighting: Lighting;
@group(0) @binding(2) var<uniform> diffusion: Diffusion;
@group(0) @binding(3) var<storage, read> rbfs: array<Rbf>;
@group(0) @binding(4) var<storage, read> bin_offsets: array<u32>;
@group(0) @binding(5) var<storage, read> bin_indices: array<u32>;
@group(0) @binding(6) var<storage, read> probes: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read> columns: array<f32>;
@group(0) @binding(8) var coarse: texture_3d<f32>;
@group(0) @binding(9) var coarse_sampler: sampler;
// Four an RBF.
@group(0) @binding(10) var<storage, read_write> fits: array<Fit>;
@group(0) @binding(11) var<storage, read_write> cells: array<Cell>;

@compute @workgroup_size(64)
fn fit(@builtin(global_invocation_id) id: vec3<u32>) {
    let l = id.x / KEPT;
    let k = id.x % KEPT;
    if l >= frame.rbf_count {
        return;
    }
    let rbf = rbfs[l];
    let r = probe_reach(rbf, lighting.sigma_mean, frame.density_scale);
    var values: array<vec4<f32>, PROBES>;
    for (var i = 0u; i < lighting.probes; i++) {
        let probe = l * PROBES + i;
        var light = probes[probe * SH_COEFFICIENTS + k].rgb;
        let point = probe_position(rbf.center, r, i);
        for (var j = 0u; j < lighting.lamp_count; j++) {
            let lamp = arriving_from(lighting.lamps[j], point, lighting.softening);
            let column = columns[probe * MAX_LAMPS + j];
            let kept = select(exp(-lighting.sigma * column), vec3(0.0), column < 0.0);
            light += lamp.irradiance * kept * basis(lamp.direction)[k];
        }
        values[i] = vec4(lighting.scatter[band(k)].rgb * light, 0.0);
    }
    for (var i = lighting.probes; i < PROBES; i++) {
        values[i] = values[0];
    }
    let center = values[0];
    fits[id.x] = Fit(
        center,
        (values[1] - values[2]) / (2.0 * r),
        (values[3] - values[4]) / (2.0 * r),
        (values[5] - values[6]) / (2.0 * r),
        (values[1] + values[2] - 2.0 * center) / (2.0 * r * r),
        (values[3] + values[4] - 2.0 * center) / (2.0 * r * r),
        (values[5] + values[6] - 2.0 * center) / (2.0 * r * r),
    );
}

// Extinction of the cell about a point: the mean of eight points.
fn extinction(x: vec3<f32>) -> f32 {
    let coarse_size = vec3<f32>(frame.coarse_dims + 2u) * (frame.coarse_ratio * frame.cell);
    var sum = 0.0;
    for (var i = 0u; i < 8u; i++) {
        let corner = vec3(f32(i & 1u), f32((i >> 1u) & 1u), f32(i >> 2u)) * 2.0 - 1.0;
        let point = x + 0.25 * diffusion.cell * corner;
        sum += textureSampleLevel(coarse, coarse_sampler, point / coarse_size + 0.5, 0.0).x;
    }
    let found = lighting.sigma_mean * sum / 8.0;
    return select(0.0, found, found * diffusion.cell > EMPTY);
}

@compute @workgroup_size(64)
fn spread(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= diffusion.cell_count {
        return;
    }
    let cell = vec3<f32>(cell_at(diffusion, id.x));
    let x = (cell + 0.5 - 0.5 * vec3<f32>(diffusion.dims)) * diffusion.cell;
    let found = extinction(x);
    if found == 0.0 {
        cells[id.x] = Cell();
        return;
    }
    let bin = bin_index(frame, vec3<i32>(floor(x / frame.cell + 0.5 * vec3<f32>(frame.dims))));
    var sums = array<vec3<f32>, KEPT>();
    var weights = 0.0;
    for (var i = bin_offsets[bin]; i < bin_offsets[bin + 1u]; i++) {
        let l = bin_indices[i];
        let rbf = rbfs[l];
        let offset = x - rbf.center;
        let u2 = dot(offset, offset) / (rbf.radius * rbf.radius);
        let phi = weight_at(rbf, u2);
        let delta = offset * min(1.0, REACH / sqrt(max(u2, 1e-12)));
        for (var k = 0u; k < KEPT; k++) {
            sums[k] += phi * value_of(fits[KEPT * l + k], delta).rgb;
        }
        weights += phi;
    }
    let scale = 1.0 / max(weights, 1e-30);
    cells[id.x] = Cell(
        vec4(sums[0] * (scale / UNIT), found),
        vec4(sums[3] * (scale * LINEAR), 0.0),
        vec4(sums[1] * (scale * LINEAR), 0.0),
        vec4(sums[2] * (-scale * LINEAR), 0.0),
    );
}
