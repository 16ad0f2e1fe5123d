//! Smoke that nothing was baked of: a compute shader writes its density every frame, and the plug-in lights what it finds.
//!
//! `cargo run --example live`

use bevy::asset::RenderAssetUsages;
use bevy::camera::Exposure;
use bevy::core_pipeline::schedule::camera_driver;
use bevy::prelude::*;
use bevy::render::extract_resource::{ExtractResource, ExtractResourcePlugin};
use bevy::render::render_asset::RenderAssets;
use bevy::render::render_resource::binding_types::{texture_storage_3d, uniform_buffer};
use bevy::render::render_resource::{
    BindGroupEntries, BindGroupLayoutDescriptor, BindGroupLayoutEntries, CachedComputePipelineId,
    ComputePassDescriptor, ComputePipelineDescriptor, Extent3d, PipelineCache, ShaderStages, StorageTextureAccess,
    TextureDimension, TextureFormat, TextureUsages, UniformBuffer,
};
use bevy::render::renderer::{RenderContext, RenderDevice, RenderGraph, RenderQueue};
use bevy::render::texture::GpuImage;
use bevy::render::{RenderApp, RenderStartup};
use bevy_smoke::prelude::*;
use bevy_smoke::render::SmokeSystems;

fn main() {
    App::new().add_plugins((DefaultPlugins, SmokePlugin, VentPlugin)).add_systems(Startup, setup).run();
}

/// Cells of the texture.
const CELLS: UVec3 = UVec3::new(48, 72, 48);
/// Threads of a workgroup along each side; as in the shader.
const WORKGROUP: u32 = 4;

pub fn setup(
    mut commands: Commands,
    mut images: ResMut<Assets<Image>>,
    mut meshes: ResMut<Assets<Mesh>>,
    mut materials: ResMut<Assets<StandardMaterial>>,
) {
    let mut image = Image::new_fill(
        Extent3d { width: CELLS.x, height: CELLS.y, depth_or_array_layers: CELLS.z },
        TextureDimension::D3,
        &[0; 4],
        TextureFormat::R32Float,
        RenderAssetUsages::RENDER_WORLD,
    );
    image.texture_descriptor.usage |= TextureUsages::STORAGE_BINDING;
    let image = images.add(image);
    commands.insert_resource(Vent { seconds: 0.0, image: image.clone() });
    commands.spawn((
        SmokeVolume::live(image),
        SmokeMedium { sigma_t: 8.0, ..default() },
        Transform::from_xyz(0.0, 1.5, 0.0).with_scale(Vec3::splat(3.0)),
    ));

    commands.spawn((
        Mesh3d(meshes.add(Plane3d::default().mesh().size(30.0, 30.0))),
        MeshMaterial3d(materials.add(Color::srgb(0.6, 0.55, 0.5))),
    ));
    commands.spawn((
        DirectionalLight { illuminance: 2000.0, ..default() },
        Transform::default().looking_to(Vec3::new(1.0, -1.2, -0.6), Vec3::Y),
    ));
    let [sky, horizon, ground] =
        [Color::srgb(0.45, 0.6, 0.9), Color::srgb(0.8, 0.75, 0.7), Color::srgb(0.2, 0.17, 0.15)];
    commands.spawn((
        Camera3d::default(),
        Exposure::INDOOR,
        EnvironmentMapLight {
            intensity: 250.0,
            ..EnvironmentMapLight::hemispherical_gradient(&mut images, sky, horizon, ground)
        },
        Transform::from_xyz(0.0, 2.2, 6.0).looking_at(Vec3::Y * 1.2, Vec3::Y),
    ));
}

/// What the compute shader needs to know.
#[derive(Resource, Clone, ExtractResource)]
struct Vent {
    seconds: f32,
    image: Handle<Image>,
}

/// Writes the texture: the part that a game brings.
pub struct VentPlugin;

impl Plugin for VentPlugin {
    fn build(&self, app: &mut App) {
        app.add_plugins(ExtractResourcePlugin::<Vent>::default())
            .add_systems(Update, |time: Res<Time>, mut vent: ResMut<Vent>| vent.seconds = time.elapsed_secs());
        app.sub_app_mut(RenderApp).add_systems(RenderStartup, init_pipeline).add_systems(
            RenderGraph,
            // Smoke reads the texture after it is written.
            blow.before(SmokeSystems::Light).before(camera_driver).run_if(resource_exists::<Vent>),
        );
    }
}

#[derive(Resource)]
struct VentPipeline {
    layout: BindGroupLayoutDescriptor,
    pipeline: CachedComputePipelineId,
}

fn init_pipeline(mut commands: Commands, assets: Res<AssetServer>, cache: Res<PipelineCache>) {
    let entries = BindGroupLayoutEntries::sequential(
        ShaderStages::COMPUTE,
        (uniform_buffer::<f32>(false), texture_storage_3d(TextureFormat::R32Float, StorageTextureAccess::WriteOnly)),
    );
    let layout = BindGroupLayoutDescriptor::new("vent", &entries);
    let pipeline = cache.queue_compute_pipeline(ComputePipelineDescriptor {
        layout: vec![layout.clone()],
        shader: assets.load("live.wgsl"),
        entry_point: Some("blow".into()),
        ..default()
    });
    commands.insert_resource(VentPipeline { layout, pipeline });
}

fn blow(
    vent: Res<Vent>,
    vent_pipeline: Res<VentPipeline>,
    cache: Res<PipelineCache>,
    images: Res<RenderAssets<GpuImage>>,
    device: Res<RenderDevice>,
    queue: Res<RenderQueue>,
    mut ctx: RenderContext,
) {
    let pipeline = cache.get_compute_pipeline(vent_pipeline.pipeline);
    let (Some(pipeline), Some(image)) = (pipeline, images.get(&vent.image)) else { return };
    let mut seconds = UniformBuffer::from(vent.seconds);
    seconds.write_buffer(&device, &queue);
    let bind_group = device.create_bind_group(
        "vent",
        &cache.get_bind_group_layout(&vent_pipeline.layout),
        &BindGroupEntries::sequential((&seconds, &image.texture_view)),
    );
    let mut pass = ctx.command_encoder().begin_compute_pass(&ComputePassDescriptor::default());
    pass.set_pipeline(pipeline);
    pass.set_bind_group(0, &bind_group, &[]);
    pass.dispatch_workgroups(CELLS.x / WORKGROUP, CELLS.y / WORKGROUP, CELLS.z / WORKGROUP);
}
