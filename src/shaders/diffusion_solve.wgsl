// Diffusion on a grid of finite volumes, three colour channels in lock-step (see `reference/diffusion.rs`):
//     -div(kappa grad L0) + sigma_a D L0 = sigma_t D J0 - div(kappa sigma_t D J1),
//     kappa = 1 / (3 (1 - Omega g) (sigma_t D + 1 / l)),
// by conjugate gradients from what the solution is, preconditioned by the diagonal. `begin` starts; `multiply`, `descend`
// and `turn` are a step, which finds nothing to do once the residual is small enough; `media` ends with L0 and L1. One
// thread a cell; every workgroup leaves its share of a dot product, and every workgroup adds up all shares.
#import bevy_smoke::lighting::Lighting
#import bevy_smoke::diffusion::{Cell, Diffusion, cell_at, index_of}
#import bevy_smoke::sum::{add_up, THREADS}

// The longest free path l, by measurement.
const FREE_PATH: f32 = 0.125;

struct Control {
    done: u32,
    steps: u32,
    error: f32,
    unused: u32,
}

@group(0) @binding(0) var<uniform> lighting: Lighting;
@group(0) @binding(1) var<uniform> diffusion: Diffusion;
@group(0) @binding(2) var<storage, read> cells: array<Cell>;
@group(0) @binding(3) var<storage, read_write> solution: array<vec4<f32>>;
// The residual r, the direction p and q = A p; at the end the terms of media radiance: L0, with 1 in alpha where there is
// smoke, and the components of L1.
@group(0) @binding(4) var<storage, read_write> vectors: array<vec4<f32>>;
// Shares of p . q; of r . z at the step before and at this one, z = r / diagonal; and of b . b / diagonal.
@group(0) @binding(5) var<storage, read_write> images: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> before: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> after: array<vec4<f32>>;
@group(0) @binding(8) var<storage, read_write> goal: array<vec4<f32>>;
@group(0) @binding(9) var<storage, read_write> control: Control;

fn residual_at(index: u32) -> u32 { return index; }
fn direction_at(index: u32) -> u32 { return diffusion.cell_count + index; }
fn image_at(index: u32) -> u32 { return 2u * diffusion.cell_count + index; }

// The number of shares, at most THREADS.
fn share_count() -> u32 {
    return (diffusion.cell_count + THREADS - 1u) / THREADS;
}

fn is_small(power: vec3<f32>, reference: vec3<f32>) -> bool {
    return all(power <= diffusion.tolerance * diffusion.tolerance * reference);
}

// a / b, and zero where there is nothing left to do.
fn ratio(a: vec3<f32>, b: vec3<f32>) -> vec3<f32> {
    return select(vec3(0.0), a / max(b, vec3(1e-37)), b > vec3(1e-37));
}

// The largest residual of the channels, relative to the right-hand side.
fn relative(power: vec3<f32>, reference: vec3<f32>) -> f32 {
    let left = ratio(power, reference);
    return sqrt(max(left.x, max(left.y, left.z)));
}

fn kappa_of(extinction: f32) -> vec3<f32> {
    return 1.0 / (3.0 * (1.0 - lighting.scatter[1].rgb) * (extinction + 1.0 / FREE_PATH));
}

// One of a cell's six faces.
struct Face {
    // Whether smoke goes on behind it, and where.
    is_open: bool,
    beyond: u32,
    // At the face; of the cell itself where smoke ends.
    kappa: vec3<f32>,
    // kappa sigma_t D J1 . n, n outward.
    driven: vec3<f32>,
}

fn along(cell: Cell, axis: u32) -> vec3<f32> {
    return select(select(cell.z.rgb, cell.y.rgb, axis == 1u), cell.x.rgb, axis == 0u);
}

fn face_of(index: u32, number: u32) -> Face {
    let axis = number / 2u;
    let side = select(-1, 1, (number & 1u) == 1u);
    let here = cells[index];
    let driven = f32(side) * here.mean.a * along(here, axis);
    let step = vec3(select(0, side, axis == 0u), select(0, side, axis == 1u), select(0, side, axis == 2u));
    let place = vec3<i32>(cell_at(diffusion, index)) + step;
    if all(place >= vec3(0)) && all(place < vec3<i32>(diffusion.dims)) {
        let beyond = index_of(diffusion, vec3<u32>(place));
        let there = cells[beyond];
        if there.mean.a > 0.0 {
            let kappa = kappa_of(0.5 * (here.mean.a + there.mean.a));
            let both = 0.5 * (driven + f32(side) * there.mean.a * along(there, axis));
            return Face(false, beyond, kappa, kappa * both);
        }
    }
    let kappa = kappa_of(here.mean.a);
    return Face(true, index, kappa, kappa * driven);
}

// How much of L0 flows out of a face, per unit of volume.
fn outflow(face: Face) -> vec3<f32> {
    let h = diffusion.cell;
    return select(face.kappa / (h * h), 2.0 * face.kappa / (h * (4.0 * face.kappa + h)), face.is_open);
}

fn diagonal(index: u32) -> vec3<f32> {
    var sum = (1.0 - lighting.scatter[0].rgb) * cells[index].mean.a;
    for (var number = 0u; number < 6u; number++) {
        sum += outflow(face_of(index, number));
    }
    return sum;
}

@compute @workgroup_size(THREADS)
fn begin(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let index = id.x;
    var power = vec3(0.0);
    var reference = vec3(0.0);
    if index < diffusion.cell_count {
        var residual = vec3(0.0);
        var direction = vec3(0.0);
        let cell = cells[index];
        if cell.mean.a > 0.0 {
            let x = solution[index].rgb;
            var rhs = cell.mean.a * cell.mean.rgb;
            var d = (1.0 - lighting.scatter[0].rgb) * cell.mean.a;
            var image = vec3(0.0);
            for (var number = 0u; number < 6u; number++) {
                let face = face_of(index, number);
                let h = diffusion.cell;
                rhs -= face.driven / select(vec3(h), 4.0 * face.kappa + h, face.is_open);
                let flow = outflow(face);
                d += flow;
                if !face.is_open {
                    image -= flow * solution[face.beyond].rgb;
                }
            }
            residual = rhs - image - d * x;
            direction = residual / d;
            power = residual * direction;
            reference = rhs * rhs / d;
        } else {
            solution[index] = vec4(0.0);
        }
        vectors[residual_at(index)] = vec4(residual, 0.0);
        vectors[direction_at(index)] = vec4(direction, 0.0);
    }
    power = add_up(power, thread);
    reference = add_up(reference, thread);
    if thread == 0u {
        before[group.x] = vec4(power, 0.0);
        goal[group.x] = vec4(reference, 0.0);
        if group.x == 0u {
            control = Control();
        }
    }
}

@compute @workgroup_size(THREADS)
fn multiply(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let has_share = thread < share_count();
    let power = add_up(select(vec3(0.0), before[thread].rgb, has_share), thread);
    if is_small(power, add_up(select(vec3(0.0), goal[thread].rgb, has_share), thread)) {
        return;
    }
    let index = id.x;
    var product = vec3(0.0);
    if index < diffusion.cell_count {
        var image = vec3(0.0);
        if cells[index].mean.a > 0.0 {
            let p = vectors[direction_at(index)].rgb;
            image = (1.0 - lighting.scatter[0].rgb) * cells[index].mean.a * p;
            for (var number = 0u; number < 6u; number++) {
                let face = face_of(index, number);
                let next = select(vectors[direction_at(face.beyond)].rgb, vec3(0.0), face.is_open);
                image += outflow(face) * (p - next);
            }
            product = p * image;
        }
        vectors[image_at(index)] = vec4(image, 0.0);
    }
    product = add_up(product, thread);
    if thread == 0u {
        images[group.x] = vec4(product, 0.0);
    }
}

@compute @workgroup_size(THREADS)
fn descend(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let has_share = thread < share_count();
    let power = add_up(select(vec3(0.0), before[thread].rgb, has_share), thread);
    if is_small(power, add_up(select(vec3(0.0), goal[thread].rgb, has_share), thread)) {
        return;
    }
    let step = ratio(power, add_up(select(vec3(0.0), images[thread].rgb, has_share), thread));
    let index = id.x;
    var next = vec3(0.0);
    if index < diffusion.cell_count && cells[index].mean.a > 0.0 {
        solution[index] += vec4(step * vectors[direction_at(index)].rgb, 0.0);
        let residual = vectors[residual_at(index)].rgb - step * vectors[image_at(index)].rgb;
        vectors[residual_at(index)] = vec4(residual, 0.0);
        next = residual * residual / diagonal(index);
    }
    next = add_up(next, thread);
    if thread == 0u {
        after[group.x] = vec4(next, 0.0);
    }
}

@compute @workgroup_size(THREADS)
fn turn(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let has_share = thread < share_count();
    let power = add_up(select(vec3(0.0), before[thread].rgb, has_share), thread);
    let reference = add_up(select(vec3(0.0), goal[thread].rgb, has_share), thread);
    if is_small(power, reference) {
        // For the next step to see the same.
        if thread == 0u {
            after[group.x] = before[group.x];
        }
        if id.x == 0u {
            control.done = 1u;
            control.error = relative(power, reference);
        }
        return;
    }
    let next = add_up(select(vec3(0.0), after[thread].rgb, has_share), thread);
    let index = id.x;
    if index < diffusion.cell_count && cells[index].mean.a > 0.0 {
        let p = vectors[direction_at(index)].rgb;
        let z = vectors[residual_at(index)].rgb / diagonal(index);
        vectors[direction_at(index)] = vec4(z + ratio(next, power) * p, 0.0);
    }
    if id.x == 0u {
        control.steps += 1u;
        control.done = u32(is_small(next, reference));
        control.error = relative(next, reference);
    }
}

// L1 is three times the flux, the mean of opposite faces. Radiance L0 + L1 . w below zero is cut off.
@compute @workgroup_size(THREADS)
fn media(@builtin(global_invocation_id) id: vec3<u32>) {
    let index = id.x;
    if index >= diffusion.cell_count {
        return;
    }
    let count = diffusion.cell_count;
    if cells[index].mean.a == 0.0 {
        for (var slot = 0u; slot < 4u; slot++) {
            vectors[slot * count + index] = vec4(0.0);
        }
        return;
    }
    let x = solution[index].rgb;
    var first = array<vec3<f32>, 3>();
    for (var number = 0u; number < 6u; number++) {
        let face = face_of(index, number);
        let h = diffusion.cell;
        let half = h / (2.0 * face.kappa);
        let inner = face.kappa * (x - solution[face.beyond].rgb) / h + face.driven;
        let flux = select(inner, (x + face.driven * half) / (2.0 + half), face.is_open);
        first[number / 2u] += 1.5 * select(-flux, flux, (number & 1u) == 1u);
    }
    let mean = max(x, vec3(0.0));
    let length = sqrt(first[0] * first[0] + first[1] * first[1] + first[2] * first[2]);
    let shorter = min(vec3(1.0), mean / max(length, vec3(1e-30)));
    vectors[index] = vec4(mean, 1.0);
    for (var axis = 0u; axis < 3u; axis++) {
        vectors[(axis + 1u) * count + index] = vec4(first[axis] * shorter, 0.0);
    }
}
