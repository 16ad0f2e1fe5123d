//! Casters: the volumes whose smoke shades meshes and other smoke, seen or not, and the texture that holds their coarse
//! densities side by side, so that a pass can look through all of them.

use bevy::platform::collections::HashMap;
use bevy::prelude::*;
use bevy::render::diagnostic::RecordDiagnostics;
use bevy::render::render_resource::{
    Extent3d, Origin3d, ShaderType, TexelCopyTextureInfo, TextureAspect, TextureDescriptor, TextureDimension,
    TextureUsages, TextureView, TextureViewDescriptor, TextureViewId,
};
use bevy::render::renderer::{RenderContext, RenderDevice};
use bevy::render::sync_world::MainEntity;

use super::SmokeWork;
use super::frame::{FILTERED_FORMAT, GpuSmokeFrame};
use super::placed::Placed;
use crate::density::COARSE_CELLS;

/// Casters at once, at most; as in `casters.wgsl`.
pub(super) const MAX_CASTERS: usize = 8;
/// Texels a side of a caster's place: the coarse grid with a texel of padding on each side; as in `casters.wgsl`.
const SLOT_SIDE: u32 = COARSE_CELLS + 2;

/// Name of the copies' GPU span.
const LABEL: &str = "smoke_casters";

/// The `Caster` of `casters.wgsl`.
#[derive(ShaderType, Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct CasterUniform {
    pub bundle_from_here: Mat4,
    pub half_extent: Vec3,
    pub sigma: f32,
    pub padded: Vec3,
    pub texel: f32,
    pub slot: u32,
}

/// A caster in this frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct Caster {
    pub entity: MainEntity,
    /// Its `bundle_from_here` is from the world.
    pub uniform: CasterUniform,
    /// Counts the changes of what its slot holds.
    pub version: u32,
}

/// The casters' densities, and who has which slot.
#[derive(Default)]
pub(super) struct Casters {
    densities: Option<TextureView>,
    slots: HashMap<MainEntity, Slot>,
    /// Those of this frame.
    pub current: Vec<Caster>,
}

struct Slot {
    index: u32,
    /// The density and its version that were copied last.
    copied: Option<(TextureViewId, u32)>,
    version: u32,
}

/// A coarse density to be copied to its slot.
pub(crate) struct Copy {
    from: TextureView,
    to: TextureView,
    slot: u32,
}

impl Casters {
    /// Starts a frame in which these volumes cast shadows, at most [`MAX_CASTERS`].
    pub fn begin(&mut self, casting: &[MainEntity], device: &RenderDevice) {
        self.current.clear();
        self.slots.retain(|entity, _| casting.contains(entity));
        for &entity in casting {
            if !self.slots.contains_key(&entity) {
                let taken = |index: u32| self.slots.values().any(|slot| slot.index == index);
                let index = (0..).find(|&index| !taken(index)).expect("there is always a larger number");
                self.slots.insert(entity, Slot { index, copied: None, version: 0 });
            }
        }
        let needed = self.slots.values().map(|slot| slot.index + 1).max().unwrap_or(0);
        if needed == 0 {
            self.densities = None;
        } else if self.densities.as_ref().is_none_or(|view| view.texture().depth_or_array_layers() < needed * SLOT_SIDE)
        {
            self.densities = Some(densities(needed.next_power_of_two(), device));
            for slot in self.slots.values_mut() {
                slot.copied = None;
            }
        }
    }

    /// Adds a caster and lists the copy of its density where that has changed.
    pub fn add(
        &mut self,
        entity: MainEntity,
        placed: &Placed,
        sigma: f32,
        frame: &GpuSmokeFrame,
        work: &mut SmokeWork,
    ) {
        let (Some(densities), Some(slot)) = (&self.densities, self.slots.get_mut(&entity)) else { return };
        let current = Some((frame.coarse.id(), frame.version));
        if slot.copied != current {
            slot.copied = current;
            slot.version += 1;
            work.copies.push(Copy { from: frame.coarse.clone(), to: densities.clone(), slot: slot.index });
        }
        let shape = placed.shape.coarse();
        self.current.push(Caster {
            entity,
            uniform: CasterUniform {
                bundle_from_here: Mat4::from(placed.world_from_bundle.inverse()),
                half_extent: placed.shape.half_extent(),
                sigma,
                padded: (shape.dims + 2).as_vec3(),
                texel: shape.cell_size(),
                slot: slot.index,
            },
            version: slot.version,
        });
    }

    /// The densities, a slot beneath the other; None while there are no casters.
    pub fn densities(&self) -> Option<&TextureView> {
        self.densities.as_ref()
    }
}

impl CasterUniform {
    /// The same asked from another space.
    pub fn seen_from(self, world_from_here: Mat4) -> Self {
        Self { bundle_from_here: self.bundle_from_here * world_from_here, ..self }
    }
}

fn densities(slots: u32, device: &RenderDevice) -> TextureView {
    let texture = device.create_texture(&TextureDescriptor {
        label: Some("smoke_caster_densities"),
        size: Extent3d { width: SLOT_SIDE, height: SLOT_SIDE, depth_or_array_layers: slots * SLOT_SIDE },
        mip_level_count: 1,
        sample_count: 1,
        dimension: TextureDimension::D3,
        format: FILTERED_FORMAT,
        usage: TextureUsages::TEXTURE_BINDING | TextureUsages::COPY_DST,
        view_formats: &[],
    });
    texture.create_view(&TextureViewDescriptor::default())
}

/// Copies the coarse densities that have changed.
pub(super) fn copy_casters(work: Res<SmokeWork>, mut ctx: RenderContext) {
    if work.copies.is_empty() {
        return;
    }
    let recorder = ctx.diagnostic_recorder();
    let recorder = recorder.as_deref();
    let encoder = ctx.command_encoder();
    let span = recorder.time_span(encoder, LABEL);
    for copy in &work.copies {
        let at = |texture, z| TexelCopyTextureInfo {
            texture,
            mip_level: 0,
            origin: Origin3d { x: 0, y: 0, z },
            aspect: TextureAspect::All,
        };
        let (from, to) = (at(copy.from.texture(), 0), at(copy.to.texture(), copy.slot * SLOT_SIDE));
        encoder.copy_texture_to_texture(from, to, copy.from.texture().size());
    }
    span.end(encoder);
}
