// What the passes of multiple scattering share.
#define_import_path bevy_smoke::scattering

// How far the solution is; all zero at the start.
struct Control {
    // 1 when the solution is good enough: what is left of the work is skipped.
    done: u32,
    // Sweeps done.
    sweeps: u32,
    // Estimated error, relative to the root mean square of the solution.
    error: f32,
    // By how much the last extrapolation and its sweeps have changed the solution, likewise; 0 before the first.
    change: f32,
}

// An RBF's place in the list of sources: its coefficients, and the share that escapes.
fn source_stride(coefficients: u32) -> u32 {
    return coefficients + 1u;
}

struct Step {
    // Which of the solutions is read, and which is written.
    from_slot: u32,
    to_slot: u32,
    // 1 where the work is not skipped when the solution is good enough.
    always: u32,
    // Relative error at which it is.
    tolerance: f32,
}
