// Marches every pixel's ray through one volume and composites it over what is drawn so far.
// At each step, half a voxel long unless the model says otherwise, smoke of extinction sigma D emits J (1 - exp(-sigma D step)); where PRINTED_EMISSION is
// defined, sigma step times what the texture holds, J D (Zhou et al. 2008).
//
// With MSAA the rectangle is drawn once per sample: where all samples of a pixel see the same depth the first instance
// shades them all and the others return at once; at the edges of meshes each sample is marched to its own depth.
//
// Where SLABS is defined it is not the whole that is drawn but a slab of it, from one depth to another, and the instances of
// one slab come after those of another.
//
// Where CONSTELLATION is defined the texture holds no radiance, and J is summed over a light constellation at every sample
// (constellation.wgsl). Samples then are at whole numbers of steps from the eye, so that leaving out empty ones moves none.
//
// At half resolution a volume is drawn twice. Where HALF is defined, a pixel of half the size is marched through the corner
// that four pixels share, as deep as the deepest of them sees, and how deep that is is kept beside it. Where UPSAMPLED is
// defined, a pixel blends those of the four nearest that see as deep as itself (joint bilateral upsampling, Kopf et al. 2007);
// where too few do, it is marched. So smoke leaks neither before a mesh nor behind it.
#import bevy_render::view::View
#import bevy_smoke::lighting::phase
#import bevy_smoke::march::{Ray, ray_through, texture_position}
#ifdef CONSTELLATION
#import bevy_smoke::constellation::{
    Counts, NONE, Options, first_samples, lights_a_draw, loop_counts, settings, source_radiance
}
#import bevy_smoke::march::empty_samples
#endif
#ifdef TONEMAP_IN_SHADER
#import bevy_core_pipeline::tonemapping::tone_mapping
#endif

// A lamp in or near the smoke, whose glow falls with the square of a distance that cells cannot hold.
struct Glow {
    // Bundle space.
    position: vec3<f32>,
    // What `lighting.wgsl` adds to the squared distance.
    softening: f32,
    // Intensity times albedo.
    color: vec3<f32>,
    spot_scale: f32,
    axis: vec3<f32>,
    spot_offset: f32,
}

struct Smoke {
    // From normalised device coordinates to the volume's bundle space.
    bundle_from_clip: mat4x4<f32>,
    // Bundle space: the eye (w = 1, perspective); w = 0 where rays are parallel (orthographic).
    eye: vec4<f32>,
    // Corners of the rectangle on screen, in normalised device coordinates: min.xy, max.xy.
    rectangle: vec4<f32>,
    half_extent: vec3<f32>,
    // Length of a step at most, in bundle space.
    step: f32,
    // Side of a voxel in bundle space.
    cell: f32,
    // Extinction a bundle unit where the scaled density is 1.
    sigma: f32,
    // From stored radiance to exposed radiance.
    radiance_scale: f32,
    // Mean cosine of the phase function.
    g: f32,
    glow_count: u32,
    glows: array<Glow, 8>,
}

@group(0) @binding(0) var<uniform> view: View;
#ifdef MULTISAMPLED
@group(0) @binding(1) var depth_texture: texture_depth_multisampled_2d;
#else
@group(0) @binding(1) var depth_texture: texture_depth_2d;
#endif
#ifdef SLABS
// The depths, in normalised device coordinates, where each slab ends and begins: x, the farther, is 0 at infinity; y is 1
// where nothing is nearer.
@group(0) @binding(4) var<uniform> slabs: array<vec4<f32>, 8>;
#endif
#ifdef UPSAMPLED
// Exposed radiance, opacity in alpha.
@group(0) @binding(5) var half_color: texture_2d<f32>;
// As `depth_in_box` has it.
@group(0) @binding(6) var half_depth: texture_2d<f32>;
#endif
@group(1) @binding(0) var<uniform> smoke: Smoke;
// RGB: source radiance (for a CONSTELLATION, red: distance to smoke, in cells); alpha: scaled density; padded by one cell on
// each side.
@group(1) @binding(1) var volume: texture_3d<f32>;
@group(1) @binding(2) var volume_sampler: sampler;

struct Vertex {
    @builtin(position) position: vec4<f32>,
    @location(0) @interpolate(flat) sample: u32,
    // `smoke.glow_count`. Where a uniform bounds a loop, Mesa's CPU driver (lavapipe 22.3) compiles the fragment shader anew
    // at every draw, and never lets go of it; a value from the vertex stage is as good and costs nothing.
    @location(1) @interpolate(flat) glow_count: u32,
#ifdef SLABS
    @location(2) @interpolate(flat) slab: vec2<f32>,
#endif
#ifdef CONSTELLATION
    // For the same reason.
    @location(3) @interpolate(flat) counts: vec3<u32>,
    @location(4) @interpolate(flat) options: vec4<u32>,
    // Which of the lights this draw sums: from the first, to before the last.
    @location(5) @interpolate(flat) lights: vec2<u32>,
#endif
}

@vertex
fn vertex(@builtin(vertex_index) index: u32, @builtin(instance_index) instance: u32) -> Vertex {
    let corner = vec2(
        select(smoke.rectangle.x, smoke.rectangle.z, (index & 1u) == 1u),
        select(smoke.rectangle.y, smoke.rectangle.w, (index & 2u) == 2u),
    );
    var out: Vertex;
    out.position = vec4(corner, 0.0, 1.0);
    out.sample = instance;
    out.glow_count = smoke.glow_count;
#ifdef SLABS
    out.sample = instance % #{SAMPLES}u;
    out.slab = slabs[(instance / #{SAMPLES}u) % 8u].xy;
#endif
#ifdef CONSTELLATION
    let all = loop_counts();
    out.counts = vec3(all.lamps, all.casters, all.spheres);
    let options = settings.options;
    let draw = instance / (8u * #{SAMPLES}u);
    out.sample = instance % #{SAMPLES}u;
    out.lights = vec2(draw, draw + 1u) * lights_a_draw(options);
#ifdef TONEMAP_IN_SHADER
    // Display colours cannot be added up.
    out.lights = vec2(0u, options.light_count);
#endif
    out.lights.y = min(out.lights.y, options.light_count);
    out.options = vec4(options.light_count, options.shading, options.skip_empty, options.masked);
#endif
    return out;
}

// Distance along the ray to the mesh at a depth.
fn distance_to(ray: Ray, ndc: vec2<f32>, depth: f32) -> f32 {
    if depth <= 0.0 {
        return 1e30;
    }
    let point = smoke.bundle_from_clip * vec4(ndc, depth, 1.0);
    return dot(point.xyz / point.w - ray.origin, ray.direction);
}

// The padded texture at a point.
fn sample_volume(x: vec3<f32>) -> vec4<f32> {
    return textureSampleLevel(volume, volume_sampler, texture_position(x, smoke.half_extent, smoke.cell), 0.0);
}

// Distance along the ray at which a lamp is nearest, between its ends.
fn nearest(glow: Glow, ray: Ray, leave: f32) -> f32 {
    return clamp(dot(glow.position - ray.origin, ray.direction), ray.enter, leave);
}

const NEAR_LIGHT_STEPS: u32 = 12u;

// What the texture's softened light leaves out of a lamp's glow along the ray, where smoke about the nearest point is even:
//     integral of p (1 / d^2 - 1 / (d^2 + softening)) dt,   d^2 = b^2 + t^2,   t = b tan(angle),
// with t from the ray's nearest point, which is b from the lamp, in even steps of the angle: p from the middle of each,
// and the rest in closed form, angle / b - atan(t / wide) / wide with wide^2 = b^2 + softening.
// `footprint` is how far apart the rays of neighbouring pixels are along a pixel's diagonal, where they start and how much
// more a unit further: over a pixel, 1 / b is averaged.
fn near_light(glow: Glow, ray: Ray, leave: f32, footprint: vec2<f32>) -> vec3<f32> {
    let offset = glow.position - ray.origin;
    let middle = dot(offset, ray.direction);
    let blur = 0.2 * (footprint.x + footprint.y * max(middle, 0.0));
    let b2 = max(dot(offset, offset) - middle * middle, 0.0) + max(blur * blur, 1e-12);
    let b = sqrt(b2);
    let wide = sqrt(b2 + glow.softening);
    let from_to = vec2(ray.enter, leave) - middle;
    let ends = atan(from_to / b);
    let step = (ends.y - ends.x) / f32(NEAR_LIGHT_STEPS);
    var sum = 0.0;
    var before = atan(from_to.x / wide);
    for (var i = 1u; i <= NEAR_LIGHT_STEPS; i++) {
        let angle = ends.x + f32(i) * step;
        // Near a right angle the tangent is all rounding: the end is known better.
        let t = select(b * tan(angle), from_to.y, i == NEAR_LIGHT_STEPS);
        let after = atan(t / wide);
        // The lamp is ahead while t < 0.
        sum += phase(-sin(angle - 0.5 * step), smoke.g) * (step / b - (after - before) / wide);
        before = after;
    }
    let point = ray.origin + ray.direction * clamp(middle, ray.enter, leave);
    let toward = (point - glow.position) / max(distance(point, glow.position), 1e-9);
    let spot = saturate(dot(glow.axis, toward) * glow.spot_scale + glow.spot_offset);
    let sigma = smoke.sigma * sample_volume(point).a;
    return glow.color * (sum * sigma * exp(-sigma * b) * spot * spot);
}

#ifdef CONSTELLATION

// Radiance in RGB, transmittance in alpha. The i-th sample stands for what is between i and i + 1 steps from the eye; of the
// first and the last, for the part that is between the ray's ends. None before `first` is in smoke.
fn march(
    ray: Ray,
    leave: f32,
    footprint: vec2<f32>,
    glow_count: u32,
    first: u32,
    lights: vec2<u32>,
    options: Options,
    counts: Counts,
) -> vec4<f32> {
    let step = settings.step;
    let begin = u32(ray.enter / step);
    let end = u32(ceil(leave / step));
    var radiance = vec3(0.0);
    var transmittance = 1.0;
    var i = max(first, begin);
    while i < end {
        let x = ray.origin + ray.direction * ((f32(i) + 0.5) * step);
        let s = sample_volume(x);
        if s.a > 0.0 {
            for (var j = 0u; j < glow_count; j++) {
                // Where there is no smoke there is no glow.
                if clamp(u32(nearest(smoke.glows[j], ray, leave) / step), begin, end - 1u) == i {
                    radiance += near_light(smoke.glows[j], ray, leave, footprint) * transmittance;
                }
            }
            let source = source_radiance(volume, volume_sampler, x, ray.direction, lights.x, lights.y, options, counts);
            let length = min(f32(i + 1u) * step, leave) - max(f32(i) * step, ray.enter);
            let kept = exp(-smoke.sigma * s.a * max(length, 0.0));
            radiance += source * (transmittance * (1.0 - kept));
            transmittance *= kept;
            // What lies behind is not seen any more.
            if transmittance < 1e-5 {
                break;
            }
        }
        i++;
        if options.skip_empty != 0u && s.a <= 0.0 {
            i += empty_samples(s.r, ray.direction, smoke.cell, step);
        }
    }
    return vec4(radiance, transmittance);
}

#else

// Radiance in RGB, transmittance in alpha.
fn march(ray: Ray, leave: f32, footprint: vec2<f32>, glow_count: u32) -> vec4<f32> {
    let length = leave - ray.enter;
    let steps = u32(ceil(length / smoke.step));
    let step = length / f32(steps);
    var radiance = vec3(0.0);
    var transmittance = 1.0;
    for (var i = 0u; i < steps; i++) {
        let x = ray.origin + ray.direction * (ray.enter + (f32(i) + 0.5) * step);
        let s = sample_volume(x);
        for (var j = 0u; j < glow_count; j++) {
            let at = (nearest(smoke.glows[j], ray, leave) - ray.enter) / step;
            if min(u32(at), steps - 1u) == i {
                radiance += near_light(smoke.glows[j], ray, leave, footprint) * transmittance;
            }
        }
        if s.a > 0.0 {
            let kept = exp(-smoke.sigma * s.a * step);
#ifdef PRINTED_EMISSION
            // Density is in the radiance.
            radiance += s.rgb * (transmittance * smoke.sigma * step);
#else
            radiance += s.rgb * (transmittance * (1.0 - kept));
#endif
            transmittance *= kept;
            // What lies behind is not seen any more.
            if transmittance < 1e-5 {
                break;
            }
        }
    }
    return vec4(radiance, transmittance);
}

#endif

// How deep a pixel sees: where the mesh behind it is, over the radius of the sphere about the box, from -1, before, to 1,
// behind the smoke.
fn depth_in_box(ray: Ray, mesh: f32) -> f32 {
    return clamp((mesh + dot(ray.origin, ray.direction)) / length(smoke.half_extent), -1.0, 1.0);
}

#ifdef UPSAMPLED
// Pixels whose depths are so many cells apart have nothing to do with each other.
const APART: f32 = 2.0;
// So much of the four nearest has to see as deep.
const ENOUGH: f32 = 0.2;

// A pixel, from those of half the size around it; opacity -1 where too few see as deep.
fn upsampled(at: vec2<f32>, depth: f32) -> vec4<f32> {
    let x = 0.5 * at - 0.5;
    let low = floor(x);
    let f = x - low;
    let last = vec2<i32>(textureDimensions(half_color)) - 1;
    var sum = vec4(0.0);
    var total = 0.0;
    for (var i = 0u; i < 4u; i++) {
        let corner = vec2(i & 1u, i >> 1u);
        let texel = clamp(vec2<i32>(low) + vec2<i32>(corner), vec2(0), last);
        let share = select(1.0 - f, f, corner == vec2(1u));
        let apart = abs(textureLoad(half_depth, texel, 0).x - depth) * length(smoke.half_extent) / smoke.cell;
        let weight = share.x * share.y * saturate(1.0 - apart / APART);
        sum += weight * textureLoad(half_color, texel, 0);
        total += weight;
    }
    return select(vec4(0.0, 0.0, 0.0, -1.0), sum / max(total, 1e-6), total >= ENOUGH);
}
#endif

// Exposed radiance, and opacity in alpha, of what a march came to. The target may be f16, which must not overflow.
fn exposed(marched: vec4<f32>) -> vec4<f32> {
    return vec4(min(marched.rgb * smoke.radiance_scale, vec3(65504.0)), 1.0 - marched.a);
}

// Length of a pixel's diagonal, from its sides.
fn diagonal(x: vec3<f32>, y: vec3<f32>) -> f32 {
    return sqrt(dot(x, x) + dot(y, y));
}

struct Fragment {
    @location(0) color: vec4<f32>,
#ifdef HALF
    @location(1) depth: f32,
#endif
#ifdef MULTISAMPLED
    @builtin(sample_mask) mask: u32,
#endif
}

@fragment
fn fragment(in: Vertex) -> Fragment {
#ifdef HALF
    let at = 2.0 * in.position.xy + view.main_pass_viewport.xy;
#else
    let at = in.position.xy;
#endif
    let uv = (at - view.main_pass_viewport.xy) / view.main_pass_viewport.zw;
    let ndc = vec2(2.0 * uv.x - 1.0, 1.0 - 2.0 * uv.y);
    var ray = ray_through(smoke.bundle_from_clip, smoke.eye, smoke.half_extent, ndc);
    let footprint = vec2(
        diagonal(dpdx(ray.origin), dpdy(ray.origin)),
        diagonal(dpdx(ray.direction), dpdy(ray.direction)),
    );
#ifdef SLABS
    ray.leave = min(ray.leave, distance_to(ray, ndc, in.slab.x));
    if in.slab.y < 1.0 {
        ray.enter = max(ray.enter, distance_to(ray, ndc, in.slab.y));
    }
#endif
#ifdef HALF
    let end = vec2<i32>(view.main_pass_viewport.xy + view.main_pass_viewport.zw) - 1;
    var deepest = 1.0;
    for (var i = 0; i < 4; i++) {
        let pixel = min(vec2<i32>(at) - vec2(i & 1, i >> 1u), end);
        deepest = min(deepest, textureLoad(depth_texture, pixel, 0));
    }
    let mesh = distance_to(ray, ndc, deepest);
    var half: Fragment;
    half.depth = depth_in_box(ray, mesh);
    let leave = min(ray.leave, mesh);
    if leave > ray.enter {
        half.color = exposed(march(ray, leave, footprint, in.glow_count));
    }
    return half;
#else
    if ray.leave <= ray.enter {
        discard;
    }
#ifdef CONSTELLATION
    var first = 0u;
    if in.options.w != 0u {
        first = textureLoad(first_samples, vec2<i32>(at - view.main_pass_viewport.xy), 0).x;
        if first == NONE {
            discard;
        }
    }
#endif
    var leave = ray.leave;
#ifdef MULTISAMPLED
    let samples = textureNumSamples(depth_texture);
    leave = min(leave, distance_to(ray, ndc, textureLoad(depth_texture, vec2<i32>(at), i32(in.sample))));
    var nearest = leave;
    var farthest = leave;
    for (var s = 0u; s < samples; s++) {
        let other = min(ray.leave, distance_to(ray, ndc, textureLoad(depth_texture, vec2<i32>(at), i32(s))));
        nearest = min(nearest, other);
        farthest = max(farthest, other);
    }
    // One march serves all samples where their depths differ by less than it resolves.
    let shared_by_all = max(farthest, ray.enter) - max(nearest, ray.enter) < smoke.step;
    if shared_by_all && in.sample > 0u {
        discard;
    }
#else
    let mesh = distance_to(ray, ndc, textureLoad(depth_texture, vec2<i32>(at), 0));
    leave = min(leave, mesh);
#endif
    if leave <= ray.enter {
        discard;
    }
#ifdef UPSAMPLED
    var seen = upsampled(at - view.main_pass_viewport.xy, depth_in_box(ray, mesh));
    if seen.a < 0.0 {
        seen = exposed(march(ray, leave, footprint, in.glow_count));
    }
#else
#ifdef CONSTELLATION
    let options = Options(in.options.x, in.options.y, in.options.z, in.options.w);
    let counts = Counts(in.counts.x, in.counts.y, in.counts.z);
    // Lamps' glow, and what is behind, count once.
    let is_first = in.lights.x == 0u;
    let glow_count = select(0u, in.glow_count, is_first);
    let seen = exposed(march(ray, leave, footprint, glow_count, first, in.lights, options, counts));
#else
    let seen = exposed(march(ray, leave, footprint, in.glow_count));
#endif
#endif
    let opacity = seen.a;
    var color = seen.rgb;
#ifdef TONEMAP_IN_SHADER
    // The target holds display colours: tone-map the smoke's own colour, as for any translucent material.
    color = opacity * tone_mapping(vec4(color / max(opacity, 1e-5), 1.0), view.color_grading).rgb;
#endif
    var out: Fragment;
    out.color = vec4(color, opacity);
#ifdef CONSTELLATION
    out.color.a = select(0.0, opacity, is_first);
#endif
#ifdef MULTISAMPLED
    out.mask = select(1u << in.sample, 0xffffffffu, shared_by_all);
#endif
    return out;
#endif
}
