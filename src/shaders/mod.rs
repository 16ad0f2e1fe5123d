//! The WGSL sources, embedded in the library: one file per pass, and the maths they share as libraries.

use bevy::asset::{AssetServer, Handle, embedded_asset, load_embedded_asset};
use bevy::prelude::*;
use bevy::shader::{Shader, load_shader_library};

/// Registers every shader as an embedded asset.
pub(crate) fn embed(app: &mut App) {
    load_shader_library!(app, "casters.wgsl");
    load_shader_library!(app, "constellation.wgsl");
    load_shader_library!(app, "diffusion.wgsl");
    load_shader_library!(app, "footprint.wgsl");
    load_shader_library!(app, "frame.wgsl");
    load_shader_library!(app, "lighting.wgsl");
    load_shader_library!(app, "march.wgsl");
    load_shader_library!(app, "occluders.wgsl");
    load_shader_library!(app, "radiance.wgsl");
    load_shader_library!(app, "scattering.wgsl");
    load_shader_library!(app, "sh.wgsl");
    load_shader_library!(app, "sum.wgsl");
    embedded_asset!(app, "environment.wgsl");
    embedded_asset!(app, "density.wgsl");
    embedded_asset!(app, "live.wgsl");
    embedded_asset!(app, "coarse.wgsl");
    embedded_asset!(app, "lattice.wgsl");
    embedded_asset!(app, "pair_matrix.wgsl");
    embedded_asset!(app, "incident_light.wgsl");
    embedded_asset!(app, "scattering_source.wgsl");
    embedded_asset!(app, "sweep.wgsl");
    embedded_asset!(app, "extrapolate.wgsl");
    embedded_asset!(app, "diffusion_source.wgsl");
    embedded_asset!(app, "diffusion_solve.wgsl");
    embedded_asset!(app, "diffusion_scatter.wgsl");
    embedded_asset!(app, "outgoing.wgsl");
    embedded_asset!(app, "volume.wgsl");
    embedded_asset!(app, "constellation_radiance.wgsl");
    embedded_asset!(app, "constellation_lights.wgsl");
    embedded_asset!(app, "constellation_distance.wgsl");
    embedded_asset!(app, "constellation_mask.wgsl");
    embedded_asset!(app, "shadow_probes.wgsl");
    embedded_asset!(app, "shadow_mask.wgsl");
    embedded_asset!(app, "mesh_shadows.wgsl");
    embedded_asset!(app, "view.wgsl");
    embedded_asset!(app, "debug.wgsl");
    #[cfg(feature = "reference")]
    {
        load_shader_library!(app, "paper.wgsl");
        embedded_asset!(app, "paper_single.wgsl");
        embedded_asset!(app, "paper_system.wgsl");
        embedded_asset!(app, "paper_solve.wgsl");
        embedded_asset!(app, "paper_media.wgsl");
        embedded_asset!(app, "paper_outgoing.wgsl");
        embedded_asset!(app, "paper_volume.wgsl");
    }
}

/// Handles of the passes' shaders.
pub(crate) struct Shaders {
    pub environment: Handle<Shader>,
    pub density: Handle<Shader>,
    pub live: Handle<Shader>,
    pub coarse: Handle<Shader>,
    pub lattice: Handle<Shader>,
    pub pair_matrix: Handle<Shader>,
    pub incident_light: Handle<Shader>,
    pub scattering_source: Handle<Shader>,
    pub sweep: Handle<Shader>,
    pub extrapolate: Handle<Shader>,
    pub diffusion_source: Handle<Shader>,
    pub diffusion_solve: Handle<Shader>,
    pub diffusion_scatter: Handle<Shader>,
    pub outgoing: Handle<Shader>,
    pub volume: Handle<Shader>,
    pub constellation: ConstellationShaders,
    pub shadow_probes: Handle<Shader>,
    pub shadow_mask: Handle<Shader>,
    pub mesh_shadows: Handle<Shader>,
    pub view: Handle<Shader>,
    pub debug: Handle<Shader>,
    #[cfg(feature = "reference")]
    pub paper: PaperShaders,
}

/// Handles of the shaders of the light constellation.
pub(crate) struct ConstellationShaders {
    pub radiance: Handle<Shader>,
    pub lights: Handle<Shader>,
    pub distance: Handle<Shader>,
    pub mask: Handle<Shader>,
}

/// Handles of the shaders of Zhou et al. 2008.
#[cfg(feature = "reference")]
pub(crate) struct PaperShaders {
    pub single: Handle<Shader>,
    pub system: Handle<Shader>,
    pub solve: Handle<Shader>,
    pub media: Handle<Shader>,
    pub outgoing: Handle<Shader>,
    pub volume: Handle<Shader>,
}

impl Shaders {
    pub fn load(assets: &AssetServer) -> Self {
        Self {
            environment: load_embedded_asset!(assets, "environment.wgsl"),
            density: load_embedded_asset!(assets, "density.wgsl"),
            live: load_embedded_asset!(assets, "live.wgsl"),
            coarse: load_embedded_asset!(assets, "coarse.wgsl"),
            lattice: load_embedded_asset!(assets, "lattice.wgsl"),
            pair_matrix: load_embedded_asset!(assets, "pair_matrix.wgsl"),
            incident_light: load_embedded_asset!(assets, "incident_light.wgsl"),
            scattering_source: load_embedded_asset!(assets, "scattering_source.wgsl"),
            sweep: load_embedded_asset!(assets, "sweep.wgsl"),
            extrapolate: load_embedded_asset!(assets, "extrapolate.wgsl"),
            diffusion_source: load_embedded_asset!(assets, "diffusion_source.wgsl"),
            diffusion_solve: load_embedded_asset!(assets, "diffusion_solve.wgsl"),
            diffusion_scatter: load_embedded_asset!(assets, "diffusion_scatter.wgsl"),
            outgoing: load_embedded_asset!(assets, "outgoing.wgsl"),
            volume: load_embedded_asset!(assets, "volume.wgsl"),
            constellation: ConstellationShaders {
                radiance: load_embedded_asset!(assets, "constellation_radiance.wgsl"),
                lights: load_embedded_asset!(assets, "constellation_lights.wgsl"),
                distance: load_embedded_asset!(assets, "constellation_distance.wgsl"),
                mask: load_embedded_asset!(assets, "constellation_mask.wgsl"),
            },
            shadow_probes: load_embedded_asset!(assets, "shadow_probes.wgsl"),
            shadow_mask: load_embedded_asset!(assets, "shadow_mask.wgsl"),
            mesh_shadows: load_embedded_asset!(assets, "mesh_shadows.wgsl"),
            view: load_embedded_asset!(assets, "view.wgsl"),
            debug: load_embedded_asset!(assets, "debug.wgsl"),
            #[cfg(feature = "reference")]
            paper: PaperShaders {
                single: load_embedded_asset!(assets, "paper_single.wgsl"),
                system: load_embedded_asset!(assets, "paper_system.wgsl"),
                solve: load_embedded_asset!(assets, "paper_solve.wgsl"),
                media: load_embedded_asset!(assets, "paper_media.wgsl"),
                outgoing: load_embedded_asset!(assets, "paper_outgoing.wgsl"),
                volume: load_embedded_asset!(assets, "paper_volume.wgsl"),
            },
        }
    }
}

#[cfg(test)]
mod tests {
    //! Every WGSL file, composed and validated without a graphics adapter.

    use std::collections::HashMap;

    use naga::valid::{Capabilities, ValidationFlags, Validator};
    use naga_oil::compose::{
        ComposableModuleDescriptor, Composer, NagaModuleDescriptor, ShaderDefValue, ShaderLanguage, ShaderType,
    };

    /// What `view.wgsl` takes of Bevy: the same names and types, no more.
    const BEVY_VIEW: &str = "#define_import_path bevy_render::view
        struct ColorGrading { exposure: f32 }
        struct View { viewport: vec4<f32>, main_pass_viewport: vec4<f32>, color_grading: ColorGrading }";
    const BEVY_TONEMAPPING: &str = "#define_import_path bevy_core_pipeline::tonemapping
        #import bevy_render::view::ColorGrading
        fn tone_mapping(color: vec4<f32>, grading: ColorGrading) -> vec4<f32> { return color * grading.exposure; }";

    fn validate(name: &str, source: &str, defs: &[&str]) {
        let mut composer = Composer::default();
        let libraries = [
            ("sh.wgsl", include_str!("sh.wgsl")),
            ("casters.wgsl", include_str!("casters.wgsl")),
            ("occluders.wgsl", include_str!("occluders.wgsl")),
            ("march.wgsl", include_str!("march.wgsl")),
            ("radiance.wgsl", include_str!("radiance.wgsl")),
            ("diffusion.wgsl", include_str!("diffusion.wgsl")),
            ("footprint.wgsl", include_str!("footprint.wgsl")),
            ("frame.wgsl", include_str!("frame.wgsl")),
            ("lighting.wgsl", include_str!("lighting.wgsl")),
            ("constellation.wgsl", include_str!("constellation.wgsl")),
            ("paper.wgsl", include_str!("paper.wgsl")),
            ("scattering.wgsl", include_str!("scattering.wgsl")),
            ("sum.wgsl", include_str!("sum.wgsl")),
            ("bevy view", BEVY_VIEW),
            ("bevy tonemapping", BEVY_TONEMAPPING),
        ];
        for (file_path, source) in libraries {
            composer
                .add_composable_module(ComposableModuleDescriptor {
                    source,
                    file_path,
                    language: ShaderLanguage::Wgsl,
                    ..Default::default()
                })
                .unwrap_or_else(|error| panic!("{file_path}: {}", error.emit_to_string(&Composer::default())));
        }
        // A number where there is one: "NAME=4".
        let value = |def: &&str| match def.split_once('=') {
            Some((name, number)) => (name.to_string(), ShaderDefValue::UInt(number.parse().unwrap())),
            None => (def.to_string(), ShaderDefValue::Bool(true)),
        };
        let mut shader_defs: HashMap<_, _> = defs.iter().map(value).collect();
        shader_defs.insert("SAMPLES".into(), ShaderDefValue::UInt(4));
        let module = composer
            .make_naga_module(NagaModuleDescriptor {
                source,
                file_path: name,
                shader_type: ShaderType::Wgsl,
                shader_defs,
                ..Default::default()
            })
            .unwrap_or_else(|error| panic!("{name} {defs:?}: {}", error.emit_to_string(&composer)));
        assert!(!module.entry_points.is_empty(), "{name} has no entry point");
        // No capabilities: what every WebGPU device can do.
        Validator::new(ValidationFlags::all(), Capabilities::empty())
            .validate(&module)
            .unwrap_or_else(|error| panic!("{name} {defs:?}: {error:?}"));
    }

    #[test]
    fn compute_shaders_are_valid() {
        validate("environment.wgsl", include_str!("environment.wgsl"), &[]);
        validate("environment.wgsl", include_str!("environment.wgsl"), &["EQUIRECT"]);
        validate("density.wgsl", include_str!("density.wgsl"), &[]);
        validate("coarse.wgsl", include_str!("coarse.wgsl"), &[]);
        validate("pair_matrix.wgsl", include_str!("pair_matrix.wgsl"), &[]);
        for directions in ["DIRECTIONS=16", "DIRECTIONS=32", "DIRECTIONS=64"] {
            validate("incident_light.wgsl", include_str!("incident_light.wgsl"), &[directions]);
        }
        validate("scattering_source.wgsl", include_str!("scattering_source.wgsl"), &[]);
        validate("sweep.wgsl", include_str!("sweep.wgsl"), &[]);
        validate("extrapolate.wgsl", include_str!("extrapolate.wgsl"), &[]);
        validate("diffusion_source.wgsl", include_str!("diffusion_source.wgsl"), &[]);
        validate("diffusion_solve.wgsl", include_str!("diffusion_solve.wgsl"), &[]);
        validate("diffusion_scatter.wgsl", include_str!("diffusion_scatter.wgsl"), &[]);
        validate("debug.wgsl", include_str!("debug.wgsl"), &[]);
        for defs in [&[][..], &["SCATTERED_ONLY"]] {
            validate("outgoing.wgsl", include_str!("outgoing.wgsl"), defs);
            validate("volume.wgsl", include_str!("volume.wgsl"), defs);
        }
        for defs in [&[][..], &["EQUIRECT"], &["COEFFICIENTS"]] {
            validate("constellation_radiance.wgsl", include_str!("constellation_radiance.wgsl"), defs);
        }
        validate("constellation_lights.wgsl", include_str!("constellation_lights.wgsl"), &[]);
        for defs in [&[][..], &["FIRST"], &["LAST"]] {
            validate("constellation_distance.wgsl", include_str!("constellation_distance.wgsl"), defs);
        }
        validate("constellation_mask.wgsl", include_str!("constellation_mask.wgsl"), &[]);
        validate("shadow_probes.wgsl", include_str!("shadow_probes.wgsl"), &[]);
        validate("paper_single.wgsl", include_str!("paper_single.wgsl"), &[]);
        validate("paper_system.wgsl", include_str!("paper_system.wgsl"), &[]);
        validate("paper_solve.wgsl", include_str!("paper_solve.wgsl"), &[]);
        validate("paper_media.wgsl", include_str!("paper_media.wgsl"), &[]);
        validate("paper_outgoing.wgsl", include_str!("paper_outgoing.wgsl"), &[]);
        validate("paper_volume.wgsl", include_str!("paper_volume.wgsl"), &[]);
    }

    #[test]
    fn the_mask_shader_is_valid() {
        validate("shadow_mask.wgsl", include_str!("shadow_mask.wgsl"), &[]);
    }

    #[test]
    fn the_view_shader_is_valid_in_every_variant() {
        let source = include_str!("view.wgsl");
        for defs in [&[][..], &["MULTISAMPLED"], &["TONEMAP_IN_SHADER"], &["MULTISAMPLED", "TONEMAP_IN_SHADER"]] {
            validate("view.wgsl", source, defs);
            validate("view.wgsl", source, &[defs, &["PRINTED_EMISSION"]].concat());
            validate("view.wgsl", source, &[defs, &["CONSTELLATION"]].concat());
            validate("view.wgsl", source, &[defs, &["CONSTELLATION", "SLABS"]].concat());
        }
        for defs in [&["HALF"][..], &["UPSAMPLED"], &["UPSAMPLED", "TONEMAP_IN_SHADER"]] {
            validate("view.wgsl", source, defs);
        }
    }
}
