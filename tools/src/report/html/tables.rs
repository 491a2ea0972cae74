//! The figures, in tables: the same as on the screen, and all of their quantiles.

use super::Sheet;
use super::markup::{Table, count, escape, of, section, us};
use crate::report::figures::StationFigures;
use crate::report::histogram::Summary;
use crate::report::screen::{guard_words, host_items};
use crate::report::text::signed_time;

/// Stations that are listed: what a lab holds. All are in the JSON report.
const ROWS_MAX: usize = 250;

const QUANTILES: [&str; 11] = [
    "station",
    "n",
    "gaps",
    "longest gap µs",
    "min µs",
    "p50 µs",
    "p99 µs",
    "p99.9 µs",
    "p99.99 µs",
    "max µs",
    "SD µs",
];

/// Who they are, and what became of their frames.
pub fn stations(sheet: &Sheet<'_>) -> String {
    let heads = [
        "station",
        "role",
        "clock offset",
        "drift ppm",
        "frames seen",
        "expected",
        "missed",
        "outside",
        "late, skipped",
        "stalled in send",
        "guard drops",
        "lost on the way",
    ];
    let mut table = Table::new("", 2, &heads);
    for station in shown(sheet) {
        table.row([
            escape(&station.name),
            station.role.to_string(),
            signed_time(station.clock_offset_ns),
            format!("{:+.1}", station.clock_drift_ppb as f64 / 1e3),
            count(station.frames_seen),
            count(station.frames_expected),
            count(station.slots_missed),
            count(station.stray),
            count(station.overruns),
            count(station.stalled_in_send),
            count(station.guard_drops),
            count(station.frames_lost),
        ]);
    }
    section("stations", "Stations", &left_out(sheet), &table.html())
}

/// Every jitter with its definition, per station and of all.
pub fn jitter(sheet: &Sheet<'_>) -> String {
    let figures = sheet.figures;
    let mut slot =
        Table::new(defined("Slot error", "actual − scheduled transmit; gaps: slots missed"), 1, &QUANTILES);
    let mut sync = Table::new(
        defined("Sync error", "estimated − true global time whenever a station sends; gaps: slots missed"),
        1,
        &QUANTILES,
    );
    for station in shown(sheet) {
        slot.row(quantiles(escape(&station.name), &station.slot_error_ns));
        if station.sync_error_ns.n > 0 {
            sync.row(quantiles(escape(&station.name), &station.sync_error_ns));
        }
    }
    slot.row_of("all", quantiles("all".into(), &figures.slot_error_ns));
    if figures.sync_error_ns.n > 0 {
        sync.row_of("all", quantiles("all".into(), &figures.sync_error_ns));
        sync.row_of("all", quantiles("all, |sync error|".into(), &figures.sync_error_abs_ns));
    }
    let mut others = Table::new("Of the whole network", 1, &QUANTILES);
    let deviation = "|slot error − the station’s median|; a missed slot counts as a whole slot";
    others.row(quantiles(defined("Slot error, abs", deviation), &figures.slot_error_abs_ns));
    let period = "(t(n) − t(n−1)) − T of Synchronisation frames; gaps: times from one to the next with some missing between, or not \
                  stamped";
    others.row(quantiles(defined("Sync period jitter", period), &figures.sync_period_jitter_ns));
    for of in &figures.queueing {
        let name = format!("Queueing, priority {}", of.priority);
        others.row(quantiles(
            defined(&name, "frame on the wire − queued by its program; gaps: frames that found no room"),
            &of.delay_ns,
        ));
    }
    let note = "Early is below zero. A quantile is the least value that the share of all does not exceed; minimum, maximum and SD are exact.";
    section("jitter", "Jitter, by its definitions", note, &(slot.html() + &sync.html() + &others.html()))
}

/// Without which no figure means anything.
pub fn host(sheet: &Sheet<'_>) -> String {
    let guard = guard_words(&sheet.figures.per_station);
    let items = host_items(&sheet.figures.host, Some(guard));
    let items: String = items.iter().map(|item| format!("<li>{}</li>", escape(item))).collect();
    section("host", "Host", "", &format!("<ul class=\"items\">{items}</ul>\n"))
}

fn defined(name: &str, definition: &str) -> String {
    format!("<b>{name}</b> = {definition}")
}

fn quantiles(name: String, of: &Summary) -> [String; 11] {
    let [min, p50, p99, p999, p9999, max, sd] =
        [of.min, of.p50, of.p99, of.p999, of.p9999, of.max, of.sd].map(us);
    let gaps = of.gaps.map_or("–".into(), count);
    [name, count(of.n), gaps, us(of.longest_gap_ns), min, p50, p99, p999, p9999, max, sd]
}

fn shown<'a>(sheet: &'a Sheet<'_>) -> &'a [StationFigures] {
    let all = &sheet.figures.per_station;
    &all[..all.len().min(ROWS_MAX)]
}

fn left_out(sheet: &Sheet<'_>) -> String {
    let all = sheet.figures.per_station.len();
    if all <= ROWS_MAX {
        String::new()
    } else {
        format!("The first {}; all are in the JSON report.", of(ROWS_MAX as u64, all as u64))
    }
}
