// What the lighting passes share: the medium and the lamps as they see them, and where an RBF's probes are.
// Filled by `LightingUniform` (render/lighting.rs).
#define_import_path bevy_smoke::lighting
#import bevy_smoke::frame::Rbf

// A sun, a point light or a spot light. Lengths are bundle units, so that irradiance is intensity over distance squared.
struct Lamp {
    // Where it is; for a sun, the unit vector toward it.
    position: vec3<f32>,
    // 1 / range^2, where its light ends.
    inverse_range_squared: f32,
    // Intensity; for a sun, irradiance on a surface that faces it.
    color: vec3<f32>,
    is_sun: u32,
    // Unit vector along a spot's axis; saturate(cos * scale + offset)^2 is its share at that angle.
    axis: vec3<f32>,
    spot_scale: f32,
    spot_offset: f32,
}

struct Lighting {
    // Rotates a direction from the volume's axes to the environment's.
    environment_from_bundle: mat3x3<f32>,
    // Radiance from everywhere on top of the environment.
    ambient: vec3<f32>,
    // Multiplies the environment's coefficients.
    environment_scale: f32,
    // A sun that the coefficients contain and a lamp stands for: in the environment's axes and units.
    sun_direction: vec3<f32>,
    sun_irradiance: vec3<f32>,
    // Extinction a bundle unit where the scaled density is 1, as light on its way to the smoke sees it; reduced for
    // multiple scattering forward (delta-M).
    sigma: vec3<f32>,
    // Mean cosine of the phase function.
    g: f32,
    // Factor of each band at the last scattering event: albedo g^l.
    scatter: array<vec4<f32>, 4>,
    // The same at all events before: reduced like sigma.
    inner: array<vec4<f32>, 4>,
    // Grey sigma, for transport between RBFs.
    sigma_mean: f32,
    // Coefficients kept of radiance that scatters more than once: 1 (isotropic), 4, 9 or 16; 0 where light scatters once.
    coefficients: u32,
    lamp_count: u32,
    // Added to the squared distance of lamps, for cells to hold their light; the view pass makes up for it.
    softening: f32,
    // Probes that each RBF looks from: PROBES, or 1, its centre.
    probes: u32,
    // Coefficients kept of light at the probes: 1, 4 or 16.
    light_coefficients: u32,
    lamps: array<Lamp, 8>,
}

const MAX_LAMPS: u32 = 8u;
const PI: f32 = 3.14159265358979;

// A quantity around an RBF: at its centre, its slopes and its curvatures along the axes, in bundle units. Radiance keeps
// its bounds in alpha: the lower in center, dx, dy, the upper in dz, qx, qy.
struct Fit {
    center: vec4<f32>,
    dx: vec4<f32>,
    dy: vec4<f32>,
    dz: vec4<f32>,
    qx: vec4<f32>,
    qy: vec4<f32>,
    qz: vec4<f32>,
}

// A fit, `offset` from the RBF's centre.
fn value_of(fit: Fit, offset: vec3<f32>) -> vec4<f32> {
    return fit.center + (fit.dx + fit.qx * offset.x) * offset.x + (fit.dy + fit.qy * offset.y) * offset.y
        + (fit.dz + fit.qz * offset.z) * offset.z;
}

// Fits are followed no farther than this many radii.
const REACH: f32 = 1.5;
const TAIL: f32 = 1e-6;

// How much an RBF's fit counts u radii from its centre, for the square of u. The tail, a millionth at the centre, decays
// slowly: where no RBF reaches, wisps take the source radiance of the nearest ones.
fn weight_at(rbf: Rbf, square: f32) -> f32 {
    return rbf.weight * (exp(-square) + TAIL / ((1.0 + square) * (1.0 + square)));
}

// Probes around an RBF, at most: its centre, and both sides along x, y and z.
const PROBES: u32 = 7u;
// How far they are from its centre: a radius, but farther where the RBF is so thick that light ends before, about where
// the smoke that is left outside has an optical depth of 1, for a grey extinction and the density's scale.
fn probe_reach(rbf: Rbf, sigma: f32, density_scale: f32) -> f32 {
    let depth = sigma * density_scale * rbf.weight * rbf.radius;
    return rbf.radius * sqrt(clamp(log(max(3.0 * depth, 1e-30)), 1.0, 6.0));
}

fn probe_position(center: vec3<f32>, reach: f32, i: u32) -> vec3<f32> {
    let side = select(-reach, reach, (i & 1u) == 1u);
    let axis = (i + 1u) / 2u;
    return center + side * vec3(f32(axis == 1u), f32(axis == 2u), f32(axis == 3u));
}

// A lamp as a point sees it, without the smoke between.
struct Arriving {
    // Toward the lamp.
    direction: vec3<f32>,
    distance: f32,
    irradiance: vec3<f32>,
}

fn arriving_from(lamp: Lamp, point: vec3<f32>, softening: f32) -> Arriving {
    if lamp.is_sun != 0u {
        return Arriving(lamp.position, 1e30, lamp.color);
    }
    let offset = lamp.position - point;
    let distance_squared = dot(offset, offset);
    let distance = sqrt(distance_squared);
    let direction = offset / max(distance, 1e-9);
    // The fall-offs of Bevy's own lights, so that smoke and meshes agree.
    let in_range = distance_squared * lamp.inverse_range_squared;
    let range_share = saturate(1.0 - in_range * in_range);
    let spot_share = saturate(dot(lamp.axis, -direction) * lamp.spot_scale + lamp.spot_offset);
    let share = range_share * range_share * spot_share * spot_share / (distance_squared + softening);
    return Arriving(direction, distance, lamp.color * share);
}

// Henyey-Greenstein phase function, per steradian.
fn phase(cos_theta: f32, g: f32) -> f32 {
    let s = max(1.0 + g * g - 2.0 * g * cos_theta, 1e-6);
    return (1.0 - g * g) / (4.0 * PI * s * sqrt(s));
}
