//! The time table as a picture: a row for each cycle until it repeats, to scale.
//!
//! ```text
//!   cycle 1/2 |sync|  [####]--   [####]--        |      a slot: its frame, its guard band behind it
//!                      arm 0      leg 0                 its label: below it, or slanting where that has no room
//!   cycle 2/2 |sync|  [####]--         [####]--  |
//!                      arm 0            leg 2
//!             0    100    200    300    400  us
//!   legend: sync window, frame, guard band, free
//! ```

mod labels;

use std::fmt::Write;

use labels::{Label, Labels};

use super::{Plan, SlotRow};
use crate::report::text::duration;

/// Of longer tables the first cycles are drawn.
const PHASES_DRAWN: u64 = 64;
/// The least: of many slots it is wider.
const WIDTH: f64 = 1200.0;
const LEFT: f64 = 110.0;
const RIGHT: f64 = 40.0;
const TOP: f64 = 44.0;
const BAR: f64 = 24.0;
/// Below a row's labels.
const GAP: f64 = 12.0;
/// Below the last row: the axis, the legend, and what is not drawn.
const FOOT: f64 = 88.0;
/// Hues are so far apart, in degrees, that neighbours are not alike.
const HUE_STEP: f64 = 137.5;
const STYLE: &str = "text{font:12px sans-serif;fill:#222}.small{font-size:10px;fill:#555}.sync{fill:#333}.backup{fill:#888}\
                     .guard{fill-opacity:.25}.free{fill:#fff;stroke:#bbb}.line{stroke:#ddd}.lead{stroke:#999;stroke-width:.5}";

/// The picture, which needs nothing else to be shown.
pub fn draw(plan: &Plan) -> String {
    let picture = Picture::of(plan);
    let phases = plan.table.phases.unwrap_or(1);
    let (width, height) = (picture.width, picture.bottom() + FOOT);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" role=\"img\">\n<style>{STYLE}</style>\n\
         <rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>\n"
    );
    text(&mut svg, LEFT, 22.0, "", &title(plan));
    picture.axis(&mut svg);
    for (phase, labels) in picture.rows.iter().enumerate() {
        let top = picture.top(phase);
        picture.row(&mut svg, phase as u64, top);
        labels.draw(&mut svg, top + BAR);
        let label =
            if phases == 1 { "every cycle".to_owned() } else { format!("cycle {}/{phases}", phase + 1) };
        text(&mut svg, 8.0, top + 17.0, "", &label);
    }
    legend(&mut svg, plan, picture.bottom() + 30.0);
    let more = phases - picture.rows.len() as u64;
    if more > 0 {
        text(&mut svg, 8.0, height - 4.0, "small", &format!("and {more} cycles more until it repeats"));
    }
    svg + "</svg>\n"
}

fn title(plan: &Plan) -> String {
    format!(
        "{} stations, cycle {}, {} Mbit/s, guard band {}, of which hosts may be late by {}",
        plan.stations,
        duration(plan.cycle_ns.unsigned_abs()),
        plan.rate as f64 / 1e6,
        duration(plan.guard.band_ns.unsigned_abs()),
        duration(plan.guard.lateness_ns.unsigned_abs())
    )
}

/// Where everything is.
struct Picture<'a> {
    plan: &'a Plan,
    width: f64,
    /// The labels of each cycle that is drawn.
    rows: Vec<Labels>,
    /// From one row to the next.
    row: f64,
}

impl<'a> Picture<'a> {
    fn of(plan: &'a Plan) -> Self {
        let drawn = plan.table.phases.unwrap_or(1).min(PHASES_DRAWN);
        let most = (0..drawn).map(|phase| plan.table.phase(phase).count()).max().unwrap_or(0);
        let width = WIDTH.max(LEFT + RIGHT + Labels::room_for(most));
        let mut picture = Self { plan, width, rows: Vec::new(), row: 0.0 };
        let label = |slot: &SlotRow| Label::of(picture.x(slot.begins_ns), &slot.station, &slot.name());
        let labels = |phase| plan.table.phase(phase).map(label).collect();
        let rows: Vec<_> =
            (0..drawn).map(|phase| Labels::place(labels(phase), LEFT, width - RIGHT)).collect();
        picture.row = BAR + GAP + rows.iter().map(Labels::height).fold(0.0, f64::max);
        Self { rows, ..picture }
    }

    fn top(&self, phase: usize) -> f64 {
        TOP + self.row * phase as f64
    }

    fn bottom(&self) -> f64 {
        self.top(self.rows.len())
    }

    fn x(&self, ns: i64) -> f64 {
        LEFT + (self.width - LEFT - RIGHT) * ns as f64 / self.plan.cycle_ns as f64
    }

    fn row(&self, svg: &mut String, phase: u64, top: f64) {
        let plan = self.plan;
        self.block(svg, [0, plan.cycle_ns], top, "class=\"free\"", "the cycle");
        self.block(svg, [0, plan.sync_window_ns], top, "class=\"sync\"", "sync window");
        for backup in &plan.table.backups {
            let of = format!("backup {}", backup.station);
            self.block(svg, [backup.sends_ns, backup.until_ns], top, "class=\"backup\"", &of);
        }
        for slot in plan.table.phase(phase) {
            let fill = format!("fill=\"{}\"", colour(slot.number));
            let of = format!("slot {} of {}", slot.name(), slot.station);
            self.block(svg, [slot.begins_ns, slot.ends_ns], top, &format!("class=\"guard\" {fill}"), &of);
            self.block(svg, [slot.begins_ns, slot.frame_ends_ns], top, &fill, &of);
        }
    }

    /// A part of a row, at least half a point wide.
    fn block(&self, svg: &mut String, [from, until]: [i64; 2], top: f64, style: &str, title: &str) {
        let (left, right) = (self.x(from), self.x(until));
        let times = [from, until].map(|ns| duration(ns.unsigned_abs()));
        let _ = writeln!(
            svg,
            "<rect x=\"{left:.2}\" y=\"{top:.1}\" width=\"{:.2}\" height=\"{BAR}\" {style}><title>{}: {} to {}</title></rect>",
            (right - left).max(0.5),
            escaped(title),
            times[0],
            times[1]
        );
    }

    /// Ten steps at the most, of 1, 2 or 5 of some unit.
    fn axis(&self, svg: &mut String) {
        let (cycle, bottom) = (self.plan.cycle_ns, self.bottom());
        let steps = (0..12).flat_map(|decade| [1, 2, 5].map(|first| first * 10_i64.pow(decade)));
        let step = steps.into_iter().find(|step| cycle / step <= 10).unwrap_or(cycle);
        for mark in 0..=cycle / step {
            let at = self.x(mark * step);
            let _ = writeln!(
                svg,
                "<line class=\"line\" x1=\"{at:.2}\" x2=\"{at:.2}\" y1=\"{TOP}\" y2=\"{bottom:.1}\"/>"
            );
            text(svg, at, bottom + 14.0, "small", &duration((mark * step).unsigned_abs()));
        }
    }
}

/// What the parts of a row mean.
fn legend(svg: &mut String, plan: &Plan, top: f64) {
    let fill = format!("fill=\"{}\"", colour(0));
    let mut parts = vec![
        ("class=\"sync\"".to_owned(), "window of the sync"),
        (fill.clone(), "a slot's frame of full size, in its station's colour"),
        (format!("class=\"guard\" {fill}"), "the guard band behind it"),
        ("class=\"free\"".to_owned(), "free"),
    ];
    if !plan.table.backups.is_empty() {
        parts.insert(1, ("class=\"backup\"".to_owned(), "a backup's sync, if it takes over"));
    }
    let mut x = LEFT;
    for (style, what) in parts {
        let _ = writeln!(svg, "<rect x=\"{x:.1}\" y=\"{top:.1}\" width=\"18\" height=\"12\" {style}/>");
        text(svg, x + 24.0, top + 10.0, "small", what);
        x += 24.0 + labels::width(what) + 20.0;
    }
    text(
        svg,
        LEFT,
        top + 28.0,
        "small",
        "below each slot: its station and its number, of a joint one with whose queue it sends",
    );
}

fn text(svg: &mut String, x: f64, y: f64, class: &str, text: &str) {
    let _ = writeln!(svg, "<text x=\"{x:.2}\" y=\"{y:.1}\" class=\"{class}\">{}</text>", escaped(text));
}

/// One for each station, by its number.
fn colour(number: usize) -> String {
    format!("hsl({:.0},65%,45%)", number as f64 * HUE_STEP % 360.0)
}

/// A text as it may stand between tags and in quotes.
fn escaped(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for letter in text.chars() {
        match letter {
            '&' => escaped += "&amp;",
            '<' => escaped += "&lt;",
            '>' => escaped += "&gt;",
            '"' => escaped += "&quot;",
            other => escaped.push(other),
        }
    }
    escaped
}

#[cfg(test)]
mod tests;
