//! Sequences: identity, resuming, segments, frames without smoke.

use std::cell::Cell;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use glam::Vec3;

use super::super::*;
use crate::bundle::{SmokeAnimation, SmokeFrame};
use crate::density::{GridShape, Placement, SourceInfo, write_npy};
use crate::playback::Moment;

const SHAPE: GridShape = GridShape::new(glam::UVec3::new(28, 20, 16));

/// Three blobs on their ways, longer than wide so that each takes several Gaussians, with a ripple too fine for those,
/// at time `t`.
fn smoke(t: f32) -> DensityGrid {
    let blobs = [
        (Vec3::new(-0.25 + 0.06 * t, 0.1, 0.0), Vec3::new(0.16, 0.07, 0.08), 1.0),
        (Vec3::new(0.2 - 0.05 * t, -0.1 + 0.03 * t, 0.05), Vec3::new(0.06, 0.13, 0.08), 1.5),
        (Vec3::new(0.05, 0.15 - 0.06 * t, -0.1), Vec3::new(0.07, 0.06, 0.12) * (1.0 + 0.1 * t), 0.8),
    ];
    let values = (0..SHAPE.len()).map(|index| {
        let cell = SHAPE.cell(index);
        let ripple = 1.0 + 0.05 * (1.9 * cell.x as f32).sin() * (1.7 * cell.y as f32).cos();
        let x = SHAPE.center(cell);
        let density: f32 = blobs.iter().map(|(c, r, w)| w * (-((x - c) / r).length_squared()).exp()).sum();
        if density > 0.01 { density * ripple } else { 0.0 }
    });
    grid(values.collect())
}

fn grid(values: Vec<f32>) -> DensityGrid {
    let placement = Placement { center: glam::DVec3::ZERO, voxel_size: 1.0 / 28.0 };
    DensityGrid { shape: SHAPE, values, placement, source: SourceInfo::default() }
}

fn settings() -> BakeSettings {
    BakeSettings { target: FitTarget::Count(8), ..BakeSettings::default() }
}

/// A folder with frames and the bundle made of them.
struct Workshop {
    folder: tempfile::TempDir,
    inputs: Vec<PathBuf>,
}

impl Workshop {
    fn new(frames: &[DensityGrid]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let inputs: Vec<PathBuf> = (0..frames.len()).map(|i| folder.path().join(format!("in_{i}.npy"))).collect();
        inputs.iter().zip(frames).for_each(|(path, grid)| fs::write(path, write_npy(grid)).unwrap());
        Self { folder, inputs }
    }

    fn output(&self) -> PathBuf {
        self.folder.path().join("out.smoke")
    }

    fn parts(&self) -> PathBuf {
        self.folder.path().join("out.smoke.parts")
    }

    fn try_bake(
        &self,
        settings: &BakeSettings,
        segment: Segment,
        progress: &(dyn Fn(SequenceProgress) + Sync),
    ) -> Result<SequenceReport, BakeError> {
        let output = self.output();
        let sequence = Sequence { inputs: &self.inputs, grid: None, segment, output: &output };
        bake_sequence(&sequence, settings, progress)
    }

    fn bake(&self) -> SequenceReport {
        self.try_bake(&settings(), Segment::WHOLE, &|_| {}).unwrap()
    }

    fn bytes(&self) -> Vec<u8> {
        fs::read(self.output()).unwrap()
    }

    fn animation(&self) -> SmokeAnimation {
        bundle::read(&self.bytes()).unwrap()
    }
}

fn frames(animation: &SmokeAnimation) -> Vec<&std::sync::Arc<SmokeFrame>> {
    (0..animation.frames.len()).map(|index| animation.frames.get(index).unwrap()).collect()
}

fn distance(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>().sqrt()
}

/// Copies the files of a folder.
fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        fs::copy(entry.path(), to.join(entry.file_name())).unwrap();
    }
}

/// Report without what differs from run to run.
fn figures(report: &SequenceReport) -> serde_json::Value {
    fn strip(value: &mut serde_json::Value) {
        if let Some(fields) = value.as_object_mut() {
            for timing in ["seconds", "stage_seconds", "resumed"] {
                fields.remove(timing);
            }
            fields.values_mut().for_each(strip);
        } else if let Some(list) = value.as_array_mut() {
            list.iter_mut().for_each(strip);
        }
    }
    let mut value = serde_json::to_value(report).unwrap();
    strip(&mut value);
    value
}

#[test]
fn gaussians_keep_their_numbers_and_move() {
    let shop = Workshop::new(&[smoke(0.0), smoke(1.0), smoke(2.0)]);
    let report = shop.bake();
    let animation = shop.animation();
    let frames = frames(&animation);
    assert_eq!((frames.len(), report.frames.len(), report.summary.frames), (3, 3, 3));
    for (pair, report) in frames.windows(2).zip(&report.frames[1..]) {
        let kept = pair[1].ids.iter().filter(|id| pair[0].ids.contains(id)).count();
        assert_eq!(kept, pair[1].ids.len() - report.report.fit.inserted);
        assert!(2 * kept >= pair[0].ids.len(), "most go on");
    }
    for (frame, t) in frames.iter().zip([0.0, 1.0, 2.0]) {
        assert!(distance(&frame.decode(), &smoke(t).values) < 0.01 * distance(&smoke(t).values, &[0.0; SHAPE.len()]));
    }
    assert!(!shop.parts().exists());
}

#[test]
fn moments_between_frames_are_nearer_than_a_cross_fade() {
    let shop = Workshop::new(&[smoke(0.0), smoke(1.0)]);
    shop.bake();
    let animation = shop.animation();
    let [from, to] = [0, 1].map(|index| animation.frames.get(index).unwrap().clone());
    let truth = smoke(0.5).values;
    let faded: Vec<f32> = from.decode().iter().zip(to.decode()).map(|(a, b)| 0.5 * (a + b)).collect();
    let moved = Moment { from, to, blend: 0.5, max_density: animation.max_density }.decode();
    let (moved, faded) = (distance(&moved, &truth), distance(&faded, &truth));
    assert!(moved < 0.6 * faded, "{moved} against {faded}");
}

#[test]
fn a_stopped_bake_goes_on_to_the_same_bytes() {
    let shop = Workshop::new(&[smoke(0.0), smoke(1.0), smoke(2.0), smoke(3.0)]);
    let snapshots = Mutex::new(Vec::new());
    let (parts, folder) = (shop.parts(), shop.folder.path());
    let keep = |progress| {
        if let SequenceProgress::Finished(done) = progress {
            let snapshot = folder.join(format!("snapshot_{done}"));
            copy(&parts, &snapshot);
            snapshots.lock().unwrap().push((done, snapshot));
        }
    };
    let whole = shop.try_bake(&settings(), Segment::WHOLE, &keep).unwrap();
    let bytes = shop.bytes();

    let resume = |expected: usize, damage: &dyn Fn(&Path)| {
        damage(&parts);
        // What a bundle of that name held before does not matter.
        fs::write(shop.output(), "something else").unwrap();
        let resumed = Mutex::new(0);
        let report = shop.try_bake(&settings(), Segment::WHOLE, &|progress| match progress {
            SequenceProgress::Resumed(done) => *resumed.lock().unwrap() = done,
            SequenceProgress::Restarted => panic!("nothing has changed"),
            _ => {}
        });
        let report = report.unwrap();
        assert_eq!(*resumed.lock().unwrap(), expected);
        assert_eq!(report.summary.resumed, expected);
        assert!(shop.bytes() == bytes, "after {expected}");
        assert_eq!(figures(&report), figures(&whole));
        assert!(!parts.exists());
    };
    let snapshots = snapshots.into_inner().unwrap();
    assert_eq!(snapshots.len(), 4);
    for (done, snapshot) in &snapshots {
        copy(snapshot, &parts);
        resume(*done, &|_| {});
    }
    // Damaged parts are made again, with all after them; unfinished files are ignored.
    let all = &snapshots[3].1;
    copy(all, &parts);
    resume(1, &|parts| {
        let part = parts.join("frame_00001.part");
        let bytes = fs::read(&part).unwrap();
        fs::write(&part, &bytes[..bytes.len() / 2]).unwrap();
    });
    copy(all, &parts);
    resume(2, &|parts| {
        let part = parts.join("frame_00002.part");
        let mut bytes = fs::read(&part).unwrap();
        bytes[40] ^= 1;
        fs::write(&part, bytes).unwrap();
    });
    copy(all, &parts);
    resume(0, &|parts| fs::write(parts.join("frame_00000.part"), "").unwrap());
    copy(&snapshots[1].1, &parts);
    resume(2, &|parts| {
        fs::write(parts.join("frame_00002.tmp"), "half a part").unwrap();
        fs::write(parts.join("bundle.tmp"), "half a bundle").unwrap();
        fs::write(parts.join("manifest.tmp"), "{").unwrap();
    });
}

#[test]
fn other_settings_and_inputs_start_afresh() {
    let shop = Workshop::new(&[smoke(0.0), smoke(1.0)]);
    let snapshot = shop.folder.path().join("snapshot");
    let parts = shop.parts();
    let keep = |progress| {
        if matches!(progress, SequenceProgress::Finished(2)) {
            copy(&parts, &snapshot);
        }
    };
    shop.try_bake(&settings(), Segment::WHOLE, &keep).unwrap();
    let restarts = |settings: &BakeSettings, change: &dyn Fn()| {
        copy(&snapshot, &parts);
        change();
        let restarted = Mutex::new(0);
        let report = shop.try_bake(settings, Segment::WHOLE, &|progress| {
            if matches!(progress, SequenceProgress::Restarted) {
                *restarted.lock().unwrap() += 1;
            }
        });
        assert_eq!(report.unwrap().summary.resumed, 0);
        *restarted.lock().unwrap() == 1
    };
    assert!(restarts(&BakeSettings { seed: 2, ..settings() }, &|| {}));
    assert!(restarts(&BakeSettings { threshold: 1.3, ..settings() }, &|| {}));
    assert!(restarts(&settings(), &|| fs::write(parts.join("manifest.json"), "{}").unwrap()));
    assert!(restarts(&settings(), &|| fs::write(&shop.inputs[1], write_npy(&smoke(1.5))).unwrap()));
    let changed = shop.bytes();
    shop.bake();
    assert!(shop.bytes() == changed);
}

#[test]
fn two_processes_do_not_share_an_output() {
    let shop = Workshop::new(&[smoke(0.0)]);
    let refused = Mutex::new(None);
    let again = |progress| {
        if matches!(progress, SequenceProgress::Finished(1)) {
            *refused.lock().unwrap() = shop.try_bake(&settings(), Segment::WHOLE, &|_| {}).err();
        }
    };
    shop.try_bake(&settings(), Segment::WHOLE, &again).unwrap();
    assert!(matches!(refused.into_inner().unwrap(), Some(BakeError::Busy(_))));
}

#[test]
fn frames_without_smoke() {
    let clear = || grid(vec![0.0; SHAPE.len()]);
    let shop = Workshop::new(&[clear(), smoke(0.0), clear(), smoke(1.0)]);
    let report = shop.bake();
    let animation = shop.animation();
    let counts: Vec<usize> = frames(&animation).iter().map(|frame| frame.rbfs.rbfs.len()).collect();
    assert_eq!((counts[0], counts[1], counts[2]), (0, 8, 0));
    assert!(counts[3] > 0 && counts[3] <= 16);
    assert!(frames(&animation)[2].decode().iter().all(|&d| d == 0.0));
    // Numbers are not used again, and the first frame with smoke is what others are held to.
    assert!(frames(&animation)[3].ids.iter().all(|&id| id >= 8));
    assert!((report.frames[1].report.fit.ratio - 1.0).abs() < 1e-6);
    assert!(report.frames[3].report.fit.ratio <= 1.2 || !report.frames[3].report.fit.reached);
    let none = Workshop::new(&[clear(), clear()]);
    none.bake();
    assert_eq!(none.animation().max_density, 0.0);
}

#[test]
fn an_error_as_target_holds_for_all_frames() {
    let shop = Workshop::new(&[smoke(0.0), smoke(1.0), smoke(2.0)]);
    let settings = BakeSettings { target: FitTarget::Error(0.12), ..settings() };
    let report = shop.try_bake(&settings, Segment::WHOLE, &|_| {}).unwrap();
    let errors: Vec<f64> = report.frames.iter().map(|frame| frame.report.fit.error).collect();
    assert!(errors.iter().all(|&error| error <= 0.12), "{errors:?}");
    assert!(report.summary.short.is_empty());
}

#[test]
fn segments_share_box_and_threshold() {
    let shop = Workshop::new(&[smoke(0.0), smoke(1.0), smoke(2.0), smoke(3.0), smoke(4.0)]);
    let whole = shop.bake();
    let frames = Cell::new(0);
    for number in 1..=2 {
        let report = shop.try_bake(&settings(), Segment { number, of: 2 }, &|_| {}).unwrap();
        for (part, of_whole) in report.frames.iter().zip(&whole.frames[frames.get()..]) {
            assert_eq!(part.input, of_whole.input);
            let [part, of_whole] = [part, of_whole].map(|frame| &frame.report.fit);
            assert!(part.error <= 1.2001 * whole.frames[0].report.fit.error || part.rbfs == 16, "{part:?}");
            assert!(part.rbfs.abs_diff(of_whole.rbfs) <= 8, "{part:?} {of_whole:?}");
        }
        frames.set(frames.get() + report.frames.len());
        assert_eq!(shop.animation().placement, Placement { center: glam::DVec3::ZERO, voxel_size: 1.0 / 28.0 });
    }
    assert_eq!(frames.get(), 5);
    let refused = shop.try_bake(&settings(), Segment { number: 1, of: 6 }, &|_| {}).unwrap_err().to_string();
    assert!(refused.contains("segment 1/6 of 5 frames"), "{refused}");
}

#[test]
fn frames_of_other_boxes_are_refused() {
    let shop = Workshop::new(&[smoke(0.0), smoke(1.0)]);
    let small = GridShape::new(glam::UVec3::new(28, 20, 14));
    let other = DensityGrid { shape: small, values: vec![1.0; small.len()], ..smoke(0.0) };
    fs::write(&shop.inputs[1], write_npy(&other)).unwrap();
    let refused = shop.try_bake(&settings(), Segment::WHOLE, &|_| {}).unwrap_err().to_string();
    assert!(
        refused.contains("in_0.npy") && refused.contains("in_1.npy") && refused.contains("28 × 20 × 14"),
        "{refused}"
    );
    assert!(!shop.output().exists());
}

#[test]
fn joined_segments_are_one_animation() {
    let shop = Workshop::new(&[smoke(0.0), smoke(0.5), smoke(1.0), smoke(1.5), smoke(2.0)]);
    let segments: Vec<PathBuf> = (1..=2)
        .map(|number| {
            shop.try_bake(&settings(), Segment { number, of: 2 }, &|_| {}).unwrap();
            let path = shop.folder.path().join(format!("segment_{number}.smoke"));
            fs::rename(shop.output(), &path).unwrap();
            path
        })
        .collect();
    let mut file = Cursor::new(Vec::new());
    let joined = join(&segments, &shop.output(), &mut file).unwrap();
    let animation = bundle::read(file.get_ref()).unwrap();
    assert_eq!((joined.frames, animation.frames.len()), (5, 5));
    assert_eq!(joined.bytes, file.get_ref().len() as u64);

    let parts: Vec<SmokeAnimation> =
        segments.iter().map(|path| bundle::read(&fs::read(path).unwrap()).unwrap()).collect();
    let apart: Vec<_> = parts.iter().flat_map(frames).collect();
    for (together, apart) in frames(&animation).iter().zip(&apart) {
        assert_eq!((&together.rbfs, &together.residual), (&apart.rbfs, &apart.residual));
    }
    assert_eq!(animation.max_density, parts.iter().map(|part| part.max_density).fold(0.0, f32::max));
    // Whoever has the number of an earlier one across the seam is its match; no other number comes twice.
    let numbers = |range: std::ops::Range<usize>| -> std::collections::HashSet<u32> {
        frames(&animation)[range].iter().flat_map(|frame| frame.ids.iter().copied()).collect()
    };
    let [seam] = joined.seams[..] else { panic!("one seam") };
    assert_eq!(numbers(0..2).intersection(&numbers(2..5)).count(), seam.matched);
    assert!(seam.matched >= 2, "{seam:?}");

    let other = Workshop::new(&[smoke(0.0)]);
    other.try_bake(&BakeSettings { frames_per_second: 24.0, ..settings() }, Segment::WHOLE, &|_| {}).unwrap();
    let mixed = [segments[0].clone(), other.output()];
    let refused = join(&mixed, &shop.output(), Cursor::new(Vec::new())).unwrap_err().to_string();
    assert!(refused.contains("the speed of") && refused.contains("is 24, that of"), "{refused}");
}
