// What smoke takes of the sky's light from surfaces around it: one workgroup a probe, one thread a direction. The
// directions fill the cone in which the ellipsoid about the box is seen, and each misses the sky's radiance times the share
// that the smoke stops. The workgroup sums
//     D = sum_j L(w_j) (1 - exp(-tau_j)) dw_j   and   V = sum_j L(w_j) (1 - exp(-tau_j)) w_j dw_j,
// of which `missing_irradiance` makes what a surface misses.
#import bevy_smoke::casters::{Caster, Sky, crossing, optical_depth, shadow_probe_position, sky_radiance, PI, PROBES, PROBE_TEXELS}
#import bevy_smoke::frame::MAX_HALF

const DIRECTIONS: u32 = 64u;
const STEPS: u32 = 16u;
const GOLDEN_ANGLE: f32 = 2.39996322972865;
// Of the ellipsoid about a box, in half sides: sqrt(3).
const RADIUS_SQUARED: f32 = 3.0;

// Its `bundle_from_here` is from the world.
@group(0) @binding(0) var<uniform> caster: Caster;
@group(0) @binding(1) var<uniform> sky: Sky;
@group(0) @binding(2) var<uniform> environment: array<vec4<f32>, 16>;
@group(0) @binding(3) var<uniform> world_from_bundle: mat4x4<f32>;
@group(0) @binding(4) var densities: texture_3d<f32>;
@group(0) @binding(5) var linear: sampler;
@group(0) @binding(6) var probes: texture_storage_3d<rgba16float, write>;

// Radiance that is missing times its solid angle, and where it would come from.
var<workgroup> missing: array<vec3<f32>, DIRECTIONS>;
var<workgroup> directions: array<vec3<f32>, DIRECTIONS>;

@compute @workgroup_size(DIRECTIONS)
fn gather(
    @builtin(workgroup_id) probe: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    // Where the box is a cube of half side 1 the ellipsoid is a sphere, and even directions fill its cone.
    let position = shadow_probe_position(caster, probe) / caster.half_extent;
    let distance_squared = dot(position, position);
    let outside = distance_squared > RADIUS_SQUARED;
    let cosine = select(-1.0, sqrt(max(1.0 - RADIUS_SQUARED / distance_squared, 0.0)), outside);
    let z = select(vec3(0.0, 0.0, 1.0), -normalize(position), outside);
    let x = normalize(select(cross(z, vec3(1.0, 0.0, 0.0)), cross(z, vec3(0.0, 1.0, 0.0)), abs(z.x) > 0.7));
    let y = cross(z, x);
    let height = 1.0 - (1.0 - cosine) * (f32(thread) + 0.5) / f32(DIRECTIONS);
    let side = sqrt(max(1.0 - height * height, 0.0));
    let phi = f32(thread) * GOLDEN_ANGLE;
    // Back to the world, where they are no longer even: det / |stretched|^3 times the solid angle.
    let even = x * (side * cos(phi)) + y * (side * sin(phi)) + z * height;
    let stretched = caster.half_extent * even;
    let stretch = length(stretched);
    let volume = caster.half_extent.x * caster.half_extent.y * caster.half_extent.z;
    let solid_angle = 2.0 * PI * (1.0 - cosine) / f32(DIRECTIONS) * volume / (stretch * stretch * stretch);
    let point = (world_from_bundle * vec4(position * caster.half_extent, 1.0)).xyz;
    let towards = normalize((world_from_bundle * vec4(stretched, 0.0)).xyz);

    let tau = optical_depth(caster, densities, linear, crossing(caster, point, towards, 1e30), STEPS);
    var radiance = vec3(0.0);
    if tau > 0.0 {
        radiance = max(sky_radiance(sky, environment, towards), vec3(0.0)) * (1.0 - exp(-tau));
    }
    missing[thread] = radiance * solid_angle;
    directions[thread] = towards;
    workgroupBarrier();
    if thread < PROBE_TEXELS {
        var sum = vec4(0.0);
        for (var j = 0u; j < DIRECTIONS; j++) {
            sum += missing[j][thread] * vec4(1.0, directions[j]);
        }
        // At the grid's end the shadow ends.
        let inner = all(probe > vec3(0u)) && all(probe < vec3(PROBES - 1u));
        let layer = (caster.slot * PROBE_TEXELS + thread) * PROBES + probe.z;
        textureStore(probes, vec3(probe.xy, layer), select(vec4(0.0), clamp(sum, vec4(-MAX_HALF), vec4(MAX_HALF)), inner));
    }
}
