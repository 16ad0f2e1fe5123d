//! Pictures as they should be.

use glam::{IVec3, Vec3};
use rayon::prelude::*;

use crate::cli::render::read_equirect;
use crate::cli::scene::{Environment, Scene};
use crate::density::{DensityGrid, GridShape};
use crate::reference::flicker::DrawnFrame;
use crate::reference::path::EquirectImage;
use crate::reference::voxel_single::{DistantLight, LitVoxels, distant_lights, gathered_lights};
use crate::reference::{Grid, Medium, Ray};

/// A picture of single scattering, rows from the top: linear RGB media radiance without background, and 1 − transmittance.
pub struct Picture {
    pub radiance: Vec<[f32; 3]>,
    pub alpha: Vec<f32>,
}

impl Picture {
    /// With what was drawn in its place.
    pub fn drawn_as<'a>(&'a self, picture: &'a [[f32; 3]]) -> DrawnFrame<'a> {
        DrawnFrame { picture, truth: &self.radiance, alpha: &self.alpha }
    }
}

/// What all frames share.
pub struct Truth<'a> {
    scene: &'a Scene,
    lights: Vec<DistantLight>,
}

impl<'a> Truth<'a> {
    /// Light of the scene's environment from a number of directions.
    pub fn new(scene: &'a Scene, directions: usize) -> anyhow::Result<Self> {
        let lights = match &scene.environment {
            Environment::Equirect(path) => {
                let ([width, height], texels) = read_equirect(path)?;
                let image = EquirectImage::new(width as usize, texels.into_iter().map(Vec3::from).collect());
                gathered_lights(directions, [width as usize, height as usize], |w| image.radiance(w))
            }
            lobes => distant_lights(directions, |w| lobes.radiance(w).unwrap_or_default()),
        };
        Ok(Self { scene, lights })
    }

    /// The picture of a density where its file places it, one ray through the middle of every pixel.
    pub fn picture(&self, density: &DensityGrid) -> Picture {
        // A voxel reaches to the centres of its neighbours: with one more cell around it the box cuts none off.
        let min = density.source.index_min.saturating_sub(IVec3::ONE);
        let density = density.reframed(min, GridShape::new(density.shape.dims + 2));
        let (center, side) = (density.placement.center, density.world_size());
        let values = density.values.iter().map(|&value| f64::from(value)).collect();
        let grid = Grid { shape: density.shape, values };
        let Scene { camera, sigma_t, albedo, g, .. } = self.scene;
        let medium = Medium { sigma: sigma_t * side, albedo: *albedo, g: *g };
        let eye = (camera.eye - center) / side;
        let lit = LitVoxels::new(&grid, &medium, eye, &self.lights);

        let [width, height] = camera.size;
        let pixel = |index: u32| {
            let (x, y) = (f64::from(index % width) + 0.5, f64::from(index / width) + 0.5);
            let (radiance, transmittance) = lit.march(&Ray::new(eye, camera.direction(camera.size, x, y)));
            (radiance.as_vec3().to_array(), (1.0 - transmittance) as f32)
        };
        let (radiance, alpha) = (0..width * height).into_par_iter().map(pixel).unzip();
        Picture { radiance, alpha }
    }
}
