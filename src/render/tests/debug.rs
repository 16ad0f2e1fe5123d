use super::*;
use crate::reference::debug::{Field, field};
use crate::render::debug::{DebugPasses, Step};
use crate::render::frame::{FILTERED_FORMAT, texture_3d};
use crate::render::volume;

#[test]
fn fields_match_their_twin() {
    let (mut gpu, frame) = (Gpu::new(), fixture());
    // They are made on demand.
    let shaders = crate::shaders::Shaders::load(gpu.headless.app.world().resource());
    let cache = gpu.headless.app.sub_app(RenderApp).world().resource::<PipelineCache>();
    let passes = DebugPasses::new(&shaders, cache);
    for _ in 0..100 {
        if passes.are_ready(gpu.cache()) {
            break;
        }
        gpu.headless.app.update();
    }
    assert!(passes.are_ready(gpu.cache()));

    let density = twin_density(&frame);
    let shape = density.shape;
    let mut uploaded = gpu.frame(&frame);
    uploaded.density =
        gpu.texture_3d(shape.dims, TextureFormat::R32Float, |cell| density.values[shape.index(cell)] as f32);
    for (step, shown) in [(Step::Density, Field::Density), (Step::Rbfs, Field::Rbfs), (Step::Residual, Field::Residual)]
    {
        let output = texture_3d(gpu.device(), "test", shape.dims + 2, FILTERED_FORMAT);
        let bind_group = passes.bind_field(step, &uploaded, &output, gpu.device(), gpu.cache());
        gpu.run(passes.get(step), Job { bind_group, workgroups: volume::workgroups(shape) });
        let twin = field(shown, rbfs(&frame), &density, MAX_DENSITY.into());
        let texels = gpu.read_texels(&output);
        let (colors, fields): (Vec<_>, Vec<_>) =
            texels.as_chunks::<4>().0.iter().map(|&[r, g, b, a]| ([r, g, b].map(f64::from), f64::from(a))).unzip();
        assert_close(&format!("{step:?}"), HALF, fields, twin.density);
        let twins = twin.radiance.iter().flat_map(|color| color.to_array()).collect::<Vec<_>>();
        assert_close(&format!("colours of {step:?}"), HALF, colors.into_flattened(), twins);
    }
}
