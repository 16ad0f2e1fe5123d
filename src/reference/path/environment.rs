//! The environment: light from infinitely far away.

use core::f64::consts::PI;

use glam::{DVec3, Vec3};

use super::Rng;

/// Radiance by the direction it comes from.
#[derive(Clone, Copy)]
pub enum Environment<'a> {
    /// A smooth function of a unit vector: found by scattering alone.
    Function(&'a (dyn Fn(DVec3) -> DVec3 + Sync)),
    /// An image, which may hold a sun: bright texels are looked for.
    Image(&'a EquirectImage),
}

impl Environment<'_> {
    /// Radiance from direction `w`, a unit vector.
    pub fn radiance(&self, w: DVec3) -> DVec3 {
        match self {
            Self::Function(radiance) => radiance(w),
            Self::Image(image) => image.radiance(w),
        }
    }
}

/// An equirectangular image and a table to draw directions from it.
///
/// Column u·width and row v·height with u = φ/2π, v = θ/π, ω = (sin φ sin θ, cos θ, −cos φ sin θ). Radiance is bilinear
/// between the texels' centres, around the seam too; above the first row and below the last it stays.
pub struct EquirectImage {
    size: [usize; 2],
    texels: Vec<Vec3>,
    /// Probability per steradian with which a direction of each texel is drawn.
    density: Vec<f64>,
    /// The probability of the texels up to each, itself included.
    cumulative: Vec<f64>,
}

impl EquirectImage {
    /// An image of rows of `width` texels from the top: linear radiance, finite; not empty.
    pub fn new(width: usize, texels: Vec<Vec3>) -> Self {
        let size = [width, texels.len() / width];
        let luminance = |t: Vec3| f64::from(t.dot(Vec3::new(0.2126, 0.7152, 0.0722)).max(0.0));
        let mut image = Self { size, texels, density: Vec::new(), cumulative: Vec::new() };
        // The mean of the interpolated luminance over a texel: six eighths are its own, an eighth either neighbour's.
        let mean = |index: usize| {
            let (x, y) = ((index % size[0]) as i64, (index / size[0]) as i64);
            let row = |y| {
                let at = |x| luminance(image.texel(x, y));
                0.125 * (at(x - 1) + at(x + 1)) + 0.75 * at(x)
            };
            0.125 * (row(y - 1) + row(y + 1)) + 0.75 * row(y)
        };
        let means: Vec<f64> = (0..size[0] * size[1]).map(mean).collect();
        let solid_angle = |index: usize| {
            let [above, below] = [0.0, 1.0].map(|edge| (PI * ((index / size[0]) as f64 + edge) / size[1] as f64).cos());
            (above - below) * 2.0 * PI / size[0] as f64
        };
        let power: f64 = means.iter().enumerate().map(|(index, mean)| mean * solid_angle(index)).sum();
        if power > 0.0 {
            let mut sum = 0.0;
            image.density = means.iter().map(|mean| mean / power).collect();
            image.cumulative = (0..means.len())
                .map(|index| {
                    sum += image.density[index] * solid_angle(index);
                    sum
                })
                .collect();
        }
        image
    }

    /// A texel; columns wrap around, rows end.
    fn texel(&self, x: i64, y: i64) -> Vec3 {
        let [width, height] = self.size.map(|side| side as i64);
        self.texels[(y.clamp(0, height - 1) * width + x.rem_euclid(width)) as usize]
    }

    /// Place in the image, in texels from its top left corner.
    fn place(&self, w: DVec3) -> [f64; 2] {
        let u = w.x.atan2(-w.z) / (2.0 * PI);
        let v = w.y.clamp(-1.0, 1.0).acos() / PI;
        [(u - u.floor()) * self.size[0] as f64, v * self.size[1] as f64]
    }

    /// Radiance from direction `w`, a unit vector.
    pub fn radiance(&self, w: DVec3) -> DVec3 {
        let [x, y] = self.place(w).map(|p| p - 0.5);
        let (left, top) = (x.floor(), y.floor());
        let (fx, fy) = ((x - left) as f32, (y - top) as f32);
        let row = |y| self.texel(left as i64, y).lerp(self.texel(left as i64 + 1, y), fx);
        row(top as i64).lerp(row(top as i64 + 1), fy).as_dvec3()
    }

    /// The direction of every texel's centre and its light, radiance times solid angle.
    pub fn texels(&self) -> impl Iterator<Item = (DVec3, DVec3)> {
        let [width, height] = self.size;
        self.texels.iter().enumerate().map(move |(index, texel)| {
            let [x, y] = [index % width, index / width].map(|i| i as f64);
            let (sin_phi, cos_phi) = (2.0 * PI * (x + 0.5) / width as f64).sin_cos();
            let (sin, cos) = (PI * (y + 0.5) / height as f64).sin_cos();
            let [above, below] = [y, y + 1.0].map(|y| (PI * y / height as f64).cos());
            let solid_angle = (above - below) * 2.0 * PI / width as f64;
            (DVec3::new(sin_phi * sin, cos, -cos_phi * sin), texel.as_dvec3() * solid_angle)
        })
    }

    /// Probability per steradian with which [`sample`](Self::sample) draws `w`; 0 from a black image.
    pub fn density(&self, w: DVec3) -> f64 {
        let [x, y] = self.place(w).map(|p| p as usize);
        let [width, height] = self.size;
        self.density.get(y.min(height - 1) * width + x.min(width - 1)).copied().unwrap_or(0.0)
    }

    /// A random direction and its [`density`](Self::density): texels by their light, evenly within each. `None` from a
    /// black image.
    pub fn sample(&self, rng: &mut Rng) -> Option<(DVec3, f64)> {
        let pick = rng.uniform() * self.cumulative.last()?;
        let index = self.cumulative.partition_point(|&sum| sum <= pick).min(self.cumulative.len() - 1);
        let [width, height] = self.size;
        let (x, y) = ((index % width) as f64, (index / width) as f64);
        let phi = 2.0 * PI * (x + rng.uniform()) / width as f64;
        let [above, below] = [y, y + 1.0].map(|y| (PI * y / height as f64).cos());
        let cos = above + (below - above) * rng.uniform();
        let sin = (1.0 - cos * cos).max(0.0).sqrt();
        Some((DVec3::new(phi.sin() * sin, cos, -phi.cos() * sin), self.density[index]))
    }
}
