// A game's own smoke: puffs that leave a vent, rise, swirl and fade. It has no memory, so that it is short; a simulation would
// read the texture of the frame before.

struct Vent {
    seconds: f32,
}

@group(0) @binding(0) var<uniform> vent: Vent;
@group(0) @binding(1) var density: texture_storage_3d<r32float, write>;

const PUFFS: u32 = 24u;
const LIFETIME: f32 = 4.0;

@compute @workgroup_size(4, 4, 4)
fn blow(@builtin(global_invocation_id) id: vec3<u32>) {
    let size = textureDimensions(density);
    if any(id >= size) {
        return;
    }
    // The box's longest side is 1.
    let x = (vec3<f32>(id) + 0.5 - 0.5 * vec3<f32>(size)) / f32(max(size.x, max(size.y, size.z)));
    var sum = 0.0;
    for (var i = 0u; i < PUFFS; i++) {
        let age = fract(vent.seconds / LIFETIME + f32(i) / f32(PUFFS));
        let turn = 2.4 * f32(i) + 3.0 * age;
        let drift = vec3(0.16 * cos(turn), 0.0, 0.16 * sin(turn)) * sqrt(age);
        let center = vec3(0.0, -0.42 + 0.75 * age, 0.0) + drift;
        let radius = 0.03 + 0.09 * age;
        // Wrinkles that rise with the puff.
        let wrinkled = length(x - center) + 0.2 * radius * sin(70.0 * x.x + 5.0 * turn) * sin(60.0 * (x.y - 0.5 * age)) * sin(65.0 * x.z);
        let near = wrinkled / radius;
        sum += (1.0 - age) * exp(-2.0 * near * near);
    }
    textureStore(density, id, vec4(max(sum - 0.02, 0.0), 0.0, 0.0, 0.0));
}
