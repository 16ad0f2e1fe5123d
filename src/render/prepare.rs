//! Decides what must be computed this frame, and for whom.
//!
//! The work forms a tree, and each level is done only when something above it changed:
//!
//! | state | one per | changes with |
//! |---|---|---|
//! | [`Environments`] | environment | its image or coefficients |
//! | [`GpuSmokeFrame`](super::frame::GpuSmokeFrame) | frame of smoke | the asset |
//! | [`LitVolume`] | volume × environment | the two above, the medium, the volume's rotation and scale |
//! | [`SlicedVolume`] | lit volume, × view where the phase function is not isotropic | the lit volume; the eye in bundle space |

use bevy::math::{Affine3A, Vec3A};
use bevy::platform::collections::HashMap;
use bevy::prelude::*;
use bevy::render::camera::ExtractedCamera;
use bevy::render::render_asset::{ExtractedAssets, RenderAssets};
use bevy::render::render_resource::encase::internal::WriteInto;
use bevy::render::render_resource::{
    AddressMode, BindGroup, Buffer, BufferDescriptor, BufferId, BufferUsages, FilterMode, PipelineCache, Sampler,
    SamplerDescriptor, ShaderType, TextureView, UniformBuffer,
};
use bevy::render::renderer::{RenderDevice, RenderQueue};
use bevy::render::sync_world::MainEntity;
use bevy::render::texture::GpuImage;
use bevy::render::view::{ExtractedView, RenderVisibleEntities, RetainedViewEntity};

use super::extract::{ExtractedSmoke, ExtractedVolume};
use super::frame::{FILTERED_FORMAT, GpuSmokeAnimation, GpuSmokeFrame, texture_3d};
use super::light::{Environments, Light, LightKey, Lit};
use super::outgoing::{LookUniform, OUTGOING_BYTES};
use super::pass::Job;
use super::source_radiance::{LightingUniform, PROBES};
use super::view::{SmokeUniform, ViewPass, ViewSmoke, ViewSmokeVolume};
use super::{SmokePasses, SmokeWork, coarse, density, outgoing, source_radiance, volume};
use crate::density::GridShape;
use crate::volume::SmokeVolume;

/// Frames that computed state is kept while nobody looks at it.
const KEEP_FRAMES: u32 = 300;

/// Everything that outlives a frame.
#[derive(Resource, Default)]
pub(super) struct SmokeCache {
    frame: u32,
    environments: Environments,
    volumes: HashMap<(MainEntity, LightKey), LitVolume>,
    sampler: Option<Sampler>,
}

#[cfg(all(test, feature = "cli"))]
impl SmokeCache {
    /// The one 3D texture there is.
    pub fn only_texture(&self) -> &TextureView {
        let mut sliced = self.volumes.values().flat_map(|volume| volume.sliced.values());
        let texture = &sliced.next().expect("a volume has been drawn").texture;
        assert!(sliced.next().is_none(), "more than one volume has been drawn");
        texture
    }
}

/// A volume lit by an environment: its probes.
struct LitVolume {
    frame: BufferId,
    environment_version: u32,
    uniform: Cached<LightingUniform>,
    probes: Buffer,
    bind_group: BindGroup,
    /// Counts the changes.
    version: u32,
    last_used: u32,
    sliced: HashMap<Option<RetainedViewEntity>, SlicedVolume>,
}

/// A lit volume as an eye sees it: its 3D texture.
struct SlicedVolume {
    look: Cached<LookUniform>,
    lit_version: u32,
    texture: TextureView,
    outgoing: BindGroup,
    volume: BindGroup,
    last_used: u32,
    seen: HashMap<RetainedViewEntity, SeenVolume>,
}

/// A 3D texture as one view draws it.
struct SeenVolume {
    uniform: Cached<SmokeUniform>,
    bind_group: BindGroup,
    last_used: u32,
}

/// A uniform buffer that knows what is in it.
struct Cached<T: ShaderType + WriteInto + Clone + PartialEq> {
    value: T,
    buffer: UniformBuffer<T>,
}

impl<T: ShaderType + WriteInto + Clone + PartialEq> Cached<T> {
    fn new(value: T, gpu: &Gpu) -> Self {
        let mut buffer = UniformBuffer::from(value.clone());
        buffer.write_buffer(gpu.device, gpu.queue);
        Self { value, buffer }
    }

    /// Stores a value; whether it is another than before.
    fn set(&mut self, value: T, gpu: &Gpu) -> bool {
        if self.value == value {
            return false;
        }
        self.buffer.set(value.clone());
        self.buffer.write_buffer(gpu.device, gpu.queue);
        self.value = value;
        true
    }

    fn buffer(&self) -> &Buffer {
        self.buffer.buffer().expect("written when it was made")
    }
}

/// What making resources takes.
pub(super) struct Gpu<'a> {
    pub device: &'a RenderDevice,
    pub queue: &'a RenderQueue,
    pub cache: &'a PipelineCache,
    pub passes: &'a SmokePasses,
    view_pass: &'a ViewPass,
    pub sampler: &'a Sampler,
}

/// Lists this frame's work, and every view's volumes from far to near.
pub(super) fn prepare_smoke(
    mut commands: Commands,
    mut work: ResMut<SmokeWork>,
    mut smoke_cache: ResMut<SmokeCache>,
    smoke: Res<ExtractedSmoke>,
    animations: Res<RenderAssets<GpuSmokeAnimation>>,
    images: Res<RenderAssets<GpuImage>>,
    views: Query<(Entity, &ExtractedView, &ExtractedCamera, &RenderVisibleEntities), With<Camera3d>>,
    device: Res<RenderDevice>,
    queue: Res<RenderQueue>,
    pipelines: Res<PipelineCache>,
    changed_images: Res<ExtractedAssets<GpuImage>>,
    (passes, view_pass): (Res<SmokePasses>, Res<ViewPass>),
) {
    work.clear();
    let ready = passes.are_ready(&pipelines);
    let SmokeCache { frame: now, environments, volumes, sampler } = &mut *smoke_cache;
    *now = now.wrapping_add(1);
    environments.begin(*now, changed_images.added.iter().chain(&changed_images.modified));
    let sampler = sampler.get_or_insert_with(|| linear_sampler(&device));
    let gpu =
        Gpu { device: &device, queue: &queue, cache: &pipelines, passes: &passes, view_pass: &view_pass, sampler };

    for (view_entity, view, camera, visible) in &views {
        let mut drawn = Vec::new();
        let visible = visible.get::<SmokeVolume>().map_or(&[][..], |class| &class.entities_cpu_culling);
        for &(_, volume_entity) in visible.iter().filter(|_| ready) {
            let Some(volume) = smoke.volumes.get(&volume_entity) else {
                continue;
            };
            let Some(animation) = animations.get(volume.animation) else {
                continue;
            };
            let Some(frame) = animation.frames.get(volume.frame as usize).or(animation.frames.last()) else {
                continue;
            };
            let Some(placed) = Placed::new(volume_entity, volume, animation) else {
                continue;
            };
            let Some(light) = Light::of(volume_entity, volume, view, &smoke) else {
                continue;
            };
            let Some(lit) = environments.light(light, &images, &gpu, &mut work) else {
                continue;
            };
            if frame.take_unpacking() {
                work.density.push(density::job(&passes.density, animation.shape, frame, &device, &pipelines));
                work.coarse.push(coarse::job(&passes.coarse, animation.shape, frame, &device, &pipelines));
            }

            let uniform = placed.lighting(volume, &lit);
            let lit_volume = volumes
                .entry((volume_entity, lit.key))
                .and_modify(|v| {
                    if v.frame != frame.uniform.id() {
                        *v = LitVolume::new(frame, &lit, uniform.clone(), &gpu);
                    }
                })
                .or_insert_with(|| LitVolume::new(frame, &lit, uniform.clone(), &gpu));
            lit_volume.update(frame, &lit, uniform, *now, &gpu, &mut work);

            let eye = placed.eye(view);
            // Isotropic smoke looks the same from everywhere: one texture serves all views.
            let isotropic = volume.medium.g == 0.0;
            let (key, look) =
                if isotropic { (None, Vec4::Z.with_w(0.0)) } else { (Some(view.retained_view_entity), eye) };
            let sliced = lit_volume.slice(key, look, frame, animation.shape, *now, &gpu, &mut work);
            let uniform = placed.smoke_uniform(view, eye, volume, lit.intensity * camera.exposure);
            if let Some(uniform) = uniform {
                let bind_group = sliced.see(view.retained_view_entity, uniform, *now, &gpu);
                drawn.push(ViewSmokeVolume { distance: placed.distance(view), bind_group });
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
    volumes.retain(|(entity, _), volume| in_use(volume.last_used) && smoke.volumes.contains_key(entity));
    for volume in volumes.values_mut() {
        volume.sliced.retain(|_, sliced| in_use(sliced.last_used));
        for sliced in volume.sliced.values_mut() {
            sliced.seen.retain(|_, seen| in_use(seen.last_used));
        }
    }
}

/// A volume's box in the world.
struct Placed {
    world_from_bundle: Affine3A,
    shape: GridShape,
    /// World length of a bundle unit: the cube root of the change of volume.
    scale: f32,
    /// What the value 1 of the filtered density textures stands for.
    max_density: f32,
}

impl Placed {
    /// None where the transform flattens the box or is not finite.
    fn new(entity: MainEntity, volume: &ExtractedVolume, animation: &GpuSmokeAnimation) -> Option<Self> {
        let world_from_bundle = volume.world_from_bundle;
        if !world_from_bundle.is_finite() {
            warn_once!("the transform of smoke volume {entity:?} is not finite: it is not drawn (said once)");
            return None;
        }
        let scale = world_from_bundle.matrix3.determinant().abs().cbrt();
        let usable = scale > 0.0 && world_from_bundle.inverse().is_finite();
        usable.then_some(Self { world_from_bundle, shape: animation.shape, scale, max_density: animation.max_density })
    }

    fn lighting(&self, volume: &ExtractedVolume, lit: &Lit) -> LightingUniform {
        let m = &self.world_from_bundle.matrix3;
        let world_from_bundle =
            Mat3::from_cols(m.x_axis.normalize().into(), m.y_axis.normalize().into(), m.z_axis.normalize().into());
        let g = volume.medium.g;
        let albedo = volume.medium.albedo;
        LightingUniform {
            environment_from_bundle: lit.environment_from_world * world_from_bundle,
            albedo: Vec3::new(albedo.red, albedo.green, albedo.blue),
            sigma: self.sigma(volume),
            bands: Vec4::new(1.0, g, g * g, g * g * g),
        }
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

    /// What the view pass needs; None where the box is off the screen.
    fn smoke_uniform(
        &self,
        view: &ExtractedView,
        eye: Vec4,
        volume: &ExtractedVolume,
        radiance_scale: f32,
    ) -> Option<SmokeUniform> {
        let bundle_from_view = Mat4::from(self.bundle_from_view(view));
        let half_extent = self.shape.half_extent();
        let clip_from_bundle = view.clip_from_view * bundle_from_view.inverse();
        let rectangle = screen_rectangle(clip_from_bundle, half_extent)?;
        Some(SmokeUniform {
            bundle_from_clip: bundle_from_view * view.clip_from_view.inverse(),
            eye,
            rectangle,
            half_extent,
            cell: self.shape.cell_size(),
            sigma: self.sigma(volume),
            radiance_scale,
        })
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

impl LitVolume {
    fn new(frame: &GpuSmokeFrame, lit: &Lit, uniform: LightingUniform, gpu: &Gpu) -> Self {
        let bytes = u64::from(frame.rbf_count.max(1)) * u64::from(PROBES) * 16 * 16;
        let probes = storage_buffer(gpu.device, "smoke_probes", bytes);
        let uniform = Cached::new(uniform, gpu);
        let bindings = source_radiance::Bindings {
            frame,
            lighting: uniform.buffer(),
            environment: lit.coefficients,
            sampler: gpu.sampler,
            probes: &probes,
        };
        Self {
            bind_group: source_radiance::bind(&gpu.passes.source_radiance, bindings, gpu.device, gpu.cache),
            frame: frame.uniform.id(),
            // Older than any environment: lit at the first look.
            environment_version: 0,
            uniform,
            probes,
            version: 0,
            last_used: 0,
            sliced: HashMap::default(),
        }
    }

    fn update(
        &mut self,
        frame: &GpuSmokeFrame,
        lit: &Lit,
        uniform: LightingUniform,
        now: u32,
        gpu: &Gpu,
        work: &mut SmokeWork,
    ) {
        self.last_used = now;
        let changed = self.uniform.set(uniform, gpu) | (self.environment_version != lit.version);
        if changed {
            self.environment_version = lit.version;
            self.version += 1;
            let workgroups = source_radiance::workgroups(frame);
            work.source_radiance.push(Job { bind_group: self.bind_group.clone(), workgroups });
        }
    }

    /// The 3D texture for a view, or for all.
    fn slice(
        &mut self,
        view: Option<RetainedViewEntity>,
        eye: Vec4,
        frame: &GpuSmokeFrame,
        shape: GridShape,
        now: u32,
        gpu: &Gpu,
        work: &mut SmokeWork,
    ) -> &mut SlicedVolume {
        let (probes, version) = (&self.probes, self.version);
        let sliced = self.sliced.entry(view).or_insert_with(|| SlicedVolume::new(eye, frame, shape, probes, gpu));
        sliced.last_used = now;
        let changed = sliced.look.set(LookUniform { eye }, gpu) | (sliced.lit_version != version);
        if changed {
            sliced.lit_version = version;
            let bind_group = sliced.outgoing.clone();
            work.outgoing.push(Job { bind_group, workgroups: outgoing::workgroups(frame) });
            let bind_group = sliced.volume.clone();
            work.volume.push(Job { bind_group, workgroups: volume::workgroups(shape) });
        }
        sliced
    }
}

impl SlicedVolume {
    fn new(eye: Vec4, frame: &GpuSmokeFrame, shape: GridShape, probes: &Buffer, gpu: &Gpu) -> Self {
        let bytes = u64::from(frame.rbf_count.max(1)) * OUTGOING_BYTES;
        let outgoing = storage_buffer(gpu.device, "smoke_outgoing", bytes);
        let texture = texture_3d(gpu.device, "smoke_volume", shape.dims + 2, FILTERED_FORMAT);
        let look = Cached::new(LookUniform { eye }, gpu);
        let leave = outgoing::Bindings { frame, look: look.buffer(), probes, outgoing: &outgoing };
        let reconstruct = volume::Bindings { frame, outgoing: &outgoing, volume: &texture };
        Self {
            outgoing: outgoing::bind(&gpu.passes.outgoing, leave, gpu.device, gpu.cache),
            volume: volume::bind(&gpu.passes.volume, reconstruct, gpu.device, gpu.cache),
            look,
            // Older than any lit volume.
            lit_version: 0,
            texture,
            last_used: 0,
            seen: HashMap::default(),
        }
    }

    /// What a view binds to draw it.
    fn see(&mut self, view: RetainedViewEntity, uniform: SmokeUniform, now: u32, gpu: &Gpu) -> BindGroup {
        let texture = &self.texture;
        let seen = self.seen.entry(view).or_insert_with(|| {
            let uniform = Cached::new(uniform.clone(), gpu);
            let bindings = (uniform.buffer(), texture, gpu.sampler);
            let bind_group = gpu.view_pass.bind(bindings, gpu.device, gpu.cache);
            SeenVolume { uniform, bind_group, last_used: now }
        });
        seen.last_used = now;
        seen.uniform.set(uniform, gpu);
        seen.bind_group.clone()
    }
}

fn storage_buffer(device: &RenderDevice, label: &str, size: u64) -> Buffer {
    let usage = BufferUsages::STORAGE | BufferUsages::COPY_SRC;
    device.create_buffer(&BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false })
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
