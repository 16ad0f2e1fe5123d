// Marks the pixels of meshes that smoke does not shade; the vertex stage is that of each mesh's material.
@fragment
fn fragment() -> @location(0) vec4<f32> {
    return vec4(1.0);
}
