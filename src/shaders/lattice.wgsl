// Lays Gaussians through live density: one in every cell of a lattice in which there is any, at its centre of mass, with the
// weight that gives it the cell's mass. Then sorts them into bins as `rbf/bins.rs` does those of baked smoke: a bin lists
// those whose support meets its box, and those whose cell does. Five dispatches:
//     gather, a workgroup a lattice cell; place, one; count, a thread a bin; offset, one; list, a thread a bin.
#import bevy_smoke::frame::{BIN_CELLS, Frame, Rbf, cell_center}

struct Lattice {
    // Its cells a side; their side in bundle space, and in cells of the coarse grid.
    dims: vec3<u32>,
    side: f32,
    coarse_side: f32,
}

// Written too: how many RBFs there are.
@group(0) @binding(0) var<storage, read_write> frame: Frame;
@group(0) @binding(1) var<uniform> lattice: Lattice;
@group(0) @binding(2) var coarse: texture_3d<f32>;
// Of every lattice cell, its centre of mass and its mass: scaled density times coarse cells.
@group(0) @binding(3) var<storage, read_write> masses: array<vec4<f32>>;
// The number of its RBF.
@group(0) @binding(4) var<storage, read_write> slots: array<u32>;
@group(0) @binding(5) var<storage, read_write> rbfs: array<Rbf>;
@group(0) @binding(6) var<storage, read_write> bin_offsets: array<u32>;
@group(0) @binding(7) var<storage, read_write> bin_indices: array<u32>;

// Radius of a Gaussian over its cell's side, by measurement: as in `reference/lattice.rs`.
const RADIUS: f32 = 0.45;
const SUPPORT: f32 = 3.0;
const SQRT_PI: f32 = 1.7724538509055159;
const NONE: u32 = 0xffffffffu;

fn lattice_cell(index: u32) -> vec3<u32> {
    let dims = lattice.dims;
    return vec3(index % dims.x, index / dims.x % dims.y, index / (dims.x * dims.y));
}

// The first coarse cells that belong to lattice cells: those whose centres are in them.
fn first_coarse(cell: vec3<u32>) -> vec3<i32> {
    let from_center = (vec3<f32>(cell) - 0.5 * vec3<f32>(lattice.dims)) * lattice.coarse_side;
    return vec3<i32>(ceil(from_center + 0.5 * vec3<f32>(frame.coarse_dims) - 0.5));
}

const GATHERERS: u32 = 64u;
var<workgroup> partial: array<vec4<f32>, GATHERERS>;

@compute @workgroup_size(GATHERERS)
fn gather(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let cell = lattice_cell(group.x);
    let first = max(first_coarse(cell), vec3(0));
    let size = vec3<u32>(max(min(first_coarse(cell + 1u), vec3<i32>(frame.coarse_dims)) - first, vec3(0)));
    var sum = vec4(0.0);
    for (var i = thread; i < size.x * size.y * size.z; i += GATHERERS) {
        let at = vec3<u32>(first) + vec3(i % size.x, i / size.x % size.y, i / (size.x * size.y));
        let mass = textureLoad(coarse, at + 1u, 0).x;
        sum += mass * vec4(vec3<f32>(at) + 0.5 - 0.5 * vec3<f32>(frame.coarse_dims), 1.0);
    }
    partial[thread] = sum;
    workgroupBarrier();
    for (var half = GATHERERS / 2u; half > 0u; half /= 2u) {
        if thread < half {
            partial[thread] += partial[thread + half];
        }
        workgroupBarrier();
    }
    if thread == 0u {
        let mass = partial[0].w;
        let center = partial[0].xyz / max(mass, 1e-30) * (frame.coarse_ratio * frame.cell);
        masses[group.x] = vec4(center, mass);
    }
}

const THREADS: u32 = 256u;
var<workgroup> ends: array<u32, THREADS>;

// The sum of the values of the threads before this one, and with it.
fn scan(value: u32, thread: u32) -> vec2<u32> {
    ends[thread] = value;
    workgroupBarrier();
    for (var reach = 1u; reach < THREADS; reach *= 2u) {
        var before = 0u;
        if thread >= reach {
            before = ends[thread - reach];
        }
        workgroupBarrier();
        ends[thread] += before;
        workgroupBarrier();
    }
    return vec2(ends[thread] - value, ends[thread]);
}

@compute @workgroup_size(THREADS)
fn place(@builtin(local_invocation_index) thread: u32) {
    let cells = lattice.dims.x * lattice.dims.y * lattice.dims.z;
    let share = (cells + THREADS - 1u) / THREADS;
    let first = min(thread * share, cells);
    let last = min(first + share, cells);
    var count = 0u;
    for (var i = first; i < last; i++) {
        count += select(0u, 1u, masses[i].w > 0.0);
    }
    let range = scan(count, thread);
    var next = range.x;
    let cell_volume = lattice.coarse_side * lattice.coarse_side * lattice.coarse_side;
    let gaussian_volume = pow(SQRT_PI * RADIUS, 3.0);
    for (var i = first; i < last; i++) {
        slots[i] = NONE;
        if masses[i].w > 0.0 {
            slots[i] = next;
            let weight = masses[i].w / (cell_volume * gaussian_volume * frame.density_scale);
            rbfs[next] = Rbf(masses[i].xyz, RADIUS * lattice.side, weight);
            next += 1u;
        }
    }
    if thread == THREADS - 1u {
        frame.rbf_count = range.y;
    }
}

// What lies in a bin: where its list begins, how many it lists.
fn visit(bin_number: u32, begin: u32, write: bool) -> u32 {
    let bins = frame.bins;
    let bin = vec3(bin_number % bins.x, bin_number / bins.x % bins.y, bin_number / (bins.x * bins.y));
    let first = vec3<i32>(bin * BIN_CELLS);
    let last = min(first + i32(BIN_CELLS), vec3<i32>(frame.dims)) - 1;
    // Grown by a cell, so that neighbouring bins' cells see the same.
    let low = cell_center(frame, first) - 1.5 * frame.cell;
    let high = cell_center(frame, last) + 1.5 * frame.cell;
    let support = SUPPORT * RADIUS * lattice.side;
    let middle = 0.5 * vec3<f32>(lattice.dims);
    let from_cell = vec3<i32>(max(floor((low - support) / lattice.side + middle), vec3(0.0)));
    let to_cell = min(vec3<i32>(floor((high + support) / lattice.side + middle)), vec3<i32>(lattice.dims) - 1);
    var count = 0u;
    for (var z = from_cell.z; z <= to_cell.z; z++) {
        for (var y = from_cell.y; y <= to_cell.y; y++) {
            for (var x = from_cell.x; x <= to_cell.x; x++) {
                let cell = vec3<u32>(vec3(x, y, z));
                let slot = slots[cell.x + lattice.dims.x * (cell.y + lattice.dims.y * cell.z)];
                if slot == NONE {
                    continue;
                }
                let corner = (vec3<f32>(cell) - middle) * lattice.side;
                let is_inside = all(corner < high) && all(corner + lattice.side > low);
                let center = rbfs[slot].center;
                let apart = clamp(center, low, high) - center;
                if is_inside || dot(apart, apart) < support * support {
                    if write {
                        bin_indices[begin + count] = slot;
                    }
                    count += 1u;
                }
            }
        }
    }
    return count;
}

fn bin_count() -> u32 {
    return frame.bins.x * frame.bins.y * frame.bins.z;
}

@compute @workgroup_size(64)
fn count(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x < bin_count() {
        bin_offsets[id.x + 1u] = visit(id.x, 0u, false);
    }
}

@compute @workgroup_size(THREADS)
fn offset(@builtin(local_invocation_index) thread: u32) {
    let bins = bin_count();
    let share = (bins + THREADS - 1u) / THREADS;
    let first = min(thread * share, bins);
    let last = min(first + share, bins);
    var sum = 0u;
    for (var i = first; i < last; i++) {
        sum += bin_offsets[i + 1u];
    }
    var end = scan(sum, thread).x;
    for (var i = first; i < last; i++) {
        end += bin_offsets[i + 1u];
        bin_offsets[i + 1u] = end;
    }
    if thread == 0u {
        bin_offsets[0] = 0u;
    }
}

@compute @workgroup_size(64)
fn list(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x < bin_count() {
        visit(id.x, bin_offsets[id.x], true);
    }
}
