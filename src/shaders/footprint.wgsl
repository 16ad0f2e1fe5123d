// How a Gaussian looks from a distance of u radii, and from its own centre: tables filled by `render/footprint.rs`.
// They are read by the passes themselves, between the entries below and above, since a function cannot take a table
// without a copy.
#define_import_path bevy_smoke::footprint

const ENTRIES: u32 = 256u;

struct Footprints {
    // Over u / (1 + u). x: F(u) (1 + 2 u^2), with F(u) = (sqrt(pi) / 2) Daw(u) / u; yzw: a_1, a_2, a_3, the band weights
    // of its optical depth over that of band 0.
    pairs: array<vec4<f32>, ENTRIES>,
    // Over x / (1 + x): erfcx(x) (1 + x), in x.
    selves: array<vec4<f32>, ENTRIES>,
}

// Where in `pairs` the distance u is; never past the last entry but one.
fn pair_entry(u: f32) -> f32 {
    return min(u / (1.0 + u), 0.999999) * f32(ENTRIES - 1u);
}

// F(u) of an entry of `pairs`.
fn pair_footprint(entry: vec4<f32>, u: f32) -> f32 {
    return entry.x / (1.0 + 2.0 * u * u);
}

fn self_entry(x: f32) -> f32 {
    return min(x / (1.0 + x), 0.999999) * f32(ENTRIES - 1u);
}

// exp(x^2) erfc(x) of an entry of `selves`.
fn self_footprint(entry: f32, x: f32) -> f32 {
    return entry / (1.0 + x);
}
