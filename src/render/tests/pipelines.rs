use super::*;

/// Every compute pipeline is there: its shader composes, validates, and fits the layout that the Rust side gives it.
#[test]
fn compute_pipelines_are_made() {
    let gpu = Gpu::new();
    let failures: Vec<String> = gpu.passes().all().filter_map(|pass| pass.failure(gpu.cache())).collect();
    assert_eq!(failures, Vec::<String>::new());
    assert_eq!(gpu.passes().all().count(), 41);
}
