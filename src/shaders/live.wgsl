// Copies a game's density texture to where the passes read density: what is below 0 or no number becomes 0.

// Its first channel counts.
@group(0) @binding(0) var live: texture_3d<f32>;
@group(0) @binding(1) var density: texture_storage_3d<r32float, write>;

@compute @workgroup_size(8, 8, 4)
fn copy(@builtin(global_invocation_id) id: vec3<u32>) {
    if any(id >= textureDimensions(density)) {
        return;
    }
    let value = textureLoad(live, id, 0).x;
    // Comparisons with what is no number are false.
    let usable = select(0.0, min(value, 3e38), value > 0.0);
    textureStore(density, id, vec4(usable, 0.0, 0.0, 0.0));
}
