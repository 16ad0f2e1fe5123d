//! Whole scenes whose volumes show moments of the test's choice: what is on the GPU for them, and how solvers go on.

use bevy::platform::collections::HashMap;
use bevy::prelude::*;

use super::density::neighbours;
use super::*;
use crate::bundle::SmokeAnimation;
use crate::density::Placement;
use crate::lighting::SmokeEnvironment;
use crate::paper::SmokePaper;
use crate::playback::SmokeMoment;
use crate::render::prepare::SmokeCache;
use crate::render::{SmokeMemory, SmokeRenderStats};
use crate::scattering::{ScatteringEvents, ScatteringSolver, SmokeScattering};
use crate::volume::SmokeVolume;

/// What volumes show, whatever playback says.
#[derive(Resource, Default)]
struct Show(HashMap<Entity, Moment>);

fn show(moments: Res<Show>, mut volumes: Query<(Entity, &mut SmokeMoment)>) {
    for (entity, mut moment) in &mut volumes {
        moment.0 = moments.0.get(&entity).cloned();
    }
}

struct Scene {
    headless: Headless,
    volumes: Vec<Entity>,
}

/// How the smoke is lit.
#[derive(Clone, Copy)]
struct Look {
    g: f32,
    solver: ScatteringSolver,
    paper: bool,
    tolerance: f32,
    sigma_t: f32,
}

const TRANSPORT: Look =
    Look { g: 0.0, solver: ScatteringSolver::Transport, paper: false, tolerance: 0.005, sigma_t: 8.0 };

impl Scene {
    /// Volumes of grey smoke, side by side.
    fn new(count: usize, look: Look) -> Self {
        let mut headless = Headless::new(UVec2::splat(48), TextureFormat::Rgba16Float).unwrap();
        headless.app.init_resource::<Show>().add_systems(Last, show);
        let camera = headless.radiance_camera();
        let world = headless.app.world_mut();
        world.spawn((camera, Transform::from_xyz(0.0, 0.0, 3.0)));
        let frame = fixture();
        let animation = world.resource_mut::<Assets<SmokeAnimation>>().add(SmokeAnimation {
            shape: frame.residual.shape(),
            placement: Placement { center: DVec3::ZERO, voxel_size: 1.0 },
            frames_per_second: 30.0,
            max_density: MAX_DENSITY,
            frames: vec![frame].into(),
        });
        let volumes = (0..count)
            .map(|i| {
                let mut volume = world.spawn((
                    SmokeVolume::new(animation.clone()),
                    SmokeMedium { sigma_t: look.sigma_t, g: look.g, ..medium([0.95, 0.9, 0.8], 0.0) },
                    SmokeEnvironment::constant(Vec3::ONE, 1.0),
                    SmokeScattering {
                        events: ScatteringEvents::Multiple,
                        solver: look.solver,
                        tolerance: look.tolerance,
                    },
                    Transform::from_xyz(i as f32 - 0.5 * (count - 1) as f32, 0.0, 0.0),
                ));
                if look.paper {
                    volume.insert(SmokePaper { steps: 10, ..default() });
                }
                volume.id()
            })
            .collect();
        Self { headless, volumes }
    }

    /// The picture of these moments, one a volume.
    fn draw(&mut self, moments: &[&Moment]) -> Vec<[f32; 4]> {
        let pairs = self.volumes.iter().copied().zip(moments.iter().map(|moment| (*moment).clone()));
        let pairs = pairs.collect();
        self.headless.app.world_mut().resource_mut::<Show>().0 = pairs;
        if self.dispatches("density") == 0 {
            self.headless.settle().unwrap();
        }
        self.headless.app.update();
        let pixels = self.headless.float_pixels();
        assert!(pixels.iter().flatten().all(|value| value.is_finite()));
        pixels
    }

    fn stats(&self) -> &SmokeRenderStats {
        self.headless.app.world().resource()
    }

    fn memory(&self) -> SmokeMemory {
        self.stats().memory()
    }

    fn dispatches(&self, pass: &str) -> u32 {
        let name = format!("smoke_{pass}");
        self.stats().dispatches()[SmokeRenderStats::PASSES.iter().position(|other| *other == name).unwrap()]
    }

    /// Density dispatches that drawing takes.
    fn unpacked(&mut self, moments: &[&Moment]) -> u32 {
        let before = self.dispatches("density");
        self.draw(moments);
        self.dispatches("density") - before
    }

    fn sweeps(&self) -> u32 {
        self.headless.solver_reports().iter().map(|report| report.sweeps).sum()
    }
}

/// The same seen for the first time.
fn cold(moment: &Moment, look: Look) -> (Vec<[f32; 4]>, u32) {
    let mut scene = Scene::new(1, look);
    // Drawn once only: a second time changes nothing.
    let picture = scene.draw(&[moment]);
    (picture, scene.sweeps())
}

fn between(from: &Arc<SmokeFrame>, to: &Arc<SmokeFrame>, blend: f32) -> Moment {
    Moment { from: from.clone(), to: to.clone(), blend, max_density: MAX_DENSITY }
}

/// Relative to the first.
fn difference(a: &[[f32; 4]], b: &[[f32; 4]]) -> f64 {
    distance(widen(b.as_flattened()), widen(a.as_flattened()))
}

#[test]
fn a_moment_lies_between_its_frames() {
    let [a, b] = neighbours();
    let mut scene = Scene::new(1, TRANSPORT);
    let [first, middle, last] =
        [(&a, &b, 0.0), (&a, &b, 0.5), (&b, &b, 0.0)].map(|(from, to, blend)| scene.draw(&[&between(from, to, blend)]));
    let mean: Vec<[f32; 4]> =
        first.iter().zip(&last).map(|(a, b)| std::array::from_fn(|i| 0.5 * (a[i] + b[i]))).collect();
    let (whole, off) = (difference(&first, &last), difference(&mean, &middle));
    println!("frames differ by {whole:.3}, half-way from their mean by {off:.3}");
    assert!(off < 0.4 * whole);
    assert!(difference(&first, &middle) < 0.8 * whole && difference(&last, &middle) < 0.8 * whole);
}

#[test]
fn volumes_share_the_moments_that_they_show_together() {
    let [a, b] = neighbours();
    let at = |blend| between(&a, &b, blend);
    let mut scene = Scene::new(2, TRANSPORT);
    scene.draw(&[&at(0.0), &at(0.0)]);
    assert_eq!((scene.dispatches("density"), scene.memory().moments), (1, 1), "the same moment");
    // One goes on: the other still shows what was.
    assert_eq!(scene.unpacked(&[&at(0.0), &at(0.25)]), 1);
    assert_eq!(scene.memory().moments, 2);
    assert_eq!(scene.unpacked(&[&at(0.0), &at(0.25)]), 0);
    for step in 1..5 {
        let blend = 0.1 * step as f32;
        assert_eq!(scene.unpacked(&[&at(blend), &at(blend + 0.05)]), 2);
    }
    for step in 1..5 {
        let moment = at(0.5 + 0.1 * step as f32);
        assert_eq!(scene.unpacked(&[&moment, &moment]), 1, "together again");
    }
    assert_eq!((scene.memory().moments, scene.memory().moments_created), (2, 2));
    // Volumes that swap their moments find them.
    scene.draw(&[&at(0.0), &at(0.5)]);
    assert_eq!(scene.unpacked(&[&at(0.5), &at(0.0)]), 0);
}

#[test]
fn time_goes_on_in_place() {
    let [a, b] = neighbours();
    let frames: Vec<Arc<SmokeFrame>> = (0..6).map(|i| Arc::new(SmokeFrame::clone([&a, &b][i % 2]))).collect();
    let mut scene = Scene::new(1, TRANSPORT);
    scene.draw(&[&between(&frames[0], &frames[1], 0.5)]);
    let texture = |scene: &Scene| {
        let world = scene.headless.app.sub_app(RenderApp).world();
        world.resource::<SmokeCache>().only_texture().id()
    };
    let (first, seen) = (scene.memory(), texture(&scene));
    let residuals = |frames: [&Arc<SmokeFrame>; 2]| {
        frames.iter().map(|frame| GpuBakedFrame::residual_bytes(&frame.residual)).sum::<u64>()
    };
    let own = first.bytes - residuals([&frames[0], &frames[1]]);
    for step in 0..30 {
        let (pair, blend) = (step / 6, (step % 6) as f32 / 6.0);
        let (from, to) = (&frames[pair], &frames[pair + 1]);
        assert_eq!(scene.unpacked(&[&between(from, to, blend)]), 1);
        let memory = scene.memory();
        assert_eq!((memory.moments, memory.moments_created), (1, 1));
        // A frame on its own needs no other's residual.
        let held = if blend == 0.0 { residuals([from, to]) - residuals([to, to]) / 2 } else { residuals([from, to]) };
        assert_eq!(memory.bytes, own + held, "step {step}");
        assert_eq!(texture(&scene), seen);
    }
    // Nobody else holds the frames that were passed.
    assert_eq!(Arc::strong_count(&frames[0]), 1);
}

/// Solvers go on from where they were: by less work to the same picture.
#[test]
fn solvers_go_on_from_moment_to_moment() {
    let [a, b] = neighbours();
    // Thick enough for some work.
    let thick = Look { sigma_t: 40.0, tolerance: 1e-3, ..TRANSPORT };
    for look in
        [thick, Look { g: 0.5, ..thick }, Look { solver: ScatteringSolver::Diffusion, tolerance: 0.005, ..TRANSPORT }]
    {
        let mut scene = Scene::new(1, look);
        // Diffusion takes more than one solve from black.
        for blend in [0.02, 0.04, 0.06, 0.08, 0.1] {
            scene.draw(&[&between(&a, &b, blend)]);
        }
        let (mut warm_sweeps, mut cold_sweeps) = (0, 0);
        for blend in [0.12, 0.14, 0.16] {
            let moment = between(&a, &b, blend);
            let warm = scene.draw(&[&moment]);
            let (fresh, sweeps) = cold(&moment, look);
            warm_sweeps += scene.sweeps();
            cold_sweeps += sweeps;
            let off = difference(&fresh, &warm);
            println!("{:?}, g {}: at {blend} {off:.1e} off", look.solver, look.g);
            // Either is off by the tolerance, of the light that it solves for.
            assert!(off < 2.0 * f64::from(look.tolerance), "{off}");
        }
        println!("{:?}, g {}: {warm_sweeps} sweeps, {cold_sweeps} from black", look.solver, look.g);
        assert!(warm_sweeps < cold_sweeps, "{:?}: {warm_sweeps} {cold_sweeps}", look.solver);
    }
}

/// More RBFs than there is room for: buffers grow, and what was solved is handed on.
#[test]
fn buffers_grow_with_the_number_of_rbfs() {
    let a = Arc::new(fixture());
    let mut more = fixture();
    for i in 0..40 {
        more.ids.push(1000 + i);
        more.rbfs.rbfs.push(Rbf { weight: 0.1, ..more.rbfs.rbfs[i as usize] });
    }
    let moment = between(&Arc::new(more), &a, 0.0);
    for look in
        [TRANSPORT, Look { solver: ScatteringSolver::Diffusion, ..TRANSPORT }, Look { paper: true, ..TRANSPORT }]
    {
        let mut scene = Scene::new(1, look);
        scene.draw(&[&between(&a, &a, 0.0)]);
        let grown = scene.draw(&[&moment]);
        assert_eq!(scene.memory().moments_created, 1);
        if !look.paper {
            // The paper's solver is far from its end after any number of steps.
            let off = difference(&cold(&moment, look).0, &grown);
            assert!(off < 2.0 * f64::from(look.tolerance), "{off}");
        }
        // And back.
        scene.draw(&[&between(&a, &a, 0.0)]);
    }
}

/// Where RBFs come and go, their weights near zero, nothing is seen of it.
#[test]
fn nothing_jumps_where_rbfs_come_and_go() {
    let [a, b] = neighbours();
    for look in [
        Look { tolerance: 1e-4, ..TRANSPORT },
        Look { g: 0.5, tolerance: 1e-4, ..TRANSPORT },
        Look { solver: ScatteringSolver::Diffusion, tolerance: 1e-4, ..TRANSPORT },
    ] {
        let mut scene = Scene::new(1, look);
        for (frame, blend) in [(between(&a, &b, 0.0), 1e-6), (between(&b, &b, 0.0), 1.0 - 1e-6)] {
            // Diffusion takes more than one solve from black.
            let pairs = [(); 5].map(|()| (scene.draw(&[&frame]), scene.draw(&[&between(&a, &b, blend)])));
            let off = difference(&pairs[4].0, &pairs[4].1);
            println!("{:?}, g {}: {off:.1e} off at {blend}", look.solver, look.g);
            assert!(off < 1e-3, "{:?}, g {}: {off:.1e} off at {blend}", look.solver, look.g);
        }
    }
}

#[test]
fn weights_of_next_to_nothing_stay_finite() {
    let mut frame = fixture();
    for (i, weight) in [0.0, 1e-30, 1e-38, 0.0, 1e-20].into_iter().enumerate() {
        frame.rbfs.rbfs[i].weight = weight;
    }
    // One far from all others, on its own.
    frame.rbfs.rbfs.push(Rbf { center: [-0.35, 0.49, -0.27], radius: 0.02, weight: 0.0 });
    frame.ids.push(99);
    let moment = Moment::frame(Arc::new(frame), MAX_DENSITY);
    for look in [
        TRANSPORT,
        Look { g: 0.5, ..TRANSPORT },
        Look { solver: ScatteringSolver::Diffusion, ..TRANSPORT },
        Look { paper: true, ..TRANSPORT },
    ] {
        // `draw` looks for what is not finite.
        Scene::new(1, look).draw(&[&moment]);
        // Nothing that is not finite stays.
        let mut scene = Scene::new(1, look);
        scene.draw(&[&moment]);
        scene.draw(&[&Moment::frame(Arc::new(fixture()), MAX_DENSITY)]);
    }
}

#[test]
fn timing_steps() {
    use std::time::Instant;
    let Ok(path) = std::env::var("TIMING") else { return };
    let animation = crate::bundle::read(&std::fs::read(path).unwrap()).unwrap();
    let a = animation.frames.get(0).unwrap().clone();
    let mut other = SmokeFrame::clone(&a);
    let mut random = Random(3);
    for rbf in &mut other.rbfs.rbfs {
        rbf.center = (Vec3::from(rbf.center) + 0.01 * (random.vector() - 0.5).as_vec3()).to_array();
    }
    other.ids[3] = 9999;
    let b = Arc::new(other);
    println!("TIMING {} RBFs, {:?}", a.ids.len(), a.residual.shape());
    for look in [TRANSPORT, Look { g: 0.4, ..TRANSPORT }] {
        let mut scene = Scene::new(1, look);
        scene.headless.app.world_mut().resource_mut::<Assets<SmokeAnimation>>().add(animation.clone());
        let at = |blend: f32| Moment { from: a.clone(), to: b.clone(), blend, max_density: animation.max_density };
        scene.draw(&[&at(0.0)]);
        let mut run = |what: &str, moments: Vec<Moment>| {
            let mut times = vec![];
            let mut sweeps = vec![];
            for moment in moments {
                scene.headless.app.world_mut().resource_mut::<Show>().0 =
                    [(scene.volumes[0], moment)].into_iter().collect();
                let start = Instant::now();
                scene.headless.app.update();
                scene.headless.wait();
                times.push(start.elapsed().as_secs_f64() * 1e3);
                sweeps.push(scene.sweeps());
            }
            times.sort_by(f64::total_cmp);
            println!(
                "TIMING g {}: {what}: min {:.1} median {:.1} ms, sweeps {sweeps:?}",
                look.g,
                times[0],
                times[times.len() / 2]
            );
        };
        run("static", (0..12).map(|_| at(0.0)).collect());
        run("stepping", (1..12).map(|i| at(0.05 * i as f32)).collect());
        let diagnostics = scene.headless.app.world().resource::<bevy::diagnostic::DiagnosticsStore>();
        for d in diagnostics.iter() {
            let name = d.path().as_str();
            if name.contains("smoke") {
                println!("TIMING   {name}: {:?}", d.average());
            }
        }
    }
}
