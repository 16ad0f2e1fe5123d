//! What the RBFs leave out: `R = D − D̃`, quantised to 8 bits and kept in a perfect spatial hash (Zhou et al. 2008,
//! section 5.2; Lefebvre and Hoppe 2006).
//!
//! [`QuantizationLaw`] maps a residual to a signed byte and back; [`HashedResidual`] stores the bytes that are not zero
//! so that a GPU finds any one of them in constant time.

#[cfg(feature = "bake")]
mod build;
mod hash;
mod law;
#[cfg(test)]
mod tests;

pub use hash::{HashedResidual, ResidualError};
pub use law::QuantizationLaw;
