//! The WGSL sources, embedded in the library: one file per pass, and the maths they share as libraries.

use bevy::asset::{AssetServer, Handle, embedded_asset, load_embedded_asset};
use bevy::prelude::*;
use bevy::shader::{Shader, load_shader_library};

/// Registers every shader as an embedded asset.
pub(crate) fn embed(app: &mut App) {
    load_shader_library!(app, "frame.wgsl");
    load_shader_library!(app, "lighting.wgsl");
    load_shader_library!(app, "sh.wgsl");
    embedded_asset!(app, "environment.wgsl");
    embedded_asset!(app, "density.wgsl");
    embedded_asset!(app, "coarse.wgsl");
    embedded_asset!(app, "source_radiance.wgsl");
    embedded_asset!(app, "outgoing.wgsl");
    embedded_asset!(app, "volume.wgsl");
    embedded_asset!(app, "view.wgsl");
}

/// Handles of the passes' shaders.
pub(crate) struct Shaders {
    pub environment: Handle<Shader>,
    pub density: Handle<Shader>,
    pub coarse: Handle<Shader>,
    pub source_radiance: Handle<Shader>,
    pub outgoing: Handle<Shader>,
    pub volume: Handle<Shader>,
    pub view: Handle<Shader>,
}

impl Shaders {
    pub fn load(assets: &AssetServer) -> Self {
        Self {
            environment: load_embedded_asset!(assets, "environment.wgsl"),
            density: load_embedded_asset!(assets, "density.wgsl"),
            coarse: load_embedded_asset!(assets, "coarse.wgsl"),
            source_radiance: load_embedded_asset!(assets, "source_radiance.wgsl"),
            outgoing: load_embedded_asset!(assets, "outgoing.wgsl"),
            volume: load_embedded_asset!(assets, "volume.wgsl"),
            view: load_embedded_asset!(assets, "view.wgsl"),
        }
    }
}
