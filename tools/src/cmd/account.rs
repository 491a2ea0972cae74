//! A lab's account in words, and whether it is a good one.

use anyhow::anyhow;
use rtnet::time::Span;

use super::tdma::longest;
use crate::control::{LabStatus, MemberStatus};
use crate::report::figures::GuardName;
use crate::report::screen::{implausible_syncs, latest, rivals, strays};
use crate::report::text::{Column, grouped, micros, paragraph, table};

/// Columns of the table.
const WIDTH: usize = 110;

/// What could not be written at the end of a lab.
pub fn unwritten(status: &LabStatus) -> impl Iterator<Item = anyhow::Error> {
    status.unwritten.iter().map(|what| anyhow!("lab '{}': {what}", status.name))
}

/// A lab in words.
pub fn account(status: &LabStatus) -> String {
    let stations = &status.stations;
    let mut text = format!(
        "lab '{}': {} stations, cycle {}, {} cycles in {}s, process {}\n\n",
        status.name,
        stations.len(),
        Span::from_nanos(status.cycle_ns as i64),
        grouped(status.cycles),
        status.up_seconds,
        status.pid
    );
    let left = |head, cell: fn(&MemberStatus) -> String| Column::left(["", head], stations.iter().map(cell));
    let right =
        |head, cell: fn(&MemberStatus) -> String| Column::right(["", head], stations.iter().map(cell));
    let mut columns = vec![
        left("station", |s| s.name.clone()),
        left("role", |s| s.role.clone()),
        left("state", |s| s.state.clone()),
        left("address", |s| s.address.clone()),
        right("process", |s| s.pid.to_string()),
        right("frames", |s| grouped(s.frames_seen)),
        right("missed", |s| grouped(s.slots_missed)),
        right("p99 us", |s| s.slot_error_ns.p99.map_or("-".into(), micros)),
        right("max us", |s| s.slot_error_ns.max.map_or("-".into(), micros)),
        right("bad", |s| grouped(s.payload_errors)),
        right("lost", |s| grouped(s.frames_lost)),
    ];
    if stations.iter().any(|station| station.ip.is_some()) {
        columns.insert(4, left("ip", |s| s.ip.clone().unwrap_or("-".into())));
    }
    text += &(table(&columns, WIDTH).join("\n") + "\n");
    let refused = |s: &MemberStatus| {
        let counts: Vec<String> = s.refusals.iter().map(|(reason, n)| format!("{reason} {n}")).collect();
        (!counts.is_empty()).then(|| format!("refused by {}: {}\n", s.name, counts.join(", ")))
    };
    let refused: String = stations.iter().filter_map(refused).collect();
    text += &format!("{}{refused}", if refused.is_empty() { "" } else { "\n" });
    let failed = |s: &MemberStatus| s.failed.as_ref().map(|why| format!("\nstation {}: {why}\n", s.name));
    text.extend(stations.iter().filter_map(failed));
    let stray = strays(stations.iter().map(|s| (&s.name, s.stray)), &status.strangers);
    if !stray.is_empty() {
        text += &format!("\nframes outside their slots, by sender: {}\n", stray.join(", "));
    }
    for note in &status.notes {
        text += &format!("\n{}\n", paragraph("note: ", note, WIDTH).join("\n"));
    }
    text += &format!("\nslots are kept by {}; {} cpu {}\n", guard(stations), load(status), status.cpu);
    if stations.iter().any(|station| station.role == "backup") {
        let taken_over: u64 = stations.iter().filter_map(|station| station.events.get("took_over")).sum();
        text += &format!(
            "{} gives the time; backups have taken over {} times; {} cycles had no sync\n",
            status.time_by,
            grouped(taken_over),
            grouped(status.syncs_missing)
        );
    }
    if status.schedule_changes > 0 {
        text += &format!("the schedule has changed {} times\n", grouped(status.schedule_changes));
    }
    let implausible = implausible_syncs(&status.implausible_syncs);
    if !implausible.is_empty() {
        text += &format!("implausible syncs: {}\n", implausible.join(", "));
    }
    for line in rivals(&status.rivals) {
        text += &format!("gave the time: {line}\n");
    }
    if let Some(late) = status.latest_frame_ns {
        text += &format!("{}\n", latest(late));
    }
    if !status.causes.is_empty() {
        let counts =
            status.causes.iter().map(|(cause, n)| format!("{} {}", cause.replace('_', " "), grouped(*n)));
        text += &format!("\nmissed or late, by cause: {}\n", counts.collect::<Vec<_>>().join(", "));
        if !status.worst.is_empty() {
            let (names, worst): (Vec<_>, Vec<_>) = status.worst.iter().cloned().unzip();
            text += &format!("\n{}\n", longest(&worst, Some(names)));
        }
    }
    status.unexplained_last.iter().for_each(|line| text += &format!("unexplained: {line}\n"));
    if status.not_judged > 0 {
        text +=
            &format!("not judged: {} frames, lost by the observer or wrongly stamped\n", status.not_judged);
    }
    let counts = format!(
        "{} of {} frames in their slots, {} missed, {} overlaps, {} out of slot, unexplained {}",
        grouped(status.frames_seen),
        grouped(status.frames_expected),
        grouped(status.slots_missed),
        status.overlaps,
        status.out_of_slot,
        status.unexplained
    );
    let verdict = status.verdict.lines(&counts, WIDTH).join("\n");
    text += &if status.verdict.ok { format!("\n{verdict}\n") } else { format!("\n{counts}\n{verdict}\n") };
    text
}

/// What enforces the slots, and what it has dropped for that.
fn guard(stations: &[MemberStatus]) -> String {
    let kernel = stations.iter().filter(|station| station.guard == GuardName::Kernel).count();
    let dropped = |kind| stations.iter().filter_map(|station| station.events.get(kind)).sum::<u64>();
    let dropped = grouped(dropped("guard_dropped") + dropped("sync_dropped"));
    match kernel {
        0 => "each station's own last look at the clock".into(),
        all if all == stations.len() => format!("the kernel guard, which has dropped {dropped} frames"),
        some => {
            format!("the kernel guard in {some} of {} stations: {dropped} frames dropped", stations.len())
        }
    }
}

/// What the real-time threads take.
fn load(status: &LabStatus) -> String {
    format!("real-time threads take about {:.0} % of", status.load * 100.0)
}
