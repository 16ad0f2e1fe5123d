//! `smoke study`: the numerical studies behind the method, run again.

mod flicker;
mod quality;
mod shadows;
mod sphere;
mod spheres;
mod stability;
mod table1;

use clap::Subcommand;

pub(super) const EXAMPLES: &str = "\
  smoke study sphere
  smoke study sphere --paths 10000000 --json
  smoke study stability > docs/stability.md
  smoke study spheres --spheres 16,32
  smoke study flicker plume.smoke --density plume_*.vdb
  smoke study shadows plume.smoke
  smoke study quality --references REFERENCES > quality.json
  smoke study table1 plume.vdb --size 96x96";

/// What to study.
#[derive(Subcommand, Debug)]
pub enum Study {
    /// Diffusion in a homogeneous sphere under constant light: the equation as printed by Zhou et al. 2008 and as the
    /// moments of light transport give it, against random paths. The ratio is that of the light in the sphere to the
    /// true amount; the error is relative and root mean square, by volume
    Sphere(sphere::SphereArgs),
    /// Smoke where methods fail: very thin and thick, dark and white, forward and backward, tiny and huge, empty, one
    /// voxel, sharp and sudden light. Prints the table of docs/stability.md
    Stability(stability::StabilityArgs),
    /// How much baked animations flicker when the plug-in draws them: change of the picture's error from frame to frame,
    /// over the change of the true picture, in single scattering. The truth is computed from the densities they were baked
    /// from, without noise
    Flicker(flicker::FlickerArgs),
    /// Shadows between smoke and meshes, as the plug-in draws them: what a floor under the smoke receives of sky and sun,
    /// against exact integrals, and smoke that a ball shades, against path tracing
    Shadows(shadows::ShadowArgs),
    /// What models of `--quality` cost and how far off they are, and the formulas that choose among them, fitted to that.
    /// Prints measurements, fit and choices as JSON
    Quality(quality::QualityStudyArgs),
    /// How close fitted spheres come to the meshes they stand for in smoke's light, and how long fitting takes. Prints
    /// tables: a cube, a wall, a torus, a figure that walks, and ground
    Spheres(spheres::SpheresArgs),
    /// What validity mask and distance map bring to --method constellation: Table 1 of Navarro et al. 2008, done again
    Table1(table1::Table1Args),
}

/// Runs `smoke study`.
pub fn run(study: &Study) -> anyhow::Result<()> {
    match study {
        Study::Sphere(args) => sphere::run(args),
        Study::Stability(args) => stability::run(args),
        Study::Flicker(args) => flicker::run(args),
        Study::Shadows(args) => shadows::run(args),
        Study::Quality(args) => quality::run(args),
        Study::Spheres(args) => spheres::run(args),
        Study::Table1(args) => table1::run(args),
    }
}
