//! The panel, moved by keyboard as somebody would move it who cannot point: every control changes what it says, and the
//! scene that is saved comes back.

use std::collections::BTreeSet;
use std::time::Duration;

use bevy::asset::RenderAssetUsages;
use bevy::camera::RenderTarget;
use bevy::prelude::*;
use bevy::render::render_resource::{Extent3d, TextureDimension, TextureFormat, TextureUsages};
use bevy::time::TimeUpdateStrategy;
use bevy_egui::egui::output::OutputEvent;
use bevy_egui::egui::{Event, Key, Modifiers, WidgetType};
use bevy_egui::input::{EguiInputEvent, FocusedNonWindowEguiContext};
use bevy_egui::{EguiGlobalSettings, EguiOutput, PrimaryEguiContext};
use bevy_smoke::headless::Headless;
use bevy_smoke::panel::{SmokePanel, SmokePanelPlugin, scene};
use bevy_smoke::prelude::*;
use bevy_smoke::render::SmokeRenderStats;

use crate::scene::{SIZE, camera, rms};

/// A scene with something for every control, and the panel, which another camera draws.
struct Panel {
    app: Headless,
    volume: Entity,
    eye: Entity,
    context: Entity,
    image: Handle<Image>,
}

/// Few RBFs, to be quick; all else in full.
const QUALITY: SmokeQuality = SmokeQuality::Model(SmokeModel { rbfs: 40, ..SmokeModel::FULL });

/// Pixels of the picture of the panel.
const PANEL: UVec2 = UVec2::new(360, 240);

impl Panel {
    fn new(environment: SmokeEnvironment) -> Self {
        let assets = AssetPlugin::default().file_path;
        let mut app = Headless::with_plugins(SIZE, TextureFormat::Rgba16Float, assets, |app| {
            app.add_plugins(SmokePanelPlugin);
        })
        .unwrap();
        let animation = app.app.world().resource::<AssetServer>().load("billow.smoke");
        let smoke_camera = camera(&app);
        let world = app.app.world_mut();
        world.insert_resource(TimeUpdateStrategy::ManualDuration(Duration::from_millis(100)));
        let mut settings = world.resource_mut::<EguiGlobalSettings>();
        settings.auto_create_primary_context = false;
        settings.enable_focused_non_window_context_updates = false;
        let map = EnvironmentMapLight {
            intensity: 1.0,
            ..EnvironmentMapLight::hemispherical_gradient(
                &mut world.resource_mut::<Assets<Image>>(),
                Color::WHITE,
                Color::linear_rgb(0.5, 0.5, 0.5),
                Color::BLACK,
            )
        };
        let eye = world.spawn((smoke_camera, map)).id();
        let volume = world
            .spawn((
                SmokeVolume::new(animation),
                SmokeMedium { sigma_t: 5.0, albedo: LinearRgba::rgb(0.8, 0.7, 0.6), g: 0.3 },
                environment,
                SmokeScattering::MULTIPLE,
                QUALITY,
                SmokePlayback::at_frame(30),
                Transform::from_scale(Vec3::splat(3.0)),
            ))
            .id();
        let ground = world.resource_mut::<Assets<Mesh>>().add(Plane3d::default().mesh().size(6.0, 6.0));
        let material = world.resource_mut::<Assets<StandardMaterial>>().add(Color::WHITE);
        world.spawn((Mesh3d(ground), MeshMaterial3d(material), Transform::from_xyz(0.0, -1.2, 0.0)));
        world.spawn((SmokeOccluder::new([(Vec3::ZERO, 0.3)]), Transform::from_xyz(0.6, -1.0, 0.6)));
        let down = Transform::from_xyz(0.5, 2.0, 1.0).looking_at(Vec3::ZERO, Vec3::Y);
        world.spawn((DirectionalLight { illuminance: 1.0, ..default() }, down));
        world.spawn((PointLight { intensity: 30.0, ..default() }, Transform::from_xyz(-1.0, 0.0, 1.0)));
        world.spawn((SpotLight { intensity: 60.0, outer_angle: 0.6, ..default() }, down));
        let mut image = Image::new_target_texture(PANEL.x, PANEL.y, TextureFormat::Rgba8UnormSrgb, None);
        image.texture_descriptor.usage |= TextureUsages::COPY_SRC;
        let image = world.resource_mut::<Assets<Image>>().add(image);
        let target = RenderTarget::Image(image.clone().into());
        let camera = (Camera2d, Camera { order: 1, ..default() }, Msaa::Off, target);
        let context = world.spawn((camera, PrimaryEguiContext)).id();
        // No window gives it the keyboard.
        world.insert_resource(FocusedNonWindowEguiContext(context));
        let mut panel = Self { app, volume, eye, context, image };
        panel.app.settle().unwrap();
        panel.wait();
        panel
    }

    /// Updates until all has come to rest.
    fn wait(&mut self) {
        for _ in 0..2 {
            self.app.app.update();
        }
    }

    fn picture(&self) -> Vec<[f32; 4]> {
        self.app.float_pixels()
    }

    /// The panel's own.
    fn pixels(&self) -> Vec<u8> {
        self.app.pixels_of(&self.image)
    }

    /// A latitude-longitude image, red on one side and black on the other.
    fn red_image(&mut self) -> Handle<Image> {
        let texels: Vec<u8> = (0..8)
            .flat_map(|i| [if i % 4 < 2 { 1.0_f32 } else { 0.0 }, 0.0, 0.0, 1.0])
            .flat_map(f32::to_le_bytes)
            .collect();
        let size = Extent3d { width: 4, height: 2, depth_or_array_layers: 1 };
        let usage = RenderAssetUsages::RENDER_WORLD;
        let image = Image::new(size, TextureDimension::D2, texels, TextureFormat::Rgba32Float, usage);
        self.app.app.world_mut().resource_mut::<Assets<Image>>().add(image)
    }

    fn work(&self) -> [u32; SmokeRenderStats::PASSES.len()] {
        self.app.app.world().resource::<SmokeRenderStats>().dispatches()
    }

    /// Presses a key, and says what egui has to tell.
    fn press(&mut self, key: Key) -> Vec<OutputEvent> {
        for pressed in [true, false] {
            let event = Event::Key { key, physical_key: None, pressed, repeat: false, modifiers: Modifiers::NONE };
            self.app.app.world_mut().write_message(EguiInputEvent { context: self.context, event });
        }
        self.app.app.update();
        self.app.app.world().get::<EguiOutput>(self.context).unwrap().platform_output.events.clone()
    }

    /// The name of the control that the tabulator key goes to next; empty where it has none, and for headings.
    fn next(&mut self) -> String {
        let events = self.press(Key::Tab);
        let focused = events.iter().rev().find_map(|event| match event {
            OutputEvent::FocusGained(info) if info.typ != WidgetType::CollapsingHeader => info.label.clone(),
            _ => None,
        });
        focused.unwrap_or_default()
    }

    /// Whether the smoke is drawn: not while controls are looked for, to be quicker.
    fn look(&mut self, on: bool) {
        self.app.app.world_mut().get_mut::<Camera>(self.eye).unwrap().is_active = on;
    }

    fn focus(&mut self, name: &str) {
        self.look(false);
        for _ in 0..250 {
            if self.next() == name {
                self.look(true);
                // It takes arrows for its own from the next update on.
                self.app.app.update();
                return;
            }
        }
        panic!("the panel has no {name}");
    }

    /// The names of all controls.
    fn names(&mut self) -> BTreeSet<String> {
        let mut names = BTreeSet::new();
        self.look(false);
        for _ in 0..250 {
            names.insert(self.next());
        }
        names.remove("");
        names
    }
}

/// What a control changes.
#[derive(Clone, Copy)]
enum Changes {
    /// What the camera sees.
    Picture,
    /// How often a pass has run.
    Work(&'static str),
    /// Something else in the world of the volume.
    World(fn(&World, Entity) -> bool),
    /// Nothing: it is what has been chosen before.
    Nothing,
}

/// A change of the picture that counts, in a scene of radiances of about 1.
const SEEN: f64 = 1e-4;

/// A control, the key that moves it, and what that changes.
type Control = (&'static str, Key, Changes);

use Changes::{Nothing, Picture, Work};

const MEDIUM: [Control; 5] = [
    ("sigma_t, 1/m", Key::ArrowRight, Picture),
    ("albedo red", Key::ArrowUp, Picture),
    ("albedo green", Key::ArrowUp, Picture),
    ("albedo blue", Key::ArrowUp, Picture),
    ("g", Key::ArrowRight, Picture),
];

fn playback(world: &World, volume: Entity) -> &SmokePlayback {
    world.get(volume).unwrap()
}

fn quality(world: &World, volume: Entity) -> SmokeQuality {
    *world.get(volume).unwrap()
}

const OTHERS: [Control; 51] = [
    ("auto", Key::Space, Changes::World(|w, volume| w.get::<SmokeScattering>(volume).unwrap().events == default())),
    ("single", Key::Space, Picture),
    ("multiple", Key::Space, Nothing),
    ("transport", Key::Space, Nothing),
    ("diffusion", Key::Space, Picture),
    ("tolerance", Key::ArrowRight, Work("smoke_scattering")),
    ("model", Key::Space, Nothing),
    ("error", Key::Space, Changes::World(|w, volume| quality(w, volume) == SmokeQuality::Error(0.02))),
    ("budget", Key::Space, Changes::World(|w, volume| quality(w, volume) == SmokeQuality::Budget(2.0))),
    ("RBFs at most", Key::ArrowLeft, Changes::World(|w, volume| quality(w, volume) != QUALITY)),
    ("1 probe", Key::Space, Picture),
    ("7 probes", Key::Space, Nothing),
    ("order 1", Key::Space, Picture),
    ("order 2", Key::Space, Picture),
    ("order 3", Key::Space, Picture),
    ("order 4", Key::Space, Nothing),
    ("16 directions", Key::Space, Picture),
    ("32 directions", Key::Space, Picture),
    ("64 directions", Key::Space, Nothing),
    ("sweeps", Key::ArrowLeft, Changes::World(|w, volume| quality(w, volume) != QUALITY)),
    ("step, cells", Key::ArrowRight, Picture),
    ("half resolution", Key::Space, Picture),
    ("lighting interval, frames", Key::ArrowRight, Changes::World(|w, volume| quality(w, volume) != QUALITY)),
    ("play", Key::Space, Picture),
    ("speed", Key::ArrowRight, Changes::World(|world, volume| playback(world, volume).speed > 1.0)),
    ("loop", Key::Space, Nothing),
    ("once", Key::Space, Changes::World(|world, volume| playback(world, volume).mode == PlaybackMode::Once)),
    ("there and back", Key::Space, Changes::World(|w, volume| playback(w, volume).mode == PlaybackMode::PingPong)),
    ("frame", Key::ArrowRight, Picture),
    ("sun colour red", Key::ArrowDown, Picture),
    ("sun colour green", Key::ArrowDown, Picture),
    ("sun colour blue", Key::ArrowDown, Picture),
    ("sun, lux", Key::ArrowRight, Picture),
    ("sun turn, °", Key::ArrowRight, Picture),
    ("sun tilt, °", Key::ArrowRight, Picture),
    ("lamp colour red", Key::ArrowDown, Picture),
    ("lamp colour green", Key::ArrowDown, Picture),
    ("lamp colour blue", Key::ArrowDown, Picture),
    ("lamp, lumens", Key::ArrowRight, Picture),
    ("lamp at x", Key::ArrowUp, Picture),
    ("lamp at y", Key::ArrowUp, Picture),
    ("lamp at z", Key::ArrowUp, Picture),
    ("spot light colour red", Key::ArrowDown, Picture),
    ("spot light colour green", Key::ArrowDown, Picture),
    ("spot light colour blue", Key::ArrowDown, Picture),
    ("spot light, lumens", Key::ArrowRight, Picture),
    ("spot light half angle, °", Key::ArrowRight, Picture),
    ("spot light at x", Key::ArrowUp, Picture),
    ("spot light turn, °", Key::ArrowRight, Picture),
    ("smoke shades meshes", Key::Space, Picture),
    ("spheres shade meshes", Key::Space, Picture),
];

/// The views of the volume: what each shows, other tests see.
const VIEWS: [Control; 8] = [
    ("picture", Key::Space, Nothing),
    ("density", Key::Space, Picture),
    ("RBFs", Key::Space, Picture),
    ("residual", Key::Space, Picture),
    ("scattered once", Key::Space, Picture),
    ("scattered again", Key::Space, Picture),
    ("probes", Key::Space, Picture),
    ("occluder spheres", Key::Space, Picture),
];

/// Moves controls, in the order in which they are reached, and looks at what changes.
fn check(panel: &mut Panel, controls: &[Control]) {
    let volume = panel.app.app.world().entity(panel.volume);
    let before = (
        *volume.get::<SmokeMedium>().unwrap(),
        volume.get::<SmokeEnvironment>().unwrap().clone(),
        *volume.get::<SmokeScattering>().unwrap(),
        *volume.get::<SmokeQuality>().unwrap(),
        volume.get::<SmokePlayback>().unwrap().clone(),
    );
    for (name, key, changes) in controls {
        let (picture, work) = (panel.picture(), panel.work());
        panel.focus(name);
        for _ in 0..if *key == Key::Space { 1 } else { 3 } {
            panel.press(*key);
        }
        // Passes that a view needs are there some updates later.
        let mut change = rms(&picture, &panel.picture());
        for update in 0..20 {
            if update >= 2 && (change > SEEN || !matches!(changes, Picture)) {
                break;
            }
            panel.app.app.update();
            change = rms(&picture, &panel.picture());
        }
        match changes {
            Picture => assert!(change > SEEN, "{name} changes the picture by {change:.1e} only"),
            // Solvers go on from where they were.
            Nothing => assert!(change < 0.1 * SEEN, "{name} changes the picture by {change:.1e}"),
            Work(pass) => {
                let at = SmokeRenderStats::PASSES.iter().position(|other| other == pass).unwrap();
                assert!(panel.work()[at] > work[at], "{name} does not make {pass} run");
            }
            Changes::World(changed) => assert!(changed(panel.app.app.world(), panel.volume), "{name} changes nothing"),
        }
        let world = panel.app.app.world_mut();
        world.entity_mut(panel.volume).insert(before.clone()).remove::<SmokeDebugView>();
        world.entity_mut(panel.eye).remove::<SmokeShadows>();
        panel.wait();
    }
}

#[test]
fn every_control_does_what_it_says() {
    let mut panel = Panel::new(SmokeEnvironment::constant(Vec3::ONE, 1.0));
    let environment = [
        ("camera's", Key::Space, Picture),
        ("constant", Key::Space, Nothing),
        ("coefficients", Key::Space, Picture),
        ("intensity, cd/m²", Key::ArrowRight, Picture),
        ("radiance red", Key::ArrowDown, Picture),
        ("radiance green", Key::ArrowDown, Picture),
        ("radiance blue", Key::ArrowDown, Picture),
    ];
    check(&mut panel, &VIEWS);
    check(&mut panel, &MEDIUM);
    check(&mut panel, &environment);
    check(&mut panel, &OTHERS);
    let notice = |panel: &Panel| panel.app.app.world().resource::<SmokePanel>().notice.clone();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("smoke.scn.ron");
    panel.app.app.world_mut().resource_mut::<SmokePanel>().scene = file.to_str().unwrap().into();
    let noticed = Changes::World(|world, _| world.resource::<SmokePanel>().notice.is_some());
    check(&mut panel, &[("save", Key::Space, noticed)]);
    assert_eq!(notice(&panel), Some(format!("Saved {}.", file.display())));
    assert!(file.exists());
    check(&mut panel, &[("close", Key::Space, Nothing)]);
    assert_eq!(notice(&panel), None);
    // All there are: the window's own, and places of the spot light and headings that are like those above.
    let moved = [&VIEWS[..], &MEDIUM, &environment, &OTHERS].concat();
    let mut known: BTreeSet<_> = moved.into_iter().map(|(name, ..)| name.to_string()).collect();
    known.extend(
        ["Close window", "Hide", "save", "spot light at y", "spot light at z", "spot light tilt, °"].map(String::from),
    );
    assert_eq!(panel.names(), known);

    // What was made in memory has no name that a game could load it by.
    let animation = panel.app.app.world_mut().resource_mut::<Assets<SmokeAnimation>>().reserve_handle();
    panel.app.app.world_mut().spawn(SmokeVolume::new(animation));
    let error = scene::scene_text(panel.app.app.world()).unwrap_err().to_string();
    assert!(error.ends_with("save that as a file first, and load it from there"), "{error}");
}

#[test]
fn environments_have_controls_of_their_own() {
    let mut panel = Panel::new(SmokeEnvironment::Camera);
    let camera =
        [("map, cd/m²", Key::ArrowRight, Picture), ("rotation, °", Key::ArrowRight, Work("smoke_incident_light"))];
    check(&mut panel, &camera);
    check(&mut panel, &[("ambient, cd/m²", Key::ArrowRight, Picture)]);

    // An image, red on one side: once the panel has seen it, other environments can go back to it.
    let red = panel.red_image();
    let volume = panel.volume;
    let world = panel.app.app.world_mut();
    world.entity_mut(volume).insert(SmokeEnvironment::equirect(red, 1.0));
    panel.wait();
    let image = [
        ("constant", Key::Space, Picture),
        ("image", Key::Space, Nothing),
        ("intensity, cd/m²", Key::ArrowRight, Picture),
        ("rotation, °", Key::ArrowRight, Picture),
    ];
    check(&mut panel, &image);
    panel.app.app.world_mut().entity_mut(volume).insert(SmokeEnvironment::constant(Vec3::ONE, 1.0));
    panel.wait();
    check(&mut panel, &[("image", Key::Space, Picture)]);
}

#[test]
fn a_closed_panel_draws_nothing_and_changes_nothing() {
    let mut panel = Panel::new(SmokeEnvironment::constant(Vec3::ONE, 1.0));
    assert!(panel.pixels().iter().any(|byte| *byte > 100), "the panel can be seen");
    panel.app.app.world_mut().resource_mut::<SmokePanel>().open = false;
    panel.wait();
    let empty = panel.pixels();
    assert!(empty.as_chunks::<4>().0.iter().all(|pixel| *pixel == empty[..4]), "nothing of it is left");
    assert_eq!(panel.press(Key::Tab), []);
}

#[test]
fn a_saved_scene_comes_back() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::copy(concat!(env!("CARGO_MANIFEST_DIR"), "/assets/billow.smoke"), folder.path().join("billow.smoke"))
        .unwrap();
    let assets = || folder.path().to_str().unwrap().to_string();
    let new = || Headless::with_assets(SIZE, TextureFormat::Rgba16Float, assets()).unwrap();

    let mut made = new();
    let animation = made.app.world().resource::<AssetServer>().load("billow.smoke");
    let components = (
        SmokeMedium { sigma_t: 3.0, albedo: LinearRgba::rgb(0.9, 0.5, 0.25), g: -0.25 },
        SmokeEnvironment::Coefficients {
            coefficients: std::array::from_fn(|i| Vec3::splat(0.1 * i as f32)),
            intensity: 2.0,
        },
        SmokeScattering { events: ScatteringEvents::Multiple, tolerance: 0.01, solver: ScatteringSolver::Diffusion },
        SmokeQuality::Model(SmokeModel { rbfs: 100, order: 2, ..SmokeModel::FULL }),
        SmokePlayback::at_frame(7).with_range(2..=20).with_speed(0.5),
        Transform::from_xyz(0.25, 0.5, 0.0).with_scale(Vec3::splat(2.5)),
    );
    let light = PointLight { intensity: 12.0, color: Color::linear_rgb(1.0, 0.5, 0.25), ..default() };
    let place = Transform::from_xyz(1.0, 0.5, 0.25);
    let smoke_camera = camera(&made);
    made.app.world_mut().spawn((SmokeVolume::new(animation.clone()), components.clone(), Name::new("chimney")));
    // A child has its place in the world.
    let parent = Transform::from_xyz(0.5, 0.0, -1.0);
    let world = made.app.world_mut();
    let child = world.spawn((light, place.with_translation(place.translation - parent.translation))).id();
    world.spawn((parent, Visibility::default())).add_child(child);
    let (constellation, hidden) = (SmokeConstellation { lights: 24, ..default() }, Visibility::Hidden);
    world.spawn((SmokeVolume::new(animation.clone()), constellation, hidden));
    made.app.world_mut().spawn(smoke_camera);
    let before = crate::scene::draw(&mut made);
    scene::save_scene(made.app.world(), &folder.path().join("smoke.scn.ron")).unwrap();
    let refused = scene::save_scene(made.app.world(), &folder.path().join("smoke.txt")).unwrap_err();
    assert!(refused.to_string().contains(".scn.ron"), "{refused}");

    let mut loaded = new();
    let root = loaded.app.world().resource::<AssetServer>().load("smoke.scn.ron");
    loaded.app.world_mut().spawn(DynamicWorldRoot(root));
    let smoke_camera = camera(&loaded);
    loaded.app.world_mut().spawn(smoke_camera);
    let after = crate::scene::draw(&mut loaded);

    let world = loaded.app.world_mut();
    let mut volumes = world.query::<(
        &SmokeVolume,
        &SmokeMedium,
        &SmokeEnvironment,
        &SmokeScattering,
        &SmokeQuality,
        &SmokePlayback,
        &Transform,
        Option<&Name>,
    )>();
    let (volume, medium, environment, scattering, quality, playback, transform, name) =
        volumes.iter(world).find(|found| found.7.is_some()).unwrap();
    assert_eq!(volume.animation().unwrap().path().unwrap().to_string(), "billow.smoke");
    let back = (*medium, environment.clone(), *scattering, *quality, playback.clone(), *transform);
    let name = name.map(Name::to_string);
    assert_eq!(back, components);
    let mut lights = world.query::<(&PointLight, &Transform)>();
    let (lamp, at) = lights.single(world).unwrap();
    assert_eq!((lamp.intensity, lamp.color.to_linear(), *at), (light.intensity, light.color.to_linear(), place));
    let mut constellations = world.query::<(&SmokeConstellation, &Visibility)>();
    assert_eq!(constellations.single(world).unwrap(), (&constellation, &hidden));
    assert!(rms(&before, &after) < 1e-6, "the same picture");
    assert_eq!(name.as_deref(), Some("chimney"));
}
