//! The time table as a picture: a row for each cycle until it repeats, to scale.
//!
//! ```text
//!   cycle 1/2 |sync|  [arm 0]--   [leg 0]--      |      a slot: its frame, its guard band behind it
//!   cycle 2/2 |sync|  [arm 0]--         [leg 2]--|
//!             0    100    200    300    400  us
//! ```

use std::fmt::Write;

use super::{Plan, SlotRow};
use crate::report::text::duration;

/// Of longer tables the first cycles are drawn.
const PHASES_DRAWN: u64 = 64;
const WIDTH: f64 = 1200.0;
const LEFT: f64 = 110.0;
const RIGHT: f64 = 40.0;
const TOP: f64 = 44.0;
const ROW: f64 = 46.0;
const BAR: f64 = 24.0;
/// Hues are so far apart, in degrees, that neighbours are not alike.
const HUE_STEP: f64 = 137.5;
const STYLE: &str = "text{font:12px sans-serif;fill:#222}.small{font-size:10px;fill:#555}.sync{fill:#333}.backup{fill:#888}\
                     .guard{fill-opacity:.25}.line{stroke:#bbb}";

/// The picture, which needs nothing else to be shown.
pub fn draw(plan: &Plan) -> String {
    let phases = plan.table.phases.unwrap_or(1);
    let drawn = phases.min(PHASES_DRAWN);
    let height = TOP + ROW * drawn as f64 + 40.0;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {height}\" role=\"img\">\n<style>{STYLE}</style>\n\
         <rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>\n"
    );
    let title = format!(
        "{} stations, cycle {}, {} Mbit/s, guard band {}",
        plan.stations,
        duration(plan.cycle_ns.unsigned_abs()),
        plan.rate as f64 / 1e6,
        duration(plan.guard.band_ns.unsigned_abs())
    );
    text(&mut svg, LEFT, 22.0, "", &title);
    for phase in 0..drawn {
        row(&mut svg, plan, phase, TOP + ROW * phase as f64);
        let label =
            if phases == 1 { "every cycle".to_owned() } else { format!("cycle {}/{phases}", phase + 1) };
        text(&mut svg, 8.0, TOP + ROW * phase as f64 + 17.0, "", &label);
    }
    axis(&mut svg, plan, TOP + ROW * drawn as f64);
    if phases > drawn {
        text(
            &mut svg,
            8.0,
            height - 4.0,
            "small",
            &format!("and {} cycles more until it repeats", phases - drawn),
        );
    }
    svg + "</svg>\n"
}

fn x(plan: &Plan, ns: i64) -> f64 {
    LEFT + (WIDTH - LEFT - RIGHT) * ns as f64 / plan.cycle_ns as f64
}

fn row(svg: &mut String, plan: &Plan, phase: u64, top: f64) {
    block(svg, plan, [0, plan.sync_window_ns], top, "class=\"sync\"", "sync window");
    for backup in &plan.table.backups {
        let of = format!("backup {}", backup.station);
        block(svg, plan, [backup.sends_ns, backup.until_ns], top, "class=\"backup\"", &of);
    }
    for slot in plan.table.phase(phase) {
        let fill = format!("fill=\"{}\"", colour(slot));
        let of = format!("slot {} of {}", slot.slot, slot.station);
        block(svg, plan, [slot.begins_ns, slot.ends_ns], top, &format!("class=\"guard\" {fill}"), &of);
        block(svg, plan, [slot.begins_ns, slot.frame_ends_ns], top, &fill, &of);
        let label = format!("{} {}", slot.station, slot.slot);
        // A name that has no room is told when it is pointed at.
        if x(plan, slot.ends_ns) - x(plan, slot.begins_ns) > 6.0 * label.chars().count() as f64 {
            text(svg, x(plan, slot.begins_ns), top + BAR + 11.0, "small", &label);
        }
    }
}

/// A part of a row, at least half a point wide.
fn block(svg: &mut String, plan: &Plan, [from, until]: [i64; 2], top: f64, style: &str, title: &str) {
    let (left, right) = (x(plan, from), x(plan, until));
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
fn axis(svg: &mut String, plan: &Plan, top: f64) {
    let steps = (0..12).flat_map(|decade| [1, 2, 5].map(|first| first * 10_i64.pow(decade)));
    let step = steps.into_iter().find(|step| plan.cycle_ns / step <= 10).unwrap_or(plan.cycle_ns);
    for mark in 0..=plan.cycle_ns / step {
        let at = x(plan, mark * step);
        let _ = writeln!(
            svg,
            "<line class=\"line\" x1=\"{at:.2}\" x2=\"{at:.2}\" y1=\"{TOP}\" y2=\"{top:.1}\"/>"
        );
        text(svg, at, top + 14.0, "small", &duration((mark * step).unsigned_abs()));
    }
}

fn text(svg: &mut String, x: f64, y: f64, class: &str, text: &str) {
    let _ = writeln!(svg, "<text x=\"{x:.2}\" y=\"{y:.1}\" class=\"{class}\">{}</text>", escaped(text));
}

/// One for each station.
fn colour(row: &SlotRow) -> String {
    format!("hsl({:.0},65%,45%)", row.number as f64 * HUE_STEP % 360.0)
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
