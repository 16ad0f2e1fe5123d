//! A volume as a light and as the eyes see it: the buffers, bindings and texture that outlive a frame, and the work that
//! brings them up to date.

use std::sync::Arc;

use bevy::platform::collections::HashMap;
use bevy::prelude::*;
use bevy::render::render_resource::encase::internal::WriteInto;
use bevy::render::render_resource::{
    BindGroup, Buffer, BufferDescriptor, BufferId, BufferUsages, CommandEncoderDescriptor, ShaderType, TextureView,
    UniformBuffer,
};
use bevy::render::renderer::RenderDevice;
use bevy::render::view::RetainedViewEntity;

use super::debug::Step;
use super::diffusion::{self, DiffusionJob, DiffusionUniform};
use super::frame::{FILTERED_FORMAT, GpuSmokeFrame, texture_3d};
use super::incident_light::{COLUMN_BYTES, ESCAPE_BYTES, IncidentLightJob, PROBE_BYTES};
use super::lighting::LightingUniform;
use super::outgoing::{LookUniform, OUTGOING_BYTES, SHADE_BYTES};
use super::pair_matrix::ROW_BYTES;
#[cfg(feature = "reference")]
use super::paper::{PaperLight, PaperSlice};
use super::pass::Job;
use super::prepare::Gpu;
use super::scattering::{self, CONTROL_BYTES, SOURCE_BYTES, STATE_BYTES, SWEEPS, ScatteringJob, StepUniform};
use super::surroundings::Surroundings;
use super::view::SmokeUniform;
use super::{SmokeWork, incident_light, outgoing, pair_matrix, volume};
use crate::debug::SmokeDebugView;
use crate::density::GridShape;
#[cfg(feature = "reference")]
use crate::paper::SmokePaper;
use crate::quality::SmokeModel;
use crate::scattering::{ScatteringChoice, ScatteringSolver};

/// A volume lit by an environment and lamps.
pub(super) struct LitVolume {
    frame: BufferId,
    /// The frame's, when it was lit.
    frame_version: u32,
    /// Whether light that scatters more than once is drawn, and why.
    pub choice: ScatteringChoice,
    environment: BufferId,
    environment_version: u32,
    /// What it was lit with.
    effort: Effort,
    uniform: Cached<LightingUniform>,
    /// The radiance that 1 stands for in it.
    unit: f32,
    light: LightBuffers,
    incident_light: BindGroup,
    around: AroundBuffers,
    /// Of the surroundings, when it was lit.
    surroundings_version: u32,
    transport: Option<Transport>,
    diffusion: Option<Diffusion>,
    /// What is drawn of it.
    debug: SmokeDebugView,
    /// Lit by this alone, in the place of the others.
    #[cfg(feature = "reference")]
    paper: Option<PaperLight>,
    /// Counts the changes.
    version: u32,
    /// The frame in which it was lit.
    lit_at: u32,
    /// Whether something has changed since that it has yet to be lit for.
    is_pending: bool,
    pub last_used: u32,
    pub sliced: HashMap<Option<RetainedViewEntity>, SlicedVolume>,
}

/// What tells what is around the volume.
struct AroundBuffers {
    surroundings: Buffer,
    spheres: Buffer,
    densities: TextureView,
}

impl AroundBuffers {
    fn new(light: &FrameLight) -> Self {
        Self {
            surroundings: light.surroundings.uniform.buffer().clone(),
            spheres: light.surroundings.spheres.clone(),
            densities: light.densities.clone(),
        }
    }

    fn is_of(&self, light: &FrameLight) -> bool {
        let FrameLight { surroundings, densities, .. } = light;
        self.surroundings.id() == surroundings.uniform.buffer().id()
            && self.spheres.id() == surroundings.spheres.id()
            && self.densities.id() == densities.id()
    }
}

/// How much a volume's light is computed with; nothing before it is first lit.
#[derive(Clone, Copy, Default, PartialEq)]
struct Effort {
    directions: u32,
    sweeps: u32,
    probes: u32,
    light_coefficients: u32,
    coefficients: u32,
}

impl Effort {
    fn new(light: &FrameLight) -> Self {
        let LightingUniform { probes, light_coefficients, coefficients, .. } = light.uniform;
        let SmokeModel { directions, sweeps, .. } = light.model;
        Self { directions, sweeps, probes, light_coefficients, coefficients }
    }
}

/// The light at the probes, and what the RBFs see of each other.
struct LightBuffers {
    probes: Buffer,
    escapes: Buffer,
    columns: Buffer,
    gathered: Buffer,
    rows: Buffer,
}

/// What light that scatters more than once takes.
struct Transport {
    pair_matrix: BindGroup,
    /// Extinction, coefficients and the frame's version that the matrix was made with.
    matrix_of: Option<(f32, u32, u32)>,
    /// The solutions, of which the first is where the next solve starts.
    states: Buffer,
    steps: [Cached<StepUniform>; SWEEPS as usize + 1],
    #[cfg_attr(not(feature = "cli"), expect(dead_code, reason = "only tools read back what the solver did"))]
    control: Buffer,
    bind_groups: Arc<scattering::BindGroups>,
}

/// The same by diffusion.
struct Diffusion {
    shape: GridShape,
    uniform: Cached<DiffusionUniform>,
    solution: Buffer,
    #[cfg_attr(not(feature = "cli"), expect(dead_code, reason = "only tools read back what the solver did"))]
    control: Buffer,
    bind_groups: Arc<diffusion::BindGroups>,
}

/// A lit volume as an eye sees it: its 3D texture.
pub(super) struct SlicedVolume {
    look: Cached<LookUniform>,
    lit_version: u32,
    pub texture: TextureView,
    outgoing: BindGroup,
    volume: BindGroup,
    #[cfg(feature = "reference")]
    paper: Option<PaperSlice>,
    pub last_used: u32,
    pub seen: HashMap<RetainedViewEntity, SeenVolume>,
}

/// A 3D texture as one view draws it.
pub(super) struct SeenVolume {
    uniform: Cached<SmokeUniform>,
    bind_group: BindGroup,
    pub last_used: u32,
}

/// A uniform buffer that knows what is in it.
pub(super) struct Cached<T: ShaderType + WriteInto + Clone + PartialEq> {
    value: T,
    buffer: UniformBuffer<T>,
}

impl<T: ShaderType + WriteInto + Clone + PartialEq> Cached<T> {
    pub fn new(value: T, gpu: &Gpu) -> Self {
        let mut buffer = UniformBuffer::from(value.clone());
        buffer.write_buffer(gpu.device, gpu.queue);
        Self { value, buffer }
    }

    /// Whether it is another value.
    pub fn differs(&self, value: &T) -> bool {
        self.value != *value
    }

    /// Stores a value; whether it is another than before.
    pub fn set(&mut self, value: T, gpu: &Gpu) -> bool {
        if self.value == value {
            return false;
        }
        self.buffer.set(value.clone());
        self.buffer.write_buffer(gpu.device, gpu.queue);
        self.value = value;
        true
    }

    pub fn value(&self) -> &T {
        &self.value
    }

    pub fn buffer(&self) -> &Buffer {
        self.buffer.buffer().expect("written when it was made")
    }
}

/// A volume's light in a frame, ready for the GPU.
pub(super) struct FrameLight<'a> {
    /// The environment's coefficients, and how often they have changed.
    pub coefficients: &'a Buffer,
    pub environment_version: u32,
    pub uniform: LightingUniform,
    /// The radiance that 1 stands for in it.
    pub unit: f32,
    pub surroundings: &'a Surroundings,
    /// The densities of all casters.
    pub densities: &'a TextureView,
    pub choice: ScatteringChoice,
    /// How it is solved for.
    pub solver: ScatteringSolver,
    pub tolerance: f32,
    pub model: SmokeModel,
    pub debug: SmokeDebugView,
    #[cfg(feature = "reference")]
    pub paper: Option<SmokePaper>,
}

impl LitVolume {
    pub fn new(frame: &GpuSmokeFrame, light: &FrameLight, gpu: &Gpu) -> Self {
        let buffer = |label, bytes| storage_buffer(gpu.device, label, u64::from(frame.rbf_capacity) * bytes);
        let buffers = LightBuffers {
            probes: buffer("smoke_probes", PROBE_BYTES),
            escapes: buffer("smoke_escapes", ESCAPE_BYTES),
            columns: buffer("smoke_lamp_columns", COLUMN_BYTES),
            gathered: buffer("smoke_gathered", 16 * 16),
            rows: buffer("smoke_pair_rows", ROW_BYTES),
        };
        let uniform = Cached::new(light.uniform.clone(), gpu);
        let around = AroundBuffers::new(light);
        let bindings = incident_light::Bindings {
            frame,
            lighting: uniform.buffer(),
            environment: light.coefficients,
            sampler: gpu.sampler,
            probes: &buffers.probes,
            escapes: &buffers.escapes,
            columns: &buffers.columns,
            surroundings: &around.surroundings,
            spheres: &around.spheres,
            densities: &around.densities,
        };
        #[cfg(feature = "reference")]
        let paper = light.paper.map(|settings| {
            let from_bundle = light.uniform.environment_from_bundle;
            PaperLight::new(settings, frame, uniform.buffer(), from_bundle, light.coefficients, gpu)
        });
        Self {
            #[cfg(feature = "reference")]
            paper,
            incident_light: incident_light::bind(&gpu.passes.incident_light, bindings, gpu.device, gpu.cache),
            frame: frame.uniform.id(),
            frame_version: frame.version,
            choice: light.choice,
            environment: light.coefficients.id(),
            // Older than any environment: lit at the first look.
            environment_version: 0,
            effort: Effort::default(),
            uniform,
            unit: light.unit,
            light: buffers,
            around,
            surroundings_version: light.surroundings.version,
            transport: None,
            diffusion: None,
            debug: light.debug,
            version: 0,
            lit_at: 0,
            is_pending: false,
            last_used: 0,
            sliced: HashMap::default(),
        }
    }

    /// Whether this is of the frame's buffers, and of coefficients that have not been let go since.
    pub fn is_of(&self, frame: &GpuSmokeFrame, light: &FrameLight) -> bool {
        let same = self.frame == frame.uniform.id()
            && self.environment == light.coefficients.id()
            && self.around.is_of(light)
            && self.debug == light.debug;
        #[cfg(feature = "reference")]
        let same = same && self.paper.is_some() == light.paper.is_some();
        same
    }

    /// Starts solving where that of other buffers has ended.
    pub fn follow(&mut self, before: &Self, frame: &GpuSmokeFrame, gpu: &Gpu) {
        self.transport = before.transport.as_ref().map(|before| {
            let transport = Transport::new(frame, &self.uniform, &self.light, gpu);
            before.hand_on(&transport, gpu);
            transport
        });
        // On the same cells the solution goes on as it is.
        let same_cells = |before: &&Diffusion| before.shape == frame.shape;
        self.diffusion = before.diffusion.as_ref().filter(same_cells).map(|before| {
            let (uniform, solution) = (before.uniform.value.clone(), before.solution.clone());
            Diffusion::new(frame, uniform, solution, &self.uniform, &self.light, gpu)
        });
        #[cfg(feature = "reference")]
        if let (Some(paper), Some(before)) = (&self.paper, &before.paper) {
            before.hand_on(paper, gpu);
        }
    }

    pub fn update(&mut self, frame: &GpuSmokeFrame, light: FrameLight, now: u32, gpu: &Gpu, work: &mut SmokeWork) {
        self.last_used = now;
        self.choice = light.choice;
        let (sigma, coefficients) = (light.uniform.sigma_mean, light.uniform.coefficients);
        #[cfg(feature = "reference")]
        let environment_from_bundle = light.uniform.environment_from_bundle;
        let effort = Effort::new(&light);
        let moved = self.frame_version != frame.version;
        self.frame_version = frame.version;
        let mut changed = self.uniform.differs(&light.uniform)
            | moved
            | self.is_pending
            | (self.effort != effort)
            | (self.surroundings_version != light.surroundings.version)
            | (self.environment_version != light.environment_version);
        #[cfg(feature = "reference")]
        if let (Some(paper), Some(settings)) = (&mut self.paper, light.paper) {
            self.uniform.set(light.uniform, gpu);
            self.unit = light.unit;
            changed |= paper.set(settings, light.choice.multiple, environment_from_bundle, gpu);
            if changed {
                self.environment_version = light.environment_version;
                self.surroundings_version = light.surroundings.version;
                self.effort = effort;
                self.version += 1;
                paper.light(frame, work);
            }
            return;
        }
        if coefficients == 0 {
            self.transport = None;
        } else {
            let transport =
                self.transport.get_or_insert_with(|| Transport::new(frame, &self.uniform, &self.light, gpu));
            for (step, value) in transport.steps.iter_mut().zip(StepUniform::all(light.tolerance)) {
                changed |= step.set(value, gpu);
            }
            changed |= transport.matrix_of != Some((sigma, coefficients, frame.version));
        }
        if light.choice.multiple && light.solver == ScatteringSolver::Diffusion {
            let uniform = DiffusionUniform::new(frame.shape, light.tolerance);
            changed |= self.diffusion.is_none();
            let diffusion = self.diffusion.get_or_insert_with(|| {
                let solution = diffusion::solution_buffer(frame.shape, gpu.device);
                Diffusion::new(frame, uniform.clone(), solution, &self.uniform, &self.light, gpu)
            });
            changed |= diffusion.uniform.set(uniform, gpu);
        } else {
            changed |= self.diffusion.take().is_some();
        }
        // What has been lit with another effort does not fit: neither has what was never lit.
        let is_due = self.effort != effort || now.wrapping_sub(self.lit_at) >= light.model.lighting_interval;
        self.is_pending = changed && !is_due;
        if self.is_pending {
            // Density does not wait for light.
            self.version += u32::from(moved);
            return;
        }
        // Until then, nothing that light is computed from changes; where nothing else does, radiance is linear in the unit.
        self.uniform.set(light.uniform, gpu);
        self.unit = light.unit;
        if changed {
            self.environment_version = light.environment_version;
            self.surroundings_version = light.surroundings.version;
            self.effort = effort;
            self.lit_at = now;
            self.version += 1;
            let Effort { directions, sweeps, probes, .. } = effort;
            let workgroups = incident_light::workgroups(frame, probes, directions);
            let job = Job { bind_group: self.incident_light.clone(), workgroups };
            work.incident_light.push(IncidentLightJob { directions, job });
            if let Some(transport) = &mut self.transport {
                let matrix_of = Some((sigma, coefficients, frame.version));
                if transport.matrix_of != matrix_of {
                    transport.matrix_of = matrix_of;
                    let bind_group = transport.pair_matrix.clone();
                    work.pair_matrix.push(Job { bind_group, workgroups: pair_matrix::workgroups(frame) });
                }
                let cycles = sweeps / SWEEPS;
                let bind_groups = transport.bind_groups.clone();
                let (rbf_count, rbf_capacity) = (frame.rbf_count, frame.rbf_capacity);
                work.scattering.push(ScatteringJob { bind_groups, rbf_count, rbf_capacity, coefficients, cycles });
            }
            if let Some(diffusion) = &self.diffusion {
                let bind_groups = diffusion.bind_groups.clone();
                work.diffusion.push(DiffusionJob { bind_groups, rbf_count: frame.rbf_count });
            }
        }
    }

    /// What it has been lit by, and the radiance that 1 stands for.
    pub fn lit_by(&self) -> (&LightingUniform, f32) {
        (self.uniform.value(), self.unit)
    }

    /// The 3D texture for a view, or for all.
    pub fn slice(
        &mut self,
        view: Option<RetainedViewEntity>,
        eye: Vec4,
        frame: &GpuSmokeFrame,
        now: u32,
        gpu: &Gpu,
        work: &mut SmokeWork,
    ) -> &mut SlicedVolume {
        let lit = &*self;
        let version = lit.version;
        if !lit.sliced.contains_key(&view) {
            let sliced = SlicedVolume::new(eye, frame, lit, gpu);
            self.sliced.insert(view, sliced);
        }
        let sliced = self.sliced.get_mut(&view).expect("just inserted where it was missing");
        sliced.last_used = now;
        let changed = sliced.look.set(LookUniform { eye }, gpu) | (sliced.lit_version != version);
        if changed {
            sliced.lit_version = version;
            #[cfg(feature = "reference")]
            if let Some(paper) = &sliced.paper {
                paper.look(frame, work);
                return sliced;
            }
            let leave = Job { bind_group: sliced.outgoing.clone(), workgroups: outgoing::workgroups(frame) };
            let bind_group = sliced.volume.clone();
            let reconstruct = Job { bind_group, workgroups: volume::workgroups(frame.shape) };
            if let Some(step) = Step::of_field(self.debug) {
                work.debug.push((step, reconstruct));
            } else if self.debug == SmokeDebugView::Multiple {
                work.debug.extend([(Step::Outgoing, leave), (Step::Volume, reconstruct)]);
            } else {
                work.outgoing.push(leave);
                work.volume.push(reconstruct);
            }
        }
        sliced
    }

    /// The solver's report, where there is a solver.
    #[cfg(feature = "cli")]
    pub fn control(&self) -> Option<&Buffer> {
        let transport = self.transport.as_ref().map(|transport| &transport.control);
        transport.or(self.diffusion.as_ref().map(|diffusion| &diffusion.control))
    }
}

impl Transport {
    fn new(frame: &GpuSmokeFrame, lighting: &Cached<LightingUniform>, light: &LightBuffers, gpu: &Gpu) -> Self {
        let count = u64::from(frame.rbf_capacity);
        let buffer = |label, bytes| storage_buffer(gpu.device, label, bytes);
        let matrix = buffer("smoke_pair_matrix", 4 * count * count);
        let sources = buffer("smoke_scattering_sources", count * SOURCE_BYTES);
        let states = buffer("smoke_scattering_states", count * STATE_BYTES);
        let control = buffer("smoke_scattering_control", CONTROL_BYTES);
        let steps = StepUniform::all(0.0).map(|step| Cached::new(step, gpu));
        let step_buffers = steps.each_ref().map(|step| step.buffer().clone());
        let bindings = scattering::Bindings {
            frame,
            lighting: lighting.buffer(),
            footprints: gpu.footprints,
            steps: &step_buffers,
            probes: &light.probes,
            escapes: &light.escapes,
            columns: &light.columns,
            matrix: &matrix,
            rows: &light.rows,
            sources: &sources,
            states: &states,
            gathered: &light.gathered,
            control: &control,
        };
        let relate = pair_matrix::Bindings {
            frame,
            lighting: lighting.buffer(),
            footprints: gpu.footprints,
            sampler: gpu.sampler,
            matrix: &matrix,
            rows: &light.rows,
        };
        Self {
            pair_matrix: pair_matrix::bind(&gpu.passes.pair_matrix, relate, gpu.device, gpu.cache),
            matrix_of: None,
            bind_groups: Arc::new(gpu.passes.scattering.bind(&bindings, gpu.device, gpu.cache)),
            steps,
            states,
            control,
        }
    }

    /// Lets another start solving where this has ended; RBFs are known by their place in the list.
    fn hand_on(&self, next: &Self, gpu: &Gpu) {
        // The first of the solutions comes first.
        let solution = |buffer: &Buffer| buffer.size() / (u64::from(SWEEPS) + 1);
        copy_start(&self.states, &next.states, solution(&self.states).min(solution(&next.states)), gpu);
    }
}

impl Diffusion {
    fn new(
        frame: &GpuSmokeFrame,
        uniform: DiffusionUniform,
        solution: Buffer,
        lighting: &Cached<LightingUniform>,
        light: &LightBuffers,
        gpu: &Gpu,
    ) -> Self {
        let uniform = Cached::new(uniform, gpu);
        let control = diffusion::control_buffer(gpu.device);
        let bindings = diffusion::Bindings {
            frame,
            lighting: lighting.buffer(),
            diffusion: uniform.buffer(),
            sampler: gpu.sampler,
            probes: &light.probes,
            columns: &light.columns,
            solution: &solution,
            control: &control,
        };
        let bind_groups = Arc::new(bindings.bind(frame.shape, &gpu.passes.diffusion, gpu.device, gpu.cache));
        Self { shape: frame.shape, bind_groups, uniform, solution, control }
    }
}

impl SlicedVolume {
    fn new(eye: Vec4, frame: &GpuSmokeFrame, lit: &LitVolume, gpu: &Gpu) -> Self {
        let buffer = |label, bytes| storage_buffer(gpu.device, label, u64::from(frame.rbf_capacity) * bytes);
        let outgoing = buffer("smoke_outgoing", OUTGOING_BYTES);
        let shades = buffer("smoke_shades", SHADE_BYTES);
        let texture = texture_3d(gpu.device, "smoke_volume", frame.shape.dims + 2, FILTERED_FORMAT);
        let look = Cached::new(LookUniform { eye }, gpu);
        let leave = outgoing::Bindings {
            frame,
            lighting: lit.uniform.buffer(),
            look: look.buffer(),
            probes: &lit.light.probes,
            escapes: &lit.light.escapes,
            gathered: &lit.light.gathered,
            rows: &lit.light.rows,
            columns: &lit.light.columns,
            outgoing: &outgoing,
            shades: &shades,
        };
        let reconstruct = volume::Bindings {
            frame,
            lighting: lit.uniform.buffer(),
            look: look.buffer(),
            outgoing: &outgoing,
            shades: &shades,
            volume: &texture,
            surroundings: &lit.around.surroundings,
            spheres: &lit.around.spheres,
        };
        Self {
            #[cfg(feature = "reference")]
            paper: lit.paper.as_ref().map(|light| PaperSlice::new(frame, look.buffer(), light, &texture, gpu)),
            outgoing: outgoing::bind(&gpu.passes.outgoing, leave, gpu.device, gpu.cache),
            volume: match (Step::of_field(lit.debug), gpu.debug) {
                (Some(step), Some(passes)) => passes.bind_field(step, frame, &texture, gpu.device, gpu.cache),
                _ => volume::bind(&gpu.passes.volume, reconstruct, gpu.device, gpu.cache),
            },
            look,
            // Older than any lit volume.
            lit_version: 0,
            texture,
            last_used: 0,
            seen: HashMap::default(),
        }
    }

    /// What a view binds to draw it.
    pub fn see(&mut self, view: RetainedViewEntity, uniform: SmokeUniform, now: u32, gpu: &Gpu) -> BindGroup {
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

/// Copies the first bytes of a buffer to another, before this frame's passes.
pub(super) fn copy_start(from: &Buffer, to: &Buffer, bytes: u64, gpu: &Gpu) {
    let mut encoder = gpu.device.create_command_encoder(&CommandEncoderDescriptor { label: Some("smoke_hand_on") });
    encoder.copy_buffer_to_buffer(from, 0, to, 0, bytes);
    gpu.queue.submit([encoder.finish()]);
}

/// A buffer of zeros that passes write and tools can read back.
pub(super) fn storage_buffer(device: &RenderDevice, label: &str, size: u64) -> Buffer {
    let usage = BufferUsages::STORAGE | BufferUsages::COPY_SRC | BufferUsages::COPY_DST;
    device.create_buffer(&BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false })
}
