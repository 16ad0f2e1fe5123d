//! What does not change from frame to frame: the `Tables` of `paper.wgsl`; and the `Paper` that does.

use bevy::math::DMat3;
use bevy::prelude::*;
use bevy::render::render_resource::{Buffer, ShaderType};
use bevy::render::renderer::{RenderDevice, RenderQueue};

use crate::paper::PaperExponential;
use crate::reference::paper::{ANGLES, DepthTable};
use crate::render::frame::uniform;
use crate::sh::{BANDS, COEFFICIENTS, NORMS, OptimalLinear, Sh, SphereRule};

/// Directions that integrate products of three functions of order 4 exactly: 2 · 5².
const DIRECTIONS: usize = 50;

/// The `Tables` of `paper.wgsl`.
#[derive(ShaderType, Clone, Debug)]
pub(in crate::render) struct Tables {
    depth: [Vec4; ANGLES],
    exponential: [Vec4; NORMS],
    directions: [Vec4; DIRECTIONS],
}

impl Tables {
    fn new() -> Self {
        let depth = DepthTable::default();
        let linear = OptimalLinear::get(BANDS);
        let rule = SphereRule::new(5);
        Self {
            depth: core::array::from_fn(|i| Vec4::from_array(depth.entries()[i].map(|factor| factor as f32))),
            exponential: core::array::from_fn(|i| {
                let [a, b] = linear.logarithms()[i];
                Vec4::new(a as f32, b as f32, 0.0, 0.0)
            }),
            directions: core::array::from_fn(|i| {
                let (dir, weight) = rule.nodes()[i];
                dir.as_vec3().extend(weight as f32)
            }),
        }
    }

    /// The tables on the GPU.
    pub fn buffer(device: &RenderDevice, queue: &RenderQueue) -> Buffer {
        uniform(device, queue, "smoke_paper_tables", Self::new())
    }
}

/// The `Paper` of `paper.wgsl`.
#[derive(ShaderType, Clone, Debug, PartialEq)]
pub(in crate::render) struct PaperUniform {
    rotation: [Vec4; 64],
    hybrid: u32,
}

impl PaperUniform {
    pub fn new(environment_from_bundle: Mat3, exponential: PaperExponential) -> Self {
        let m = environment_from_bundle;
        let bundle_from_environment =
            DMat3::from_cols(m.x_axis.as_dvec3(), m.y_axis.as_dvec3(), m.z_axis.as_dvec3()).transpose();
        let columns: [[f64; COEFFICIENTS]; COEFFICIENTS] = core::array::from_fn(|j| {
            let unit: Sh<f64> = Sh(core::array::from_fn(|k| f64::from(u8::from(k == j))));
            unit.rotate(bundle_from_environment).0
        });
        let entry = |k: usize, j: usize| columns[j][k] as f32;
        Self {
            rotation: core::array::from_fn(|i| {
                let (k, j) = (i / 4, 4 * (i % 4));
                Vec4::new(entry(k, j), entry(k, j + 1), entry(k, j + 2), entry(k, j + 3))
            }),
            hybrid: u32::from(exponential == PaperExponential::Hybrid),
        }
    }
}
