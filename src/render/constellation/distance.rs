//! Distance pass: density → distance to smoke of every cell of the padded grid, beside the density, in the texture that the
//! view pass marches. Three sweeps, an axis each. Runs after the density pass, for moments that are new.

use bevy::prelude::*;
use bevy::render::render_resource::binding_types::{
    texture_3d as texture_3d_entry, texture_storage_3d, uniform_buffer,
};
use bevy::render::render_resource::{
    BindGroupLayoutEntries, BufferId, PipelineCache, ShaderStages, StorageTextureAccess, TextureSampleType, TextureView,
};
use bevy::render::renderer::RenderDevice;
use bevy::shader::Shader;

use super::ConstellationWork;
use crate::render::frame::{DENSITY_FORMAT, FILTERED_FORMAT, FrameUniform, GpuSmokeFrame, texture_3d};
use crate::render::pass::{ComputePass, Job, workgroups};

/// Name of the pass and its GPU span.
pub const LABEL: &str = "smoke_constellation_distance";

/// The sweeps along X, Y and Z.
pub(in crate::render) struct DistancePass([ComputePass; 3]);

impl DistancePass {
    pub fn new(shader: &Handle<Shader>, cache: &PipelineCache) -> Self {
        let read = || texture_3d_entry(TextureSampleType::Float { filterable: false });
        let write = |format| texture_storage_3d(format, StorageTextureAccess::WriteOnly);
        let frame = || uniform_buffer::<FrameUniform>(false);
        let compute = ShaderStages::COMPUTE;
        let first = BindGroupLayoutEntries::sequential(compute, (frame(), read(), write(DENSITY_FORMAT)));
        let middle = BindGroupLayoutEntries::sequential(compute, (frame(), read(), read(), write(DENSITY_FORMAT)));
        let last = BindGroupLayoutEntries::sequential(compute, (frame(), read(), read(), write(FILTERED_FORMAT)));
        let sweep = |layout: &[_], defs| ComputePass::new(LABEL, layout, shader, "sweep", defs, cache);
        Self([sweep(&first, vec!["FIRST".into()]), sweep(&middle, vec![]), sweep(&last, vec!["LAST".into()])])
    }

    pub fn passes(&self) -> [&ComputePass; 3] {
        self.0.each_ref()
    }
}

/// Distance and density of a moment on the GPU.
pub(in crate::render) struct DistanceMap {
    /// Red: distance to smoke in cells; alpha: scaled density. Padded by a cell on each side.
    pub texture: TextureView,
    pub jobs: [Job; 3],
    /// The moment's uniform, which is new where its RBFs had outgrown it.
    frame: BufferId,
    /// The moment's, when it was made.
    version: Option<u32>,
    pub last_used: u32,
}

impl DistanceMap {
    pub fn new(moment: &GpuSmokeFrame, passes: &DistancePass, device: &RenderDevice, cache: &PipelineCache) -> Self {
        let padded = moment.shape.dims + 2;
        let distances =
            ["smoke_distance_x", "smoke_distance_xy"].map(|label| texture_3d(device, label, padded, DENSITY_FORMAT));
        let texture = texture_3d(device, "smoke_distance", padded, FILTERED_FORMAT);
        let (frame, density) = (moment.uniform.as_entire_binding(), &moment.density);
        let [first, middle, last] = passes.passes();
        let bind_groups = [
            first.bind(device, cache, (frame.clone(), density, &distances[0])),
            middle.bind(device, cache, (frame.clone(), density, &distances[0], &distances[1])),
            last.bind(device, cache, (frame, density, &distances[1], &texture)),
        ];
        let workgroups = workgroups(padded, UVec3::splat(4));
        let jobs = bind_groups.map(|bind_group| Job { bind_group, workgroups });
        Self { texture, jobs, frame: moment.uniform.id(), version: None, last_used: 0 }
    }

    /// Whether this is of the moment's buffers.
    pub fn is_of(&self, moment: &GpuSmokeFrame) -> bool {
        self.frame == moment.uniform.id()
    }

    /// Lists the work where the moment is another.
    pub fn update(&mut self, moment: &GpuSmokeFrame, now: u32, work: &mut ConstellationWork) {
        self.last_used = now;
        if self.version != Some(moment.version) {
            self.version = Some(moment.version);
            work.distance.push(self.jobs.clone());
        }
    }

    /// Counts the changes.
    pub fn version(&self) -> u32 {
        self.version.unwrap_or(0)
    }
}
