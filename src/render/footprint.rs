//! How a Gaussian looks from a distance and from its own centre, tabulated for the transport passes.

use bevy::prelude::*;
use bevy::render::render_resource::{Buffer, ShaderType};
use bevy::render::renderer::{RenderDevice, RenderQueue};

use super::frame::uniform;
use crate::optics::{dawson, erfcx, gaussian_bands};

/// Entries of a table; as in `footprint.wgsl`.
const ENTRIES: usize = 256;

/// The `Footprints` of `footprint.wgsl`.
#[derive(ShaderType, Clone, Debug)]
pub(super) struct Footprints {
    pairs: [Vec4; ENTRIES],
    selves: [Vec4; ENTRIES],
}

impl Footprints {
    fn new() -> Self {
        Self {
            pairs: core::array::from_fn(|i| match distance(i) {
                Some(u) => {
                    let seen = if u > 0.0 { half_sqrt_pi() * dawson(u) / u } else { half_sqrt_pi() };
                    let [_, a1, a2, a3] = gaussian_bands(u);
                    Vec4::new((seen * (1.0 + 2.0 * u * u)) as f32, a1 as f32, a2 as f32, a3 as f32)
                }
                // Infinitely far: Daw(u) → 1/(2u), and the Gaussian is a point.
                None => Vec4::new(half_sqrt_pi() as f32, 1.0, 1.0, 1.0),
            }),
            selves: core::array::from_fn(|i| {
                let value = match distance(i) {
                    Some(x) => erfcx(x) * (1.0 + x),
                    None => 1.0 / core::f64::consts::PI.sqrt(),
                };
                Vec4::X * value as f32
            }),
        }
    }

    /// The tables on the GPU.
    pub fn buffer(device: &RenderDevice, queue: &RenderQueue) -> Buffer {
        uniform(device, queue, "smoke_footprints", Self::new())
    }
}

fn half_sqrt_pi() -> f64 {
    0.5 * core::f64::consts::PI.sqrt()
}

/// The argument of an entry, at u / (1 + u) of the table; None for infinity.
fn distance(entry: usize) -> Option<f64> {
    let s = entry as f64 / (ENTRIES - 1) as f64;
    (s < 1.0).then(|| s / (1.0 - s))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_interpolate_what_they_hold() {
        let table = Footprints::new();
        for i in 0..2000 {
            let u = 0.0137 * f64::from(i);
            let at = u / (1.0 + u) * (ENTRIES - 1) as f64;
            let (below, f) = (at as usize, at.fract() as f32);
            let found = table.pairs[below].lerp(table.pairs[below + 1], f);
            let seen = if u > 0.0 { half_sqrt_pi() * dawson(u) / u } else { half_sqrt_pi() };
            // Linear interpolation of smooth functions over 255 steps: curvature / 8 / 255², below 5e-5 here.
            assert!((f64::from(found.x) / (1.0 + 2.0 * u * u) / seen - 1.0).abs() < 2e-4, "{u}");
            for (k, a) in gaussian_bands(u).into_iter().enumerate().skip(1) {
                assert!((f64::from(found[k]) - a).abs() < 2e-4, "{u} {k}");
            }
            let own = table.selves[below].lerp(table.selves[below + 1], f).x;
            assert!((f64::from(own) / (1.0 + u) / erfcx(u) - 1.0).abs() < 2e-4, "{u}");
        }
    }
}
