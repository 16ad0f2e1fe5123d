//! Shadow-probe pass: sky and coarse density → the irradiance that smoke takes from surfaces around it, at a grid of points
//! that is dense near the volume and reaches far beyond it. Runs when the smoke or the sky changed; a mesh in the grid is
//! shaded by it at the cost of three texture reads.

use bevy::platform::collections::HashMap;
use bevy::prelude::*;
use bevy::render::render_resource::binding_types::{sampler, texture_3d, texture_storage_3d, uniform_buffer};
use bevy::render::render_resource::{
    BindGroup, BindGroupLayoutEntries, Buffer, BufferId, PipelineCache, Sampler, SamplerBindingType, ShaderStages,
    StorageTextureAccess, TextureSampleType, TextureView, TextureViewId,
};
use bevy::render::renderer::{RenderContext, RenderDevice};
use bevy::render::sync_world::MainEntity;
use bevy::shader::Shader;

use super::casters::{Caster, CasterUniform, Casters};
use super::frame::{FILTERED_FORMAT, texture_3d as new_texture_3d};
use super::light::{LightKey, Lit};
use super::lit::Cached;
use super::pass::{ComputePass, Job};
use super::prepare::Gpu;
use super::sky::SkyUniform;
use super::{SmokePasses, SmokeRenderStats, SmokeWork};

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_shadow_probes";

/// Probes a side of a caster's grid; as in `casters.wgsl`.
pub(super) const PROBES: u32 = 24;
/// Texels a probe takes, one above the other; as in `casters.wgsl`.
pub(super) const PROBE_TEXELS: u32 = 3;

pub(super) fn pass(shader: &Handle<Shader>, cache: &PipelineCache) -> ComputePass {
    let entries = BindGroupLayoutEntries::sequential(
        ShaderStages::COMPUTE,
        (
            uniform_buffer::<CasterUniform>(false),
            uniform_buffer::<SkyUniform>(false),
            uniform_buffer::<[Vec4; 16]>(false),
            uniform_buffer::<Mat4>(false),
            texture_3d(TextureSampleType::Float { filterable: true }),
            sampler(SamplerBindingType::Filtering),
            texture_storage_3d(FILTERED_FORMAT, StorageTextureAccess::WriteOnly),
        ),
    );
    ComputePass::new(LABEL, &entries, shader, "gather", vec![], cache)
}

/// What one dispatch reads and writes.
pub(super) struct Bindings<'a> {
    pub caster: &'a Buffer,
    pub sky: &'a Buffer,
    pub environment: &'a Buffer,
    pub world_from_bundle: &'a Buffer,
    pub densities: &'a TextureView,
    pub sampler: &'a Sampler,
    pub probes: &'a TextureView,
}

pub(super) fn bind(pass: &ComputePass, b: Bindings, device: &RenderDevice, cache: &PipelineCache) -> BindGroup {
    pass.bind(
        device,
        cache,
        (
            b.caster.as_entire_binding(),
            b.sky.as_entire_binding(),
            b.environment.as_entire_binding(),
            b.world_from_bundle.as_entire_binding(),
            b.densities,
            b.sampler,
            b.probes,
        ),
    )
}

/// A texture for the probes of so many casters.
pub(super) fn probe_texture(slots: u32, device: &RenderDevice) -> TextureView {
    let dims = UVec3::new(PROBES, PROBES, PROBES * PROBE_TEXELS * slots);
    new_texture_3d(device, "smoke_shadow_probes", dims, FILTERED_FORMAT)
}

/// One workgroup a probe.
pub(super) fn workgroups() -> UVec3 {
    UVec3::splat(PROBES)
}

/// The probes of all casters, under every sky in use.
#[derive(Default)]
pub(super) struct ShadowProbes {
    skies: HashMap<LightKey, ProbedSky>,
}

/// The probes under one sky.
pub(super) struct ProbedSky {
    pub probes: TextureView,
    pub sky: SkyUniform,
    /// The sky's coefficients.
    pub environment: Buffer,
    environment_version: u32,
    sky_buffer: Cached<SkyUniform>,
    casters: HashMap<MainEntity, ProbedCaster>,
    last_used: u32,
}

struct ProbedCaster {
    caster: Cached<CasterUniform>,
    world_from_bundle: Cached<Mat4>,
    bind_group: BindGroup,
    /// What the bind group binds: densities, coefficients, probes.
    of: (TextureViewId, BufferId, TextureViewId),
    version: u32,
}

impl ShadowProbes {
    /// The probes under a sky, brought up to date.
    pub fn update(&mut self, lit: &Lit, casters: &Casters, now: u32, gpu: &Gpu, work: &mut SmokeWork) -> &ProbedSky {
        let sky = SkyUniform::new(lit);
        let slots = casters.current.iter().map(|caster| caster.uniform.slot + 1).max().unwrap_or(1).next_power_of_two();
        let probed = self.skies.entry(lit.key).or_insert_with(|| ProbedSky {
            probes: probe_texture(slots, gpu.device),
            sky,
            environment: lit.coefficients.clone(),
            environment_version: lit.version,
            sky_buffer: Cached::new(sky, gpu),
            casters: HashMap::default(),
            last_used: now,
        });
        if probed.last_used == now && !probed.casters.is_empty() {
            // Another view of this frame has the same sky.
            return probed;
        }
        probed.last_used = now;
        if probed.probes.texture().depth_or_array_layers() < slots * PROBE_TEXELS * PROBES {
            probed.probes = probe_texture(slots, gpu.device);
        }
        // Radiance in units of the sky's own strength does not change with that alone.
        let relative = SkyUniform { unit: 1.0, ..sky };
        let mut changed = probed.sky_buffer.set(relative, gpu);
        changed |= probed.environment_version != lit.version || probed.environment.id() != lit.coefficients.id();
        probed.sky = sky;
        probed.environment = lit.coefficients.clone();
        probed.environment_version = lit.version;
        probed.casters.retain(|entity, _| casters.current.iter().any(|caster| caster.entity == *entity));
        for caster in &casters.current {
            if let Some(bind_group) = probed.probe(caster, casters, changed, gpu) {
                work.shadow_probes.push(Job { bind_group, workgroups: workgroups() });
            }
        }
        probed
    }

    pub fn retain(&mut self, in_use: impl Fn(u32) -> bool) {
        self.skies.retain(|_, sky| in_use(sky.last_used));
    }
}

impl ProbedSky {
    /// What to dispatch for a caster, where its probes are out of date.
    fn probe(&mut self, caster: &Caster, casters: &Casters, changed: bool, gpu: &Gpu) -> Option<BindGroup> {
        let densities = casters.densities()?;
        let of = (densities.id(), self.environment.id(), self.probes.id());
        let world_from_bundle = caster.uniform.bundle_from_here.inverse();
        let bind = |uniform: &Cached<CasterUniform>, world: &Cached<Mat4>| {
            let bindings = Bindings {
                caster: uniform.buffer(),
                sky: self.sky_buffer.buffer(),
                environment: &self.environment,
                world_from_bundle: world.buffer(),
                densities,
                sampler: gpu.sampler,
                probes: &self.probes,
            };
            bind(&gpu.passes.shadow_probes, bindings, gpu.device, gpu.cache)
        };
        let Some(probed) = self.casters.get_mut(&caster.entity) else {
            let uniform = Cached::new(caster.uniform, gpu);
            let world = Cached::new(world_from_bundle, gpu);
            let bind_group = bind(&uniform, &world);
            let probed = ProbedCaster {
                caster: uniform,
                world_from_bundle: world,
                bind_group: bind_group.clone(),
                of,
                version: caster.version,
            };
            self.casters.insert(caster.entity, probed);
            return Some(bind_group);
        };
        // A volume that only moves takes its probes with it.
        let turned = relative(probed.caster.value()) != relative(&caster.uniform);
        let moved = probed.caster.set(caster.uniform, gpu) | probed.world_from_bundle.set(world_from_bundle, gpu);
        let rebound = probed.of != of;
        if rebound {
            probed.bind_group = bind(&probed.caster, &probed.world_from_bundle);
            probed.of = of;
        }
        let stale = changed || rebound || probed.version != caster.version || (moved && turned);
        probed.version = caster.version;
        stale.then(|| probed.bind_group.clone())
    }
}

/// A caster wherever it is.
fn relative(caster: &CasterUniform) -> CasterUniform {
    let mut placed = *caster;
    placed.bundle_from_here.w_axis = Vec4::W;
    placed
}

/// Lights the probes of every caster whose smoke or sky changed.
pub(super) fn shadow_probes(
    work: Res<SmokeWork>,
    passes: Res<SmokePasses>,
    cache: Res<PipelineCache>,
    stats: Res<SmokeRenderStats>,
    mut ctx: RenderContext,
) {
    passes.shadow_probes.run(&work.shadow_probes, &cache, &stats.shadow_probes, &mut ctx);
}
