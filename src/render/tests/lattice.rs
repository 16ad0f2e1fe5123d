use super::*;
use crate::rbf::{BIN_CELLS, RbfBins, SUPPORT};
use crate::reference::lattice::Gaussian;
use crate::render::frame::GpuSmokeFrame;
use crate::render::{coarse, lattice, live};

/// Two blobs in a box that lattice cells do not divide, with much of it empty.
fn density(shape: GridShape, cell: UVec3) -> f32 {
    let x = shape.center(cell);
    let blob = |at: Vec3, r: f32| (1.0 - x.distance_squared(at) / (r * r)).max(0.0);
    1.7 * blob(Vec3::new(-0.1, -0.25, 0.0), 0.2) + blob(Vec3::new(0.1, 0.2, 0.05), 0.15)
}

/// Live smoke, its passes run.
fn run(gpu: &Gpu, shape: GridShape, cells: u32, value: impl Fn(UVec3) -> f32) -> GpuSmokeFrame {
    let room = lattice::room(shape, cells);
    let frame = GpuSmokeFrame::live(shape, MAX_DENSITY, room, gpu.device(), gpu.queue());
    let source = gpu.texture_3d(shape.dims, TextureFormat::R32Float, value);
    let passes = gpu.passes();
    gpu.run(&passes.live, live::job(&passes.live, &source, &frame, gpu.device(), gpu.cache()));
    gpu.run(&passes.coarse, coarse::job(&passes.coarse, &frame, gpu.device(), gpu.cache()));
    let jobs = lattice::jobs(&passes.lattice, &frame, cells, gpu.device(), gpu.queue(), gpu.cache());
    for (step, job) in jobs {
        gpu.run(passes.lattice.of(step), job);
    }
    frame
}

/// RBFs as the passes wrote them.
fn written(gpu: &Gpu, frame: &GpuSmokeFrame) -> Vec<Rbf> {
    let count = read_words(gpu, &frame.uniform)[3] as usize;
    let floats = gpu.read_floats(&frame.rbfs);
    let rbf = |v: &[f32]| Rbf { center: [v[0], v[1], v[2]], radius: v[3], weight: v[4] };
    floats.chunks(8).take(count).map(rbf).collect()
}

fn read_words(gpu: &Gpu, buffer: &Buffer) -> Vec<u32> {
    read_buffer(gpu.device(), gpu.queue(), buffer).as_chunks().0.iter().map(|b| u32::from_le_bytes(*b)).collect()
}

#[test]
fn lattice_matches_its_twin() {
    let gpu = Gpu::new();
    for (dims, cells) in [([41, 64, 37], 12), ([96, 80, 72], 16), ([7, 9, 5], 4)] {
        let shape = GridShape::new(dims.into());
        let frame = run(&gpu, shape, cells, |cell| density(shape, cell));
        // From what the lattice reads: the coarse density has passed through half precision.
        let padded = GridShape::new(shape.coarse().dims + 2);
        let texels = gpu.read_texels(&frame.coarse);
        let coarse = shape.coarse();
        let value = |i| f64::from(texels[4 * padded.index(coarse.cell(i) + 1)] * MAX_DENSITY);
        let coarse = Grid { shape: coarse, values: (0..coarse.len()).map(value).collect() };
        let expected = reference::lattice::lattice(&coarse, shape, cells);
        let found = written(&gpu, &frame);
        assert_eq!(found.len(), expected.len());
        assert!(found.len() > 4 && found.len() < shape.coarsened(cells).len() / 2, "{}", found.len());
        let flat = |g: &Gaussian| [g.center.x, g.center.y, g.center.z, g.radius, g.weight];
        let floats = |r: &Rbf| [r.center[0], r.center[1], r.center[2], r.radius, r.weight].map(f64::from);
        assert_close("lattice", EXACT, found.iter().flat_map(floats), expected.iter().flat_map(flat));
    }
}

/// Every bin lists the RBFs whose support meets it, as baked smoke's bins do, and those whose cells do.
#[test]
fn bins_list_what_reaches_them() {
    let gpu = Gpu::new();
    let (shape, cells) = (GridShape::new(UVec3::new(41, 64, 37)), 12);
    let frame = run(&gpu, shape, cells, |cell| density(shape, cell));
    let rbfs = written(&gpu, &frame);
    let offsets = read_words(&gpu, &frame.bin_offsets);
    let indices = read_words(&gpu, &frame.bin_indices);
    let bins = GridShape::new(shape.dims.map(|n| n.div_ceil(BIN_CELLS)));
    assert_eq!((offsets.len(), offsets[0]), (bins.len() + 1, 0));
    assert!(offsets[bins.len()] as usize <= indices.len(), "the room that was made is enough");
    let baked = RbfBins::new(&rbfs, shape);
    let mut listed = 0;
    for bin in 0..bins.len() {
        let list = &indices[offsets[bin] as usize..offsets[bin + 1] as usize];
        assert!(list.is_sorted() && list.iter().all(|&i| (i as usize) < rbfs.len()));
        listed += list.len();
        let middle = (bins.cell(bin) * BIN_CELLS + BIN_CELLS / 2).min(shape.dims - 1);
        let near = |i: &&u32| {
            let rbf = &rbfs[**i as usize];
            // Of what no support meets, baked smoke's bins list the nearest.
            shape.center(middle).distance(rbf.center.into()) < SUPPORT * rbf.radius
        };
        for index in baked.at(middle).iter().filter(near) {
            assert!(list.contains(index), "bin {bin} lacks {index}");
        }
    }
    assert!(listed > 100);
}

/// What is no density does not count.
#[test]
fn what_is_no_density_is_none() {
    let gpu = Gpu::new();
    let shape = GridShape::new(UVec3::splat(16));
    let bad = [f32::NAN, -3.0, f32::NEG_INFINITY, f32::INFINITY];
    let value = |cell: UVec3| if cell.x < 4 { bad[cell.x as usize] } else { 0.25 };
    let frame = run(&gpu, shape, 4, value);
    let texels = gpu.read_texels(&frame.density);
    for (i, &found) in texels.iter().enumerate() {
        let expected = match shape.cell(i).x {
            0..=2 => 0.0,
            3 => 3e38,
            _ => 0.25,
        };
        assert_eq!(found, expected);
    }
    assert!(written(&gpu, &frame).iter().all(|rbf| rbf.weight.is_finite() && rbf.center.iter().all(|c| c.is_finite())));
    // Nothing at all is no RBF, and no entry.
    let frame = run(&gpu, shape, 4, |_| 0.0);
    assert!(written(&gpu, &frame).is_empty());
    assert!(read_words(&gpu, &frame.bin_offsets).iter().all(|&offset| offset == 0));
}
