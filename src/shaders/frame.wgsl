// What every pass knows of one moment of smoke: its grid and its RBFs' bins.
// Filled by `GpuSmokeFrame` (render/frame.rs).
#define_import_path bevy_smoke::frame

struct Frame {
    // Cells a side of the density grid.
    dims: vec3<u32>,
    rbf_count: u32,
    // Bins a side; a bin is BIN_CELLS cells a side.
    bins: vec3<u32>,
    // Side of a cell in bundle space: 1 / longest side.
    cell: f32,
    // Cells a side of the coarse density grid, without its padding.
    coarse_dims: vec3<u32>,
    // Side of a coarse cell, in fine cells.
    coarse_ratio: f32,
    // Multiplies the density where it is stored in half precision, so that it is at most about 1 there.
    density_scale: f32,
    // The share of the second of two residuals that are blended.
    blend: f32,
    // RBFs that buffers have room for.
    rbf_capacity: u32,
}

// The largest number that half precision holds.
const MAX_HALF: f32 = 65504.0;

struct Rbf {
    center: vec3<f32>,
    radius: f32,
    weight: f32,
}

const BIN_CELLS: u32 = 8u;

// Bundle-space position of a cell's centre; the box is centred on the origin.
fn cell_center(frame: Frame, cell: vec3<i32>) -> vec3<f32> {
    return (vec3<f32>(cell) + 0.5 - 0.5 * vec3<f32>(frame.dims)) * frame.cell;
}

fn bin_index(frame: Frame, cell: vec3<i32>) -> u32 {
    let inside = vec3<u32>(clamp(cell, vec3<i32>(0), vec3<i32>(frame.dims) - 1));
    let bin = inside / BIN_CELLS;
    return bin.x + frame.bins.x * (bin.y + frame.bins.y * bin.z);
}
