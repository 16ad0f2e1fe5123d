//! Views that show what a volume's picture is made of.

mod markers;

use bevy::prelude::*;

use crate::scattering::{ScatteringEvents, ScatteringSolver, SmokeScattering};

/// What is drawn of a volume in the place of its picture: for finding out why smoke looks as it does.
///
/// Fields ([`Density`](Self::Density), [`Rbfs`](Self::Rbfs), [`Residual`](Self::Residual)) are drawn as smoke that emits a false
/// colour and absorbs as its field says, exposed by 1 whatever the camera's exposure: radiance J(1 − exp(−σ_t D Δ)) a step, with
/// J the colour and D the field. In colours by density, t = D / (the animation's largest density): blue at 0, green at ½,
/// red at 1 and above, linear between, (max(0, 2t − 1), 1 − |2t − 1|, max(0, 1 − 2t)).
#[derive(Component, Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Reflect)]
#[reflect(Component, Default, Debug, Clone, PartialEq, Hash)]
pub enum SmokeDebugView {
    /// The picture.
    #[default]
    None,
    /// The density D, as decoded, in colours by density.
    Density,
    /// The sum of the Gaussians that light is computed at, D̃, in colours by density.
    Rbfs,
    /// What the residual adds, D − D̃: red where it adds, blue where it takes away; its magnitude absorbs.
    Residual,
    /// Light that has scattered exactly once: the picture with [`ScatteringEvents::Single`].
    Single,
    /// Light that has scattered more than once, as [`ScatteringSolver::Transport`] has it. With isotropic smoke this and
    /// [`Single`](Self::Single) add up to the picture, up to the bounds of the fits; with g > 0 what scatters into the
    /// phase function's forward peak counts as not having scattered (delta-M).
    Multiple,
    /// The probes where light is looked for, in the place of the smoke: seven an RBF, white at its centre and yellow around
    /// it, at the distances of smoke without delta-M. Of baked smoke and the full model.
    Probes,
    /// The picture, and the spheres of all [`SmokeOccluder`](crate::occluder::SmokeOccluder)s, magenta.
    Spheres,
}

impl SmokeDebugView {
    /// Whether a field is drawn, in false colours.
    pub(crate) fn is_field(self) -> bool {
        matches!(self, Self::Density | Self::Rbfs | Self::Residual)
    }

    /// Whether the picture is drawn, and something on top at most.
    pub(crate) fn is_of_picture(self) -> bool {
        matches!(self, Self::None | Self::Spheres)
    }

    /// Whether it takes passes of its own.
    pub(crate) fn has_passes(self) -> bool {
        self.is_field() || self == Self::Multiple
    }

    /// How light has to scatter for it.
    pub(crate) fn scattering(self, scattering: SmokeScattering) -> SmokeScattering {
        match self {
            Self::Single => SmokeScattering { events: ScatteringEvents::Single, ..scattering },
            Self::Multiple => SmokeScattering {
                events: ScatteringEvents::Multiple,
                solver: ScatteringSolver::Transport,
                ..scattering
            },
            _ => scattering,
        }
    }
}

/// Keeps the markers of views that have some.
pub(crate) struct SmokeDebugPlugin;

impl Plugin for SmokeDebugPlugin {
    fn build(&self, app: &mut App) {
        app.register_type::<SmokeDebugView>().add_systems(
            PostUpdate,
            markers::mark
                .after(TransformSystems::Propagate)
                .run_if(resource_exists::<Assets<Mesh>>)
                .run_if(resource_exists::<Assets<StandardMaterial>>)
                .run_if(any_with_component::<SmokeDebugView>.or_else(any_with_component::<markers::Markers>)),
        );
    }
}
