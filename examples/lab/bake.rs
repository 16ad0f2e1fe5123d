//! Density files are baked on other threads.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use bevy::prelude::*;
use bevy::tasks::futures::check_ready;
use bevy::tasks::{AsyncComputeTaskPool, Task};
use bevy_egui::{EguiContexts, EguiPrimaryContextPass, egui};
use bevy_smoke::bake::{BakeError, BakeSettings, Segment, Sequence, SequenceProgress, bake_sequence};
use bevy_smoke::density::{self, DensityError, DensityGrid};
use bevy_smoke::panel::SmokePanel;
use bevy_smoke::prelude::*;

use super::open::{Queue, put_on_ground};

/// The bakes that are going on.
#[derive(Resource, Default)]
pub struct Bakes(Vec<Bake>);

struct Bake {
    output: PathBuf,
    progress: Arc<Mutex<Progress>>,
    task: Task<Result<(), BakeError>>,
    /// The first file's density, to be shown as it is until the bundle is there.
    preview: Option<Task<Result<DensityGrid, DensityError>>>,
}

/// How far it is.
#[derive(Clone, Debug, Default)]
struct Progress {
    /// From 0 to 1.
    share: f32,
    text: String,
}

impl Progress {
    fn of(progress: SequenceProgress, frames: usize) -> Self {
        let (done, text) = match progress {
            SequenceProgress::Restarted => (0.0, "other settings: starting afresh".into()),
            SequenceProgress::Surveyed(count) => (0.0, format!("looked at {count} of {frames} files")),
            SequenceProgress::Resumed(count) => (count as f32, format!("{count} of {frames} frames were there")),
            SequenceProgress::Fitting(frame, fit) => {
                (frame as f32 + fit.fraction, format!("frame {} of {frames}, {} RBFs", frame + 1, fit.rbfs))
            }
            SequenceProgress::Finished(count) => (count as f32, format!("{count} of {frames} frames")),
        };
        Self { share: done / frames as f32, text }
    }
}

impl Bakes {
    /// Begins to bake files, in this order, into a bundle beside the first.
    pub fn begin(&mut self, inputs: Vec<PathBuf>) {
        let output = free_name(&inputs[0]);
        let progress = Arc::new(Mutex::new(Progress { share: 0.0, text: "reading".into() }));
        let first = inputs[0].clone();
        let preview = AsyncComputeTaskPool::get().spawn(async move { density::read(first, None) });
        let (to, told) = (output.clone(), progress.clone());
        let task = AsyncComputeTaskPool::get().spawn(async move {
            let sequence = Sequence { inputs: &inputs, grid: None, segment: Segment::WHOLE, output: &to };
            let tell = |progress| {
                *told.lock().expect("nobody panics with it") = Progress::of(progress, inputs.len());
            };
            bake_sequence(&sequence, &BakeSettings::default(), &tell).map(drop)
        });
        self.0.push(Bake { output, progress, task, preview: Some(preview) });
    }
}

/// A name for the bundle of a density file that no other file has.
fn free_name(input: &Path) -> PathBuf {
    let stem = input.file_stem().unwrap_or_default().to_string_lossy();
    let name = |number: u32| match number {
        1 => input.with_file_name(format!("{stem}.smoke")),
        _ => input.with_file_name(format!("{stem}-{number}.smoke")),
    };
    (1..).map(name).find(|name| !name.exists()).expect("there are many numbers")
}

pub struct BakePlugin;

impl Plugin for BakePlugin {
    fn build(&self, app: &mut App) {
        app.init_resource::<Bakes>()
            .add_systems(Update, (preview, finish).chain())
            .add_systems(EguiPrimaryContextPass, show);
    }
}

/// Shows density as it was read.
fn preview(
    mut bakes: ResMut<Bakes>,
    mut images: ResMut<Assets<Image>>,
    panel: Res<SmokePanel>,
    mut volumes: Query<(&mut SmokeVolume, &mut Transform)>,
) {
    for bake in &mut bakes.0 {
        let Some(read) = bake.preview.as_mut().and_then(check_ready) else { continue };
        bake.preview = None;
        // What is wrong with a file, the bake will say.
        let Ok(grid) = read else { continue };
        let Some((mut volume, mut transform)) = panel.volume.and_then(|volume| volumes.get_mut(volume).ok()) else {
            continue;
        };
        let max_density = grid.values.iter().copied().fold(0.0, f32::max);
        let live = LiveDensity { max_density, ..LiveDensity::new(images.add(LiveDensity::image_of(&grid))) };
        volume.density = SmokeDensity::Live(live.still());
        put_on_ground(&mut transform, grid.shape.half_extent().y);
    }
}

/// Shows what has been baked.
fn finish(mut bakes: ResMut<Bakes>, mut queue: ResMut<Queue>, mut panel: ResMut<SmokePanel>) {
    bakes.0.retain_mut(|bake| match check_ready(&mut bake.task) {
        None => true,
        Some(Ok(())) => {
            queue.add(vec![bake.output.clone()]);
            false
        }
        Some(Err(error)) => {
            panel.notice = Some(format!("Not baked: {error}"));
            false
        }
    });
}

fn show(mut contexts: EguiContexts, bakes: Res<Bakes>) {
    let Ok(ctx) = contexts.ctx_mut() else { return };
    if bakes.0.is_empty() {
        return;
    }
    egui::Window::new("Baking").anchor(egui::Align2::CENTER_BOTTOM, [0.0, -12.0]).resizable(false).show(ctx, |ui| {
        for bake in &bakes.0 {
            let progress = bake.progress.lock().expect("nobody panics with it").clone();
            ui.label(format!("{}: {}", bake.output.display(), progress.text));
            ui.add(egui::ProgressBar::new(progress.share).desired_width(480.0).show_percentage());
        }
    });
}
