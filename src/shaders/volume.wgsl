// Reconstructs the source radiance at every cell, padded by one cell on each side:
//     J(x) = max(0, sum_l phi_l J_l(x) / sum_l phi_l),   phi = w (exp(-u^2) + tail),   J_l the quadratic fit,
// and, for every lamp, albedo times phase times its irradiance after exp(-sigma column), with columns interpolated by the
// same formula: transmittance falls exponentially where smoke is thick, columns grow evenly. A lamp behind a sphere lights
// nothing. Beside it the density.
#import bevy_smoke::frame::{Frame, Rbf, MAX_HALF, bin_index, cell_center}
#import bevy_smoke::lighting::{Arriving, Lighting, Fit, arriving_from, phase, probe_reach, value_of, weight_at, PI, REACH}
#import bevy_smoke::occluders::{Surroundings, hides}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> lighting: Lighting;
// As in `outgoing.wgsl`.
@group(0) @binding(2) var<uniform> eye: vec4<f32>;
@group(0) @binding(3) var<storage, read> rbfs: array<Rbf>;
@group(0) @binding(4) var<storage, read> bin_offsets: array<u32>;
@group(0) @binding(5) var<storage, read> bin_indices: array<u32>;
@group(0) @binding(6) var<storage, read> outgoing: array<Fit>;
@group(0) @binding(7) var<storage, read> shades: array<Fit>;
@group(0) @binding(8) var density: texture_3d<f32>;
// RGB: source radiance; alpha: scaled density.
@group(0) @binding(9) var volume: texture_storage_3d<rgba16float, write>;
@group(0) @binding(10) var<uniform> surroundings: Surroundings;
@group(0) @binding(11) var<storage, read> spheres: array<vec4<f32>>;

// Whether a trilinear read that touches this cell can meet any density.
fn near_density(cell: vec3<i32>) -> bool {
    let low = max(cell - 1, vec3(0));
    let high = min(cell + 1, vec3<i32>(frame.dims) - 1);
    for (var z = low.z; z <= high.z; z++) {
        for (var y = low.y; y <= high.y; y++) {
            for (var x = low.x; x <= high.x; x++) {
                if textureLoad(density, vec3(x, y, z), 0).x > 0.0 {
                    return true;
                }
            }
        }
    }
    return false;
}

// Whether a sphere stands between a cell and a lamp.
fn is_hidden(point: vec3<f32>, light: Arriving) -> bool {
    for (var i = 0u; i < surroundings.sphere_count; i++) {
        if hides(spheres[i], point, light.direction, light.distance) {
            return true;
        }
    }
    return false;
}

// RBFs hold what falls with the distance from a lamp down to one over this many radii, by measurement.
const HELD: f32 = 0.6;

// Light of a lamp that has scattered twice is brighter toward the lamp too, as 1 / d where smoke is even,
//     J_2 = Omega^2 sigma D I pi / (16 d),
// which RBFs hold to some distance: what is above that.
fn second_glow(light: Arriving, scaled_density: f32, radius: f32) -> vec3<f32> {
    let softened = light.distance * light.distance + lighting.softening;
    let above = max(inverseSqrt(softened) - HELD / radius, 0.0);
    let albedo = lighting.scatter[0].rgb;
    return albedo * albedo * lighting.sigma * scaled_density * light.irradiance * softened * (above * PI / 16.0);
}

@compute @workgroup_size(8, 8, 4)
fn reconstruct(@builtin(global_invocation_id) id: vec3<u32>) {
    if any(id >= frame.dims + 2u) {
        return;
    }
    let cell = vec3<i32>(id) - 1;
    if !near_density(cell) {
        textureStore(volume, id, vec4(0.0));
        return;
    }
    let x = cell_center(frame, cell);
    let bin = bin_index(frame, cell);
    var sum = vec3(0.0);
    var columns = array<vec4<f32>, 2>();
    var weights = 0.0;
    var radii = 0.0;
    for (var i = bin_offsets[bin]; i < bin_offsets[bin + 1u]; i++) {
        let l = bin_indices[i];
        let rbf = rbfs[l];
        let offset = x - rbf.center;
        let u2 = dot(offset, offset) / (rbf.radius * rbf.radius);
        let phi = weight_at(rbf, u2);
        let reach = REACH * probe_reach(rbf, lighting.sigma_mean, frame.density_scale) / rbf.radius;
        let delta = offset * min(1.0, reach / sqrt(max(u2, 1e-12)));
        let o = outgoing[l];
        let low = vec3(o.center.w, o.dx.w, o.dy.w);
        let high = vec3(o.dz.w, o.qx.w, o.qy.w);
        sum += phi * clamp(value_of(o, delta).rgb, low, high);
        for (var s = 0u; 4u * s < lighting.lamp_count; s++) {
            columns[s] += phi * value_of(shades[2u * l + s], delta);
        }
        weights += phi;
        radii += phi * rbf.radius;
    }
    let normalize_by = 1.0 / max(weights, 1e-30);
    let inside = all(cell >= vec3(0)) && all(cell < vec3<i32>(frame.dims));
    let d = select(0.0, textureLoad(density, max(cell, vec3(0)), 0).x, inside);
    var radiance = max(sum * normalize_by, vec3(0.0));
    let look = select(eye.xyz, (x - eye.xyz) / max(length(x - eye.xyz), 1e-9), eye.w > 0.0);
    for (var i = 0u; i < lighting.lamp_count; i++) {
        let light = arriving_from(lighting.lamps[i], x, lighting.softening);
        if is_hidden(x, light) {
            continue;
        }
        let column = max(columns[i / 4u][i % 4u] * normalize_by, 0.0);
        // Light travels from the lamp, and on toward the eye: both against these two.
        let scattered = lighting.scatter[0].rgb * phase(dot(light.direction, look), lighting.g);
#ifndef SCATTERED_ONLY
        radiance += scattered * light.irradiance * exp(-lighting.sigma * column);
#endif
        if lighting.coefficients > 0u && lighting.lamps[i].is_sun == 0u {
            radiance += second_glow(light, d * frame.density_scale, radii * normalize_by);
        }
    }
    radiance = min(radiance, vec3(MAX_HALF));
    textureStore(volume, id, vec4(radiance, min(d * frame.density_scale, MAX_HALF)));
}
