//! A ring's report as a person reads it, in a terminal.

use std::collections::BTreeMap;

use super::figures::{RecoveryFigures, RingFigures, RingStation, span};
use crate::report::figures::QueueingFigures;
use crate::report::histogram::Summary;
use crate::report::screen::{WIDTH_MIN, gaps, host_lines, sections};
use crate::report::text::{
    Column, about, cut, grouped, list, micros, micros_or_dash, paragraph, signed_time, table,
};

/// The recoveries shown; more are in the JSON report.
const SHOWN: usize = 10;
const NAME_MAX: usize = 12;

/// In plain text, no line of it longer than `width` columns (less than [`WIDTH_MIN`] counts as that).
pub fn render(figures: &RingFigures, width: usize) -> String {
    let width = width.max(WIDTH_MIN);
    sections(&[
        headline(figures, width),
        stations(&figures.per_station, width),
        times(figures, width),
        queueing(figures, width),
        misses(figures, width),
        notes(figures, width),
        host_lines(&figures.host, None, width),
        figures.verdict.lines(&well(figures), width),
    ])
}

/// What was run, one by one.
pub(super) fn facts(figures: &RingFigures) -> Vec<String> {
    let world = figures.seed.map(|seed| format!("virtual time, seed {seed}"));
    let mut facts = vec![
        format!("{} stations in a ring", grouped(figures.stations)),
        format!("{} rounds of the token", grouped(figures.rounds)),
        about(figures.measured_ns),
    ];
    facts.extend(world);
    facts.push("no slots, no cycle, no master".into());
    facts
}

fn headline(figures: &RingFigures, width: usize) -> Vec<String> {
    list("", &facts(figures), width)
}

fn stations(stations: &[RingStation], width: usize) -> Vec<String> {
    let right = |head, cell: fn(&RingStation) -> String| Column::right(head, stations.iter().map(cell));
    let columns = [
        Column::left(["", "station"], stations.iter().map(|s| cut(&s.name, NAME_MAX))),
        Column::left(["at", "the end"], stations.iter().map(|s| s.state.clone())),
        right(["clock", "offset"], |s| signed_time(s.clock_offset_ns)),
        right(["drift", "ppm"], |s| format!("{:+.1}", s.clock_drift_ppb as f64 / 1e3)),
        right(["frames", "seen"], |s| grouped(s.frames_seen)),
        right(["token", "came"], |s| grouped(s.visits)),
        right(["round", "p50"], |s| micros_or_dash(s.rotation_ns.p50)),
        right(["in us", "max"], |s| micros_or_dash(s.rotation_ns.max)),
        right(["lost", "frames"], |s| grouped(s.frames_lost)),
    ];
    table(&columns, width)
}

/// Each kind of time that was measured, what it is, and how long it may be.
pub(super) fn kinds(figures: &RingFigures) -> [(&'static str, &'static str, &Summary, Option<i64>); 3] {
    let bounds = &figures.bounds;
    let round = "from one time that the token came to a station to the next; the bound is for one in which nothing is lost; gaps: it was absent meanwhile";
    let delivery = "from the begin of a station's usual frame to the end of its next one: so long is a value under way that just missed one; gaps: a new process began meanwhile";
    let recovery = "from the last token before one was lost to the next frame; the bound is for one station dead, each more has its own; gaps: it was still lost at the end";
    [
        ("round", round, &figures.rotation_ns, Some(bounds.rotation_ns)),
        ("delivery", delivery, &figures.delivery_ns, None),
        ("recovery", recovery, &figures.recovery_ns, Some(bounds.recovery_ns)),
    ]
}

fn times(figures: &RingFigures, width: usize) -> Vec<String> {
    let rows = kinds(figures);
    let right = |head, cell: fn(&Summary) -> String| {
        Column::right(["", head], rows.iter().map(|(_, _, summary, _)| cell(summary)))
    };
    let columns = [
        Column::left(["", "times in us"], rows.iter().map(|(name, ..)| (*name).to_owned())),
        right("n", |s| grouped(s.n)),
        right("gaps", gaps),
        right("min", |s| micros_or_dash(s.min)),
        right("p50", |s| micros_or_dash(s.p50)),
        right("p99", |s| micros_or_dash(s.p99)),
        right("p99.9", |s| micros_or_dash(s.p999)),
        right("max", |s| micros_or_dash(s.max)),
        Column::right(["", "bound"], rows.iter().map(|(.., bound)| micros_or_dash(*bound))),
    ];
    let definitions =
        rows.iter().flat_map(|(name, what, ..)| paragraph(&format!("  {name:<9} = "), what, width));
    table(&columns, width).into_iter().chain(definitions).collect()
}

fn queueing(figures: &RingFigures, width: usize) -> Vec<String> {
    let all = &figures.queueing;
    if all.is_empty() {
        return Vec::new();
    }
    let right = |head, cell: fn(&QueueingFigures) -> String| Column::right(["", head], all.iter().map(cell));
    let columns = [
        Column::left(["", "queueing in us"], all.iter().map(|of| format!("priority {}", of.priority))),
        right("n", |of| grouped(of.frames_seen)),
        right("p50", |of| micros_or_dash(of.delay_ns.p50)),
        right("p99", |of| micros_or_dash(of.delay_ns.p99)),
        right("max", |of| micros_or_dash(of.delay_ns.max)),
        right("refused", |of| grouped(of.refused)),
    ];
    let definition = paragraph("  queueing  = ", &queueing_words(figures), width);
    table(&columns, width).into_iter().chain(definition).collect()
}

pub(super) fn queueing_words(figures: &RingFigures) -> String {
    format!(
        "from when a program queued a frame, by its own clock, to its begin on the wire; the most urgent one waits {} at the most, and \
         50us more, since programs of a lab queue so long before the token is here",
        span(figures.bounds.access_delay_ns)
    )
}

/// What became of tokens, and what went wrong.
pub(super) fn counts(figures: &RingFigures) -> [(u64, &'static str); 10] {
    [
        (figures.tokens_repeated, "tokens repeated"),
        (figures.stations_skipped, "stations skipped"),
        (figures.tokens_claimed, "tokens claimed"),
        (figures.tokens_void, "tokens void"),
        (figures.invitations, "invitations"),
        (figures.overlaps, "overlaps"),
        (figures.unexplained, "unexplained"),
        (figures.payload_errors, "payload errors"),
        (figures.frames_lost, "lost on the way"),
        (figures.lost_on_purpose, "of them on purpose"),
    ]
}

fn misses(figures: &RingFigures, width: usize) -> Vec<String> {
    let items: Vec<_> =
        counts(figures).iter().map(|(count, what)| format!("{what} {}", grouped(*count))).collect();
    let mut lines = list("misses: ", &items, width);
    if !figures.causes.is_empty() {
        let causes = figures.causes.iter().map(|(name, n)| format!("{} {}", words(name), grouped(*n)));
        lines.extend(list("token lost and found, by cause: ", &causes.collect::<Vec<_>>(), width));
    }
    let shown = &figures.recoveries[..figures.recoveries.len().min(SHOWN)];
    if shown.is_empty() {
        return lines;
    }
    let right =
        |head, cell: fn(&RecoveryFigures) -> String| Column::right(["", head], shown.iter().map(cell));
    let columns = [
        Column::left(["", "  the longest"], shown.iter().map(|of| format!("  {}", who(of)))),
        right("at ms", |of| format!("{:.3}", of.at_ns as f64 / 1e6)),
        right("took us", |of| micros(of.took_ns)),
        right("bound us", |of| micros(of.bound_ns)),
        Column::left(["", "cause"], shown.iter().map(|of| words(of.cause))),
    ];
    lines.extend(table(&columns, width));
    lines
}

/// Whom a token was for that was lost.
pub(super) fn who(of: &RecoveryFigures) -> String {
    if of.stations.is_empty() { "two tokens".into() } else { cut(&of.stations.join(", "), 2 * NAME_MAX) }
}

pub(super) fn words(name: &str) -> String {
    name.replace('_', " ")
}

fn notes(figures: &RingFigures, width: usize) -> Vec<String> {
    notes_of(figures).iter().flat_map(|note| paragraph("note: ", note, width)).collect()
}

/// What to know besides: of the run, and of stations, each once with those that have it.
pub(super) fn notes_of(figures: &RingFigures) -> Vec<String> {
    let mut of_stations: BTreeMap<String, Vec<&str>> = BTreeMap::new();
    for station in &figures.per_station {
        let told = station.told.iter().filter(|(kind, _)| is_own(kind));
        let told = told.map(|(kind, n)| format!("{} {}", words(kind), grouped(*n))).collect::<Vec<_>>();
        let refused = station.refusals.iter().filter(|(_, n)| **n > 0);
        let refused = refused.map(|(why, n)| format!("{} {why}", grouped(*n))).collect::<Vec<_>>();
        let lists = [("told of", told), ("refused", refused)];
        let lists = lists.into_iter().filter(|(_, list)| !list.is_empty());
        let lists = lists.map(|(what, list)| format!("{what} {}", list.join(", ")));
        for note in station.notes.iter().cloned().chain(lists) {
            of_stations.entry(note).or_default().push(&station.name);
        }
    }
    let all = figures.per_station.len();
    let with_names = of_stations.into_iter().map(|(note, names)| match names.len() {
        n if n == all => format!("{note} (all stations)"),
        _ => format!("{note} ({})", names.join(", ")),
    });
    figures.notes.iter().cloned().chain(with_names).collect()
}

/// What became of tokens is counted on the medium.
fn is_own(kind: &str) -> bool {
    !["token_repeated", "station_skipped", "token_claimed"].contains(&kind)
}

/// What a ring that is well has shown.
pub(super) fn well(figures: &RingFigures) -> String {
    let (frames, lost) = (grouped(figures.frames_seen), figures.recovery_ns.n);
    match lost {
        0 => format!("{frames} frames seen, no two at once, and no token lost"),
        _ => format!(
            "nothing unexplained, {frames} frames seen; the token lost and found {}",
            times_words(lost)
        ),
    }
}

fn times_words(n: u64) -> String {
    if n == 1 { "once".into() } else { format!("{} times", grouped(n)) }
}
