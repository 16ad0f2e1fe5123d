//! Drawing at half resolution: what `view.wgsl` does where `HALF` and `UPSAMPLED` are defined.

use bevy::camera::MainPassResolutionOverride;
use bevy::prelude::*;
use bevy::render::render_resource::{
    BindGroup, Extent3d, LoadOp, Operations, PipelineCache, RenderPassColorAttachment, RenderPassDescriptor, StoreOp,
    TextureDescriptor, TextureDimension, TextureFormat, TextureUsages, TextureView,
};
use bevy::render::renderer::{RenderContext, RenderDevice};
use bevy::render::texture::TextureCache;
use bevy::render::view::{ExtractedView, ViewDepthTexture, ViewUniforms};

use super::slabs::ViewSlabs;
use super::view::{Pipelines, ToneMappingTables, ViewSmoke, ViewSmokePipelines, ViewSmokeVolume};

/// Format of the picture of half the size.
pub(super) const COLOR_FORMAT: TextureFormat = TextureFormat::Rgba16Float;
/// Format of how deep its pixels see.
pub(super) const DEPTH_FORMAT: TextureFormat = TextureFormat::R32Float;

/// What a view draws volumes at half resolution with; not there where it draws none so.
#[derive(Component)]
pub(super) struct ViewHalfResolution {
    color: TextureView,
    depth: TextureView,
    half: BindGroup,
    /// What the view binds to draw them to its own picture.
    pub upsampled: BindGroup,
    /// Of the view.
    size: UVec2,
}

/// Makes the pictures of half the size for the views that need them.
pub(super) fn prepare_half_resolution(
    mut commands: Commands,
    views: Query<(
        Entity,
        &ExtractedView,
        &ViewDepthTexture,
        &ViewSmokePipelines,
        Option<&ViewSmoke>,
        Has<ViewSlabs>,
        Has<MainPassResolutionOverride>,
    )>,
    mut textures: ResMut<TextureCache>,
    view_uniforms: Res<ViewUniforms>,
    tables: ToneMappingTables,
    device: Res<RenderDevice>,
    cache: Res<PipelineCache>,
) {
    for (entity, view, depth, pipelines, smoke, has_slabs, is_overridden) in &views {
        commands.entity(entity).remove::<ViewHalfResolution>();
        if !smoke.is_some_and(|smoke| smoke.0.iter().any(|volume| volume.half_resolution)) {
            continue;
        }
        let Some([half, upsampled]) = &pipelines.halves else {
            warn_once!("smoke is drawn at full resolution in views with MSAA (said once)");
            continue;
        };
        if has_slabs || is_overridden {
            warn_once!(
                "smoke is drawn at full resolution in views with transparent meshes in it or behind it, or with \
                 MainPassResolutionOverride (said once)"
            );
            continue;
        }
        let ready = [half, upsampled].iter().all(|pipelines| pipelines.are_ready(&cache));
        let Some(view_uniforms) = view_uniforms.uniforms.binding().filter(|_| ready) else { continue };
        let size = view.viewport.zw();
        let mut texture = |label, format| {
            let half = size.map(|side| side.div_ceil(2));
            let descriptor = TextureDescriptor {
                label: Some(label),
                size: Extent3d { width: half.x, height: half.y, depth_or_array_layers: 1 },
                mip_level_count: 1,
                sample_count: 1,
                dimension: TextureDimension::D2,
                format,
                usage: TextureUsages::RENDER_ATTACHMENT | TextureUsages::TEXTURE_BINDING,
                view_formats: &[],
            };
            textures.get(&device, descriptor).default_view
        };
        let color = texture("smoke_half_color", COLOR_FORMAT);
        let half_depth = texture("smoke_half_depth", DEPTH_FORMAT);
        let bind = |pipelines: &Pipelines, halves| {
            pipelines.bind_view(view_uniforms.clone(), depth.view(), None, halves, &tables, &device, &cache)
        };
        let (half, upsampled) = (bind(half, None), bind(upsampled, Some([&color, &half_depth])));
        commands.entity(entity).insert(ViewHalfResolution { color, depth: half_depth, half, upsampled, size });
    }
}

impl ViewHalfResolution {
    /// Draws a volume to the picture of half the size.
    pub fn draw(
        &self,
        volume: &ViewSmokeVolume,
        pipelines: &Pipelines,
        uniform_offset: u32,
        cache: &PipelineCache,
        ctx: &mut RenderContext,
    ) -> u32 {
        let attachment = |view, value: f64| {
            // No mesh is as deep as what nothing has been drawn to.
            let clear = wgpu::Color { r: value, g: value, b: value, a: value };
            let ops = Operations { load: LoadOp::Clear(clear), store: StoreOp::Store };
            Some(RenderPassColorAttachment { view, depth_slice: None, resolve_target: None, ops })
        };
        let mut pass = ctx.begin_tracked_render_pass(RenderPassDescriptor {
            label: Some("smoke_view_half"),
            color_attachments: &[attachment(&self.color, 0.0), attachment(&self.depth, 1e9)],
            depth_stencil_attachment: None,
            timestamp_writes: None,
            occlusion_query_set: None,
            multiview_mask: None,
        });
        let size = 0.5 * self.size.as_vec2();
        pass.set_viewport(0.0, 0.0, size.x, size.y, 0.0, 1.0);
        pass.set_bind_group(0, &self.half, &[uniform_offset]);
        pipelines.draw([volume].into_iter(), 0, cache, &mut pass)
    }
}
