//! A windowless Bevy app that draws into an image and hands back its pixels: for the `smoke` command, the tests and
//! the pictures in the documentation.

use std::sync::Once;
use std::time::{Duration, Instant};

use bevy::asset::{RenderAssetUsages, UnapprovedPathMode};
use bevy::camera::{Exposure, Hdr, RenderTarget, ShadowLodOrigin};
use bevy::core_pipeline::tonemapping::{DebandDither, Tonemapping};
use bevy::log::LogPlugin;
use bevy::prelude::*;
use bevy::render::RenderApp;
use bevy::render::RenderPlugin;
use bevy::render::diagnostic::RenderDiagnosticsPlugin;
use bevy::render::pipelined_rendering::PipelinedRenderingPlugin;
use bevy::render::render_asset::RenderAssets;
use bevy::render::render_resource::{
    Buffer, BufferDescriptor, BufferUsages, CommandEncoderDescriptor, MapMode, PollType, TexelCopyBufferInfo,
    TexelCopyBufferLayout, TextureFormat, TextureUsages,
};
use bevy::render::renderer::{RenderDevice, RenderQueue};
use bevy::render::settings::WgpuSettings;
use bevy::render::texture::GpuImage;
use bevy::window::ExitCondition;
use bevy::winit::WinitPlugin;

use crate::SmokePlugin;
use crate::render::{self, SmokeRenderStats, SolverReport};

/// A Bevy app without a window: `DefaultPlugins`, [`SmokePlugin`], GPU spans, and one image to draw into. Updates
/// happen one at a time, rendering included, and pipelines are compiled before they are first needed.
pub struct Headless {
    /// The app: spawn what is to be drawn into its world.
    pub app: App,
    target: Handle<Image>,
}

/// Warnings and errors, but not Bevy's remark that a software adapter is slow: whoever runs without a window knows.
const LOG_FILTER: &str = "warn,bevy_render::renderer=error";

/// Why nothing can be drawn.
#[derive(Debug, thiserror::Error)]
pub enum HeadlessError {
    /// There is no graphics adapter that Bevy could use.
    #[error(
        "no graphics adapter found: install a Vulkan driver (on Debian, `apt install mesa-vulkan-drivers` gives one that needs no GPU)"
    )]
    NoAdapter,
    /// The smoke did not appear: it is out of sight, or what it needs has not loaded (then the log says why).
    #[error("no smoke was drawn: it is out of sight, or an asset is missing (see the log)")]
    NothingDrawn,
}

impl Headless {
    /// An app whose image has `size` pixels of a format: `Rgba16Float` for radiance, `Rgba8UnormSrgb` for pictures.
    ///
    /// # Errors
    ///
    /// [`HeadlessError::NoAdapter`] where there is nothing to draw with.
    pub fn new(size: UVec2, format: TextureFormat) -> Result<Self, HeadlessError> {
        Self::with_assets(size, format, AssetPlugin::default().file_path)
    }

    /// The same with assets from another folder than `assets`.
    ///
    /// # Errors
    ///
    /// Those of [`new`](Self::new).
    pub fn with_assets(size: UVec2, format: TextureFormat, folder: String) -> Result<Self, HeadlessError> {
        Self::with_plugins(size, format, folder, |_| {})
    }

    /// The same with plug-ins of the caller's, added after all others.
    ///
    /// # Errors
    ///
    /// Those of [`new`](Self::new).
    pub fn with_plugins(
        size: UVec2,
        format: TextureFormat,
        folder: String,
        add: impl FnOnce(&mut App),
    ) -> Result<Self, HeadlessError> {
        // Bevy panics without an adapter; ask first.
        let backends = wgpu::Backends::PRIMARY;
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
            backends,
            ..wgpu::InstanceDescriptor::new_without_display_handle()
        });
        let options = wgpu::RequestAdapterOptions::default();
        bevy::tasks::block_on(instance.request_adapter(&options)).map_err(|_| HeadlessError::NoAdapter)?;

        let mut app = App::new();
        // A process has one log, however many apps.
        static LOG: Once = Once::new();
        LOG.call_once(|| {
            app.add_plugins(LogPlugin { filter: LOG_FILTER.into(), ..default() });
        });
        app.add_plugins((
            DefaultPlugins
                .build()
                .disable::<LogPlugin>()
                .disable::<WinitPlugin>()
                .disable::<PipelinedRenderingPlugin>()
                // Tools read what they are told to, wherever it is.
                .set(AssetPlugin { file_path: folder, unapproved_path_mode: UnapprovedPathMode::Allow, ..default() })
                .set(WindowPlugin { primary_window: None, exit_condition: ExitCondition::DontExit, ..default() })
                .set(RenderPlugin {
                    render_creation: WgpuSettings { backends: Some(backends), ..default() }.into(),
                    synchronous_pipeline_compilation: true,
                    ..default()
                }),
            RenderDiagnosticsPlugin,
            SmokePlugin,
        ));
        add(&mut app);
        app.finish();
        app.cleanup();
        let mut image = Image::new_target_texture(size.x, size.y, format, None);
        image.texture_descriptor.usage |= TextureUsages::COPY_SRC;
        image.asset_usage = RenderAssetUsages::default();
        let target = app.world_mut().resource_mut::<Assets<Image>>().add(image);
        Ok(Self { app, target })
    }

    /// The image, as a camera's target.
    pub fn target(&self) -> RenderTarget {
        RenderTarget::Image(self.target.clone().into())
    }

    /// A camera that shows radiance as it is, over nothing: exposure 1, no tone mapping, no dithering.
    pub fn radiance_camera(&self) -> impl Bundle + use<> {
        (
            Camera3d::default(),
            Camera { clear_color: ClearColorConfig::Custom(Color::NONE), ..default() },
            self.target(),
            Hdr,
            Msaa::Off,
            Tonemapping::None,
            DebandDither::Disabled,
            // Exposure is 1 / (1.2 · 2^ev100): this makes it 1.
            Exposure { ev100: -(1.2_f32.log2()) },
            ShadowLodOrigin,
        )
    }

    /// Makes every camera that the app's systems spawn draw into the image, whatever its target was.
    pub fn draw_cameras_to_image(&mut self) {
        let target = self.target();
        self.app.add_systems(First, move |mut targets: Query<&mut RenderTarget, Added<Camera>>| {
            for mut camera_target in &mut targets {
                *camera_target = target.clone();
            }
        });
    }

    /// Updates until smoke has been drawn, or until 2 seconds and 60 updates have passed.
    ///
    /// # Errors
    ///
    /// [`HeadlessError::NothingDrawn`] when it never is.
    pub fn settle(&mut self) -> Result<(), HeadlessError> {
        let start = Instant::now();
        let view = SmokeRenderStats::PASSES.len() - 1;
        for update in 0.. {
            if update >= 60 && start.elapsed() > Duration::from_secs(2) {
                break;
            }
            self.app.update();
            if self.app.world().resource::<SmokeRenderStats>().dispatches()[view] > 0 {
                return Ok(());
            }
            // Assets load on other threads.
            std::thread::sleep(Duration::from_millis(2));
        }
        Err(HeadlessError::NothingDrawn)
    }

    /// What the solvers of multiple scattering did last, one a volume and light that has one.
    pub fn solver_reports(&self) -> Vec<SolverReport> {
        render::read_solver_reports(self.app.sub_app(RenderApp).world())
    }

    /// Waits until the GPU has done all that it was given.
    pub fn wait(&self) {
        let device = self.app.world().resource::<RenderDevice>();
        device.poll(PollType::wait_indefinitely()).expect("the device answers");
    }

    /// The image's pixels, rows from the top, each RGBA in the image's format; sRGB formats stay encoded.
    pub fn pixels(&self) -> Vec<u8> {
        self.pixels_of(&self.target)
    }

    /// The same of another image that can be copied from.
    pub fn pixels_of(&self, image: &Handle<Image>) -> Vec<u8> {
        let images = self.app.sub_app(RenderApp).world().resource::<RenderAssets<GpuImage>>();
        let texture = &images.get(image).expect("it has been drawn into").texture;
        read_texture(self.app.world().resource(), self.app.world().resource(), texture)
    }

    /// The same as linear floats, for an image of `Rgba16Float` or `Rgba32Float`.
    pub fn float_pixels(&self) -> Vec<[f32; 4]> {
        let bytes = self.pixels();
        let images = self.app.world().resource::<Assets<Image>>();
        let format = images.get(&self.target).expect("it is never removed").texture_descriptor.format;
        let floats: Vec<f32> = match format {
            TextureFormat::Rgba16Float => {
                bytes.as_chunks().0.iter().map(|b| half::f16::from_le_bytes(*b).to_f32()).collect()
            }
            _ => bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect(),
        };
        floats.as_chunks().0.to_vec()
    }
}

/// The texels of a texture's first mip level, without padding.
pub(crate) fn read_texture(device: &RenderDevice, queue: &RenderQueue, texture: &wgpu::Texture) -> Vec<u8> {
    let texel = texture.format().block_copy_size(None).expect("a colour format");
    let size = texture.size();
    let row = size.width * texel;
    let padded_row = row.next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
    let rows = size.height * size.depth_or_array_layers;
    let staging = device.create_buffer(&BufferDescriptor {
        label: Some("smoke_readback"),
        size: u64::from(padded_row) * u64::from(rows),
        usage: BufferUsages::COPY_DST | BufferUsages::MAP_READ,
        mapped_at_creation: false,
    });
    let mut encoder = device.create_command_encoder(&CommandEncoderDescriptor::default());
    let layout =
        TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(padded_row), rows_per_image: Some(size.height) };
    encoder.copy_texture_to_buffer(texture.as_image_copy(), TexelCopyBufferInfo { buffer: &staging, layout }, size);
    queue.submit([encoder.finish()]);
    let padded = read_mapped(device, &staging);
    padded.chunks(padded_row as usize).flat_map(|chunk| &chunk[..row as usize]).copied().collect()
}

/// The bytes of a buffer that can be copied from.
pub(crate) fn read_buffer(device: &RenderDevice, queue: &RenderQueue, buffer: &Buffer) -> Vec<u8> {
    let staging = device.create_buffer(&BufferDescriptor {
        label: Some("smoke_readback"),
        size: buffer.size(),
        usage: BufferUsages::COPY_DST | BufferUsages::MAP_READ,
        mapped_at_creation: false,
    });
    let mut encoder = device.create_command_encoder(&CommandEncoderDescriptor::default());
    encoder.copy_buffer_to_buffer(buffer, 0, &staging, 0, buffer.size());
    queue.submit([encoder.finish()]);
    read_mapped(device, &staging)
}

fn read_mapped(device: &RenderDevice, staging: &Buffer) -> Vec<u8> {
    let slice = staging.slice(..);
    slice.map_async(MapMode::Read, |result| result.expect("a buffer just made can be mapped"));
    device.poll(PollType::wait_indefinitely()).expect("the device answers");
    let bytes = slice.get_mapped_range().to_vec();
    staging.unmap();
    bytes
}
