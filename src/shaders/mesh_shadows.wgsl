// Shades the opaque meshes of a view by the smoke around them: multiplies what is drawn so far by
//     (E_sky + sum E_light exp(-tau)) / (E_sky,clear + sum E_light),
// irradiances on each pixel's surface with and without the smoke. E_sky is the environment's less what the shadow probes
// say that smoke takes of it; E_light that of Bevy's own lights behind Bevy's own shadow maps.
#import bevy_pbr::clustered_forward as clustering
#import bevy_pbr::mesh_view_bindings as view_bindings
#import bevy_pbr::mesh_view_types::{DIRECTIONAL_LIGHT_FLAGS_SHADOWS_ENABLED_BIT, POINT_LIGHT_FLAGS_SHADOWS_ENABLED_BIT, POINT_LIGHT_FLAGS_SPOT_LIGHT_Y_NEGATIVE}
#import bevy_pbr::shadows::{fetch_directional_shadow, fetch_point_shadow, fetch_spot_shadow}
#import bevy_smoke::casters::{Caster, Sky, crossing, missing_irradiance, optical_depth, shadow_probe_texel, MAX_CASTERS, PI, PROBES, PROBE_TEXELS}
#import bevy_smoke::sh::{basis, band}
#ifdef TONEMAP_IN_SHADER
#import bevy_core_pipeline::tonemapping::tone_mapping
#endif

struct MeshShadows {
    sky: Sky,
    caster_count: u32,
    // Directional lights of the view, at most.
    sun_count: u32,
    sphere_count: u32,
    casters: array<Caster, MAX_CASTERS>,
}

@group(2) @binding(0) var<uniform> scene: MeshShadows;
@group(2) @binding(1) var<uniform> environment: array<vec4<f32>, 16>;
#ifdef MULTISAMPLED
@group(2) @binding(2) var depth_texture: texture_depth_multisampled_2d;
#else
@group(2) @binding(2) var depth_texture: texture_depth_2d;
#endif
@group(2) @binding(3) var densities: texture_3d<f32>;
@group(2) @binding(4) var shadow_probes: texture_3d<f32>;
@group(2) @binding(5) var linear: sampler;
#ifdef OCCLUDERS
struct Occlusion {
    // Directions and weights, w, that integrate the sphere.
    directions: array<vec4<f32>, 32>,
    // The logarithm of a sphere's visibility: factors of four bands, over radius / distance from 0 to 1.
    log_visibility: array<vec4<f32>, 64>,
}
@group(2) @binding(6) var<uniform> occlusion: Occlusion;
// Centres in the world and radii.
@group(2) @binding(7) var<storage, read> spheres: array<vec4<f32>>;
#endif
#ifdef MASKED
// 1 where meshes are that are not shaded.
#ifdef MULTISAMPLED
@group(3) @binding(0) var mask_texture: texture_multisampled_2d<f32>;
#else
@group(3) @binding(0) var mask_texture: texture_2d<f32>;
#endif
#endif

// Radiance of a surface that reflects 18 % over its irradiance.
const GREY: f32 = 0.18 / PI;

// A smaller share of light that is missing is not seen: a quarter of a step of 8 bits at most.
const FAINT: f32 = 2e-3;

// Directional lights of a view, at most; as in `render/mesh_shadows.rs`.
const MAX_SUNS: u32 = 10u;

// Steps through a caster's coarse grid toward a light.
const STEPS: u32 = 24u;

struct Vertex {
    @builtin(position) position: vec4<f32>,
    @location(0) @interpolate(flat) sample: u32,
    // Bounds of loops, which a uniform must not give the fragment shader: see `view.wgsl`.
    @location(1) @interpolate(flat) caster_count: u32,
    @location(2) @interpolate(flat) sun_count: u32,
    @location(3) @interpolate(flat) sphere_count: u32,
}

@vertex
fn vertex(@builtin(vertex_index) index: u32, @builtin(instance_index) sample: u32) -> Vertex {
    let corner = vec2(f32(index >> 1u), f32(index & 1u)) * 4.0 - 1.0;
    return Vertex(vec4(corner, 0.0, 1.0), sample, scene.caster_count, scene.sun_count, scene.sphere_count);
}

// In the place of a sample's number: the mean of a pixel's samples, which on a plane is the depth of its middle.
const ALL_SAMPLES: u32 = 0xffffu;

fn depth_at(pixel: vec2<i32>, sample: u32) -> f32 {
#ifdef MULTISAMPLED
    if sample == ALL_SAMPLES {
        var sum = 0.0;
        for (var i = 0u; i < #{SAMPLES}u; i++) {
            sum += textureLoad(depth_texture, pixel, i32(i));
        }
        return sum / f32(#{SAMPLES}u);
    }
    return textureLoad(depth_texture, pixel, i32(sample));
#else
    return textureLoad(depth_texture, pixel, 0);
#endif
}

#ifdef MASKED
fn is_masked(pixel: vec2<i32>, sample: u32) -> bool {
#ifdef MULTISAMPLED
    return textureLoad(mask_texture, pixel, i32(sample)).r > 0.5;
#else
    return textureLoad(mask_texture, pixel, 0).r > 0.5;
#endif
}
#endif

fn world_position(pixel: vec2<f32>, depth: f32) -> vec3<f32> {
    let uv = (pixel - view_bindings::view.main_pass_viewport.xy) / view_bindings::view.main_pass_viewport.zw;
    let world = view_bindings::view.world_from_clip * vec4(uv * vec2(2.0, -2.0) + vec2(-1.0, 1.0), depth, 1.0);
    return world.xyz / world.w;
}

// From a pixel's surface to that of its nearer neighbour along an axis: across the edge of a mesh there is no slope.
fn slope(point: vec3<f32>, pixel: vec2<f32>, axis: vec2<f32>, sample: u32) -> vec3<f32> {
    let ahead = world_position(pixel + axis, depth_at(vec2<i32>(pixel + axis), sample)) - point;
    let behind = point - world_position(pixel - axis, depth_at(vec2<i32>(pixel - axis), sample));
    return select(ahead, behind, dot(behind, behind) < dot(ahead, ahead));
}

// The normal of the surface that a pixel shows, toward the eye.
fn surface_normal(point: vec3<f32>, pixel: vec2<f32>, sample: u32) -> vec3<f32> {
#ifdef NORMAL_PREPASS
#ifdef MULTISAMPLED
    let stored = textureLoad(view_bindings::normal_prepass_texture, vec2<i32>(pixel), i32(select(sample, 0u, sample == ALL_SAMPLES)));
#else
    let stored = textureLoad(view_bindings::normal_prepass_texture, vec2<i32>(pixel), 0);
#endif
    // Materials without a prepass leave none.
    if any(stored.xyz != vec3(0.0)) {
        return normalize(2.0 * stored.xyz - 1.0);
    }
#endif
    let normal = cross(slope(point, pixel, vec2(0.0, 1.0), sample), slope(point, pixel, vec2(1.0, 0.0), sample));
    return normal / max(length(normal), 1e-30);
}

// Irradiance of the sky, sun included, on a surface: bands count for pi, 2 pi / 3 and pi / 4 (Ramamoorthi and Hanrahan
// 2001).
fn sky_irradiance(normal: vec3<f32>) -> vec3<f32> {
    let y = basis(scene.sky.environment_from_world * normal);
    var linear_bands = vec3(0.0);
    for (var k = 1u; k < 4u; k++) {
        linear_bands += y[k] * environment[k].rgb;
    }
    var quadratic_bands = vec3(0.0);
    for (var k = 4u; k < 9u; k++) {
        quadratic_bands += y[k] * environment[k].rgb;
    }
    let irradiance = PI * (y[0] * environment[0].rgb + 2.0 / 3.0 * linear_bands + 0.25 * quadratic_bands);
    return max(irradiance * scene.sky.scale + PI * scene.sky.ambient, vec3(0.0));
}

// What a caster takes of the sky's irradiance.
fn sky_missing(caster: Caster, point: vec3<f32>, normal: vec3<f32>) -> vec3<f32> {
    let texel = shadow_probe_texel(caster, (caster.bundle_from_here * vec4(point, 1.0)).xyz);
    if any(texel < vec3(0.5)) {
        return vec3(0.0);
    }
    let size = vec3<f32>(textureDimensions(shadow_probes));
    var missing: vec3<f32>;
    for (var i = 0u; i < PROBE_TEXELS; i++) {
        let layer = f32((caster.slot * PROBE_TEXELS + i) * PROBES);
        let probe = textureSampleLevel(shadow_probes, linear, (texel + vec3(0.0, 0.0, layer)) / size, 0.0);
        missing[i] = missing_irradiance(probe, normal);
    }
    return missing;
}

#ifdef OCCLUDERS
// Spheres that look smaller than this, radius over distance, are left out.
const SMALLEST: f32 = 0.02;

// The share of the sky's irradiance that spheres leave to a surface (Ren et al. 2006): see `reference/occlusion.rs`.
fn unoccluded(point: vec3<f32>, normal: vec3<f32>, sphere_count: u32) -> vec3<f32> {
    let turn = scene.sky.environment_from_world;
    // Optical depth, as it were, in the environment's axes.
    var depth: array<f32, 16>;
    var met = false;
    for (var i = 0u; i < sphere_count; i++) {
        let sphere = spheres[i];
        let offset = sphere.xyz - point;
        let distance = length(offset);
        let sine = min(sphere.w / max(distance, 1e-9), 1.0);
        let above = clamp(dot(offset, normal) / sphere.w + 1.0, 0.0, 1.0);
        if sine > SMALLEST && above > 0.0 {
            let position = sine * 63.0;
            let below = min(u32(position), 62u);
            let bands = above * mix(occlusion.log_visibility[below], occlusion.log_visibility[below + 1u], position - f32(below));
            let y = basis(turn * (offset / max(distance, 1e-9)));
            for (var k = 0u; k < 16u; k++) {
                depth[k] += bands[band(k)] * y[k];
            }
            met = true;
        }
    }
    if !met {
        return vec3(1.0);
    }
    // The sums over directions of weight, cosine and visibility, against each coefficient of the sky's light.
    var clear: array<f32, 16>;
    var lit: array<f32, 16>;
    for (var j = 0u; j < 32u; j++) {
        let towards = occlusion.directions[j];
        let weight = towards.w * max(dot(turn * normal, towards.xyz), 0.0);
        if weight > 0.0 {
            let y = basis(towards.xyz);
            var exponent = 0.0;
            for (var k = 0u; k < 16u; k++) {
                exponent += depth[k] * y[k];
            }
            let visible = weight * exp(exponent);
            for (var k = 0u; k < 16u; k++) {
                clear[k] += weight * y[k];
                lit[k] += visible * y[k];
            }
        }
    }
    var clear_light = clear[0] * 2.0 * sqrt(PI) * scene.sky.ambient;
    var lit_light = lit[0] * 2.0 * sqrt(PI) * scene.sky.ambient;
    for (var k = 0u; k < 16u; k++) {
        clear_light += clear[k] * scene.sky.scale * environment[k].rgb;
        lit_light += lit[k] * scene.sky.scale * environment[k].rgb;
    }
    return select(vec3(1.0), clamp(lit_light / max(clear_light, vec3(1e-30)), vec3(0.0), vec3(1.0)), clear_light > vec3(0.0));
}
#endif

// Whether light can meet smoke on its way to a point.
fn meets_smoke(point: vec3<f32>, towards: vec3<f32>, distance: f32, caster_count: u32) -> bool {
    for (var i = 0u; i < caster_count; i++) {
        let ray = crossing(scene.casters[i], point, towards, distance);
        if ray.end > ray.begin {
            return true;
        }
    }
    return false;
}

// The share of light that smoke lets through to a point.
fn transmittance(point: vec3<f32>, towards: vec3<f32>, distance: f32, caster_count: u32) -> f32 {
    var tau = 0.0;
    for (var i = 0u; i < caster_count; i++) {
        let ray = crossing(scene.casters[i], point, towards, distance);
        tau += optical_depth(scene.casters[i], densities, linear, ray, STEPS);
    }
    return exp(-tau);
}

// Irradiance of a lamp of the view on a surface, as Bevy lights it.
fn lamp_irradiance(lamp: u32, is_spot: bool, point: vec3<f32>, normal: vec3<f32>, pixel: vec2<f32>) -> vec3<f32> {
    let light = &view_bindings::clustered_lights.data[lamp];
    let offset = (*light).position_radius.xyz - point;
    let square = dot(offset, offset);
    let towards = offset * inverseSqrt(max(square, 1e-12));
    let in_range = square * (*light).color_inverse_square_range.w;
    let range_share = saturate(1.0 - in_range * in_range);
    var share = range_share * range_share / max(square, 1e-4) * max(dot(normal, towards), 0.0);
    if is_spot {
        var axis = vec3((*light).light_custom_data.x, 0.0, (*light).light_custom_data.y);
        axis.y = sqrt(max(0.0, 1.0 - axis.x * axis.x - axis.z * axis.z));
        if ((*light).flags & POINT_LIGHT_FLAGS_SPOT_LIGHT_Y_NEGATIVE) != 0u {
            axis.y = -axis.y;
        }
        let spot = saturate(dot(-axis, towards) * (*light).light_custom_data.z + (*light).light_custom_data.w);
        share *= spot * spot;
    }
    if share <= 0.0 {
        return vec3(0.0);
    }
    if ((*light).flags & POINT_LIGHT_FLAGS_SHADOWS_ENABLED_BIT) != 0u {
        if is_spot {
            share *= fetch_spot_shadow(lamp, vec4(point, 1.0), normal, (*light).shadow_map_near_z, pixel);
        } else {
            share *= fetch_point_shadow(lamp, vec4(point, 1.0), normal, pixel);
        }
    }
    return (*light).color_inverse_square_range.rgb * share;
}

struct Fragment {
    @location(0) color: vec4<f32>,
#ifdef MULTISAMPLED
    @builtin(sample_mask) mask: u32,
#endif
}

@fragment
fn fragment(in: Vertex) -> Fragment {
    let pixel = in.position.xy;
    var sample = in.sample;
    var depth = depth_at(vec2<i32>(pixel), sample);
    var out: Fragment;
#ifdef MASKED
    if is_masked(vec2<i32>(pixel), in.sample) {
        discard;
    }
#endif
#ifdef MULTISAMPLED
    // Where all samples see about the same depth the first shades them all.
    var nearest = depth;
    var farthest = depth;
    for (var i = 0u; i < #{SAMPLES}u; i++) {
        let other = depth_at(vec2<i32>(pixel), i);
        nearest = max(nearest, other);
        farthest = min(farthest, other);
    }
    var shared_by_all = nearest - farthest < 0.02 * nearest;
#ifdef MASKED
    for (var i = 0u; i < #{SAMPLES}u; i++) {
        shared_by_all = shared_by_all && !is_masked(vec2<i32>(pixel), i);
    }
#endif
    if shared_by_all && sample > 0u {
        discard;
    }
    out.mask = select(1u << sample, 0xffffffffu, shared_by_all);
    if shared_by_all {
        sample = ALL_SAMPLES;
        depth = depth_at(vec2<i32>(pixel), sample);
    }
#endif
    // Nothing but sky.
    if depth <= 0.0 {
        discard;
    }
    let point = world_position(pixel, depth);
    let normal = surface_normal(point, pixel, sample);

    let is_orthographic = view_bindings::view.clip_from_view[3].w == 1.0;
    let view_z = (view_bindings::view.view_from_world * vec4(point, 1.0)).z;
    let cluster = clustering::view_fragment_cluster_index(pixel, view_z, is_orthographic);
    let lamps = clustering::unpack_clusterable_object_index_ranges(cluster);

    // Most surfaces are out of the smoke's reach, or so far that nobody would tell: they are left as they are.
    let clear_sky = sky_irradiance(normal);
    var sky = clear_sky;
    let sun = transpose(scene.sky.environment_from_world) * scene.sky.sun_direction;
    let sun_irradiance = scene.sky.sun_irradiance * (scene.sky.scale * max(dot(sun, normal), 0.0));
    let has_sun = any(sun_irradiance > vec3(0.0));
    var sun_depth = 0.0;
    var sun_depths: array<f32, MAX_SUNS>;
    for (var i = 0u; i < in.caster_count; i++) {
        let caster = scene.casters[i];
        let missing = sky_missing(caster, point, normal);
        // Behind one another, casters take of what is left.
        sky *= 1.0 - min(missing / max(clear_sky, vec3(1e-30)), vec3(1.0));
        if has_sun {
            sun_depth += optical_depth(caster, densities, linear, crossing(caster, point, sun, 1e30), STEPS);
        }
        for (var j = 0u; j < in.sun_count; j++) {
            let towards = view_bindings::lights.directional_lights[j].direction_to_light;
            if dot(towards, normal) > 0.0 {
                sun_depths[j] += optical_depth(caster, densities, linear, crossing(caster, point, towards, 1e30), STEPS);
            }
        }
    }
#ifdef OCCLUDERS
    sky *= unoccluded(point, normal, in.sphere_count);
#endif
    sky = max(sky - sun_irradiance * (1.0 - exp(-sun_depth)), vec3(0.0));
    var shaded = any(clear_sky - sky > FAINT * clear_sky);
    for (var j = 0u; j < in.sun_count; j++) {
        shaded = shaded || sun_depths[j] > FAINT;
    }
    for (var i = lamps.first_point_light_index_offset; i < lamps.first_reflection_probe_index_offset; i++) {
        let lamp = clustering::get_clusterable_object_id(i);
        let offset = view_bindings::clustered_lights.data[lamp].position_radius.xyz - point;
        let distance = length(offset);
        shaded = shaded || meets_smoke(point, offset / max(distance, 1e-6), distance, in.caster_count);
    }
    if !shaded {
        discard;
    }

    var clear = clear_sky * scene.sky.unit;
    var lit = sky * scene.sky.unit;
    for (var i = 0u; i < in.sun_count; i++) {
        let light = &view_bindings::lights.directional_lights[i];
        let towards = (*light).direction_to_light;
        var irradiance = (*light).color.rgb * max(dot(towards, normal), 0.0);
        if all(irradiance <= vec3(0.0)) {
            continue;
        }
        if ((*light).flags & DIRECTIONAL_LIGHT_FLAGS_SHADOWS_ENABLED_BIT) != 0u {
            irradiance *= fetch_directional_shadow(i, vec4(point, 1.0), normal, view_z, pixel);
        }
        clear += irradiance;
        lit += irradiance * exp(-sun_depths[i]);
    }
    for (var i = lamps.first_point_light_index_offset; i < lamps.first_reflection_probe_index_offset; i++) {
        let lamp = clustering::get_clusterable_object_id(i);
        let irradiance = lamp_irradiance(lamp, i >= lamps.first_spot_light_index_offset, point, normal, pixel);
        if all(irradiance <= vec3(0.0)) {
            continue;
        }
        let offset = view_bindings::clustered_lights.data[lamp].position_radius.xyz - point;
        let distance = length(offset);
        clear += irradiance;
        lit += irradiance * transmittance(point, offset / max(distance, 1e-6), distance, in.caster_count);
    }
#ifdef TONEMAP_IN_SHADER
    // The target holds display colours: shade them as those of a surface that reflects 18 %.
    let grey = GREY * view_bindings::view.exposure;
    clear = tone_mapping(vec4(clear * grey, 1.0), view_bindings::view.color_grading).rgb;
    lit = tone_mapping(vec4(lit * grey, 1.0), view_bindings::view.color_grading).rgb;
#endif
    let kept = select(vec3(1.0), clamp(lit / max(clear, vec3(1e-30)), vec3(0.0), vec3(1.0)), clear > vec3(0.0));
    out.color = vec4(kept, 1.0);
    return out;
}
