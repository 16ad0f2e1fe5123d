//! `smoke study spheres`: how close spheres come to what they stand for.

use std::time::Instant;

use clap::Args;
use glam::{Affine3A, Vec3, vec2};

use crate::cli::output::print;
use crate::occluder::{
    FitFailure, HeightField, OccluderSphere, Skin, SphereFit, TriangleMesh, fit_ground, fit_skinned, fit_solid,
    mesh_skin, mesh_triangles, shapes, silhouette_error,
};

#[allow(dead_code)]
#[path = "../../../examples/character/figure.rs"]
mod figure;

/// Options of `smoke study spheres`.
#[derive(Args, Debug)]
pub struct SpheresArgs {
    /// How many spheres to fit, at most
    #[arg(long, value_name = "N", value_delimiter = ',', default_values_t = [8, 16, 32, 64], value_parser = clap::value_parser!(u32).range(1..=1024))]
    spheres: Vec<u32>,
}

/// Poses of the figure's walk in which its outlines are compared.
const POSES: usize = 8;

/// Runs the study.
pub fn run(args: &SpheresArgs) -> anyhow::Result<()> {
    let mut table = String::from(SOLIDS);
    let cube = shapes::box_grid(Vec3::ONE, [1; 3]);
    let wall = shapes::box_grid(Vec3::new(2.0, 1.0, 0.1), [1; 3]);
    let torus = shapes::torus(1.0, 0.3, 96, 32);
    for (name, mesh) in [("cube", &cube), ("wall, 2 × 1 × 0.1", &wall), ("torus, 1 and 0.3", &torus)] {
        for count in &args.spheres {
            table += &solid_line(name, mesh, *count, |count| fit_solid(mesh, count), |_| None)?;
        }
    }
    let figure = figure::mesh();
    let (mesh, skin) = (mesh_triangles(&figure)?, mesh_skin(&figure, &figure::inverse_bindposes())?);
    for count in &args.spheres {
        let fit = |count| fit_skinned(&mesh, &skin, count);
        table +=
            &solid_line("walking figure", &mesh, *count, fit, |spheres| Some(walking_error(&mesh, &skin, spheres)))?;
    }
    table += GROUND;
    for (name, height) in GROUNDS {
        let field = field(height);
        let mean = field.heights.iter().sum::<f32>() / field.heights.len() as f32;
        let squares = field.heights.iter().map(|height| (height - mean).powi(2));
        let relief = (squares.sum::<f32>() / field.heights.len() as f32).sqrt();
        for count in &args.spheres {
            let started = Instant::now();
            let fit = fit_ground(&field, *count as usize)?;
            let milliseconds = 1000.0 * started.elapsed().as_secs_f64();
            let (rms, highest) = (fit.height_rms, fit.highest);
            table += &format!(
                "| {name} | {relief:.2} m | {} | {rms:.2} m | {highest:.2} m | {milliseconds:.0} ms |\n",
                fit.spheres.len()
            );
        }
    }
    print(&table)
}

const SOLIDS: &str = "\
# Spheres in the place of meshes

How close the spheres of `SmokeOccluderFit` come to what they stand for, and how long it takes to fit them in one thread.
Regenerate with `smoke study spheres`.

*Volume*: what is in the spheres or in the mesh but not in both, over the mesh's volume; *outside*: the part of it in the
spheres. *Outline*: area in which outlines differ, over that of the mesh's, mean over 24 directions: what a shadow sees.
*Walking*: the same with the spheres at the figure's joints and the mesh skinned, mean over eight moments of its walk; the
spheres were fitted in its bind pose.

| shape | triangles | spheres | volume | outside | outline | walking | time |
|---|---|---|---|---|---|---|---|
";

const GROUND: &str = "
Ground of 100 × 100 m, 129 × 129 heights. *Relief*: their standard deviation. *Height*: root mean square of the height of the
spheres' upper envelope above the ground; *above*: the most that it is too high.

| ground | relief | spheres | height | above | time |
|---|---|---|---|---|---|
";

/// Heights by X and Z, in metres.
const GROUNDS: [(&str, fn(f32, f32) -> f32); 4] = [
    ("flat", |_, _| 0.0),
    ("slope", |x, _| 0.4 * x),
    ("one hill", |x, z| 12.0 * (-(x * x + z * z) / 800.0).exp()),
    ("hills", |x, z| 3.0 * (0.12 * x).sin() * (0.1 * z + 1.0).cos() + 1.2 * (0.31 * x + 0.2 * z).sin()),
];

fn field(height: fn(f32, f32) -> f32) -> HeightField {
    let (columns, length) = (129, 100.0);
    let at = |index: usize| (index as f32 / (columns - 1) as f32 - 0.5) * length;
    let heights = (0..columns * columns).map(|index| height(at(index % columns), at(index / columns))).collect();
    HeightField { size: vec2(length, length), columns, heights }
}

fn solid_line(
    name: &str,
    mesh: &TriangleMesh,
    count: u32,
    fit: impl Fn(usize) -> Result<SphereFit, FitFailure>,
    moving: impl Fn(&[OccluderSphere]) -> Option<f32>,
) -> anyhow::Result<String> {
    let started = Instant::now();
    let fit = fit(count as usize)?;
    let milliseconds = 1000.0 * started.elapsed().as_secs_f64();
    let [volume, outside, outline] =
        [fit.error.difference, fit.error.outside, fit.error.silhouette].map(|error| 100.0 * error);
    let moving = moving(&fit.spheres).map_or("–".into(), |error| format!("{:.1} %", 100.0 * error));
    Ok(format!(
        "| {name} | {} | {} | {volume:.1} % | {outside:.1} % | {outline:.1} % | {moving} | {milliseconds:.0} ms |\n",
        mesh.triangles.len(),
        fit.spheres.len()
    ))
}

/// The error of a figure's outlines, mean over moments of its walk.
fn walking_error(mesh: &TriangleMesh, skin: &Skin, spheres: &[OccluderSphere]) -> f32 {
    let errors = (0..POSES).map(|pose| {
        let mut joints: Vec<Affine3A> = Vec::new();
        let places = figure::walk(core::f32::consts::TAU * pose as f32 / POSES as f32);
        for (number, (parent, place)) in figure::parents().zip(places).enumerate() {
            let place = place.compute_affine();
            joints.push(if number == 0 { place } else { joints[parent] * place });
        }
        let placed: Vec<_> = spheres
            .iter()
            .map(|sphere| {
                (joints[usize::from(sphere.joint.unwrap_or(0))].transform_point3(sphere.center), sphere.radius)
            })
            .collect();
        silhouette_error(&shapes::posed(mesh, skin, &joints), &placed).unwrap_or(0.0)
    });
    errors.sum::<f32>() / POSES as f32
}
