//! The findings as a person reads them, in a terminal; the verdict is the last line.

use super::rights::Right;
use super::verdict::{CYCLES, STATIONS};
use super::words::{accepted, cell, rounded};
use super::{Findings, Lateness};
use crate::report::histogram::Summary;
use crate::report::screen::host_lines;
use crate::report::text::{Column, duration, list, micros_or_dash, paragraph, table};

/// A row of times: what, its summary, and the shares beyond the limits where those matter.
type Row<'a> = (String, &'a Summary, Option<&'a Lateness>);

/// The findings in plain text, no line longer than `width` columns where it can be broken.
pub fn render(findings: &Findings, width: usize) -> String {
    let width = width.max(crate::report::screen::WIDTH_MIN);
    let sections = [
        headline(findings),
        times(findings, width),
        outages(findings, width),
        rights(findings, width),
        host_lines(&findings.host, None, width),
        bullets("not measured: ", &findings.not_measured, width),
        candidates(findings, width),
        bullets("to improve: ", &findings.advice, width),
        verdict(findings, width),
    ];
    let sections = sections.iter().filter(|lines| !lines.is_empty()).map(|lines| {
        let lines: Vec<_> = lines.iter().map(|line| line.trim_end()).collect();
        lines.join("\n") + "\n"
    });
    sections.collect::<Vec<_>>().join("\n")
}

fn headline(findings: &Findings) -> Vec<String> {
    let others = match &findings.other_cpus[..] {
        [] => "no other core for observers".to_owned(),
        others => {
            format!("others: {}", others.iter().map(ToString::to_string).collect::<Vec<_>>().join(", "))
        }
    };
    let scheduling = findings.scheduling;
    vec![format!("cpu {} ({others}), {scheduling}, {}", findings.cpu, duration(findings.duration_ns as u64))]
}

fn times(findings: &Findings, width: usize) -> Vec<String> {
    let wakeups = findings.wakeups.iter().map(|of| {
        let state = if of.warm_core { "warm" } else { "cold" };
        (format!("wake-up late, core {state}"), &of.lateness_ns, Some(of))
    });
    let hops = findings.hops.iter().map(|hop| {
        let place = if hop.to_cpu == findings.cpu { "the same" } else { "another" };
        (format!("thread woken on {place} core"), &hop.took_ns, None)
    });
    let wire = findings.wire.iter().flat_map(|wire| {
        [
            ("send of 60 bytes".to_owned(), &wire.send_ns, None),
            ("broadcast to 8 stations".to_owned(), &wire.broadcast_ns, None),
            ("kernel stamp - before send".to_owned(), &wire.stamp_ns, None),
        ]
    });
    let rows: Vec<Row<'_>> = wakeups.chain(hops).chain(wire).collect();
    let right = |head: [&'static str; 2], cell: &dyn Fn(&Summary) -> Option<i64>| {
        Column::right(head, rows.iter().map(|(_, summary, _)| micros_or_dash(cell(summary))))
    };
    let share = |head: &'static str, place: usize| {
        let cell =
            |row: &Row<'_>| row.2.map_or(String::new(), |of| format!("{:.3}", 100.0 * of.later[place].share));
        Column::right(["% later", head], rows.iter().map(cell))
    };
    let columns = [
        Column::left(["", "us"], rows.iter().map(|row| row.0.clone())),
        Column::right(["", "n"], rows.iter().map(|row| row.1.n.to_string())),
        right(["", "p50"], &|s| s.p50),
        right(["", "p99"], &|s| s.p99),
        right(["", "p99.9"], &|s| s.p999),
        right(["", "max"], &|s| s.max),
        share("50", 0),
        share("100", 1),
        share("200", 2),
        share("500", 3),
    ];
    table(&columns, width)
}

fn outages(findings: &Findings, width: usize) -> Vec<String> {
    let rates = findings.outages.per_second.iter();
    let mut items: Vec<_> = rates
        .map(|rate| format!("{:.1} of {} and more", rate.per_second, rounded(rate.at_least_ns)))
        .collect();
    items.push(format!("the longest {}", rounded(findings.outages.longest_ns)));
    let mut lines = list("outages of the core in a second: ", &items, width);
    let mut costs = vec![format!("one reading {:.0}ns", findings.clock_gettime_ns)];
    costs.extend(findings.timer_slack_ns.map(|slack| format!("timer slack {}", rounded(slack))));
    costs.extend(findings.wire.map(|wire| format!("a slot takes {} of the core", rounded(wire.turn_ns))));
    lines.extend(list("clock: ", &costs, width));
    lines
}

fn rights(findings: &Findings, width: usize) -> Vec<String> {
    let item = |right: &Right| {
        let answer = match right.allowed {
            Some(true) => "yes",
            Some(false) => "NO",
            None => "?",
        };
        format!("{} {answer}", right.name)
    };
    let mut lines = list("allowed: ", &findings.rights.process.iter().map(item).collect::<Vec<_>>(), width);
    lines.extend(list("kernel: ", &findings.rights.kernel.iter().map(item).collect::<Vec<_>>(), width));
    let all = findings.rights.process.iter().chain(&findings.rights.kernel);
    // What could not be told is among what was not measured.
    let told = all.filter(|right| right.allowed.is_some());
    let why = told.filter_map(|right| Some(format!("{}: {}", right.name, right.note.as_deref()?)));
    lines.extend(why.flat_map(|line| paragraph("- ", &line, width)));
    lines
}

/// The shares missed, a table for each state of the core.
fn candidates(findings: &Findings, width: usize) -> Vec<String> {
    let mut lines = vec![format!(
        "slots missed in %, predicted (* at most {}); in brackets: the core it would take, too much",
        accepted()
    )];
    for of in findings.wakeups.iter().rev() {
        lines.push(String::new());
        let cells = |stations: usize| {
            CYCLES.iter().map(move |cycle| {
                let found = findings.candidates.iter().find(|c| {
                    (c.warm_core, c.network.stations, c.network.cycle_ns)
                        == (of.warm_core, stations, cycle.nanos())
                });
                found.map_or("-".to_owned(), |c| cell(&c.network, c.holds))
            })
        };
        let state = if of.warm_core { "core warm" } else { "core cold" };
        let mut columns = vec![Column::left([state, "cycle"], CYCLES.iter().map(|cycle| cycle.to_string()))];
        columns.extend(STATIONS.iter().map(|&n| Column::right(["stations", head(n)], cells(n))));
        lines.extend(table(&columns, width));
    }
    lines
}

/// The head of a column for so many stations.
fn head(stations: usize) -> &'static str {
    ["2", "4", "8", "16", "32"][STATIONS.iter().position(|&n| n == stations).unwrap_or(0)]
}

fn bullets(label: &str, lines: &[String], width: usize) -> Vec<String> {
    lines.iter().flat_map(|line| paragraph(label, line, width)).collect()
}

/// Its last line is one line, however long: a script looks for it.
fn verdict(findings: &Findings, width: usize) -> Vec<String> {
    let Some((last, others)) = findings.verdict.split_last() else { return Vec::new() };
    let mut lines = bullets("- ", others, width);
    lines.push(last.clone());
    lines
}
