// Fields of a volume as emission and absorption in false colour, in the 3D texture that the view pass marches: density, the
// Gaussians alone, the residual. See `SmokeDebugView`.
#import bevy_smoke::frame::{Frame, Rbf, MAX_HALF, bin_index, cell_center}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> rbfs: array<Rbf>;
@group(0) @binding(2) var<storage, read> bin_offsets: array<u32>;
@group(0) @binding(3) var<storage, read> bin_indices: array<u32>;
@group(0) @binding(4) var density: texture_3d<f32>;
// RGB: colour; alpha: scaled field; padded by one cell on each side.
@group(0) @binding(5) var volume: texture_storage_3d<rgba16float, write>;

// An RBF ends at three radii, u^2 = 9.
const SUPPORT2: f32 = 9.0;
// A scaled residual below this is none.
const NOTHING: f32 = 1e-5;

// The sum of the Gaussians at a cell's centre.
fn gaussians(cell: vec3<i32>) -> f32 {
    let x = cell_center(frame, cell);
    let bin = bin_index(frame, cell);
    var sum = 0.0;
    for (var i = bin_offsets[bin]; i < bin_offsets[bin + 1u]; i++) {
        let rbf = rbfs[bin_indices[i]];
        let offset = x - rbf.center;
        let u2 = dot(offset, offset) / (rbf.radius * rbf.radius);
        if u2 < SUPPORT2 {
            sum += rbf.weight * exp(-u2);
        }
    }
    return sum;
}

fn density_at(cell: vec3<i32>) -> f32 {
    return textureLoad(density, cell, 0).x;
}

// Blue at 0, green at 1/2, red at 1.
fn by_density(t: f32) -> vec3<f32> {
    return saturate(vec3(2.0 * t - 1.0, 1.0 - abs(2.0 * t - 1.0), 1.0 - 2.0 * t));
}

// Between cells colours are interpolated beside fields: outside the box they are those of the nearest cell.
fn store(id: vec3<u32>, color: vec3<f32>, scaled: f32) {
    let inside = all(id > vec3(0u)) && all(id <= frame.dims);
    textureStore(volume, id, vec4(color, select(0.0, min(scaled, MAX_HALF), inside)));
}

fn nearest_cell(id: vec3<u32>) -> vec3<i32> {
    return vec3<i32>(clamp(id, vec3(1u), frame.dims)) - 1;
}

fn show_by_density(id: vec3<u32>, value: f32) {
    let scaled = max(value, 0.0) * frame.density_scale;
    store(id, by_density(min(scaled, 1.0)), scaled);
}

@compute @workgroup_size(8, 8, 4)
fn show_density(@builtin(global_invocation_id) id: vec3<u32>) {
    if all(id < frame.dims + 2u) {
        show_by_density(id, density_at(nearest_cell(id)));
    }
}

@compute @workgroup_size(8, 8, 4)
fn show_rbfs(@builtin(global_invocation_id) id: vec3<u32>) {
    if all(id < frame.dims + 2u) {
        show_by_density(id, gaussians(nearest_cell(id)));
    }
}

@compute @workgroup_size(8, 8, 4)
fn show_residual(@builtin(global_invocation_id) id: vec3<u32>) {
    if any(id >= frame.dims + 2u) {
        return;
    }
    let cell = nearest_cell(id);
    let value = density_at(cell) - gaussians(cell);
    let scaled = abs(value) * frame.density_scale;
    // Where there is nothing but rounding, it is neither.
    let red = select(0.5 + 0.5 * sign(value), 0.5, scaled < NOTHING);
    store(id, vec3(red, 0.0, 1.0 - red), scaled);
}
