//! Single scattering from a light constellation (Navarro et al. 2008): the twins of the passes in `render/constellation`,
//! and of the view pass as it draws by one.

pub mod distance;
pub mod median_cut;
pub mod view;

pub use self::distance::DistanceMap;
pub use self::median_cut::{Constellation, RadianceGrid};
