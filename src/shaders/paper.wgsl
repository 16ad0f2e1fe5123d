// What the passes of Zhou et al. 2008 share. Extinction here is sigma_t a bundle unit and unit of density.
#define_import_path bevy_smoke::paper
#import bevy_smoke::frame::Rbf

// The mean of a function is its first coefficient over this: sqrt(4 pi).
const UNIT: f32 = 3.5449077018;
// sqrt(3 / 4 pi), which y1, y2 and y3 have before -y, z and -x.
const LINEAR: f32 = 0.4886025119;
// An RBF ends at three radii, u^2 = 9.
const SUPPORT_SQUARED: f32 = 9.0;
// Where the RBFs' density is below this there is no smoke.
const SMALLEST_DENSITY: f32 = 1e-10;

struct Paper {
    // From the environment's coefficients to those in the volume's axes: four vectors a row.
    rotation: array<vec4<f32>, 64>,
    // 1: exponentials by scaling and squaring; 0: optimal linear.
    hybrid: u32,
}

struct Tables {
    // T(beta), a factor a band, uniform in beta from 0 to pi.
    depth: array<vec4<f32>, 256>,
    // Logarithms of a and b by norm, NORM_STEP apart.
    exponential: array<vec4<f32>, 65>,
    // Directions and weights that integrate products of three functions of order 4 exactly.
    directions: array<vec4<f32>, 50>,
}

// An RBF in a point, with its first derivatives.
struct Jet {
    gradient: vec3<f32>,
    value: f32,
    laplacian: f32,
}

fn jet(rbf: Rbf, x: vec3<f32>) -> Jet {
    let offset = x - rbf.center;
    let r2 = rbf.radius * rbf.radius;
    let u2 = dot(offset, offset) / r2;
    if u2 >= SUPPORT_SQUARED {
        return Jet();
    }
    let value = rbf.weight * exp(-u2);
    return Jet(offset * (-2.0 * value / r2), value, value * (4.0 * u2 - 6.0) / r2);
}
