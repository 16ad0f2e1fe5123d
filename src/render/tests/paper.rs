use bevy::color::LinearRgba;
use bevy::math::{DMat3, DQuat, Mat3, Quat, Vec4};

use super::*;
use crate::medium::SmokeMedium;
use crate::paper::PaperExponential;
use crate::reference::Medium;
use crate::reference::incident_light::Lighting;
use crate::reference::outgoing::Viewer;
use crate::reference::paper as twin;
use crate::reference::taylor::Taylor;
use crate::render::frame::{FILTERED_FORMAT, texture_3d, uniform};
use crate::render::lighting::LightingUniform;
use crate::render::outgoing::LookUniform;
use crate::render::paper::{LightBindings, LookBindings, PaperUniform, Step, Tables, jobs};
use crate::render::volume;
use crate::sh::Exponential;

/// Where the scaled density is 1, which stands for [`MAX_DENSITY`].
const SIGMA: f32 = 12.0;

fn smoke() -> SmokeMedium {
    SmokeMedium { albedo: LinearRgba::rgb(0.9, 0.0, 0.6), g: 0.4, ..SmokeMedium::default() }
}

fn medium() -> Medium {
    let albedo = DVec3::new(f64::from(0.9_f32), 0.0, f64::from(0.6_f32));
    Medium { sigma: f64::from(SIGMA / MAX_DENSITY), albedo, g: f64::from(0.4_f32) }
}

/// Few enough RBFs, near enough to each other, that Eq. 13 is well-conditioned: f32 keeps what squaring costs.
fn few() -> SmokeFrame {
    let at = |x, y, z, radius, weight| Rbf { center: [x, y, z], radius, weight };
    let rbfs = vec![
        at(0.0, 0.0, 0.0, 0.09, 1.0),
        at(0.06, 0.02, -0.03, 0.07, 0.6),
        at(-0.05, 0.05, 0.0, 0.08, 1.3),
        at(0.01, -0.07, 0.04, 0.06, 0.9),
    ];
    SmokeFrame::new(RbfModel { rbfs }, HashedResidual::empty(GridShape::new(UVec3::new(24, 20, 22))))
}

/// What the light's steps leave.
struct Lit {
    source: Vec<f32>,
    matrix: Vec<f32>,
    rhs: Vec<f32>,
    solution: Vec<f32>,
}

/// Runs the steps with `steps` of the solver, or single scattering alone.
fn light(frame: &SmokeFrame, exponential: PaperExponential, steps: Option<u32>) -> (Lit, Vec<ShRgb>) {
    let gpu = Gpu::new();
    let uploaded = gpu.frame(frame);
    let environment = random_light(&mut Random(23));
    let rotation = Quat::from_rotation_x(0.4) * Quat::from_rotation_y(2.1);
    let lighting = LightingUniform { environment_scale: 1.0, ..LightingUniform::of_medium(&smoke(), SIGMA, false) };
    let paper = PaperUniform::new(Mat3::from_quat(rotation), exponential);
    let count = rbfs(frame).len();
    let zeros = |vectors: usize| gpu.buffer(&vec![[0.0_f32; 4]; vectors]);
    let (source, rhs, solution) = (zeros(16 * count), zeros(count), zeros(uploaded.rbf_capacity as usize));
    let matrix = gpu.buffer(&vec![0.0_f32; 3 * count * count]);
    let bindings = LightBindings {
        frame: &uploaded,
        lighting: &uniform(gpu.device(), gpu.queue(), "test", lighting),
        paper: &uniform(gpu.device(), gpu.queue(), "test", paper),
        tables: &Tables::buffer(gpu.device(), gpu.queue()),
        environment: &gpu.buffer(&pad(environment.0)),
        source: &source,
        matrix: &matrix,
        rhs: &rhs,
        solution: &solution,
        vectors: &zeros(4 * count),
        power: &zeros(1),
    };
    let passes = &gpu.passes().paper;
    let groups = bindings.bind(passes, gpu.device(), gpu.cache());
    let jobs: Vec<_> = jobs(&groups, &uploaded, steps).into_iter().map(|(step, job)| (passes.of(step), job)).collect();
    gpu.run_all(&jobs);

    let [x, y, z, w] = rotation.to_array().map(f64::from);
    let lighting = Lighting { environment, env_from_local: DMat3::from_quat(DQuat::from_xyzw(x, y, z, w)) };
    let exponential = match exponential {
        PaperExponential::OptimalLinear => Exponential::OptimalLinear,
        PaperExponential::Hybrid => Exponential::Hybrid,
    };
    let single = twin::source_radiance(rbfs(frame), &lighting, &medium(), exponential);
    let read = |buffer| gpu.read_floats(buffer);
    (
        Lit {
            source: read(&source),
            matrix: read(&matrix),
            rhs: read(&rhs),
            solution: read(&solution)[..4 * count].to_vec(),
        },
        single,
    )
}

fn coefficients(source: &[ShRgb]) -> impl Iterator<Item = f64> + '_ {
    source.iter().flat_map(|sh| sh.0).flat_map(rgb)
}

#[test]
fn single_scattering_matches_its_twin() {
    for exponential in [PaperExponential::OptimalLinear, PaperExponential::Hybrid] {
        let (lit, expected) = light(&fixture(), exponential, None);
        // Inverse trigonometric functions on a GPU are good to 1e-4 or so.
        assert_close(&format!("paper, single, {exponential:?}"), 2e-4, unpad(&lit.source), coefficients(&expected));
    }
}

#[test]
fn the_system_matches_its_twin() {
    let frame = few();
    let (lit, single) = light(&frame, PaperExponential::Hybrid, Some(0));
    for channel in [0, 2] {
        let medium = medium();
        let optics = twin::Optics { extinction: medium.sigma, albedo: medium.albedo[channel], g: medium.g };
        let source: Vec<Taylor> = single.iter().map(|sh| Taylor::of(sh, channel)).collect();
        let system = twin::system(rbfs(&frame), &source, optics);
        let matrix = lit.matrix.iter().skip(channel).step_by(3).map(|&v| f64::from(v));
        assert_close("paper, matrix", EXACT, matrix, system.matrix.values);
        // The source's own error.
        let rhs = lit.rhs.iter().skip(channel).step_by(4).map(|&v| f64::from(v));
        assert_close("paper, right-hand side", 2e-4, rhs, system.rhs);
    }
    // Green scatters nothing, and has no equation.
    assert!(lit.matrix.iter().skip(1).step_by(3).all(|&v| v == 0.0));
}

#[test]
fn the_solver_and_what_follows_match_their_twin() {
    let frame = few();
    // Four unknowns: four steps but for rounding, which eight make up for.
    let (lit, single) = light(&frame, PaperExponential::Hybrid, Some(8));
    let expected = twin::multiple(rbfs(&frame), &single, &medium(), &[DVec3::ZERO; 4], 50);
    assert_close("paper, L0", 1e-3, unpad(&lit.solution), expected.mean.iter().flat_map(|&c| rgb(c)));
    let sum: Vec<ShRgb> = single.iter().zip(&expected.source).map(|(a, b)| *a + *b).collect();
    assert_close("paper, source radiance", 1e-3, unpad(&lit.source), coefficients(&sum));
    // On the way there too.
    let (lit, single) = light(&frame, PaperExponential::Hybrid, Some(2));
    let expected = twin::multiple(rbfs(&frame), &single, &medium(), &[DVec3::ZERO; 4], 2);
    assert_close("paper, L0 after two steps", 1e-3, unpad(&lit.solution), expected.mean.iter().flat_map(|&c| rgb(c)));
}

#[test]
fn outgoing_and_volume_match_their_twins() {
    let (gpu, frame) = (Gpu::new(), fixture());
    let shape = frame.residual.shape();
    let density = twin_density(&frame);
    let mut uploaded = gpu.frame(&frame);
    uploaded.density =
        gpu.texture_3d(shape.dims, TextureFormat::R32Float, |cell| density.values[shape.index(cell)] as f32);
    let mut random = Random(31);
    let source: Vec<ShRgb> = rbfs(&frame).iter().map(|_| random_light(&mut random)).collect();
    let eye = Vec3::new(0.11, -0.07, 0.2);
    for (eye, viewer) in [
        (eye.extend(1.0), Viewer::Perspective { eye: eye.as_dvec3() }),
        (Vec4::NEG_Z, Viewer::Orthographic { forward: DVec3::NEG_Z }),
    ] {
        let eye = if eye.w < 1.0 { eye.truncate().extend(0.0) } else { eye };
        let outgoing = gpu.buffer(&vec![[0.0_f32; 4]; rbfs(&frame).len()]);
        let output = texture_3d(gpu.device(), "test", shape.dims + 2, FILTERED_FORMAT);
        let bindings = LookBindings {
            frame: &uploaded,
            look: &uniform(gpu.device(), gpu.queue(), "test", LookUniform { eye }),
            source: &gpu.buffer(&pad(source.iter().flat_map(|sh| sh.0))),
            outgoing: &outgoing,
            volume: &output,
        };
        let passes = &gpu.passes().paper;
        let [leave, reconstruct] = bindings.bind(passes, gpu.device(), gpu.cache());
        gpu.run(passes.of(Step::Outgoing), Job { bind_group: leave, workgroups: UVec3::ONE });
        let workgroups = volume::workgroups(shape);
        gpu.run(passes.of(Step::Volume), Job { bind_group: reconstruct, workgroups });

        let expected = twin::outgoing(rbfs(&frame), &source, viewer);
        assert_close(
            "paper, outgoing",
            EXACT,
            unpad(&gpu.read_floats(&outgoing)),
            expected.iter().flat_map(|&c| rgb(c)),
        );
        let expected = twin::volume(rbfs(&frame), &expected, &density);
        let texels = gpu.read_texels(&output);
        let texels = texels.as_chunks::<4>().0;
        let scaled = |v: f32| f64::from(v * MAX_DENSITY);
        assert_close("paper, density", HALF, texels.iter().map(|t| scaled(t[3])), expected.density);
        let found = texels.iter().flat_map(|t| t[..3].to_vec()).map(scaled);
        assert_close("paper, radiance times density", HALF, found, expected.radiance.into_iter().flat_map(rgb));
    }
}
