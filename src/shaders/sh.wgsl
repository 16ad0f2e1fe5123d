// Real spherical harmonics of order 4 (bands 0..3, 16 coefficients), index l(l+1)+m, the signs of
// Sloan 2008: the same table as `sh::basis` in Rust.
#define_import_path bevy_smoke::sh

const SH_COEFFICIENTS: u32 = 16u;

fn basis(d: vec3<f32>) -> array<f32, 16> {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    let z2 = z * z;
    return array<f32, 16>(
        0.2820947918,
        -0.4886025119 * y,
        0.4886025119 * z,
        -0.4886025119 * x,
        1.0925484306 * x * y,
        -1.0925484306 * y * z,
        0.3153915653 * (3.0 * z2 - 1.0),
        -1.0925484306 * x * z,
        0.5462742153 * (x * x - y * y),
        -0.5900435899 * y * (3.0 * x * x - y * y),
        2.8906114426 * x * y * z,
        -0.4570457995 * y * (5.0 * z2 - 1.0),
        0.3731763326 * z * (5.0 * z2 - 3.0),
        -0.4570457995 * x * (5.0 * z2 - 1.0),
        1.4453057213 * z * (x * x - y * y),
        -0.5900435899 * x * (x * x - 3.0 * y * y),
    );
}

// The band l of coefficient k: floor(sqrt(k)).
fn band(k: u32) -> u32 {
    return select(0u, 1u, k >= 1u) + select(0u, 1u, k >= 4u) + select(0u, 1u, k >= 9u);
}
