// Sums over a workgroup.
#define_import_path bevy_smoke::sum

// Threads of the workgroups that add up.
const THREADS: u32 = 256u;

var<workgroup> partial: array<vec3<f32>, THREADS>;

// The sum over the workgroup's threads, all of which must call.
fn add_up(value: vec3<f32>, thread: u32) -> vec3<f32> {
    workgroupBarrier();
    partial[thread] = value;
    workgroupBarrier();
    for (var half = THREADS / 2u; half > 0u; half /= 2u) {
        if thread < half {
            partial[thread] += partial[thread + half];
        }
        workgroupBarrier();
    }
    return partial[0];
}
