use clap::Parser;

use super::*;

#[derive(Parser)]
struct Command {
    #[command(flatten)]
    args: ShadowArgs,
}

fn scene_of(text: &str) -> anyhow::Result<Scene> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scene.json");
    std::fs::write(&path, text).unwrap();
    read_scene(&Command::parse_from(["shadows", "plume.smoke", "--scene", path.to_str().unwrap()]).args)
}

#[test]
fn scenes_bring_smooth_light_alone() {
    assert!(scene_of(DEFAULT_SCENE).is_ok());
    for (from, to, expected) in [
        (
            "\"eye\"",
            "\"lights\": [{ \"kind\": \"sun\", \"dir\": [0, 1, 0], \"irradiance\": 1 }], \"eye\"",
            "brings its own",
        ),
        ("\"eye\"", "\"plane\": { \"y\": -2, \"albedo\": 0.5 }, \"eye\"", "brings its own"),
    ] {
        let message = scene_of(&DEFAULT_SCENE.replace(from, to)).unwrap_err().to_string();
        assert!(message.contains(expected), "{message}");
    }
}

#[test]
fn a_table() {
    let floor =
        FloorRow { light: "sky", points: 45, darkest: 0.876, error: 0.0034, error_of_shadow: 0.04, worst: 0.01 };
    let ball = BallRow { ball: "black", scattering: "full", left: 0.8, error: 0.021 };
    let table = table(&Report { floor: vec![floor], ball: vec![ball] });
    assert!(table.contains("| sky | 45 | 87.6 % | 0.34 % | 4.0 % | 1.00 % |\n"), "{table}");
    assert!(table.ends_with("| black | full | 80.0 % | 2.10 % |\n"), "{table}");
}
