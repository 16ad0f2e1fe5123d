use bevy::math::DMat3;

use super::*;
use crate::rbf::RbfBins;
use crate::reference::lamp::{shine, shine_again};
use crate::reference::outgoing::{Outgoing, Viewer};
use crate::reference::volume::Volume;
use crate::render::frame::{FILTERED_FORMAT, texture_3d, uniform};
use crate::render::outgoing::LookUniform;
use crate::render::volume::{self, Bindings};

/// Fits of which some leave their bounds, with slopes of `slope`.
fn random_fits(random: &mut Random, rbfs: &[Rbf], slope: f64) -> Vec<Outgoing> {
    let fit = |rbf: &Rbf| {
        let mut matrix = |scale: f64| {
            let mut column = || (scale * (random.vector() - 0.5)).as_vec3().as_dvec3();
            DMat3::from_cols(column(), column(), column())
        };
        let (gradient, curvature) = (matrix(slope), matrix(slope / f64::from(rbf.radius)));
        let center = random.vector().as_vec3().as_dvec3();
        Outgoing { center, gradient, curvature, low: 0.5 * center - 0.3, high: 2.0 * center, reach: rbf.radius.into() }
    };
    rbfs.iter().map(fit).collect()
}

/// A fit as the passes keep it.
fn pack(fit: &Outgoing) -> [[f32; 4]; 7] {
    let (g, q) = (fit.gradient, fit.curvature);
    let bounds = [fit.low.x, fit.low.y, fit.low.z, fit.high.x, fit.high.y, fit.high.z, 0.0];
    let coefficients = [fit.center, g.x_axis, g.y_axis, g.z_axis, q.x_axis, q.y_axis, q.z_axis];
    std::array::from_fn(|i| coefficients[i].as_vec3().extend(bounds[i] as f32).to_array())
}

/// Four lamps' fits, one a channel.
fn pack_shades(fits: &[Vec<Outgoing>], l: usize) -> [[[f32; 4]; 7]; 2] {
    let channel = |lamp: usize, i: usize| fits.get(lamp).map_or(0.0, |fits| pack(&fits[l])[i][0]);
    std::array::from_fn(|s| std::array::from_fn(|i| std::array::from_fn(|c| channel(4 * s + c, i))))
}

/// The volume of the pass, and the twin's; the light of RBFs times `brightness`, and that of lamps.
fn run(lighting: LightingUniform, medium: &SmokeMedium, brightness: f64) -> ([Vec<DVec3>; 2], [Vec<f64>; 2]) {
    let (gpu, frame) = (Gpu::new(), fixture());
    let (shape, rbfs) = (frame.residual.shape(), rbfs(&frame));
    let density = twin_density(&frame);
    let mut uploaded = gpu.frame(&frame);
    uploaded.density =
        gpu.texture_3d(shape.dims, TextureFormat::R32Float, |cell| density.values[shape.index(cell)] as f32);
    let mut random = Random(17);
    let mut fits = random_fits(&mut random, rbfs, 10.0);
    for fit in &mut fits {
        *fit = Outgoing {
            center: brightness * fit.center,
            gradient: brightness * fit.gradient,
            curvature: brightness * fit.curvature,
            low: brightness * fit.low,
            high: brightness * fit.high,
            ..*fit
        };
    }
    // Columns are the same in all three channels, and have no bounds.
    let mut columns = || -> Vec<Outgoing> {
        let column = |o: Outgoing| {
            let grey = |m: DMat3| {
                DMat3::from_cols(DVec3::splat(m.x_axis.x), DVec3::splat(m.y_axis.x), DVec3::splat(m.z_axis.x))
            };
            let (gradient, curvature) = (grey(o.gradient), grey(o.curvature));
            let (low, high) = (DVec3::NEG_INFINITY, DVec3::INFINITY);
            Outgoing { center: DVec3::splat(0.3 * o.center.x), gradient, curvature, low, high, ..o }
        };
        random_fits(&mut random, rbfs, 1.0).into_iter().map(column).collect()
    };
    let shades: Vec<Vec<Outgoing>> = (0..lamps().len()).map(|_| columns()).collect();
    let packed_shades: Vec<_> = (0..rbfs.len()).map(|l| pack_shades(&shades, l)).collect();
    let eye = Vec3::new(0.3, 0.5, 1.2);
    let output = texture_3d(gpu.device(), "test", shape.dims + 2, FILTERED_FORMAT);
    let around = surroundings(&frame);
    let buffers = Around::new(&gpu, &around);
    let pass = &gpu.passes().volume;
    let bindings = Bindings {
        frame: &uploaded,
        lighting: &uniform(gpu.device(), gpu.queue(), "test", lighting.clone()),
        look: &uniform(gpu.device(), gpu.queue(), "test", LookUniform { eye: eye.extend(1.0) }),
        outgoing: &gpu.buffer(&fits.iter().map(pack).collect::<Vec<_>>()),
        shades: &gpu.buffer(&packed_shades),
        volume: &output,
        surroundings: &buffers.surroundings,
        spheres: &buffers.spheres,
    };
    let bind_group = volume::bind(pass, bindings, gpu.device(), gpu.cache());
    gpu.run(pass, Job { bind_group, workgroups: volume::workgroups(shape) });

    let bins = RbfBins::new(rbfs, shape);
    let mut twin = reference::volume::volume(rbfs, &fits, &bins, &density);
    let sigma = lighting.sigma.as_dvec3();
    let (medium, viewer) = (twin_medium(medium, 1.0), Viewer::Perspective { eye: eye.as_dvec3() });
    let lamps = twin_lamps();
    for (lamp, columns) in lamps.lamps.iter().zip(&shades).take(lighting.lamp_count as usize) {
        shine(&mut twin, rbfs, &bins, columns, lamp, lamps.softening, &medium, sigma, &around, viewer);
        if lighting.coefficients > 0 {
            // Extinction is for the scaled density.
            let sigma = sigma / f64::from(MAX_DENSITY);
            shine_again(&mut twin, rbfs, &bins, lamp, lamps.softening, &medium, sigma);
        }
    }
    compare(&gpu.read_texels(&output), &twin, &density)
}

/// Radiance where a trilinear read can meet density, and the density everywhere. Elsewhere the pass leaves black what the
/// twin still computes: nothing ever reads it.
fn compare(texels: &[f32], twin: &Volume, density: &Grid) -> ([Vec<DVec3>; 2], [Vec<f64>; 2]) {
    let (shape, texels) = (twin.shape, texels.as_chunks::<4>().0);
    let padded = GridShape::new(shape.dims + 2);
    let read = |i: &usize| {
        let cell = padded.cell(*i).as_ivec3() - 1;
        let near = |d: bevy::math::IVec3| {
            let other = cell + d;
            let inside = other.cmpge(bevy::math::IVec3::ZERO).all() && other.cmplt(shape.dims.as_ivec3()).all();
            inside && density.values[shape.index(other.as_uvec3())] > 0.0
        };
        (0..27).any(|n| near(bevy::math::IVec3::new(n % 3, n / 3 % 3, n / 9) - 1))
    };
    let cells: Vec<usize> = (0..padded.len()).filter(read).collect();
    assert!(cells.len() > padded.len() / 4 && cells.len() < padded.len());
    let found = cells.iter().map(|&i| DVec3::from_slice(&texels[i].map(f64::from)[..3])).collect();
    let expected = cells.iter().map(|&i| twin.radiance[i]).collect();
    let densities = texels.iter().map(|t| f64::from(t[3] * MAX_DENSITY)).collect();
    ([found, expected], [densities, twin.density.clone()])
}

#[test]
fn volume_matches_its_twin() {
    let ([found, expected], [density, twin_density]) = run(LightingUniform::default(), &medium([0.0; 3], 0.0), 1.0);
    assert_close("volume, density", HALF, density, twin_density);
    assert_close("volume, radiance", HALF, found.into_iter().flat_map(rgb), expected.into_iter().flat_map(rgb));
}

#[test]
fn lamps_in_the_volume_match_their_twin() {
    for (multiple, g) in [(false, 0.6), (true, 0.0), (true, 0.6)] {
        let medium = medium([0.9, 0.6, 0.3], g);
        let lighting = lit_by_lamps(LightingUniform::of_medium(&medium, 5.0, multiple));
        // The RBFs' own light only as much as keeps cells from being black.
        let ([found, expected], _) = run(lighting, &medium, 1e-2);
        // Cell by cell, since a lamp is much brighter near by than elsewhere.
        let relative = found.iter().zip(&expected).flat_map(|(f, e)| rgb(*f / e.max(DVec3::splat(1e-3))));
        let ones = expected.iter().flat_map(|e| rgb(*e / e.max(DVec3::splat(1e-3))));
        assert_close(&format!("lamps, g {g}, multiple {multiple}, relative"), HALF, relative, ones);
        let (found, expected) = (found.into_iter().flat_map(rgb), expected.into_iter().flat_map(rgb));
        assert_close(&format!("lamps, g {g}, multiple {multiple}"), HALF, found, expected);
    }
}
