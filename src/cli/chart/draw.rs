//! The chart as SVG: a panel a scene and kind of scattering, error against time, both logarithmic.

use anyhow::anyhow;
use plotters::coord::Shift;
use plotters::prelude::*;

use super::reading::front;
use super::{Chart, Method, Panel, Point, Scattering};

/// Pixels of a panel.
const PANEL: (u32, u32) = (460, 380);
/// Pixels of the title and the legend above.
const HEAD: u32 = 92;
/// Pixels to the left of a panel's axis.
const LEFT: i32 = 64;
/// Pixels of a mark's name: its height, and the width of a letter on average.
const NAME: (i32, i32) = (9, 5);

/// Methods in the order of the legend, their names and colours.
const METHODS: [(Method, &str, RGBColor); 7] = [
    (Method::Rbf, "rbf: RBFs with probes", RGBColor(20, 90, 180)),
    (Method::Auto, "auto: rbf, error asked for", RGBColor(230, 140, 20)),
    (Method::Live, "rbf on raw density: lattice", RGBColor(30, 160, 160)),
    (Method::Paper, "paper: Zhou et al. 2008", RGBColor(200, 60, 40)),
    (Method::Constellation, "constellation: Navarro et al. 2008", RGBColor(140, 70, 170)),
    (Method::Fog, "Bevy's FogVolume", RGBColor(130, 130, 120)),
    (Method::Path, "path tracer, CPU", RGBColor(20, 20, 20)),
];

/// Draws a chart.
pub(super) fn svg(chart: &Chart) -> anyhow::Result<String> {
    let mut text = String::new();
    draw(chart, &mut text).map_err(|error| anyhow!("cannot draw the chart: {error}"))?;
    Ok(text)
}

type Drawing<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type Result = std::result::Result<(), Box<dyn std::error::Error>>;

fn draw(chart: &Chart, text: &mut String) -> Result {
    // A row a kind of scattering, a column a scene.
    let kinds: Vec<Scattering> = [Scattering::Single, Scattering::Full]
        .into_iter()
        .filter(|kind| chart.panels.iter().any(|panel| panel.scattering == *kind))
        .collect();
    let mut scenes: Vec<&str> = chart.panels.iter().map(|panel| panel.scene.as_str()).collect();
    scenes.dedup();
    let columns = scenes.len().max(1) as u32;
    let size = ((PANEL.0 * columns).max(2 * PANEL.0), HEAD + PANEL.1 * kinds.len().max(1) as u32);
    let root = SVGBackend::with_string(text, size).into_drawing_area();
    root.fill(&WHITE)?;
    let (head, body) = root.split_vertically(HEAD);
    let [width, height] = chart.size;
    let title = format!(
        "Error against the {}: {width} × {height} pixels, {}",
        if chart.on_gpu { "GPU's time for" } else { "time of" }.to_string()
            + " a frame in which smoke moves and light turns",
        chart.adapter
    );
    head.draw(&Text::new(title, (12, 10), ("sans-serif", 17)))?;
    let shown = |method| chart.panels.iter().flat_map(|panel| &panel.points).any(|point| point.method == method);
    for (i, (method, name, color)) in METHODS.into_iter().filter(|(method, ..)| shown(*method)).enumerate() {
        let at = (24 + 300 * (i as i32 % 3), 42 + 20 * (i as i32 / 3));
        mark(&head, method, at, color)?;
        head.draw(&Text::new(name, (at.0 + 10, at.1 - 7), ("sans-serif", 14)))?;
    }
    let cells = body.split_evenly((kinds.len().max(1), columns as usize));
    for (row, kind) in kinds.iter().enumerate() {
        for (column, scene) in scenes.iter().enumerate() {
            let found = chart.panels.iter().find(|panel| panel.scene == *scene && panel.scattering == *kind);
            if let Some(panel) = found {
                draw_panel(panel, &cells[row * columns as usize + column])?;
            }
        }
    }
    root.present()?;
    Ok(())
}

fn draw_panel(panel: &Panel, area: &Drawing) -> Result {
    let range = |of: &dyn Fn(&Point) -> f64| {
        let values = panel.points.iter().map(of).filter(|value| *value > 0.0);
        let (low, high) = values.fold((f64::MAX, 0.0_f64), |(low, high), value| (low.min(value), high.max(value)));
        if low > high { 0.1..1.0 } else { low / 1.4..high * 1.6 }
    };
    let percent = |point: &Point| 100.0 * point.error.max(1e-4);
    let (errors, times) = (range(&percent), range(&|point| point.ms));
    let kind = if panel.scattering == Scattering::Single { "single scattering" } else { "full scattering" };
    let mut chart = ChartBuilder::on(area)
        .caption(format!("{}, {kind}", panel.scene), ("sans-serif", 16))
        .margin(8)
        .x_label_area_size(36)
        .y_label_area_size(LEFT - 8)
        .build_cartesian_2d(errors.log_scale(), times.log_scale())?;
    let number = |value: &f64| format!("{}", (value * 1e6).round() / 1e6);
    chart
        .configure_mesh()
        .light_line_style(RGBColor(238, 238, 238))
        .bold_line_style(RGBColor(210, 210, 210))
        .x_desc("error, %")
        .y_desc("milliseconds")
        .x_label_formatter(&number)
        .y_label_formatter(&number)
        .label_style(("sans-serif", 12))
        .draw()?;
    // The front goes along and up, not straight.
    let mut steps: Vec<(f64, f64)> = Vec::new();
    for point in front(panel.points.iter()) {
        if let Some(&(error, _)) = steps.last() {
            steps.push((error, point.ms));
        }
        steps.push((percent(point), point.ms));
    }
    chart.draw_series(LineSeries::new(steps, RGBColor(150, 190, 120).stroke_width(3)))?;
    // Names of the front's points come first: there is not room for all.
    let front = front(panel.points.iter());
    let is_on_front = |point: &&Point| front.iter().any(|other| std::ptr::eq(*other, *point));
    let (first, others): (Vec<&Point>, Vec<&Point>) = panel.points.iter().partition(is_on_front);
    let mut names = Names::default();
    for point in first.into_iter().chain(others) {
        let color = METHODS.iter().find(|(method, ..)| *method == point.method).map_or(BLACK, |(.., color)| *color);
        let (x, y) = chart.backend_coord(&(percent(point), point.ms));
        let (left, top) = area.get_base_pixel();
        let at = (x - left, y - top);
        mark(area, point.method, at, color)?;
        if let Some(at) = names.place(&point.setting, at, area.dim_in_pixel().0 as i32) {
            area.draw(&Text::new(point.setting.as_str(), at, ("sans-serif", NAME.0).into_font().color(&color)))?;
        }
    }
    Ok(())
}

/// The places that names of marks take: left, top, right and bottom.
#[derive(Default)]
struct Names(Vec<[i32; 4]>);

impl Names {
    /// The corner of a name beside a mark where no other is, if there is such a place.
    fn place(&mut self, name: &str, mark: (i32, i32), width: i32) -> Option<(i32, i32)> {
        let length = name.chars().count() as i32 * NAME.1;
        let beside = [(6, -5), (6, 5), (6, -15), (-6 - length, -5), (-6 - length, 5), (-6 - length, -15)];
        let at = beside.map(|(x, y)| (mark.0 + x, mark.1 + y));
        let taken = |at: (i32, i32)| [at.0, at.1, at.0 + length, at.1 + NAME.0];
        let meets = |a: &[i32; 4], b: &[i32; 4]| a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];
        let is_free = |at: &(i32, i32)| {
            let place = taken(*at);
            LEFT < place[0] && place[2] < width && self.0.iter().all(|other| !meets(&place, other))
        };
        let found = at.into_iter().find(is_free)?;
        self.0.push(taken(found));
        Some(found)
    }
}

/// A method's mark, at pixels of the area.
fn mark(area: &Drawing, method: Method, at: (i32, i32), color: RGBColor) -> Result {
    let filled = color.filled();
    match method {
        Method::Rbf => area.draw(&Circle::new(at, 4, filled))?,
        Method::Auto => area.draw(&Circle::new(at, 6, color.stroke_width(2)))?,
        Method::Live => area.draw(&Circle::new(at, 4, color.stroke_width(2)))?,
        Method::Paper => area.draw(&TriangleMarker::new(at, 5, filled))?,
        Method::Constellation => area.draw(&Rectangle::new([(at.0 - 4, at.1 - 4), (at.0 + 4, at.1 + 4)], filled))?,
        Method::Fog => area.draw(&Cross::new(at, 4, color.stroke_width(2)))?,
        Method::Path => area.draw(&Cross::new(at, 3, color.stroke_width(1)))?,
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_do_not_meet() {
        let mut names = Names::default();
        assert_eq!(names.place("one", (100, 50), 250), Some((106, 45)));
        assert_eq!(names.place("two", (100, 50), 250), Some((106, 55)));
        // To the left of the edge.
        assert_eq!(names.place("three", (240, 50), 250), Some((209, 45)));
        let there = (0..9).filter(|_| names.place("four", (100, 50), 250).is_some()).count();
        assert_eq!(there, 4);
    }
}
