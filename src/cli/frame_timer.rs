//! What a frame takes: GPU milliseconds by the GPU's own timestamps, or the clock's, where a CPU draws.

use std::time::{Duration, Instant};

use bevy::prelude::*;
use bevy::render::RenderApp;
use bevy::render::render_resource::TextureFormat;
use bevy::render::renderer::{
    RenderAdapterInfo, RenderContext, RenderDevice, RenderGraph, RenderGraphSystems, RenderQueue,
};
use wgpu::{
    BindGroup, BindGroupDescriptor, BindGroupEntry, Buffer, BufferDescriptor, BufferUsages, ComputePassDescriptor,
    ComputePipeline, ComputePipelineDescriptor, DeviceType, Features, MapMode, PollType, QuerySet, QuerySetDescriptor,
    QueryType,
};

use crate::cli::render::median;
use crate::headless::{Headless, HeadlessError};

/// Frames are timed for so long, at least, where they are short: a GPU is as fast as it gets only after a while.
const SHORT: Duration = Duration::from_millis(300);
/// And for no longer than about this.
const LONG: Duration = Duration::from_secs(4);
/// Frames without smoke.
const EMPTY_FRAMES: u32 = 9;
/// Frames until what has been spawned is drawn.
const ARRIVAL: u32 = 4;
/// Workgroups that warm up.
const WARM_UP: u32 = 64;
/// Threads of one.
const THREADS: u32 = 64;
/// Bytes of two timestamps.
const BYTES: u64 = 16;

/// Measures every frame on the GPU, from before its first command to after its last. A GPU that waits for the CPU most of the
/// time clocks down, several times as slow as it is in a game: so that it does not, it is kept busy before each frame.
///
/// Does nothing on a CPU driver, whose timestamps say nothing of when work is done, and where there are no timestamps.
struct FrameTimerPlugin;

impl Plugin for FrameTimerPlugin {
    fn build(&self, _: &mut App) {}

    fn finish(&self, app: &mut App) {
        let Some(render_app) = app.get_sub_app_mut(RenderApp) else { return };
        let world = render_app.world();
        let device = world.resource::<RenderDevice>();
        let is_gpu = world.resource::<RenderAdapterInfo>().device_type != DeviceType::Cpu;
        let needed = Features::TIMESTAMP_QUERY | Features::TIMESTAMP_QUERY_INSIDE_ENCODERS;
        if !is_gpu || !device.features().contains(needed) {
            return;
        }
        let timer = GpuTimer::new(device.wgpu_device(), world.resource::<RenderQueue>().get_timestamp_period());
        render_app.insert_resource(timer.clone()).add_systems(
            RenderGraph,
            (
                begin.in_set(RenderGraphSystems::Begin),
                end.after(RenderGraphSystems::Render).before(RenderGraphSystems::Submit),
            ),
        );
        app.insert_resource(timer);
    }
}

/// A windowless app whose frames are timed.
pub struct TimedApp {
    pub headless: Headless,
    /// Of a frame without smoke, once measured.
    empty_ms: Option<f64>,
}

impl TimedApp {
    /// For pictures of such a size.
    pub fn new(size: UVec2) -> Result<Self, HeadlessError> {
        let folder = AssetPlugin::default().file_path;
        let headless = Headless::with_plugins(size, TextureFormat::Rgba16Float, folder, |app| {
            app.add_plugins(FrameTimerPlugin);
        })?;
        Ok(Self { headless, empty_ms: None })
    }

    /// The name of what draws.
    pub fn adapter(&self) -> String {
        self.headless.app.world().resource::<RenderAdapterInfo>().name.clone()
    }

    /// Whether frames are timed by the GPU.
    pub fn on_gpu(&self) -> bool {
        self.headless.app.world().contains_resource::<GpuTimer>()
    }

    pub fn world_mut(&mut self) -> &mut World {
        self.headless.app.world_mut()
    }

    /// Draws a frame, to its end: milliseconds, of the GPU where it [says them](Self::on_gpu).
    pub fn frame(&mut self) -> f64 {
        let start = Instant::now();
        self.headless.app.update();
        self.headless.wait();
        let clock = 1e3 * start.elapsed().as_secs_f64();
        let world = self.headless.app.world();
        world
            .get_resource::<GpuTimer>()
            .map_or(clock, |timer| timer.read(world.resource::<RenderDevice>().wgpu_device()))
    }

    /// Draws so many frames.
    pub fn draw(&mut self, frames: u32) {
        for _ in 0..frames {
            self.frame();
        }
    }

    /// Draws what has been spawned for the first time: assets have to reach the GPU, pipelines to be made.
    pub fn arrive(&mut self) {
        self.draw(ARRIVAL);
    }

    /// Despawns what is there, and lets go of it before the next one comes.
    pub fn clear(&mut self, entities: impl IntoIterator<Item = Entity>) {
        for entity in entities {
            self.world_mut().despawn(entity);
        }
        self.draw(2);
    }

    /// Measures what a frame takes without smoke, the first time that it is asked to: there is a camera, and nothing else.
    pub fn measure_empty(&mut self) {
        if self.empty_ms.is_none() {
            self.empty_ms = Some(self.median_frame(EMPTY_FRAMES, |_, _| ()));
        }
    }

    /// What the smoke adds to a frame, by the median of frames before each of which the world is stirred: of `frames` at least,
    /// more where they are short, fewer where they take seconds.
    pub fn smoke_ms(&mut self, frames: u32, stir: impl FnMut(&mut World, u32)) -> f64 {
        let ms = self.median_frame(frames, stir);
        (ms - self.empty_ms.unwrap_or_default()).max(1e-3)
    }

    fn median_frame(&mut self, frames: u32, mut stir: impl FnMut(&mut World, u32)) -> f64 {
        let (mut times, started) = (Vec::new(), Instant::now());
        for i in 0.. {
            stir(self.world_mut(), i);
            times.push(self.frame());
            if started.elapsed() > if i < frames { LONG } else { SHORT } {
                break;
            }
        }
        // The first are of what came before, too.
        if times.len() > 1 {
            times.drain(..times.len().div_ceil(4));
        }
        median(times).unwrap_or_default()
    }
}

/// Handles of what measures, in both worlds.
#[derive(Resource, Clone)]
struct GpuTimer {
    queries: QuerySet,
    resolved: Buffer,
    read: Buffer,
    /// Nanoseconds of a tick.
    period: f32,
    warm_up: ComputePipeline,
    bind_group: BindGroup,
}

impl GpuTimer {
    fn new(device: &wgpu::Device, period: f32) -> Self {
        let label = Some("frame_timer");
        let buffer =
            |size, usage| device.create_buffer(&BufferDescriptor { label, size, usage, mapped_at_creation: false });
        let warm_up = device.create_compute_pipeline(&ComputePipelineDescriptor {
            label,
            layout: None,
            module: &device.create_shader_module(wgpu::include_wgsl!("frame_timer.wgsl")),
            entry_point: Some("warm_up"),
            compilation_options: default(),
            cache: None,
        });
        let sums = buffer(u64::from(4 * WARM_UP * THREADS), BufferUsages::STORAGE);
        Self {
            queries: device.create_query_set(&QuerySetDescriptor { label, ty: QueryType::Timestamp, count: 2 }),
            resolved: buffer(BYTES, BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC),
            read: buffer(BYTES, BufferUsages::COPY_DST | BufferUsages::MAP_READ),
            period,
            bind_group: device.create_bind_group(&BindGroupDescriptor {
                label,
                layout: &warm_up.get_bind_group_layout(0),
                entries: &[BindGroupEntry { binding: 0, resource: sums.as_entire_binding() }],
            }),
            warm_up,
        }
    }

    /// Milliseconds of the frame before.
    fn read(&self, device: &wgpu::Device) -> f64 {
        self.read.slice(..).map_async(MapMode::Read, |result| result.expect("it can be mapped"));
        device.poll(PollType::wait_indefinitely()).expect("the device answers");
        let bytes = self.read.slice(..).get_mapped_range().to_vec();
        self.read.unmap();
        let [begin, end] = [0, 8].map(|at| u64::from_le_bytes(core::array::from_fn(|i| bytes[at + i])));
        end.saturating_sub(begin) as f64 * f64::from(self.period) * 1e-6
    }
}

fn begin(timer: Res<GpuTimer>, mut ctx: RenderContext) {
    let encoder = ctx.command_encoder();
    let mut pass = encoder.begin_compute_pass(&ComputePassDescriptor { label: Some("warm_up"), ..default() });
    pass.set_pipeline(&timer.warm_up);
    pass.set_bind_group(0, &timer.bind_group, &[]);
    pass.dispatch_workgroups(WARM_UP, 1, 1);
    drop(pass);
    encoder.write_timestamp(&timer.queries, 0);
}

fn end(timer: Res<GpuTimer>, mut ctx: RenderContext) {
    let encoder = ctx.command_encoder();
    encoder.write_timestamp(&timer.queries, 1);
    encoder.resolve_query_set(&timer.queries, 0..2, &timer.resolved, 0);
    encoder.copy_buffer_to_buffer(&timer.resolved, 0, &timer.read, 0, BYTES);
}
