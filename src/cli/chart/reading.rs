//! What the chart says, in words.

use super::{Method, Panel, Point, Scattering};

/// Points whose error is above this are no pictures of the smoke, whatever their time.
const USABLE: f64 = 0.2;

impl Point {
    /// More accurate and faster.
    fn beats(&self, other: &Self) -> bool {
        self.error < other.error && self.ms < other.ms
    }
}

/// Points that none beats, from the fastest.
pub(super) fn front<'a>(points: impl Iterator<Item = &'a Point> + Clone) -> Vec<&'a Point> {
    let beaten = |point: &&Point| points.clone().any(|other| other.beats(point));
    let mut front: Vec<&Point> = points.clone().filter(|point| !beaten(point)).collect();
    front.sort_by(|a, b| a.ms.total_cmp(&b.ms));
    front
}

/// One line a finding.
pub(super) fn read(panels: &[Panel]) -> Vec<String> {
    let mut lines = Vec::new();
    for panel in panels {
        let of = |method: Method| panel.points.iter().filter(move |point| point.method == method);
        let place = format!(
            "{}, {}",
            panel.scene,
            if panel.scattering == Scattering::Single { "single scattering" } else { "full scattering" }
        );
        if let Some(line) = against_constellation(panel) {
            lines.push(format!("{place}: {line}"));
        }
        for (method, name) in [(Method::Paper, "paper"), (Method::Fog, "Bevy's fog")] {
            let usable: Vec<&Point> = of(method).filter(|point| point.error < USABLE).collect();
            let rbfs = front(of(Method::Rbf));
            if of(method).next().is_none() || rbfs.is_empty() {
                continue;
            }
            // Any point of rbf, and those of its front.
            let beaten: Vec<&Point> =
                of(Method::Rbf).filter(|rbf| usable.iter().any(|point| point.beats(rbf))).collect();
            let beyond = usable.iter().filter(|point| rbfs.iter().any(|rbf| point.beats(rbf))).count();
            let names = |points: &[&Point]| points.iter().map(|p| p.setting.as_str()).collect::<Vec<_>>().join("; ");
            let verdict = match beaten.is_empty() {
                true => "none beats any rbf point in both error and time".into(),
                false => format!(
                    "{beyond} beat a point of rbf's front in both error and time; rbf settings that are beaten: {}",
                    names(&beaten)
                ),
            };
            lines.push(format!(
                "{place}: {} of {} points of {name} have an error under {:.0} %; {verdict}",
                usable.len(),
                of(method).count(),
                100.0 * USABLE
            ));
        }
        let find = |method, name: &str| of(method).find(|point| point.setting == name);
        if let (Some(rbf), Some(paper)) = (find(Method::Rbf, "100"), find(Method::Paper, "600")) {
            let better = of(Method::Rbf).filter(|point| point.rbfs == Some(100) && point.beats(paper));
            let better: Vec<&str> = better.map(|point| point.setting.as_str()).collect();
            lines.push(format!(
                "{place}: 100 RBFs with probes are {:.2} % off in {}, the paper's method with 600 {:.2} % in {}; closer and \
                 faster: {}",
                100.0 * rbf.error,
                milliseconds(rbf.ms),
                100.0 * paper.error,
                milliseconds(paper.ms),
                if better.is_empty() { "none".into() } else { better.join("; ") }
            ));
        }
    }
    lines
}

/// How much faster rbf is than the constellation at equal error, at least.
fn against_constellation(panel: &Panel) -> Option<String> {
    let of = |method: Method| panel.points.iter().filter(move |point| point.method == method);
    if panel.scattering == Scattering::Full {
        return None;
    }
    fn ratio<'a>(point: &'a Point, panel: &'a Panel) -> Option<(f64, &'a Point, &'a Point)> {
        let rbfs = panel.points.iter().filter(|point| point.method == Method::Rbf);
        let as_good = rbfs.filter(|rbf| rbf.error <= point.error);
        let fastest = as_good.min_by(|a, b| a.ms.total_cmp(&b.ms))?;
        Some((point.ms / fastest.ms, point, fastest))
    }
    let ratios: Vec<_> = of(Method::Constellation).filter_map(|point| ratio(point, panel)).collect();
    let (least, point, rbf) = ratios.iter().min_by(|a, b| a.0.total_cmp(&b.0))?;
    let unmatched: Vec<&str> = of(Method::Constellation)
        .filter(|point| !ratios.iter().any(|(_, matched, _)| std::ptr::eq(*matched, *point)))
        .map(|point| point.setting.as_str())
        .collect();
    let list = ratios.iter().map(|(ratio, point, _)| format!("{} {ratio:.0}×", point.setting)).collect::<Vec<_>>();
    Some(format!(
        "at the constellation's error rbf is {least:.1} times as fast or more ({}); the closest: {} at {:.2} % in {}, rbf {} at \
         {:.2} % in {}{}",
        list.join(", "),
        point.setting,
        100.0 * point.error,
        milliseconds(point.ms),
        rbf.setting,
        100.0 * rbf.error,
        milliseconds(rbf.ms),
        if unmatched.is_empty() {
            String::new()
        } else {
            format!("; no rbf setting is as close as {}", unmatched.join(", "))
        }
    ))
}

/// With as many digits as say something.
fn milliseconds(ms: f64) -> String {
    if ms < 10.0 { format!("{ms:.2} ms") } else { format!("{ms:.0} ms") }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(method: Method, setting: &str, error: f64, ms: f64) -> Point {
        Point {
            method,
            setting: setting.into(),
            rbfs: setting.split(' ').next().and_then(|n| n.parse().ok()),
            error,
            ms,
        }
    }

    #[test]
    fn the_front_is_what_nothing_beats() {
        let points = [(0.1, 1.0), (0.05, 2.0), (0.06, 3.0), (0.01, 9.0), (0.1, 5.0)]
            .map(|(error, ms)| point(Method::Rbf, "", error, ms));
        let front: Vec<f64> = front(points.iter()).iter().map(|point| point.ms).collect();
        assert_eq!(front, [1.0, 2.0, 9.0]);
    }

    #[test]
    fn figures_are_read_as_they_are() {
        let points = vec![
            point(Method::Rbf, "100", 0.02, 10.0),
            point(Method::Rbf, "600", 0.01, 40.0),
            point(Method::Constellation, "16 lights", 0.03, 300.0),
            point(Method::Constellation, "64 lights", 0.015, 1000.0),
            point(Method::Constellation, "256 lights", 0.005, 4000.0),
            point(Method::Paper, "600", 0.11, 80.0),
            point(Method::Fog, "64 steps", 0.5, 5.0),
        ];
        let panel = Panel { scene: "plume".into(), scattering: Scattering::Single, points };
        let lines = read(&[panel]);
        assert!(lines[0].contains("25.0 times as fast or more (16 lights 30×, 64 lights 25×)"), "{}", lines[0]);
        assert!(lines[0].ends_with("no rbf setting is as close as 256 lights"), "{}", lines[0]);
        assert!(lines[1].contains("1 of 1 points of paper") && lines[1].contains("none beats"), "{}", lines[1]);
        assert!(lines[2].contains("0 of 1 points of Bevy's fog"), "{}", lines[2]);
        let said = ["2.00 % off in 10 ms", "11.00 % in 80 ms", "closer and faster: 100"];
        assert!(said.iter().all(|said| lines[3].contains(said)), "{}", lines[3]);
    }

    #[test]
    fn a_better_point_is_told() {
        let points = vec![point(Method::Rbf, "100", 0.2, 10.0), point(Method::Paper, "50", 0.1, 5.0)];
        let panel = Panel { scene: "plume".into(), scattering: Scattering::Full, points };
        assert!(read(&[panel])[0].contains("1 beat a point of rbf's front in both error and time"));
    }
}
