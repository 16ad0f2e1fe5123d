// Single scattering from a light constellation (Navarro et al. 2008, Eq. 3): what the view pass draws where CONSTELLATION is
// defined. At a point x the smoke scatters toward the eye, along the ray's direction v,
//     J(x) = albedo sum over lights of p(w . v) E T(x, w),
// w toward the light, E its irradiance (radiance times solid angle) and T what smoke and spheres let through to x. The paper's
// Program 1 multiplies by 1 / 16 pi^2 where its Eq. 3 has 1 / 4 pi, the isotropic p; this is Eq. 3.
#define_import_path bevy_smoke::constellation
#import bevy_smoke::casters::{crossing, optical_depth}
#import bevy_smoke::lighting::{Lighting, arriving_from, phase}
#import bevy_smoke::march::{empty_samples, ray_in_box, texture_position}
#import bevy_smoke::occluders::{Surroundings, hides}

// What is counted and chosen; integers on their own, for the vertex stage to hand on.
struct Options {
    light_count: u32,
    // One of the constants below.
    shading: u32,
    // Whether to leave out samples that the distance map says are empty: 0 or 1.
    skip_empty: u32,
    // Whether there is a validity mask: 0 or 1.
    masked: u32,
}

struct Settings {
    options: Options,
    half_extent: vec3<f32>,
    // Side of a cell in bundle space.
    cell: f32,
    // Between samples along view rays and shadow rays, in bundle space.
    step: f32,
    shadow_step: f32,
}

struct Light {
    // Toward the light, in the environment's axes.
    direction: vec3<f32>,
    // Irradiance on a surface that faces it.
    color: vec3<f32>,
}

struct Constellation {
    // Radiance, the mean over all directions.
    mean: vec3<f32>,
    lights: array<Light, 256>,
}

// Smoke that shines by itself, albedo times the mean radiance, as if light came from everywhere through nothing.
const ALPHA: u32 = 0u;
// T = 1.
const PRIMARY: u32 = 1u;
// All of it.
const SELF_SHADOW: u32 = 2u;

// Of pixels that show no smoke; as in constellation_mask.wgsl.
const NONE: u32 = 0xffffffffu;
// Shadow rays end where no more than a millionth gets through.
const DARK: f32 = 14.0;
// Steps through other smoke.
const OTHER_STEPS: u32 = 16u;

@group(1) @binding(3) var<uniform> settings: Settings;
@group(1) @binding(4) var<uniform> lighting: Lighting;
@group(1) @binding(5) var<uniform> surroundings: Surroundings;
@group(1) @binding(6) var<uniform> constellation: Constellation;
@group(1) @binding(7) var<storage, read> spheres: array<vec4<f32>>;
// The casters' densities.
@group(1) @binding(8) var densities: texture_3d<f32>;
@group(1) @binding(9) var first_samples: texture_2d<u32>;

// What ends the loops of a fragment: handed on by the vertex stage, see view.wgsl.
struct Counts {
    lamps: u32,
    casters: u32,
    spheres: u32,
}

// Lights that one draw sums, where draws can be added up: long loops are not every driver's strength, and Mesa's CPU driver
// (lavapipe 22.3) silently ends a shader's loops after 65,535 rounds of all of them together. Few draws, for each rounds what
// a target of halves holds. As in render/constellation/mod.rs.
fn lights_a_draw(options: Options) -> u32 {
    return select(options.light_count, max(4u, (options.light_count + 15u) / 16u), options.shading == SELF_SHADOW);
}

fn loop_counts() -> Counts {
    return Counts(lighting.lamp_count, surroundings.caster_count, surroundings.sphere_count);
}

// Distance (red) and density (alpha) at a point of a shadow ray.
fn sample_toward(volume: texture_3d<f32>, linear: sampler, x: vec3<f32>, towards: vec3<f32>, distance: f32) -> vec4<f32> {
    let at = texture_position(x + towards * distance, settings.half_extent, settings.cell);
    return textureSampleLevel(volume, linear, at, 0.0);
}

// Optical depth of the volume itself from a point toward a light. `volume` holds distance (red) and density (alpha).
fn own_depth(volume: texture_3d<f32>, linear: sampler, x: vec3<f32>, towards: vec3<f32>, distance: f32, skip: bool) -> f32 {
    let ray = ray_in_box(x, towards, settings.half_extent);
    let end = max(min(ray.leave, distance), 0.0);
    let step = settings.shadow_step;
    let samples = u32(ceil(end / step));
    let dark = DARK / max(lighting.sigma_mean, 1e-30);
    var sum = 0.0;
    var i = 0u;
    // Four at a time: none waits for another, and a loop has fewer rounds. Of those past the end nothing counts.
    while i < samples && sum < dark {
        let begin = (f32(i) + vec4(0.0, 1.0, 2.0, 3.0)) * step;
        let a = sample_toward(volume, linear, x, towards, begin.x + 0.5 * step);
        let b = sample_toward(volume, linear, x, towards, begin.y + 0.5 * step);
        let c = sample_toward(volume, linear, x, towards, begin.z + 0.5 * step);
        let d = sample_toward(volume, linear, x, towards, begin.w + 0.5 * step);
        sum += dot(vec4(a.a, b.a, c.a, d.a), clamp(end - begin, vec4(0.0), vec4(step)));
        i += 4u;
        if skip && d.a <= 0.0 {
            i += empty_samples(d.r, towards, settings.cell, step);
        }
    }
    return lighting.sigma_mean * sum;
}

// What gets through to a point from a light; that of spheres is all or nothing.
fn transmittance(
    volume: texture_3d<f32>,
    linear: sampler,
    x: vec3<f32>,
    towards: vec3<f32>,
    distance: f32,
    skip: bool,
    counts: Counts,
) -> f32 {
    var hidden = false;
    for (var i = 0u; i < counts.spheres && !hidden; i++) {
        hidden = hides(spheres[i], x, towards, distance);
    }
    if hidden {
        return 0.0;
    }
    var depth = own_depth(volume, linear, x, towards, distance, skip);
    for (var i = 0u; i < counts.casters; i++) {
        let caster = surroundings.casters[i];
        depth += optical_depth(caster, densities, linear, crossing(caster, x, towards, distance), OTHER_STEPS);
    }
    return exp(-depth);
}

// Source radiance J at a point, toward an eye that looks along `look`: the share of lights `first` to `last`, and of the lamps
// where `first` is 0.
fn source_radiance(
    volume: texture_3d<f32>,
    linear: sampler,
    x: vec3<f32>,
    look: vec3<f32>,
    first: u32,
    last: u32,
    options: Options,
    counts: Counts,
) -> vec3<f32> {
    let albedo = lighting.scatter[0].rgb;
    if options.shading == ALPHA {
        return albedo * constellation.mean;
    }
    let shadowed = options.shading == SELF_SHADOW;
    let skip = options.skip_empty != 0u;
    var sum = vec3(0.0);
    for (var n = first; n < last; n++) {
        let light = constellation.lights[n];
        // As of the dark half of a sky.
        if all(light.color == vec3(0.0)) {
            continue;
        }
        // By the inverse of the rotation, its transpose.
        let towards = light.direction * lighting.environment_from_bundle;
        var through = phase(dot(towards, look), lighting.g);
        if shadowed {
            through *= transmittance(volume, linear, x, towards, 1e30, skip, counts);
        }
        sum += light.color * through;
    }
    let lamps = select(0u, counts.lamps, first == 0u);
    for (var n = 0u; n < lamps; n++) {
        let lamp = arriving_from(lighting.lamps[n], x, lighting.softening);
        var through = phase(dot(lamp.direction, look), lighting.g);
        if shadowed {
            through *= transmittance(volume, linear, x, lamp.direction, lamp.distance, skip, counts);
        }
        sum += lamp.irradiance * through;
    }
    return albedo * sum;
}
