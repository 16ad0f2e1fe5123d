//! A volume's box in the world, and what follows from where it is: the light in its own axes, what a view needs to draw
//! it, and where the method leaves what it is good for.

use core::ops::Range;

use bevy::math::{Affine3A, Vec3A, Vec4Swizzles};
use bevy::prelude::*;
use bevy::render::renderer::RenderDevice;
use bevy::render::sync_world::MainEntity;
use bevy::render::view::ExtractedView;

use super::extract::{ExtractedSmoke, ExtractedVolume};
use super::frame::GpuSmokeFrame;
use super::lamp::lamps_of;
use super::light::Lit;
use super::lighting::{LampUniform, LightingUniform, MAX_LAMPS};
#[cfg(feature = "reference")]
use super::paper;
use super::view::{Glow, SmokeUniform};
use crate::density::GridShape;
use crate::quality::SmokeModel;
use crate::scattering::{ScatteringChoice, ScatteringEvents};

/// Lamps are softened over so many cells, and their glow within is drawn by the view pass.
const SOFTENING_CELLS: f32 = 2.5;

/// How much of a view's picture a box covers.
pub(super) struct Coverage {
    pub pixels: f32,
    /// Side of a pixel in cells, at the middle of the box.
    pub cells_a_pixel: f32,
}

/// A volume's box in the world.
pub(super) struct Placed {
    pub world_from_bundle: Affine3A,
    pub shape: GridShape,
    /// World length of a bundle unit: the cube root of the change of volume.
    scale: f32,
    /// What the value 1 of the filtered density textures stands for.
    max_density: f32,
}

impl Placed {
    /// A volume of so many cells; None where the transform flattens the box or is not finite.
    pub fn new(entity: MainEntity, volume: &ExtractedVolume, shape: GridShape) -> Option<Self> {
        let world_from_bundle = volume.world_from_bundle;
        if !world_from_bundle.is_finite() {
            warn_once!("the transform of smoke volume {entity:?} is not finite: it is not drawn (said once)");
            return None;
        }
        let scale = world_from_bundle.matrix3.determinant().abs().cbrt();
        let usable = scale > 0.0 && world_from_bundle.inverse().is_finite();
        let max_density = volume.content.density_scale();
        usable.then_some(Self { world_from_bundle, shape, scale, max_density })
    }

    /// The medium and the light, and the radiance (cd/m²) that 1 in the passes' buffers and textures stands for.
    ///
    /// Where the environment is the only light, that is its intensity, which then changes at no cost; otherwise the
    /// strongest light decides, since textures are f16.
    pub fn lighting(
        &self,
        volume: &ExtractedVolume,
        lit: &Lit,
        smoke: &ExtractedSmoke,
        multiple: bool,
    ) -> (LightingUniform, f32) {
        let m = &self.world_from_bundle.matrix3;
        let world_from_bundle =
            Mat3::from_cols(m.x_axis.normalize().into(), m.y_axis.normalize().into(), m.z_axis.normalize().into());
        let environment_from_bundle = lit.environment_from_world * world_from_bundle;
        let (mut lamps, strongest) = lamps_of(
            &smoke.lamps,
            &volume.layers,
            &Affine3A::from_mat3_translation(world_from_bundle * self.scale, self.world_from_bundle.translation.into()),
            self.scale,
            self.shape.half_extent(),
        );
        let (mut sun_direction, mut sun_irradiance) = (Vec3::Y, Vec3::ZERO);
        let strongest = lit.intensity.abs().max(lit.ambient.max_element()).max(strongest);
        let unit = match lamps.is_empty() && lit.ambient == Vec3::ZERO {
            true => lit.intensity,
            false => strongest,
        };
        if let Some(sun) = lit.sun.filter(|_| lamps.len() < MAX_LAMPS && lit.intensity != 0.0) {
            sun_direction = sun.direction;
            sun_irradiance = sun.irradiance;
            lamps.push(LampUniform {
                position: environment_from_bundle.transpose() * sun.direction,
                color: sun.irradiance * lit.intensity,
                is_sun: 1,
                ..default()
            });
        }
        let relative = |value: f32| if value == unit { 1.0 } else { value / unit };
        let mut uniform = LightingUniform {
            environment_from_bundle,
            ambient: lit.ambient.map(|ambient| if ambient == 0.0 { 0.0 } else { relative(ambient) }),
            environment_scale: relative(lit.intensity),
            sun_direction,
            sun_irradiance,
            lamp_count: lamps.len() as u32,
            softening: (SOFTENING_CELLS * self.shape.cell_size()).powi(2),
            ..LightingUniform::of_medium(&volume.medium, self.sigma(volume), multiple)
        };
        for (slot, lamp) in uniform.lamps.iter_mut().zip(lamps) {
            *slot = lamp;
            slot.color /= unit;
        }
        (uniform, unit)
    }

    /// Whether light that scatters more than once is wanted, whatever the adapter can hold.
    pub fn scatters_again(&self, volume: &ExtractedVolume, frame: &GpuSmokeFrame) -> bool {
        self.scattering(volume, frame, volume.scattering.events, None).multiple
    }

    fn scattering(
        &self,
        volume: &ExtractedVolume,
        frame: &GpuSmokeFrame,
        events: ScatteringEvents,
        before: Option<bool>,
    ) -> ScatteringChoice {
        let albedo = volume.medium.albedo;
        let albedo = albedo.red.max(albedo.green).max(albedo.blue);
        ScatteringChoice::new(events, albedo, frame.chance_to_meet_again(self.sigma(volume)), before)
    }

    /// Whether light that scatters more than once is drawn.
    pub fn choose_scattering(
        &self,
        volume: &ExtractedVolume,
        frame: &GpuSmokeFrame,
        before: Option<bool>,
        device: &RenderDevice,
    ) -> ScatteringChoice {
        let mut events = volume.scattering.events;
        let limits = device.limits();
        let largest = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size);
        let pairs = 4 * u64::from(frame.rbf_capacity).pow(2);
        #[cfg(feature = "reference")]
        let pairs = if volume.paper.is_some() { paper::PaperLight::matrix_bytes(frame.rbf_capacity) } else { pairs };
        if events != ScatteringEvents::Single && pairs > largest {
            warn_once!(
                "a frame of smoke has {} RBFs, whose pairs do not fit this adapter's buffers of {largest} bytes: its \
                 light scatters only once; bake it with fewer (said once)",
                frame.rbf_count
            );
            events = ScatteringEvents::Single;
        }
        self.scattering(volume, frame, events, before)
    }

    /// Extinction a bundle unit where the filtered density textures hold 1; bounded, so that products with it stay finite.
    pub fn sigma(&self, volume: &ExtractedVolume) -> f32 {
        (volume.medium.sigma_t * self.scale * self.max_density).min(1e30)
    }

    fn bundle_from_view(&self, view: &ExtractedView) -> Affine3A {
        self.world_from_bundle.inverse() * view.world_from_view.affine()
    }

    /// The eye in bundle space (w = 1), or the direction of parallel rays (w = 0).
    pub fn eye(&self, view: &ExtractedView) -> Vec4 {
        let bundle_from_view = self.bundle_from_view(view);
        if is_orthographic(view) {
            Vec3::from(bundle_from_view.transform_vector3a(Vec3A::NEG_Z).normalize_or_zero()).extend(0.0)
        } else {
            Vec3::from(bundle_from_view.translation).extend(1.0)
        }
    }

    /// From the eye to the centre of the box, or along the view direction under an orthographic projection.
    pub fn distance(&self, view: &ExtractedView) -> f32 {
        let center = self.world_from_bundle.translation;
        let transform = view.world_from_view.affine();
        if is_orthographic(view) {
            -transform.inverse().transform_point3a(center).z
        } else {
            center.distance(transform.translation)
        }
    }

    /// Where the box ends and begins along the view's axis: Z in view space, negative ahead of the eye, ascending toward it.
    pub fn depths(&self, view: &ExtractedView) -> Range<f32> {
        let view_from_bundle = self.bundle_from_view(view).inverse();
        let center = view_from_bundle.translation.z;
        let row = Mat3::from(view_from_bundle.matrix3).row(2);
        let reach = row.abs().dot(self.shape.half_extent());
        center - reach..center + reach
    }

    /// How much of a view's picture the box covers; None where it is off the screen.
    pub fn coverage(&self, view: &ExtractedView) -> Option<Coverage> {
        let clip_from_bundle = view.clip_from_view * Mat4::from(self.bundle_from_view(view).inverse());
        let rectangle = screen_rectangle(clip_from_bundle, self.shape.half_extent())?;
        let size = view.viewport.zw().as_vec2();
        let covered = 0.5 * (rectangle.zw() - rectangle.xy()) * size;
        // Half the view's height at the middle of the box is one unit of its projection.
        let distance = (clip_from_bundle * Vec4::W).w.abs().max(1e-6);
        let pixel = 2.0 * distance / (view.clip_from_view.y_axis.y.abs().max(1e-6) * size.y.max(1.0));
        Some(Coverage {
            pixels: covered.element_product(),
            cells_a_pixel: pixel / (self.scale * self.shape.cell_size()),
        })
    }

    /// What the view pass needs, the view's projection given as its meshes are drawn with it; None where the box is off the
    /// screen.
    pub fn smoke_uniform(
        &self,
        view: &ExtractedView,
        clip_from_view: Mat4,
        eye: Vec4,
        (volume, model): (&ExtractedVolume, &SmokeModel),
        radiance_scale: f32,
        (glow_count, glows): (u32, [Glow; MAX_LAMPS]),
    ) -> Option<SmokeUniform> {
        let bundle_from_view = Mat4::from(self.bundle_from_view(view));
        let half_extent = self.shape.half_extent();
        let clip_from_bundle = clip_from_view * bundle_from_view.inverse();
        let rectangle = screen_rectangle(clip_from_bundle, half_extent)?;
        Some(SmokeUniform {
            bundle_from_clip: bundle_from_view * clip_from_view.inverse(),
            eye,
            rectangle,
            half_extent,
            step: model.step * self.shape.cell_size(),
            cell: self.shape.cell_size(),
            sigma: self.sigma(volume),
            radiance_scale,
            g: volume.medium.g,
            glow_count,
            glows,
        })
    }
}

/// Optical radius of a typical RBF beyond which the picture is off by a tenth and more.
const THICK: f32 = 4.0;
/// Mean cosine beyond which sharp light that scatters more than once is.
const FORWARD: f32 = 0.75;

/// Says once where the method leaves what it is good for.
pub(super) fn warn_of_limits(entity: MainEntity, lighting: &LightingUniform, typical_depth: f32) {
    let thickness = lighting.sigma_mean * typical_depth;
    if thickness > THICK {
        warn_once!(
            "smoke volume {entity:?} is so thick that light ends within single RBFs (optical radius {thickness:.1}): its \
             picture is off by a tenth or more; bake it with more RBFs, or lower sigma_t (said once)"
        );
    }
    if lighting.g > FORWARD && lighting.coefficients > 0 && lighting.lamp_count > 0 {
        warn_once!(
            "smoke volume {entity:?} scatters the light of a sun or lamp forward (g = {}) more than once: there its \
             picture is off by a tenth or so (said once)",
            lighting.g
        );
    }
}

fn is_orthographic(view: &ExtractedView) -> bool {
    view.clip_from_view.w_axis.w == 1.0
}

/// The rectangle in normalised device coordinates that a box covers: min.xy, max.xy.
fn screen_rectangle(clip_from_bundle: Mat4, half_extent: Vec3) -> Option<Vec4> {
    let (mut low, mut high) = (Vec2::MAX, Vec2::MIN);
    for i in 0..8u32 {
        let signs = Vec3::new((i & 1) as f32, (i >> 1 & 1) as f32, (i >> 2) as f32) * 2.0 - 1.0;
        let corner = clip_from_bundle * (half_extent * signs).extend(1.0);
        if corner.w <= 1e-5 {
            // Behind the eye: the box may be anywhere on the screen.
            return Some(Vec4::new(-1.0, -1.0, 1.0, 1.0));
        }
        low = low.min(corner.truncate().truncate() / corner.w);
        high = high.max(corner.truncate().truncate() / corner.w);
    }
    (low, high) = (low.max(Vec2::NEG_ONE), high.min(Vec2::ONE));
    (low.x < high.x && low.y < high.y).then_some(Vec4::new(low.x, low.y, high.x, high.y))
}
