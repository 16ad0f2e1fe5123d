//! The controls that sections are made of. All can be reached and moved by keyboard, and have names of their own.

use std::ops::RangeInclusive;

use bevy_egui::egui::{self, CollapsingHeader, DragValue, Slider, SliderClamping, Ui, WidgetInfo, WidgetType};

/// A part of the panel, open at first.
pub(super) fn section(ui: &mut Ui, title: &str, show: impl FnOnce(&mut Ui)) {
    CollapsingHeader::new(title).default_open(true).show(ui, show);
}

/// A number in a range. What is outside stays until it is moved.
pub(super) fn number(ui: &mut Ui, name: &str, value: &mut f32, range: RangeInclusive<f32>) {
    ui.add(Slider::new(value, range).text(name).clamping(SliderClamping::Edits));
}

/// A positive number whose size is not known beforehand; 0 is at the left end.
pub(super) fn magnitude(ui: &mut Ui, name: &str, value: &mut f32, range: RangeInclusive<f32>) {
    let smallest = f64::from(*range.start());
    let slider = Slider::new(value, 0.0..=*range.end()).logarithmic(true).smallest_positive(smallest);
    ui.add(slider.text(name).clamping(SliderClamping::Edits));
}

/// Degrees of an angle in radians.
pub(super) fn angle(ui: &mut Ui, name: &str, radians: &mut f32, range: RangeInclusive<f32>) {
    let mut degrees = radians.to_degrees();
    number(ui, name, &mut degrees, range);
    // Radians that nobody has moved stay as they are, to the bit.
    if degrees != radians.to_degrees() {
        *radians = degrees.to_radians();
    }
}

/// A linear colour or radiance: a swatch that opens a picker, and the channels by number.
pub(super) fn color(ui: &mut Ui, name: &str, rgb: &mut [f32; 3]) {
    ui.horizontal(|ui| {
        ui.color_edit_button_rgb(rgb);
        for (value, channel) in rgb.iter_mut().zip(["red", "green", "blue"]) {
            named(ui, &format!("{name} {channel}"), value, (0.01, 3), 0.0..=1e6);
        }
        ui.label(name);
    });
}

/// A position in metres.
pub(super) fn position(ui: &mut Ui, name: &str, at: &mut [f32; 3]) {
    ui.horizontal(|ui| {
        for (value, axis) in at.iter_mut().zip(["x", "y", "z"]) {
            named(ui, &format!("{name} {axis}"), value, (0.05, 2), f32::MIN..=f32::MAX);
        }
        ui.label(name);
    });
}

/// A number without a text beside it, named for those who do not see it; by how much a point of dragging moves it, and its
/// decimals. What is outside the range stays until it is edited.
fn named(ui: &mut Ui, name: &str, value: &mut f32, (speed, decimals): (f64, usize), range: RangeInclusive<f32>) {
    let before = *value;
    let widget = DragValue::new(value).speed(speed).max_decimals(decimals).range(range).clamp_existing_to_range(false);
    let response = ui.add(widget);
    response.widget_info(|| WidgetInfo::labeled(WidgetType::DragValue, true, name));
    // The text is rounded: whoever only passes through it changes nothing.
    if (*value - before).abs() < 0.5 * 0.1_f32.powi(decimals as i32) {
        *value = before;
    }
}

/// One of a few values.
pub(super) fn choice<T: PartialEq + Copy>(ui: &mut Ui, name: &str, value: &mut T, all: &[(T, &str)]) {
    ui.horizontal_wrapped(|ui| {
        ui.label(format!("{name}:"));
        for (each, title) in all {
            ui.radio_value(value, *each, *title);
        }
    });
}

/// A table of words and figures.
pub(super) fn table(ui: &mut Ui, name: &str, head: [&str; 3], rows: impl Iterator<Item = [String; 3]>) {
    egui::Grid::new(name).striped(true).num_columns(3).show(ui, |ui| {
        for row in std::iter::once(head.map(String::from)).chain(rows) {
            for cell in row {
                ui.label(cell);
            }
            ui.end_row();
        }
    });
}
