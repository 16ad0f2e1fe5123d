// What the passes of diffusion share.
#define_import_path bevy_smoke::diffusion

struct Diffusion {
    // Cells a side, centred on the box.
    dims: vec3<u32>,
    // Side of a cell in bundle space.
    cell: f32,
    cell_count: u32,
    // Residual over right-hand side, both weighted by the diagonal, at which the solver stops.
    tolerance: f32,
}

// Single scattering of a cell, J(w) = mean + (x, y, z) . w with w the direction of travel, RGB each; in alpha of `mean` its extinction a bundle unit, zero where there is no smoke.
struct Cell {
    mean: vec4<f32>,
    x: vec4<f32>,
    y: vec4<f32>,
    z: vec4<f32>,
}

// sqrt(4 pi), and sqrt(3 / 4 pi), which y1, y2 and y3 have before -y, z and -x.
const UNIT: f32 = 3.5449077018;
const LINEAR: f32 = 0.4886025119;

fn cell_at(diffusion: Diffusion, index: u32) -> vec3<u32> {
    let d = diffusion.dims;
    return vec3(index % d.x, index / d.x % d.y, index / (d.x * d.y));
}

fn index_of(diffusion: Diffusion, cell: vec3<u32>) -> u32 {
    return cell.x + diffusion.dims.x * (cell.y + diffusion.dims.y * cell.z);
}
