//! Where smoke comes from: a hot, restless ball near the floor.

use glam::{IVec3, Vec3};

use crate::density::GridShape;
use crate::random::SplitMix64;

/// Radius over half the shortest side of the box.
const RADIUS: f32 = 0.32;
/// Height of the centre above the floor, and half the height of the ball, in radii.
const HEIGHT: f32 = 0.7;
/// Size of the largest puffs, in radii.
const PUFF: f32 = 0.7;
/// Puffs that pass a point each second.
const PUFFS_A_SECOND: f32 = 5.0;

/// A ball of hot smoke, flattened to the ground, that puffs at random.
#[derive(Clone, Debug)]
pub struct Source {
    /// Centre in bundle space.
    pub center: Vec3,
    /// Horizontal radius in bundle space.
    pub radius: f32,
    seed: u64,
}

/// What the source does at a place and time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Emission {
    /// Least density there, 0..1.
    pub density: f32,
    /// Least temperature there, 0..1.
    pub temperature: f32,
    /// Random force, −1..1 by component.
    pub force: Vec3,
}

impl Source {
    /// In the middle of a box's floor.
    pub fn new(shape: GridShape, seed: u64) -> Self {
        let half = shape.half_extent();
        let radius = RADIUS * half.min_element();
        Self { center: Vec3::new(0.0, HEIGHT * radius - half.y, 0.0), radius, seed }
    }

    /// The emission at a position in bundle space, after `seconds`; `None` outside the source.
    pub fn emission(&self, position: Vec3, seconds: f32) -> Option<Emission> {
        let from_center = (position - self.center) / self.radius;
        let distance = (from_center / Vec3::new(1.0, HEIGHT, 1.0)).length();
        if distance >= 1.0 {
            return None;
        }
        // Full over most of the ball, 0 at its surface.
        let rim = ((1.0 - distance) / 0.35).min(1.0);
        let rim = rim * rim * (3.0 - 2.0 * rim);
        let at = (from_center - Vec3::Y * (PUFF * PUFFS_A_SECOND * seconds)) / PUFF;
        let noise = |channel: u64| {
            let seed = self.seed.wrapping_mul(8).wrapping_add(channel);
            noise(at, seed) * (2.0 / 3.0) + noise(2.0 * at, !seed) * (1.0 / 3.0)
        };
        let amount = (0.75 + 0.6 * noise(0)).clamp(0.0, 1.0);
        let heat = (0.7 + 0.7 * noise(1)).clamp(0.0, 1.0);
        let force = Vec3::new(noise(2), noise(3), noise(4));
        Some(Emission { density: rim * amount, temperature: rim * heat, force: rim * force })
    }
}

/// Smooth random values, −1..1: random at whole positions, quintic between (Perlin 2002, *Improving Noise*).
fn noise(position: Vec3, seed: u64) -> f32 {
    let base = position.floor();
    let t = position - base;
    let t = t * t * t * (t * (t * 6.0 - 15.0) + 10.0);
    let base = base.as_ivec3();
    let corners = std::array::from_fn(|corner| {
        let corner = corner as i32;
        random(base + IVec3::new(corner & 1, corner >> 1 & 1, corner >> 2), seed)
    });
    super::lattice::trilinear(&corners, t)
}

/// A random number of a whole position, −1..1.
fn random(position: IVec3, seed: u64) -> f32 {
    let state = position.to_array().iter().fold(seed, |state, &x| SplitMix64(state ^ u64::from(x as u32)).bits());
    (2.0 * SplitMix64(state).unit() - 1.0) as f32
}
