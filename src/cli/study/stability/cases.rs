//! The cases of the stability study.

use std::sync::Arc;

use bevy::math::{DVec3, UVec3};

use crate::bundle::{SmokeAnimation, SmokeFrame};
use crate::density::{GridShape, Placement};
use crate::random::SplitMix64;
use crate::rbf::{Rbf, RbfModel};
use crate::residual::{HashedResidual, QuantizationLaw};

/// Smoke, its medium and its light, and how the picture is known.
#[derive(Clone)]
pub struct Case {
    /// Cases that belong together.
    pub group: &'static str,
    /// What is changed.
    pub name: String,
    pub smoke: Arc<SmokeAnimation>,
    /// Length of the box's longest side in metres.
    pub width: f64,
    pub sigma_t: f64,
    pub albedo: DVec3,
    pub g: f64,
    pub light: Light,
    /// What is drawn in the frames before, in the same volume.
    pub before: Option<Box<Case>>,
    pub truth: Truth,
}

/// How the picture is known.
#[derive(Clone)]
pub enum Truth {
    /// Radiance of 1 from everywhere, and nothing absorbed: radiance is 1 − transmittance.
    Furnace,
    /// No light.
    Black,
    /// Path tracing.
    Paths,
    /// The picture of another case.
    Same(Box<Case>),
}

impl Truth {
    /// In the table.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Furnace => "exact",
            Self::Black => "black",
            Self::Paths => "paths",
            Self::Same(_) => "afresh",
        }
    }
}

/// Light from infinitely far away.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Light {
    /// None.
    Black,
    /// The same radiance from everywhere.
    Constant(f64),
    /// `factor` times a soft lobe on a dim sky.
    Soft(f64),
    /// One bright texel in an image of [`TEXELS`], which four bands of spherical harmonics turn into lobes of both signs.
    Texel,
}

/// Width and height of the image of [`Light::Texel`].
pub const TEXELS: [u32; 2] = [32, 16];
/// Where its bright texel is.
pub const BRIGHT: [u32; 2] = [20, 5];
/// And how bright.
pub const BRIGHT_RADIANCE: f64 = 100.0;

impl Light {
    /// Radiance from a direction; the texel's is its image's.
    pub fn radiance(&self, w: DVec3) -> DVec3 {
        match *self {
            Self::Black | Self::Texel => DVec3::ZERO,
            Self::Constant(radiance) => DVec3::splat(radiance),
            Self::Soft(factor) => {
                let t = w.dot(DVec3::new(0.6, 0.75, 0.28));
                factor
                    * (DVec3::new(0.12, 0.15, 0.2) + DVec3::new(3.0, 2.7, 2.2) * ((1.0 + t) * (t + 0.3).powi(2) / 3.38))
            }
        }
    }

    /// The largest radiance from any direction.
    pub fn brightest(&self) -> f64 {
        match *self {
            Self::Black => 0.0,
            Self::Constant(radiance) => radiance,
            Self::Soft(factor) => factor * 3.13,
            Self::Texel => BRIGHT_RADIANCE,
        }
    }
}

/// A cloud of `count` Gaussians with radii between two bounds, in a box of 32 × 40 × 32 cells.
fn cloud(count: usize, radii: [f64; 2]) -> Arc<SmokeAnimation> {
    let mut random = SplitMix64(count as u64 + 1);
    let mut uniform = || (random.bits() >> 11) as f64 / (1u64 << 53) as f64;
    let rbfs = (0..count).map(|_| {
        let place = DVec3::from([(); 3].map(|()| 2.0 * uniform() - 1.0));
        let radius = radii[0] + (radii[1] - radii[0]) * uniform();
        // As much smoke whatever the number.
        let weight = (0.4 + 0.6 * uniform()) * (60.0 / count as f64).min(1.0);
        rbf(place * DVec3::new(0.22, 0.34, 0.22), radius, weight)
    });
    animation(UVec3::new(32, 40, 32), rbfs.collect())
}

fn rbf(center: DVec3, radius: f64, weight: f64) -> Rbf {
    Rbf { center: center.as_vec3().to_array(), radius: radius as f32, weight: weight as f32 }
}

fn animation(dims: UVec3, rbfs: Vec<Rbf>) -> Arc<SmokeAnimation> {
    with_residual(dims, rbfs, 0)
}

/// Smoke that has `code` 127ths of a density of 1 in every cell beside its Gaussians.
fn with_residual(dims: UVec3, rbfs: Vec<Rbf>, code: i8) -> Arc<SmokeAnimation> {
    let shape = GridShape::new(dims);
    let law = QuantizationLaw { max: 1.0, exponent: 1.0 };
    let residual = HashedResidual::build(shape, &vec![code; shape.len()], law).expect("a small box");
    let frame = SmokeFrame::new(RbfModel { rbfs }, residual);
    let max_density = frame.decode().into_iter().fold(0.0, f32::max);
    let placement = Placement { center: DVec3::ZERO, voxel_size: 1.0 / f64::from(shape.longest()) };
    let frames = vec![frame].into();
    Arc::new(SmokeAnimation { shape, placement, frames_per_second: 30.0, max_density, frames })
}

/// All of them, in the order of the table.
pub fn cases() -> Vec<Case> {
    let base = Case {
        group: "extinction per metre",
        name: String::new(),
        smoke: cloud(60, [0.04, 0.09]),
        width: 3.0,
        sigma_t: 2.5,
        albedo: DVec3::splat(0.8),
        g: 0.0,
        light: Light::Soft(1.0),
        before: None,
        truth: Truth::Paths,
    };
    let white = Case { albedo: DVec3::ONE, light: Light::Constant(1.0), truth: Truth::Furnace, ..base.clone() };
    let mut all = Vec::new();
    let mut add = |group, name: String, case: Case| all.push(Case { group, name, ..case });

    for sigma_t in [0.001, 0.01, 0.1, 1.0, 10.0, 100.0, 1000.0] {
        add("extinction per metre", format!("{sigma_t}"), Case { sigma_t, ..base.clone() });
    }
    for g in [0.0, 0.8] {
        for sigma_t in [0.001, 0.04, 0.4, 4.0, 40.0, 400.0, 1000.0] {
            let name = format!("{sigma_t}, g {g}");
            add("white furnace: extinction per metre", name, Case { sigma_t, g, ..white.clone() });
        }
    }
    for albedo in [[0.0; 3], [0.5; 3], [0.99; 3], [1.0; 3], [1.0, 0.5, 0.0]] {
        let name = format!("{albedo:?}");
        add("albedo", name, Case { albedo: albedo.into(), ..base.clone() });
    }
    for albedo in [[0.99; 3], [1.0, 0.9, 0.5]] {
        let name = format!("{albedo:?}, extinction 40, g 0.6");
        add("albedo", name, Case { albedo: albedo.into(), sigma_t: 40.0, g: 0.6, ..base.clone() });
    }
    for g in [-0.95, -0.5, 0.5, 0.8, 0.95] {
        add("asymmetry", format!("{g}"), Case { g, ..base.clone() });
    }
    for count in [1, 10, 100, 1000, 2000] {
        add("number of RBFs", format!("{count}"), Case { smoke: cloud(count, [0.04, 0.09]), ..base.clone() });
    }
    for (name, apart) in [("two in one place", 0.0), ("two 1e-6 apart", 1e-6), ("two 1e-3 apart", 1e-3)] {
        let mut rbfs = base.smoke.frames.get(0).expect("made of one frame").rbfs.rbfs.clone();
        let mut twin = rbfs[0];
        twin.center[0] += apart;
        rbfs.push(twin);
        add("shapes", name.into(), Case { smoke: animation(base.smoke.shape.dims, rbfs), ..base.clone() });
    }
    for radius in [0.015, 0.09] {
        let name = format!("all radii {radius}");
        add("shapes", name, Case { smoke: cloud(60, [radius; 2]), ..base.clone() });
    }
    let empty = animation(UVec3::splat(8), Vec::new());
    add("shapes", "empty".into(), Case { smoke: empty, truth: Truth::Black, ..base.clone() });
    let voxel = with_residual(UVec3::ONE, vec![rbf(DVec3::ZERO, 0.09, 0.5)], 64);
    add("shapes", "one voxel, white furnace".into(), Case { smoke: voxel, ..white.clone() });
    for width in [0.01, 1000.0] {
        let scaled = Case { width, sigma_t: base.sigma_t * base.width / width, ..base.clone() };
        let same = Truth::Same(Box::new(base.clone()));
        add("box", format!("{width} m, as thick as 3 m"), Case { truth: same, ..scaled });
    }
    add("light", "none".into(), Case { light: Light::Black, truth: Truth::Black, ..base.clone() });
    add("light", "constant 1".into(), Case { light: Light::Constant(1.0), ..base.clone() });
    add("light", "one bright texel".into(), Case { light: Light::Texel, ..base.clone() });
    add(
        "light",
        "one bright texel, g 0.9, extinction 40".into(),
        Case { light: Light::Texel, g: 0.9, sigma_t: 40.0, ..base.clone() },
    );
    let jumps = [
        ("light × 1000", Case { light: Light::Soft(0.001), ..base.clone() }, base.clone()),
        ("light ÷ 1000", Case { light: Light::Soft(1000.0), ..base.clone() }, base.clone()),
        ("out of the dark", Case { light: Light::Black, ..base.clone() }, base.clone()),
        ("extinction × 100", Case { sigma_t: 0.4, ..base.clone() }, Case { sigma_t: 40.0, ..base.clone() }),
        ("extinction ÷ 100", Case { sigma_t: 40.0, ..base.clone() }, Case { sigma_t: 0.4, ..base.clone() }),
        ("isotropic to g 0.8", base.clone(), Case { g: 0.8, ..base.clone() }),
        ("albedo 0 to 1", Case { albedo: DVec3::ZERO, ..base.clone() }, Case { albedo: DVec3::ONE, ..base.clone() }),
    ];
    for (name, before, after) in jumps {
        let truth = Truth::Same(Box::new(after.clone()));
        add("jumps from frame to frame", name.into(), Case { before: Some(Box::new(before)), truth, ..after });
    }
    all
}
