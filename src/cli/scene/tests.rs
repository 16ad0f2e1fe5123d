use super::*;

const PLUME: &str = r#"{
    "density": "../plume.vdb", "placement": "file", "width_m": 3.0,
    "sigma_t": 2.49, "albedo": [0.66, 0.7, 1], "g": -0.5,
    "env": { "kind": "lobes", "ambient": [0.1, 0.2, 0.3], "lobes": [ { "dir": [0, 0, 2], "rgb": [3, 2, 1] } ] },
    "eye": [0, 0, 6], "target": [0, 0, 0], "fov_y_deg": 28, "size": [72, 120]
}"#;

fn parse(text: &str) -> anyhow::Result<(Scene, Vec<String>)> {
    Scene::parse(text, Path::new("scenes"))
}

/// The plume's scene with one part of its text changed.
fn changed(from: &str, to: &str) -> anyhow::Result<(Scene, Vec<String>)> {
    assert!(PLUME.contains(from));
    parse(&PLUME.replace(from, to))
}

fn fault(from: &str, to: &str) -> String {
    format!("{:#}", changed(from, to).unwrap_err())
}

#[test]
fn a_scene() {
    let (scene, warnings) = parse(PLUME).unwrap();
    assert!(warnings.is_empty());
    assert_eq!(scene.density.as_deref(), Some(Path::new("scenes/../plume.vdb")));
    assert_eq!(scene.placement, ScenePlacement::File);
    assert_eq!((scene.sigma_t, scene.g, scene.albedo), (2.49, -0.5, DVec3::new(0.66, 0.7, 1.0)));
    assert_eq!((scene.camera.eye, scene.camera.size), (DVec3::new(0.0, 0.0, 6.0), [72, 120]));

    let (scene, _) = changed("\"file\"", "\"width\"").unwrap();
    assert_eq!(scene.placement, ScenePlacement::Width(3.0));
    let (scene, _) = changed("\"density\": \"../plume.vdb\",", "").unwrap();
    assert_eq!(scene.density, None);
}

#[test]
fn lobes_become_their_coefficients() {
    let (scene, _) = parse(PLUME).unwrap();
    let sh = scene.environment.coefficients().unwrap();
    // An order-4 polynomial is its own projection: rounding is all that may differ.
    for w in [DVec3::Z, -DVec3::Z, DVec3::X, DVec3::new(0.48, -0.6, 0.64), DVec3::new(-2.0, 3.0, 6.0) / 7.0] {
        let exact = scene.environment.radiance(w).unwrap();
        assert!((sh.evaluate(w) - exact).length() < 1e-13, "{w}");
    }
    // The lobe's centre: rgb on top of the ambient light. Opposite it: nothing.
    assert!((sh.evaluate(DVec3::Z) - DVec3::new(3.1, 2.2, 1.3)).length() < 1e-13);
    assert!((sh.evaluate(-DVec3::Z) - DVec3::new(0.1, 0.2, 0.3)).length() < 1e-13);
}

#[test]
fn a_constant_is_band_zero() {
    let text = r#"{ "kind": "constant", "rgb": [1, 2, 0] }"#;
    let value: Value = serde_json::from_str(text).unwrap();
    let environment = environment(Keys::new("env.", &value, Path::new("")).unwrap(), &mut Vec::new()).unwrap();
    let sh = environment.coefficients().unwrap();
    // ∫ y₀ dω = 2 √π.
    let y0 = 2.0 * std::f64::consts::PI.sqrt();
    assert!((sh.0[0] - DVec3::new(y0, 2.0 * y0, 0.0)).length() < 1e-14);
    assert!(sh.0[1..].iter().all(|c| c.length() < 1e-14));
}

#[test]
fn an_image_is_a_path() {
    let (from, to) = (PLUME.find("{ \"kind\"").unwrap(), PLUME.find("\n    \"eye\"").unwrap());
    let (scene, _) = changed(&PLUME[from..to], r#"{ "kind": "equirect", "path": "sky.hdr" },"#).unwrap();
    assert_eq!(scene.environment, Environment::Equirect("scenes/sky.hdr".into()));
    assert!(scene.environment.coefficients().is_none());
}

const LIGHTS: &str = r#""lights": [
    { "kind": "sun", "dir": [0, 2, 0], "irradiance": [3, 2, 1], "angle_deg": 0.5 },
    { "kind": "sun", "dir": [1, 0, 0], "irradiance": 2 },
    { "kind": "point", "pos": [1, 2, 3], "intensity": 5 },
    { "kind": "spot", "pos": [0, 3, 0], "dir": [0, -3, 0], "intensity": [1, 0, 1], "inner_deg": 20, "outer_deg": 30 }
], "size""#;

#[test]
fn lights() {
    let (scene, warnings) = changed("\"size\"", LIGHTS).unwrap();
    assert!(warnings.is_empty());
    assert_eq!(
        scene.lights,
        [
            SceneLight::Sun { direction: DVec3::Y, irradiance: DVec3::new(3.0, 2.0, 1.0), angle_deg: 0.5 },
            SceneLight::Sun { direction: DVec3::X, irradiance: DVec3::splat(2.0), angle_deg: 0.0 },
            SceneLight::Point { position: DVec3::new(1.0, 2.0, 3.0), intensity: DVec3::splat(5.0) },
            SceneLight::Spot {
                position: DVec3::Y * 3.0,
                direction: -DVec3::Y,
                intensity: DVec3::new(1.0, 0.0, 1.0),
                inner_deg: 20.0,
                outer_deg: 30.0,
            },
        ]
    );
    assert!(parse(PLUME).unwrap().0.lights.is_empty());

    for (from, to, expected) in [
        ("\"sun\"", "\"moon\"", "lights[0].kind: \"moon\" is none of"),
        ("[0, 2, 0]", "[0, 0, 0]", "lights[0].dir: not a direction"),
        ("0.5 }", "180 }", "lights[0].angle_deg: 180 is not between 0 and 179"),
        ("\"irradiance\": 2", "\"irradiance\": -2", "lights[1].irradiance: -2 is negative"),
        ("\"irradiance\": 2", "\"intensity\": 2", "missing key lights[1].irradiance"),
        ("[1, 2, 3]", "5", "lights[2].pos: 5 is not a list of three numbers"),
        ("\"intensity\": 5", "\"intensity\": \"5\"", "lights[2].intensity: \"5\" is neither a number nor three"),
        ("\"inner_deg\": 20", "\"inner_deg\": 31", "lights[3].inner_deg: 31 is not between 0 and 30"),
        ("\"outer_deg\": 30", "\"outer_deg\": 91", "lights[3].outer_deg: 91"),
        ("[\n    {", "[ 7, {", "lights[0]: not an object"),
    ] {
        assert!(LIGHTS.contains(from), "{from}");
        let message = fault("\"size\"", &LIGHTS.replace(from, to));
        assert!(message.contains(expected), "{to}: {message}");
    }
    assert!(fault("\"size\"", "\"lights\": {}, \"size\"").contains("lights: not a list"));
    let (_, warnings) = changed("\"size\"", &LIGHTS.replace("\"pos\": [1", "\"colour\": 1, \"pos\": [1")).unwrap();
    assert_eq!(warnings, ["lights[2].colour: unknown key, ignored"]);
}

#[test]
fn a_grey_is_one_number() {
    let (scene, _) = changed("[0.1, 0.2, 0.3]", "0.2").unwrap();
    let Environment::Lobes { ambient, .. } = scene.environment else { panic!() };
    assert_eq!(ambient, DVec3::splat(0.2));
}

const SURFACES: &str = r#""plane": { "y": -1.5, "albedo": 0.5 }, "spheres": [
    { "center": [1, 2, 3], "radius": 0.5, "albedo": [0.1, 0.2, 1] }
], "size""#;

#[test]
fn surfaces() {
    let (scene, warnings) = changed("\"size\"", SURFACES).unwrap();
    assert!(warnings.is_empty());
    assert_eq!(scene.plane, Some(ScenePlane { y: -1.5, albedo: DVec3::splat(0.5) }));
    let sphere = SceneSphere { center: DVec3::new(1.0, 2.0, 3.0), radius: 0.5, albedo: DVec3::new(0.1, 0.2, 1.0) };
    assert_eq!(scene.spheres, [sphere]);
    for (from, to, expected) in [
        ("\"y\": -1.5,", "", "missing key plane.y"),
        ("\"albedo\": 0.5", "\"albedo\": 1.5", "plane.albedo: 1.5 is above 1"),
        ("\"radius\": 0.5", "\"radius\": 0", "spheres[0].radius: 0 is not above 0"),
    ] {
        assert_eq!(fault("\"size\"", &SURFACES.replace(from, to)), expected);
    }
}

#[test]
fn warnings() {
    let (_, warnings) = changed("\"g\": -0.5,", "\"g\": -0.5, \"fog\": 1, ").unwrap();
    assert_eq!(warnings, ["fog: unknown key, ignored"]);
    let (_, warnings) = changed("\"rgb\": [3, 2, 1]", "\"rgb\": [3, 2, 1], \"radius\": 2").unwrap();
    assert_eq!(warnings, ["env.lobes[0].radius: unknown key, ignored"]);
}

#[test]
fn errors_name_the_key() {
    for (from, to, expected) in [
        ("2.49", "-1", "sigma_t: -1 is negative"),
        ("2.49", "\"much\"", "sigma_t: \"much\" is not a number"),
        ("2.49", "NaN", "line"),
        ("\"sigma_t\": 2.49,", "", "missing key sigma_t"),
        ("0.7, 1]", "0.7, 1.01]", "albedo: 1.01 is not between 0 and 1"),
        ("0.7, 1]", "0.7]", "albedo: [0.66,0.7] is not a list of three numbers"),
        ("-0.5", "1", "g: 1 is not between -1 and 1"),
        ("-0.5", "1e999", "line"),
        ("28", "180", "fov_y_deg: 180"),
        ("28", "0", "fov_y_deg: 0"),
        ("[72, 120]", "[0, 120]", "size: 0"),
        ("[72, 120]", "[72.5, 120]", "size: 72.5"),
        ("[72, 120]", "120", "size: 120 is not [width, height]"),
        ("[0, 0, 6]", "[0, 0, 0]", "target: the same point as eye"),
        ("[0, 0, 6]", "[0, 5, 0]", "target: straight above"),
        ("\"file\"", "\"here\"", "placement: \"here\""),
        ("3.0", "0", "width_m: 0 is not above 0"),
        ("\"kind\": \"lobes\"", "\"kind\": \"lamps\"", "env.kind: \"lamps\""),
        ("[0, 0, 2]", "[0, 0, 0]", "env.lobes[0].dir: not a direction"),
        ("[3, 2, 1]", "[3, -2, 1]", "env.lobes[0].rgb: -2 is negative"),
        ("\"ambient\": [0.1, 0.2, 0.3],", "", "missing key env.ambient"),
        ("[ {", "[ 5, {", "env.lobes[0]: not an object"),
    ] {
        let message = fault(from, to);
        assert!(message.contains(expected), "{to}: {message}");
        assert!(!message.contains('\n'), "{message}");
    }
    let (scene, _) = changed("\"file\"", "\"width\"").unwrap();
    assert_eq!(scene.placement, ScenePlacement::Width(3.0));
    let no_width = PLUME.replace("\"width_m\": 3.0,", "").replace("\"file\"", "\"width\"");
    assert!(parse(&no_width).unwrap_err().to_string().contains("missing key width_m"));
}

#[test]
fn the_camera_is_bevys() {
    use bevy::camera::CameraProjection;
    use bevy::prelude::{PerspectiveProjection, Transform, Vec3};

    let camera = SceneCamera {
        eye: DVec3::new(4.2, 1.2, -3.0),
        target: DVec3::new(0.5, -0.4, 0.1),
        fov_y_deg: 35.0,
        size: [72, 120],
    };
    let size = [160, 90];
    let transform = Transform::from_translation(camera.eye.as_vec3()).looking_at(camera.target.as_vec3(), Vec3::Y);
    let fov = camera.fov_y_deg.to_radians() as f32;
    let projection = PerspectiveProjection { fov, aspect_ratio: 160.0 / 90.0, ..Default::default() };
    let view_from_clip = projection.get_clip_from_view().inverse();
    for [x, y] in [[0.0f32, 0.0], [80.0, 45.0], [160.0, 10.0], [33.5, 90.0]] {
        let view = view_from_clip.project_point3(Vec3::new(x / 80.0 - 1.0, 1.0 - y / 45.0, 0.5));
        let expected = (transform.rotation * view).normalize();
        let found = camera.direction(size, x.into(), y.into());
        // Bevy computes in f32.
        assert!((found.as_vec3() - expected).length() < 1e-6, "{found} {expected}");
    }
}

#[test]
fn placements() {
    let shape = GridShape::new([4, 8, 2].into());
    let file = Placement { center: DVec3::X, voxel_size: 0.5 };
    assert_eq!(ScenePlacement::File.center_and_side(shape, file), (DVec3::X, 4.0));
    assert_eq!(ScenePlacement::Width(3.0).center_and_side(shape, file), (DVec3::ZERO, 3.0));
}
