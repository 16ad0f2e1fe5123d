//! Decides what must be computed this frame, and for whom.
//!
//! The work forms a tree, and each level is done only when something above it changed:
//!
//! | state | one per | changes with |
//! |---|---|---|
//! | [`Environments`] | environment | its image or coefficients |
//! | [`GpuBakedFrame`](super::baked::GpuBakedFrame) | baked frame that a moment blends | nothing |
//! | [`GpuSmokeFrame`](super::frame::GpuSmokeFrame) | moment that volumes show | time, in place |
//! | [`LitVolume`] | volume × environment | environment and moment, the medium, the volume's rotation and scale, lamps |
//! | [`SlicedVolume`](super::lit::SlicedVolume) | lit volume, × view where the phase function is not isotropic | the lit volume; the eye in bundle space |

use core::ops::Range;

use bevy::camera::MainPassResolutionOverride;
use bevy::math::{Affine3A, Vec3A};
use bevy::platform::collections::HashMap;
use bevy::prelude::*;
use bevy::render::camera::{ExtractedCamera, TemporalJitter};
use bevy::render::render_asset::{ExtractedAssets, RenderAssets};
use bevy::render::render_resource::{AddressMode, Buffer, FilterMode, PipelineCache, Sampler, SamplerDescriptor};
use bevy::render::renderer::{RenderDevice, RenderQueue};
use bevy::render::sync_world::MainEntity;
use bevy::render::texture::GpuImage;
use bevy::render::view::{ExtractedView, RenderVisibleEntities};

use super::extract::{ExtractedSmoke, ExtractedVolume};
use super::footprint::Footprints;
use super::frame::GpuSmokeFrame;
use super::lamp::lamps_of;
use super::light::{Environments, Light, LightKey, Lit};
use super::lighting::{LampUniform, LightingUniform, MAX_LAMPS};
use super::lit::{FrameLight, LitVolume};
use super::moments::Moments;
#[cfg(feature = "reference")]
use super::paper;
use super::view::{Emission, Glow, SmokeUniform, ViewPass, ViewSmoke, ViewSmokeVolume};
use super::{SmokePasses, SmokeRenderStats, SmokeWork};
use crate::density::GridShape;
use crate::scattering::{ScatteringChoice, ScatteringEvents, ScatteringSolver};
use crate::volume::SmokeVolume;

/// Frames that computed state is kept while nobody looks at it.
const KEEP_FRAMES: u32 = 300;

/// Everything that outlives a frame.
#[derive(Resource, Default)]
pub(super) struct SmokeCache {
    frame: u32,
    environments: Environments,
    moments: Moments,
    volumes: HashMap<(MainEntity, LightKey), LitVolume>,
    shared: Option<Shared>,
}

/// Lamps are softened over so many cells, and their glow within is drawn by the view pass.
const SOFTENING_CELLS: f32 = 2.5;

/// Where light that scatters more than once adds less than this to single scattering, it does not diffuse.
const DIFFUSION_SHARE: f32 = 0.1;

/// What all volumes share.
struct Shared {
    sampler: Sampler,
    footprints: Buffer,
    #[cfg(feature = "reference")]
    paper_tables: Buffer,
}

#[cfg(all(test, feature = "cli"))]
impl SmokeCache {
    /// The one 3D texture there is.
    pub fn only_texture(&self) -> &bevy::render::render_resource::TextureView {
        let mut sliced = self.volumes.values().flat_map(|volume| volume.sliced.values());
        let texture = &sliced.next().expect("a volume has been drawn").texture;
        assert!(sliced.next().is_none(), "more than one volume has been drawn");
        texture
    }
}

#[cfg(feature = "cli")]
impl SmokeCache {
    /// The reports of the solvers of all volumes, as buffers on the GPU.
    pub fn solver_controls(&self) -> impl Iterator<Item = &Buffer> {
        self.volumes.values().filter_map(LitVolume::control)
    }
}

/// What making resources takes.
pub(super) struct Gpu<'a> {
    pub device: &'a RenderDevice,
    pub queue: &'a RenderQueue,
    pub cache: &'a PipelineCache,
    pub passes: &'a SmokePasses,
    pub view_pass: &'a ViewPass,
    pub sampler: &'a Sampler,
    pub footprints: &'a Buffer,
    #[cfg(feature = "reference")]
    pub paper_tables: &'a Buffer,
}

/// Lists this frame's work, and every view's volumes from far to near.
pub(super) fn prepare_smoke(
    mut commands: Commands,
    mut work: ResMut<SmokeWork>,
    mut smoke_cache: ResMut<SmokeCache>,
    smoke: Res<ExtractedSmoke>,
    images: Res<RenderAssets<GpuImage>>,
    views: Query<
        (
            Entity,
            &ExtractedView,
            &ExtractedCamera,
            &RenderVisibleEntities,
            Option<&TemporalJitter>,
            Option<&MainPassResolutionOverride>,
        ),
        With<Camera3d>,
    >,
    device: Res<RenderDevice>,
    queue: Res<RenderQueue>,
    pipelines: Res<PipelineCache>,
    changed_images: Res<ExtractedAssets<GpuImage>>,
    (passes, view_pass, stats): (Res<SmokePasses>, Res<ViewPass>, Res<SmokeRenderStats>),
) {
    work.clear();
    let ready = passes.are_ready(&pipelines);
    let SmokeCache { frame: now, environments, moments, volumes, shared } = &mut *smoke_cache;
    *now = now.wrapping_add(1);
    environments.begin(*now, changed_images.added.iter().chain(&changed_images.modified));
    moments.begin(*now, &smoke);
    let shared = shared.get_or_insert_with(|| Shared {
        sampler: linear_sampler(&device),
        footprints: Footprints::buffer(&device, &queue),
        #[cfg(feature = "reference")]
        paper_tables: paper::Tables::buffer(&device, &queue),
    });
    let gpu = Gpu {
        device: &device,
        queue: &queue,
        cache: &pipelines,
        passes: &passes,
        view_pass: &view_pass,
        sampler: &shared.sampler,
        footprints: &shared.footprints,
        #[cfg(feature = "reference")]
        paper_tables: &shared.paper_tables,
    };

    for (view_entity, view, camera, visible, jitter, resolution) in &views {
        let mut drawn = Vec::new();
        let clip_from_view = jittered(view, jitter, resolution);
        let visible = visible.get::<SmokeVolume>().map_or(&[][..], |class| &class.entities_cpu_culling);
        for &(_, volume_entity) in visible.iter().filter(|_| ready) {
            let Some(volume) = smoke.volumes.get(&volume_entity) else {
                continue;
            };
            let Some(placed) = Placed::new(volume_entity, volume) else {
                continue;
            };
            let Some(light) = Light::of(volume_entity, volume, view, &smoke) else {
                continue;
            };
            let Some(lit) = environments.light(light, &images, &smoke.suns, &gpu, &mut work) else {
                continue;
            };
            let Some(frame) = moments.show(volume_entity, &volume.moment, &gpu, &mut work) else {
                continue;
            };

            let key = (volume_entity, lit.key);
            let before = volumes.get(&key).map(|volume| volume.choice.multiple);
            let choice = placed.choose_scattering(volume, frame, before, &device);
            stats.set_scattering(volume_entity, choice);
            let emission = volume.emission();
            // Light that scatters into a forward peak goes on for the solver of transport alone.
            let solver = volume.scattering.solver;
            let transport = choice.multiple && solver == ScatteringSolver::Transport && emission == Emission::Exact;
            if choice.multiple && solver == ScatteringSolver::Diffusion && choice.share < DIFFUSION_SHARE {
                warn_once!(
                    "smoke volume {volume_entity:?} is solved by diffusion but is thin: light hardly scatters twice in it, \
                     and ScatteringSolver::Transport is more accurate (said once)"
                );
            }
            let (uniform, unit) = placed.lighting(volume, &lit, &smoke, transport);
            #[cfg(feature = "reference")]
            let uniform = if volume.paper.is_some() { paper::without_lamps(uniform, volume_entity) } else { uniform };
            warn_of_limits(volume_entity, &uniform, frame.typical_depth());
            let glows = Glow::all(&uniform, placed.shape.half_extent());
            let light = FrameLight {
                coefficients: lit.coefficients,
                environment_version: lit.version,
                uniform,
                choice,
                solver,
                tolerance: volume.scattering.clamped_tolerance(),
                #[cfg(feature = "reference")]
                paper: volume.paper,
            };
            let lit_volume = volumes
                .entry(key)
                .and_modify(|v| {
                    if !v.is_of(frame, &light) {
                        let mut next = LitVolume::new(frame, &light, &gpu);
                        next.follow(v, frame, &gpu);
                        *v = next;
                    }
                })
                .or_insert_with(|| LitVolume::new(frame, &light, &gpu));
            lit_volume.update(frame, light, *now, &gpu, &mut work);

            let eye = placed.eye(view);
            // Isotropic smoke looks the same from everywhere: one texture serves all views.
            let isotropic = volume.medium.g == 0.0;
            let (key, look) =
                if isotropic { (None, Vec4::Z.with_w(0.0)) } else { (Some(view.retained_view_entity), eye) };
            let sliced = lit_volume.slice(key, look, frame, *now, &gpu, &mut work);
            let uniform = placed.smoke_uniform(view, clip_from_view, eye, volume, unit * camera.exposure, glows);
            if let Some(uniform) = uniform {
                let bind_group = sliced.see(view.retained_view_entity, uniform, *now, &gpu);
                let (distance, depths) = (placed.distance(view), placed.depths(view));
                drawn.push(ViewSmokeVolume { distance, depths, emission, bind_group });
            }
        }
        // Far to near; equal distances keep the order of their entities.
        drawn.sort_by(|a, b| b.distance.total_cmp(&a.distance));
        let mut view = commands.entity(view_entity);
        if drawn.is_empty() {
            view.remove::<ViewSmoke>();
        } else {
            view.insert(ViewSmoke(drawn));
        }
    }

    let in_use = |last_used: u32| now.wrapping_sub(last_used) < KEEP_FRAMES;
    environments.retain(in_use);
    moments.retain(in_use, |volume| smoke.volumes.contains_key(&volume));
    stats.set_memory(moments.memory());
    stats.retain_scattering(|entity| smoke.volumes.contains_key(&MainEntity::from(entity)));
    volumes.retain(|(entity, _), volume| in_use(volume.last_used) && smoke.volumes.contains_key(entity));
    for volume in volumes.values_mut() {
        volume.sliced.retain(|_, sliced| in_use(sliced.last_used));
        for sliced in volume.sliced.values_mut() {
            sliced.seen.retain(|_, seen| in_use(seen.last_used));
        }
    }
}

/// A volume's box in the world.
pub(super) struct Placed {
    world_from_bundle: Affine3A,
    shape: GridShape,
    /// World length of a bundle unit: the cube root of the change of volume.
    scale: f32,
    /// What the value 1 of the filtered density textures stands for.
    max_density: f32,
}

impl Placed {
    /// None where the transform flattens the box or is not finite.
    pub fn new(entity: MainEntity, volume: &ExtractedVolume) -> Option<Self> {
        let world_from_bundle = volume.world_from_bundle;
        if !world_from_bundle.is_finite() {
            warn_once!("the transform of smoke volume {entity:?} is not finite: it is not drawn (said once)");
            return None;
        }
        let scale = world_from_bundle.matrix3.determinant().abs().cbrt();
        let usable = scale > 0.0 && world_from_bundle.inverse().is_finite();
        let (shape, max_density) = (volume.moment.shape(), volume.moment.density_scale());
        usable.then_some(Self { world_from_bundle, shape, scale, max_density })
    }

    /// The medium and the light, and the radiance (cd/m²) that 1 in the passes' buffers and textures stands for.
    ///
    /// Where the environment is the only light, that is its intensity, which then changes at no cost; otherwise the
    /// strongest light decides, since textures are f16.
    fn lighting(
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

    /// Whether light that scatters more than once is drawn.
    fn choose_scattering(
        &self,
        volume: &ExtractedVolume,
        frame: &GpuSmokeFrame,
        before: Option<bool>,
        device: &RenderDevice,
    ) -> ScatteringChoice {
        let albedo = volume.medium.albedo;
        let albedo = albedo.red.max(albedo.green).max(albedo.blue);
        let chance = frame.chance_to_meet_again(self.sigma(volume));
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
        ScatteringChoice::new(events, albedo, chance, before)
    }

    /// Extinction a bundle unit where the filtered density textures hold 1; bounded, so that products with it stay finite.
    fn sigma(&self, volume: &ExtractedVolume) -> f32 {
        (volume.medium.sigma_t * self.scale * self.max_density).min(1e30)
    }

    fn bundle_from_view(&self, view: &ExtractedView) -> Affine3A {
        self.world_from_bundle.inverse() * view.world_from_view.affine()
    }

    /// The eye in bundle space (w = 1), or the direction of parallel rays (w = 0).
    fn eye(&self, view: &ExtractedView) -> Vec4 {
        let bundle_from_view = self.bundle_from_view(view);
        if is_orthographic(view) {
            Vec3::from(bundle_from_view.transform_vector3a(Vec3A::NEG_Z).normalize_or_zero()).extend(0.0)
        } else {
            Vec3::from(bundle_from_view.translation).extend(1.0)
        }
    }

    /// From the eye to the centre of the box, or along the view direction under an orthographic projection.
    fn distance(&self, view: &ExtractedView) -> f32 {
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

    /// What the view pass needs; None where the box is off the screen.
    fn smoke_uniform(
        &self,
        view: &ExtractedView,
        clip_from_view: Mat4,
        eye: Vec4,
        volume: &ExtractedVolume,
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
fn warn_of_limits(entity: MainEntity, lighting: &LightingUniform, typical_depth: f32) {
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

/// The projection that a view's meshes are drawn with: moved by a part of a pixel under temporal anti-aliasing.
fn jittered(
    view: &ExtractedView,
    jitter: Option<&TemporalJitter>,
    resolution: Option<&MainPassResolutionOverride>,
) -> Mat4 {
    let mut clip_from_view = view.clip_from_view;
    if let Some(jitter) = jitter {
        let size = resolution.map_or(view.viewport.zw(), |resolution| resolution.0);
        jitter.jitter_projection(&mut clip_from_view, size.as_vec2());
    }
    clip_from_view
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

/// Trilinear, clamped at the edges.
pub(super) fn linear_sampler(device: &RenderDevice) -> Sampler {
    device.create_sampler(&SamplerDescriptor {
        label: Some("smoke_sampler"),
        address_mode_u: AddressMode::ClampToEdge,
        address_mode_v: AddressMode::ClampToEdge,
        address_mode_w: AddressMode::ClampToEdge,
        mag_filter: FilterMode::Linear,
        min_filter: FilterMode::Linear,
        ..default()
    })
}
