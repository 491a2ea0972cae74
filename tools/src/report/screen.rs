//! The report as a person reads it, in a terminal.
//!
//! Top-down: what was run, each station, how the slot errors are spread, jitter with its definitions,
//! what went wrong, the host, and the verdict as the last line.

#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use super::figures::{Figures, GuardName, Miss, QueueingFigures, StationFigures};
use super::histogram::{SignedHistogram, Summary};
use super::host::HostFacts;
use super::text::{
    Column, about, cut, duration, grouped, list, micros, micros_or_dash, paragraph, percent, signed_time,
    table,
};
use crate::judge::masters::Rivals;

/// The least width that the report is laid out for, in columns.
pub const WIDTH_MIN: usize = 80;

/// The misses shown; more are in the JSON report.
const MISSES_SHOWN: usize = 10;

/// How often two gave the time at once, the last times; more are in the JSON report.
const RIVALS_SHOWN: usize = 3;

/// Other real-time threads shown, the busiest; more are in the JSON report.
const OTHERS_SHOWN: usize = 3;

/// Longer names of stations are cut in the tables.
const NAME_MAX: usize = 12;

/// Columns of a bin of the histogram: `100us .. 200us`.
const BIN_WIDTH: usize = 14;

/// The report in plain text, no line of it longer than `width` columns (less than [`WIDTH_MIN`] counts
/// as that).
///
/// The histogram is that of |slot error - the station's median| over all stations, in nanoseconds.
pub fn render(figures: &Figures, width: usize, histogram: &SignedHistogram) -> String {
    let width = width.max(WIDTH_MIN);
    sections(&[
        headline(figures, width),
        stations(&figures.per_station, width),
        bars(histogram, width),
        jitter(figures, width),
        queueing(&figures.queueing, width),
        misses(figures, width),
        notes(figures, width),
        host_lines(&figures.host, Some(guard_words(&figures.per_station)), width),
        figures.verdict.lines(&well(figures), width),
    ])
}

/// Those that say something, with an empty line between them.
pub(crate) fn sections(sections: &[Vec<String>]) -> String {
    let mut screen = String::new();
    for lines in sections.iter().filter(|lines| !lines.is_empty()) {
        if !screen.is_empty() {
            screen.push('\n');
        }
        for line in lines {
            screen.push_str(line.trim_end());
            screen.push('\n');
        }
    }
    screen
}

fn headline(figures: &Figures, width: usize) -> Vec<String> {
    let items = [
        format!("{} stations", grouped(figures.stations)),
        format!("cycle {}", duration(figures.cycle_ns)),
        format!("{} cycles", grouped(figures.cycles)),
        about(figures.cycles.saturating_mul(figures.cycle_ns)),
        format!("real-time threads {:.1} % cpu", figures.rt_cpu_percent),
    ];
    list("", &items, width)
}

fn stations(stations: &[StationFigures], width: usize) -> Vec<String> {
    if stations.is_empty() {
        return Vec::new();
    }
    let right = |head, cell: fn(&StationFigures) -> String| Column::right(head, stations.iter().map(cell));
    let columns = [
        Column::left(["", "station"], stations.iter().map(|s| cut(&s.name, NAME_MAX))),
        Column::left(["", "role"], stations.iter().map(|s| s.role.to_string())),
        right(["clock", "offset"], |s| signed_time(s.clock_offset_ns)),
        right(["drift", "ppm"], |s| format!("{:+.1}", s.clock_drift_ppb as f64 / 1e3)),
        right(["frames", "seen/expected"], |s| {
            format!("{}/{}", grouped(s.frames_seen), grouped(s.frames_expected))
        }),
        right(["", "miss"], |s| grouped(s.slots_missed)),
        right(["", "p50"], |s| micros_or_dash(s.slot_error_ns.p50)),
        right(["slot", "p99"], |s| micros_or_dash(s.slot_error_ns.p99)),
        right(["error", "p99.9"], |s| micros_or_dash(s.slot_error_ns.p999)),
        right(["in us", "max"], |s| micros_or_dash(s.slot_error_ns.max)),
        right(["sync", "p99"], |s| micros_or_dash(s.sync_error_ns.p99)),
        right(["cpu", "%"], |s| format!("{:.1}", s.cpu_percent)),
    ];
    table(&columns, width)
}

/// A bar for each of the bins 0.1, 0.2, 0.5, 1, 2, 5 us, ... from the first to the last that holds any.
fn bars(histogram: &SignedHistogram, width: usize) -> Vec<String> {
    if histogram.is_empty() {
        return Vec::new();
    }
    let edges: Vec<u64> =
        (2..11).flat_map(|decade| [1, 2, 5].map(|first| first * 10u64.pow(decade))).collect();
    let mut counts = vec![0; edges.len() + 1];
    for (value, count) in histogram.iter() {
        counts[edges.partition_point(|&edge| edge <= value.unsigned_abs())] += count;
    }
    let first = counts.iter().position(|&count| count > 0).unwrap_or(0);
    let last = counts.iter().rposition(|&count| count > 0).unwrap_or(0);
    let highest = counts.iter().copied().max().unwrap_or(0);
    let digits = grouped(highest).len().max("frames".len());
    // The rest of a line: the label, two spaces, one space, the count, two spaces, the share.
    let bar_width = width - (BIN_WIDTH + 2 + 1 + digits + 2 + 10);

    let head = ["|slot error - median|", "frames", "up to here"];
    let mut lines = vec![format!(
        "{:<left$} {:>digits$}  {:>10}",
        format!("{}  (bars in log scale)", head[0]),
        head[1],
        head[2],
        left = BIN_WIDTH + 2 + bar_width,
    )];
    let mut so_far = 0;
    for i in first..=last {
        let label = match i.checked_sub(1).map(|lower| edges[lower]) {
            None => format!("< {}", duration(edges[0])),
            Some(from) if i == edges.len() => format!(">= {}", duration(from)),
            Some(from) => format!("{} .. {}", duration(from), duration(edges[i])),
        };
        so_far += counts[i];
        // Rounded down: 100 % is all of them.
        let share = (so_far as f64 / histogram.len() as f64 * 1e6).floor() / 1e4;
        let bar = "#".repeat(bar_length(counts[i], highest, bar_width));
        let count = grouped(counts[i]);
        lines.push(format!("{label:>BIN_WIDTH$}  {bar:<bar_width$} {count:>digits$}  {share:>8.4} %"));
    }
    lines
}

fn bar_length(count: u64, highest: u64, width: usize) -> usize {
    let share = (count as f64).ln_1p() / (highest as f64).ln_1p();
    (share * width as f64).round() as usize
}

fn jitter(figures: &Figures, width: usize) -> Vec<String> {
    let rows = [
        ("slot error", "actual - scheduled transmit; gaps: slots missed", &figures.slot_error_ns),
        (
            "slot error, abs",
            "|slot error - the station's median|; a missed slot is in n, as long as a whole slot",
            &figures.slot_error_abs_ns,
        ),
        (
            "sync period jitter",
            "(t(n) - t(n-1)) - T; gaps: times from one sync to the next with syncs missing between, or not stamped",
            &figures.sync_period_jitter_ns,
        ),
        (
            "sync error",
            "estimated - true global time whenever a station sends; gaps: slots missed",
            &figures.sync_error_ns,
        ),
    ];
    let right = |head, cell: fn(&Summary) -> String| {
        Column::right(["", head], rows.iter().map(|(_, _, summary)| cell(summary)))
    };
    let columns = [
        Column::left(["", "jitter in us"], rows.iter().map(|(name, _, _)| (*name).to_owned())),
        right("n", |s| grouped(s.n)),
        right("gaps", gaps),
        right("longest", |s| micros_or_dash(s.longest_gap_ns)),
        right("min", |s| micros_or_dash(s.min)),
        right("p50", |s| micros_or_dash(s.p50)),
        right("p99", |s| micros_or_dash(s.p99)),
        right("p99.9", |s| micros_or_dash(s.p999)),
        right("p99.99", |s| micros_or_dash(s.p9999)),
        right("max", |s| micros_or_dash(s.max)),
        right("SD", |s| micros_or_dash(s.sd)),
    ];
    let definitions = rows
        .iter()
        .flat_map(|(name, definition, _)| paragraph(&format!("  {name:<18} = "), definition, width));
    table(&columns, width).into_iter().chain(definitions).collect()
}

/// What has no value since it was missed.
pub(crate) fn gaps(of: &Summary) -> String {
    of.gaps.map_or_else(|| "-".to_owned(), grouped)
}

/// How long what programs queued has waited, by priority.
fn queueing(queueing: &[QueueingFigures], width: usize) -> Vec<String> {
    if queueing.is_empty() {
        return Vec::new();
    }
    let right =
        |head, cell: fn(&QueueingFigures) -> String| Column::right(["", head], queueing.iter().map(cell));
    let columns = [
        Column::left(["", "queueing in us"], queueing.iter().map(|of| format!("priority {}", of.priority))),
        right("n", |of| grouped(of.frames_seen)),
        right("p50", |of| micros_or_dash(of.delay_ns.p50)),
        right("p99", |of| micros_or_dash(of.delay_ns.p99)),
        right("max", |of| micros_or_dash(of.delay_ns.max)),
        right("refused", |of| grouped(of.refused)),
        right("lost", |of| grouped(of.lost)),
    ];
    let what =
        "frame on the wire - queued by its program; those that were refused or lost are in their own columns";
    let definition = paragraph("  queueing           = ", what, width);
    table(&columns, width).into_iter().chain(definition).collect()
}

/// What was missed, by kind.
pub(crate) fn miss_counts(figures: &Figures) -> impl Iterator<Item = (u64, &'static str)> {
    let causes = [
        (figures.slots_missed, "slots missed"),
        (figures.overruns, "overruns"),
        (figures.stalled_in_send, "stalled in send"),
        (figures.guard_drops, "guard drops"),
        (figures.overlaps, "overlaps"),
        (figures.out_of_slot, "out of slot"),
        (figures.unexplained, "unexplained"),
        (figures.payload_errors, "payload errors"),
        (figures.syncs_skipped, "syncs skipped"),
        (figures.clock_steps, "clock steps"),
        (figures.capture_dropped, "lost by the capture"),
        (figures.frames_lost, "lost on the way"),
    ];
    let on_purpose = Some((figures.lost_on_purpose, "of them on purpose")).filter(|(n, _)| *n > 0);
    causes.into_iter().chain(on_purpose)
}

fn misses(figures: &Figures, width: usize) -> Vec<String> {
    let counts: Vec<_> =
        miss_counts(figures).map(|(count, cause)| format!("{cause} {}", grouped(count))).collect();
    let mut lines = list("misses: ", &counts, width);
    let causes = [("causes: ", &figures.causes), ("syncs missing: ", &figures.sync_causes)];
    for (head, causes) in causes.into_iter().filter(|(_, causes)| !causes.is_empty()) {
        let causes = causes.iter().map(|(name, n)| format!("{} {}", words(name), grouped(*n)));
        lines.extend(list(head, &causes.collect::<Vec<_>>(), width));
    }
    lines.extend(figures.latest_frame_ns.map(|late| format!("latest: {}", latest(late))));
    if figures.misses.is_empty() {
        return lines;
    }

    let shown = &figures.misses[..figures.misses.len().min(MISSES_SHOWN)];
    let left = |head, cell: fn(&Miss) -> String| Column::left(["", head], shown.iter().map(cell));
    let right = |head, cell: fn(&Miss) -> String| Column::right(["", head], shown.iter().map(cell));
    let columns = [
        left("  the worst", |miss| format!("  {}", miss.kind)),
        left("station", |miss| cut(&miss.station, NAME_MAX)),
        right("cycle", |miss| grouped(miss.cycle)),
        right("by us", |miss| micros(miss.span_ns)),
        left("cause", |miss| miss.found.clone().unwrap_or_else(|| words(&miss.cause))),
    ];
    lines.extend(table(&columns, width));
    lines
}

/// When the frame that left the air latest did so.
pub(crate) fn latest(late_ns: i64) -> String {
    let by = duration(late_ns.unsigned_abs());
    match late_ns {
        ..=0 => format!("every frame had left the air {by} before its slot's end, or earlier"),
        _ => format!("a frame left the air only {by} after its slot's end"),
    }
}

fn words(name: &str) -> String {
    name.replace('_', " ")
}

/// What the stations refused, and each note once, with the stations that have it.
pub(crate) fn notes(figures: &Figures, width: usize) -> Vec<String> {
    let mut refusals: BTreeMap<&str, u64> = BTreeMap::new();
    let mut notes: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for station in &figures.per_station {
        for (refusal, count) in &station.refusals {
            *refusals.entry(refusal).or_default() += count;
        }
        for note in &station.notes {
            notes.entry(note).or_default().push(&station.name);
        }
    }
    let refusals: Vec<_> = refusals
        .into_iter()
        .filter(|&(_, count)| count > 0)
        .map(|(refusal, count)| format!("{} {refusal}", grouped(count)))
        .collect();
    let stray = strays(figures.per_station.iter().map(|of| (&of.name, of.stray)), &figures.strangers);
    let mut lines = if refusals.is_empty() { Vec::new() } else { list("refused: ", &refusals, width) };
    let implausible = implausible_syncs(&figures.implausible_syncs);
    if !implausible.is_empty() {
        lines.extend(list("implausible syncs: ", &implausible, width));
    }
    let masters = masters(figures);
    if !masters.is_empty() {
        lines.extend(list("masters: ", &masters, width));
    }
    if !stray.is_empty() {
        lines.extend(list("frames outside their slots, by sender: ", &stray, width));
    }
    for (note, names) in notes {
        let who = if names.len() == figures.per_station.len() && names.len() > 1 {
            "all stations".to_owned()
        } else {
            names.join(", ")
        };
        lines.extend(paragraph("note: ", &format!("{note} ({who})"), width));
    }
    lines
}

/// Who gave the time, if that was not one all the while.
fn masters(figures: &Figures) -> Vec<String> {
    let mut items = Vec::new();
    if figures.takeovers > 0 {
        let (n, cycles) = (grouped(figures.takeovers), figures.takeover_cycles);
        items.push(format!("{n} times another one, {cycles} cycles after the last sync at the most"));
    }
    items.extend(rivals(&figures.rivals));
    if figures.takeovers > 0 && figures.syncs_missing > 0 {
        items.push(format!("{} cycles without a sync", grouped(figures.syncs_missing)));
    }
    items
}

/// Who gave the time at once: the last times.
pub(crate) fn rivals(all: &[Rivals]) -> Vec<String> {
    let told = |Rivals { cycle, cycles, between: [a, b], silent }: &Rivals| {
        let end = silent
            .as_ref()
            .map_or("neither silent yet".to_owned(), |name| format!("until {name} was silent"));
        let (cycles, from) = (grouped((*cycles).into()), grouped((*cycle).into()));
        let unit = if cycles == "1" { "cycle" } else { "cycles" };
        format!("{a} and {b} at once for {cycles} {unit} from {from} on, {end}")
    };
    let shown = &all[all.len().saturating_sub(RIVALS_SHOWN)..];
    let more = all.len() - shown.len();
    let more = (more > 0).then(|| format!("two at once {} times before", grouped(more as u64)));
    more.into_iter().chain(shown.iter().map(told)).collect()
}

/// Synchronisations that are not what they say, by reason, where there are some.
pub(crate) fn implausible_syncs(reasons: &BTreeMap<String, u64>) -> Vec<String> {
    reasons.iter().map(|(reason, n)| format!("{} {}", words(reason), grouped(*n))).collect()
}

/// Frames outside their slots, by sender, where there are some; of a stranger its address.
pub(crate) fn strays<'a>(
    stations: impl Iterator<Item = (&'a String, u64)>,
    strangers: &'a BTreeMap<String, u64>,
) -> Vec<String> {
    let strangers = strangers.iter().map(|(of, &frames)| (format!("{of} (no station)"), frames));
    let all = stations.map(|(name, frames)| (name.clone(), frames)).chain(strangers);
    all.filter(|&(_, frames)| frames > 0)
        .map(|(name, frames)| format!("{name} {}", grouped(frames)))
        .collect()
}

/// What a run took place on, in one list, and what else there is to say of it.
pub(crate) fn host_lines(host: &HostFacts, more: Option<String>, width: usize) -> Vec<String> {
    list("host: ", &host_items(host, more), width)
}

/// The same, one by one.
pub(crate) fn host_items(host: &HostFacts, more: Option<String>) -> Vec<String> {
    if host.is_virtual_time() {
        return [host.kernel.clone()]
            .into_iter()
            .chain(more)
            .chain([format!("rtnet {}", host.rtnet)])
            .collect();
    }
    let mut items = vec![
        format!("Linux {}", host.kernel),
        host.preemption.clone(),
        format!("clock source {}", host.clock_source),
        format!("{} x {}", host.cpus, host.cpu_model),
    ];
    items.extend(host.virtual_machine.map(|yes| if yes { "virtual machine" } else { "no vm" }.to_owned()));
    items.extend(host.idle_driver.as_ref().map(|driver| format!("idle driver {driver}")));
    items.extend(host.rt_runtime_us.map(|us| match u64::try_from(us) {
        Ok(us) => format!("rt throttling at {} in 1s", duration(us.saturating_mul(1_000))),
        Err(_) => "no rt throttling".to_owned(),
    }));
    items.extend(host.steal_ticks.map(|ticks| format!("steal {} ticks", grouped(ticks))));
    items.extend(beside(host));
    items.extend(more);
    items.push(format!("rtnet {}", host.rtnet));
    items
}

/// What others took of the core of the real-time threads.
fn beside(host: &HostFacts) -> Vec<String> {
    let Some(core) = host.core else { return Vec::new() };
    let stolen = host.core_steal_ppm.map(|ppm| format!("{} of cpu {core} stolen", percent(ppm)));
    let others: Vec<String> =
        host.other_real_time.iter().take(OTHERS_SHOWN).map(ToString::to_string).collect();
    let others = match others.len() {
        0 => format!("no other real-time thread ran on cpu {core}"),
        _ => format!("other real-time threads on cpu {core}: {}", others.join(" + ")),
    };
    stolen.into_iter().chain([others]).collect()
}

/// What enforced the slots, and where.
pub(crate) fn guard_words(stations: &[StationFigures]) -> String {
    let kernel = stations.iter().filter(|station| station.guard == GuardName::Kernel).count();
    match kernel {
        0 => "no kernel guard".to_owned(),
        all if all == stations.len() => "kernel guard".to_owned(),
        some => format!("kernel guard in {some} of {} stations", stations.len()),
    }
}

/// What a run that is well has shown.
pub(crate) fn well(figures: &Figures) -> String {
    let counts = format!("{} of {}", grouped(figures.frames_seen), grouped(figures.frames_expected));
    match (figures.slots_missed, figures.out_of_slot + figures.overlaps) {
        // Only a scenario expects that.
        _ if figures.unexplained > 0 => {
            format!("as expected, {counts} frames seen; {} unexplained", grouped(figures.unexplained))
        }
        (0, 0) => format!("every frame in its slot, {counts} seen"),
        (missed, 0) => format!("every frame seen in its slot, {counts}; {} missed", grouped(missed)),
        (missed, stray) => format!(
            "as expected, {counts} frames seen; {} missed, {} out of slot or overlapping",
            grouped(missed),
            grouped(stray)
        ),
    }
}
