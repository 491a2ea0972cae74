//! An observation as a person reads it, in a terminal.
//!
//! Top-down: what was heard, each station and slot, jitter with its definitions, what was missing, the host.

use super::figures::{JitterFigures, OtherFigures, SlotFigures};
use crate::report::histogram::Summary;
use crate::report::screen::{WIDTH_MIN, host_lines, sections};
use crate::report::text::{Column, about, cut, duration, grouped, list, micros_or_dash, paragraph, table};

/// Streams shown of each kind; more are in the JSON report.
const SHOWN: usize = 100;
/// As long as an address.
const NAME_MAX: usize = 17;

/// The report in plain text, no line of it longer than `width` columns (less than
/// [`WIDTH_MIN`] counts as that).
pub fn render(figures: &JitterFigures, width: usize) -> String {
    let width = width.max(WIDTH_MIN);
    sections(&[
        headline(figures, width),
        slots(figures, width),
        others(figures, width),
        definitions(figures, width),
        counts(figures, width),
        host_lines(&figures.host, None, width),
    ])
}

fn headline(figures: &JitterFigures, width: usize) -> Vec<String> {
    let place = match &figures.lab {
        Some(lab) => format!("{} of lab '{lab}'", figures.interface),
        None => figures.interface.clone(),
    };
    let mut items = vec![place];
    items.extend(figures.cycle_ns.map(|cycle| format!("cycle {}", duration(cycle))));
    items.push(about(figures.observed_ns));
    items.push(format!("{} frames", grouped(figures.frames)));
    items.extend(figures.kinds.iter().map(|(kind, count)| format!("{kind} {}", grouped(*count))));
    items.extend(figures.clock_drift_ppb.map(|ppb| format!("master's clock {:+.1} ppm", ppb as f64 / 1e3)));
    list("", &items, width)
}

/// A line of the first table.
struct Row {
    name: String,
    which: String,
    frames: String,
    missed: String,
    times: Summary,
}

impl Row {
    fn of(slot: &SlotFigures) -> Self {
        Self {
            name: name(&slot.name, &slot.source),
            which: slot.slot.map_or_else(|| "sync".to_owned(), |id| format!("slot {id}")),
            frames: grouped(slot.frames),
            missed: grouped(slot.missed),
            times: slot.slot_error_ns,
        }
    }
}

/// Syncs, slots, and the period of the syncs, which has the same columns.
fn slots(figures: &JitterFigures, width: usize) -> Vec<String> {
    let nothing = String::new;
    let name = "sync period jitter".to_owned();
    let times = figures.sync_period_jitter_ns;
    let which = times.longest_gap_ns.map_or_else(nothing, |ns| format!("gap {}", duration(ns as u64)));
    let missed = times.gaps.map_or_else(nothing, grouped);
    let period = Row { name, which, frames: nothing(), missed, times };
    let rows: Vec<Row> = figures.slots.iter().take(SHOWN).map(Row::of).chain([period]).collect();
    let left = |head, cell: fn(&Row) -> &String| Column::left(head, rows.iter().map(|row| cell(row).clone()));
    let right =
        |head, cell: fn(&Row) -> &String| Column::right(head, rows.iter().map(|row| cell(row).clone()));
    let figure = |head, pick: fn(&Summary) -> Option<i64>| {
        Column::right(head, rows.iter().map(|row| micros_or_dash(pick(&row.times))))
    };
    let columns = [
        left(["", "station"], |row| &row.name),
        left(["slot", "error of"], |row| &row.which),
        right(["", "frames"], |row| &row.frames),
        right(["", "missed"], |row| &row.missed),
        Column::right(["", "n"], rows.iter().map(|row| grouped(row.times.n))),
        figure(["in us", "min"], |times| times.min),
        figure(["", "p50"], |times| times.p50),
        figure(["", "p99"], |times| times.p99),
        figure(["", "p99.9"], |times| times.p999),
        figure(["", "max"], |times| times.max),
        figure(["", "SD"], |times| times.sd),
    ];
    table(&columns, width)
}

fn others(figures: &JitterFigures, width: usize) -> Vec<String> {
    let rows: Vec<&OtherFigures> = figures.others.iter().take(SHOWN).collect();
    if rows.is_empty() {
        return Vec::new();
    }
    let right =
        |head, cell: fn(&OtherFigures) -> String| Column::right(head, rows.iter().map(|row| cell(row)));
    let columns = [
        Column::left(["", "station"], rows.iter().map(|row| name(&row.name, &row.source))),
        Column::left(["", ""], rows.iter().map(|row| row.what.clone())),
        right(["", "frames"], |row| grouped(row.frames)),
        right(["", "missed"], |row| row.missed.map_or_else(|| "-".to_owned(), grouped)),
        right(["", "n"], |row| grouped(row.place_ns.n)),
        right(["place", "min"], |row| micros_or_dash(row.place_ns.min)),
        right(["in", "p50"], |row| micros_or_dash(row.place_ns.p50)),
        right(["us", "max"], |row| micros_or_dash(row.place_ns.max)),
        right(["spread", "p50"], |row| micros_or_dash(row.place_spread_ns.p50)),
        right(["in", "p99"], |row| micros_or_dash(row.place_spread_ns.p99)),
        right(["us", "p99.9"], |row| micros_or_dash(row.place_spread_ns.p999)),
        right(["", "max"], |row| micros_or_dash(row.place_spread_ns.max)),
    ];
    table(&columns, width)
}

fn name(name: &Option<String>, source: &str) -> String {
    cut(name.as_deref().unwrap_or(source), NAME_MAX)
}

fn definitions(figures: &JitterFigures, width: usize) -> Vec<String> {
    let mut rows = vec![
        (
            "sync period jitter",
            "(t(n) - t(n-1)) - T, T = sched_xmit(n) - sched_xmit(n-1); missed: gaps, in which syncs were missing or not stamped, which have no jitter; gap: the longest, from sync to sync",
        ),
        ("slot error", "stamp - (scheduled + offset), scheduled as the frame itself says"),
        ("offset", "smallest stamp - max(sched_xmit, xmit_stamp) of 16 syncs, less drift"),
        ("missed", "turns without a frame between two; a turn is the shortest step seen"),
    ];
    if !figures.others.is_empty() {
        rows.push(("place", "stamp - (the cycle's start + offset), of frames that do not say when"));
        rows.push(("spread", "|place - its median|"));
    }
    rows.push(("stamps", "taken by software, here: each is off by about a microsecond"));
    if figures.clock_drift_ppb.is_none() {
        rows.push((
            "note",
            "not 64 syncs were heard: what the clocks drift in 16 cycles is in slot errors and places",
        ));
    }
    rows.iter().flat_map(|(name, text)| paragraph(&format!("  {name:<18} = "), text, width)).collect()
}

fn counts(figures: &JitterFigures, width: usize) -> Vec<String> {
    let rate = figures.rate as f64 / 1e6;
    let counts = [
        ("cycles without a sync".to_owned(), figures.sync_gaps),
        ("syncs out of turn".to_owned(), figures.syncs_repeated),
        ("implausible syncs".to_owned(), figures.syncs_implausible),
        (format!("overlaps at {rate} Mbit/s"), figures.overlaps),
        ("lost by the ring".to_owned(), figures.dropped_by_ring),
        ("clock steps".to_owned(), figures.clock_steps),
        ("new time lines".to_owned(), figures.line_restarts),
        ("not judged".to_owned(), figures.not_judged),
    ];
    list("", &counts.map(|(what, count)| format!("{what} {}", grouped(count))), width)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn figures() -> JitterFigures {
        let summary =
            Summary { n: 9, min: Some(-250), p50: Some(1_250), max: Some(31_000), ..Summary::default() };
        let slot = SlotFigures {
            source: "02:00:00:00:00:02".into(),
            name: Some("slave1".into()),
            station: Some(1),
            slot: Some(0),
            frames: 1_234,
            missed: 2,
            slot_error_ns: summary,
            ..SlotFigures::default()
        };
        let other = OtherFigures {
            source: "02:00:00:00:00:03".into(),
            what: "0x0800".into(),
            frames: 7,
            missed: Some(1),
            place_ns: summary,
            ..OtherFigures::default()
        };
        JitterFigures {
            interface: "br0".into(),
            lab: Some("lab".into()),
            cycle_ns: Some(2_000_000),
            rate: 1_000_000_000,
            slots: vec![slot],
            others: vec![other],
            ..JitterFigures::default()
        }
    }

    #[test]
    fn every_figure_has_its_definition_once_and_no_line_is_too_long() {
        for width in [80, 100, 160] {
            let screen = render(&figures(), width);
            for once in
                ["slot error         = ", "sync period jitter = ", "place              = ", "microsecond"]
            {
                assert_eq!(screen.matches(once).count(), 1, "{once}: {screen}");
            }
            assert!(screen.lines().all(|line| line.chars().count() <= width), "{screen}");
            assert!(
                screen.contains("slave1") && screen.contains("1 234") && screen.contains("0x0800"),
                "{screen}"
            );
        }
    }

    #[test]
    fn what_is_written_can_be_read() {
        let json = serde_json::to_string(&figures()).unwrap();
        assert_eq!(serde_json::from_str::<JitterFigures>(&json).unwrap(), figures());
    }

    #[test]
    fn silence_is_no_division_by_nothing() {
        let screen = render(&JitterFigures::default(), 100);
        assert!(screen.contains("0 frames") && screen.contains("slot error"), "{screen}");
    }
}
