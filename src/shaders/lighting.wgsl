// What the lighting passes share: the medium as they see it, and where an RBF's probes are.
#define_import_path bevy_smoke::lighting

struct Lighting {
    // Rotates a direction from the volume's axes to the environment's.
    environment_from_bundle: mat3x3<f32>,
    albedo: vec3<f32>,
    // Extinction a bundle unit where the scaled density is 1: sigma_t times the world length of the box's longest side
    // over the density's scale.
    sigma: f32,
    // The phase function's factor of each band: g^l.
    bands: vec4<f32>,
}

// Radiance that leaves an RBF toward the eye: its mean Jbar, then the gradient's columns, d/dx, d/dy, d/dz.
struct Outgoing {
    mean: vec3<f32>,
    dx: vec3<f32>,
    dy: vec3<f32>,
    dz: vec3<f32>,
}

// Directions each probe looks in; one thread each.
const DIRECTIONS: u32 = 64u;
// Radius of the tetrahedron of probes over the RBF's.
const RHO: f32 = 1.0;

// Corner i of the tetrahedron, a unit vector.
fn tetrahedron(i: u32) -> vec3<f32> {
    let signs = vec3(
        select(1.0, -1.0, i >= 2u),
        select(1.0, -1.0, i == 1u || i == 3u),
        select(1.0, -1.0, i == 1u || i == 2u),
    );
    return signs * 0.5773502691896258;
}

fn probe_position(center: vec3<f32>, radius: f32, i: u32) -> vec3<f32> {
    return center + RHO * radius * tetrahedron(i);
}
