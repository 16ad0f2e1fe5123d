// Smoke that shades what is around it, and the sky that it shades from it.
// Filled by `CasterUniform` (render/casters.rs) and `SkyUniform` (render/sky.rs).
#define_import_path bevy_smoke::casters
#import bevy_smoke::sh::basis

const MAX_CASTERS: u32 = 8u;
const PI: f32 = 3.14159265358979;

struct Caster {
    // From the space of whoever asks, the world or another volume's bundle space, to the caster's bundle space.
    bundle_from_here: mat4x4<f32>,
    // Half the sides of its box, bundle units.
    half_extent: vec3<f32>,
    // Extinction a bundle unit where the scaled density is 1.
    sigma: f32,
    // Texels a side of its coarse grid, with an empty one on each side.
    padded: vec3<f32>,
    // Side of a texel in bundle space.
    texel: f32,
    // Its place in the textures that the casters share.
    slot: u32,
}

struct Sky {
    environment_from_world: mat3x3<f32>,
    // Radiance from everywhere on top of the environment.
    ambient: vec3<f32>,
    // Multiplies the environment's coefficients.
    scale: f32,
    // A sun that the coefficients contain and that is lit as a ray: in the environment's axes and units.
    sun_direction: vec3<f32>,
    sun_irradiance: vec3<f32>,
    // What 1 of all these stands for, cd/m^2.
    unit: f32,
}

// Layers of the shared density texture a slot.
const SLOT_LAYERS: u32 = 66u;

// A ray in a caster's bundle space, and where it is in smoke; in none where end <= begin.
struct Crossing {
    origin: vec3<f32>,
    direction: vec3<f32>,
    begin: f32,
    end: f32,
}

// The way of light through a caster's smoke to a point, `distance` long.
fn crossing(caster: Caster, point: vec3<f32>, towards: vec3<f32>, distance: f32) -> Crossing {
    let origin = (caster.bundle_from_here * vec4(point, 1.0)).xyz;
    let along = (caster.bundle_from_here * vec4(towards, 0.0)).xyz;
    let stretch = length(along);
    let direction = along / stretch;
    // Beyond half a texel outside the grid the trilinear density is zero.
    let half_extent = 0.5 * (caster.padded - 1.0) * caster.texel;
    let inverse = 1.0 / select(direction, vec3(1e-9), abs(direction) < vec3(1e-9));
    let a = (-half_extent - origin) * inverse;
    let b = (half_extent - origin) * inverse;
    let nearer = min(a, b);
    let farther = max(a, b);
    let begin = max(max(nearer.x, nearer.y), max(nearer.z, 0.0));
    let end = min(min(farther.x, distance * stretch), min(farther.y, farther.z));
    return Crossing(origin, direction, begin, end);
}

// Optical depth along a crossing, in steps of equal length.
fn optical_depth(caster: Caster, densities: texture_3d<f32>, linear: sampler, ray: Crossing, steps: u32) -> f32 {
    if ray.end <= ray.begin {
        return 0.0;
    }
    let step = (ray.end - ray.begin) / f32(steps);
    let size = vec3<f32>(textureDimensions(densities));
    let first = vec3(0.0, 0.0, f32(caster.slot * SLOT_LAYERS));
    var sum = 0.0;
    for (var i = 0u; i < steps; i++) {
        let x = ray.origin + ray.direction * (ray.begin + (f32(i) + 0.5) * step);
        let texel = clamp(x / caster.texel + 0.5 * caster.padded, vec3(0.5), caster.padded - 0.5);
        sum += textureSampleLevel(densities, linear, (first + texel) / size, 0.0).x;
    }
    return caster.sigma * sum * step;
}

// Shadow probes: what a caster takes of the sky at PROBES points a side of a grid that reaches to REACH half sides of the
// box in every direction; denser near the box, as p / (|p| + half side).
const PROBES: u32 = 24u;
const REACH: f32 = 12.0;
// Texels a probe, one a colour: the radiance that is missing over all directions, and the same times the direction.
const PROBE_TEXELS: u32 = 3u;

// The irradiance that is missing on a surface, for a colour of a probe. Where all of it comes from above the surface it is
// n . v; where all comes from below, none; a smooth step between, as wide as what is missing is spread.
fn missing_irradiance(probe: vec4<f32>, normal: vec3<f32>) -> f32 {
    let along = dot(normal, probe.yzw);
    let spread = max(probe.x * probe.x - dot(probe.yzw, probe.yzw), 0.0);
    return 0.5 * (along + sqrt(along * along + 0.25 * spread));
}

// Where a probe is, in bundle space.
fn shadow_probe_position(caster: Caster, probe: vec3<u32>) -> vec3<f32> {
    let along = (2.0 * vec3<f32>(probe) / f32(PROBES - 1u) - 1.0) * (REACH / (REACH + 1.0));
    return caster.half_extent * along / (1.0 - abs(along));
}

// Where among the probes a point of bundle space is, in texels; outside them where any is below 0.5.
fn shadow_probe_texel(caster: Caster, point: vec3<f32>) -> vec3<f32> {
    let along = point / (abs(point) + caster.half_extent) * ((REACH + 1.0) / REACH);
    return select(0.5 * (along + 1.0) * f32(PROBES - 1u) + 0.5, vec3(0.0), abs(along) > vec3(1.0));
}

// Radiance of the sky without the sun.
fn sky_radiance(sky: Sky, environment: array<vec4<f32>, 16>, towards: vec3<f32>) -> vec3<f32> {
    let y = basis(sky.environment_from_world * towards);
    let sun = basis(sky.sun_direction);
    var radiance = vec3(0.0);
    for (var k = 0u; k < 16u; k++) {
        radiance += y[k] * (environment[k].rgb - sun[k] * sky.sun_irradiance);
    }
    return radiance * sky.scale + sky.ambient;
}
