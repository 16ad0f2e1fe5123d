// Radiance maps: the values of their texels, and where the texels of latitude-longitude images are.
#define_import_path bevy_smoke::radiance

const PI: f32 = 3.14159265358979;

// What a clipped sun or a damaged file may hold must not spread to every coefficient, and every light.
const BRIGHTEST: f32 = 1e6;

fn sane(radiance: vec3<f32>) -> vec3<f32> {
    // A number that is not equal to itself is none.
    return select(vec3(0.0), clamp(radiance, vec3(0.0), vec3(BRIGHTEST)), radiance == radiance);
}

// Direction of a point of a latitude-longitude image, right-handed, y up:
// u = phi / 2 pi, v = theta / pi, w = (sin phi sin theta, cos theta, -cos phi sin theta).
fn equirect_direction(uv: vec2<f32>) -> vec3<f32> {
    let phi = 2.0 * PI * uv.x;
    let theta = PI * uv.y;
    return vec3(sin(phi) * sin(theta), cos(theta), -cos(phi) * sin(theta));
}

// Solid angle of a texel in a row, exact: cos(theta - d) - cos(theta + d) = 2 sin(theta) sin(d), d half a row.
fn equirect_solid_angle(row: u32, size: vec2<u32>) -> f32 {
    let theta = PI * (f32(row) + 0.5) / f32(size.y);
    return 2.0 * PI / f32(size.x) * 2.0 * sin(theta) * sin(0.5 * PI / f32(size.y));
}
