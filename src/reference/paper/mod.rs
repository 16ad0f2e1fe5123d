//! Zhou et al. 2008, *Real-Time Smoke Rendering Using Compensated Ray Marching*, as printed: a baseline to measure
//! against, never improved.
//!
//! Source radiance is known at the RBF centres only. Single scattering goes through the RBFs' optical depth in
//! spherical harmonics ([`source_radiance`]), multiple scattering through a diffusion equation collocated at the
//! centres ([`multiple`]), and what lies between is interpolated with the RBFs' own weights ([`volume`], [`march`]).
//!
//! Where the paper leaves a choice: order 4; whole Gaussians in the optical depth and Gaussians cut off at three radii
//! elsewhere; the tables of the exponential are [`OptimalLinear`](crate::sh::OptimalLinear)'s, Ren et al.'s own being
//! unpublished; J¹ at a centre is that centre's own in Eq. 6; y(ω_o) looks from the eye to each RBF's centre; density
//! below zero, which the residual's quantisation can cause, is zero.

mod depth;
mod multiple;
mod single;
mod solve;
mod system;
mod view;

pub use depth::{ANGLES, DepthTable, beta};
pub use multiple::{Multiple, multiple};
pub use single::{source_radiance, transmittance};
pub use solve::{Matrix, conjugate_gradients};
pub use system::{Jet, Optics, System, jet, system};
pub use view::{SMALLEST_DENSITY, march, outgoing, volume};
