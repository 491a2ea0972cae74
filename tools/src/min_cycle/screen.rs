//! An answer in words.

use super::answer::{AGREE_WITHIN, Answer, Asked, Compared, Purpose, Run};
use super::search::TRIES;
use crate::report::screen::host_lines;
use crate::report::text::{Column, duration, grouped, paragraph, table};

/// All runs, the answer, and the host.
pub fn render(answer: &Answer, width: usize) -> String {
    let mut lines = vec![asked(&answer.asked), String::new()];
    lines.extend(runs(&answer.runs, width));
    let notes = answer.runs.iter().filter_map(|run| {
        let cycle = duration(run.cycle_ns.unsigned_abs());
        run.note.as_ref().map(|note| paragraph(&format!("{cycle}: "), note, width))
    });
    lines.extend(notes.flatten());
    lines.push(String::new());
    lines.extend(host_lines(&answer.host, None, width));
    lines.push(String::new());
    lines.extend(paragraph("", &conclusion(answer), width));
    lines.join("\n") + "\n"
}

/// One run, as soon as it is over.
pub fn run_line(run: &Run) -> String {
    let cycle = duration(run.cycle_ns.unsigned_abs());
    let what = match (run.purpose, run.holds) {
        (_, None) => "is not decided",
        (Purpose::Trial, Some(true)) => "holds",
        (Purpose::Trial, Some(false)) => "does not hold",
        (Purpose::Proof, Some(true)) => "is proven",
        (Purpose::Proof, Some(false)) => "is not proven",
    };
    match run.slots {
        0 => format!("{cycle} {what}: {}", run.note.as_deref().unwrap_or("no slot was measured")),
        _ => format!(
            "{cycle} {what}: {} missed, {} usually",
            percent(run.missed_share),
            percent(run.usual_share)
        ),
    }
}

/// How an answer compares with the one that was kept in a file of that name.
pub fn comparison(answer: &Answer, kept: &Answer, name: &str) -> String {
    let cycle = |of: &Answer| of.cycle_ns.map_or("none".to_owned(), |ns| duration(ns.unsigned_abs()));
    let (verdict, how) = match answer.compared_with(kept) {
        Compared::AsGood => ("AS GOOD", "which is within"),
        Compared::Better => ("BETTER", "which is more than"),
        Compared::Regression => ("REGRESSION", "which is more than"),
    };
    let percent = (AGREE_WITHIN - 1.0) * 100.0;
    let other = if kept.host.cpu_model == answer.host.cpu_model && kept.host.kernel == answer.host.kernel {
        String::new()
    } else {
        format!("; that was on another host, Linux {} on {}", kept.host.kernel, kept.host.cpu_model)
    };
    format!("{verdict}: {} now, {} in {name}, {how} {percent:.0} %{other}", cycle(answer), cycle(kept))
}

fn asked(asked: &Asked) -> String {
    let guard = asked.guard_ns.map_or("the rest of each slot".to_owned(), |ns| duration(ns.unsigned_abs()));
    format!(
        "{} stations, {} bytes each, {} Mbit/s, guard band {guard}, at most {} missed{}",
        asked.stations,
        asked.payload,
        asked.rate as f64 / 1e6,
        percent(f64::from(asked.miss_ppm) / 1e6),
        if asked.warm_core { ", core kept warm" } else { "" }
    )
}

fn runs(runs: &[Run], width: usize) -> Vec<String> {
    let time = |ns: i64| duration(ns.unsigned_abs());
    let measured = |run: &Run, what: String| if run.slots == 0 { "-".to_owned() } else { what };
    let column = |head, of: &dyn Fn(&Run) -> String| Column::right(head, runs.iter().map(of));
    let name = |purpose| if purpose == Purpose::Proof { "proof" } else { "trial" };
    let columns = [
        column(["", "cycle"], &|run| time(run.cycle_ns)),
        column(["", "run"], &|run| name(run.purpose).to_owned()),
        column(["", "for"], &|run| time(run.duration_ns)),
        column(["guard", "band"], &|run| time(run.guard_ns)),
        column(["", "slots"], &|run| measured(run, grouped(run.slots))),
        column(["", "missed"], &|run| measured(run, grouped(run.missed))),
        column(["", "all"], &|run| measured(run, percent(run.missed_share))),
        column(["", "usual"], &|run| measured(run, percent(run.usual_share))),
        column(["unex-", "plained"], &|run| measured(run, grouped(run.unexplained))),
        column(["cpu", "%"], &|run| measured(run, format!("{:.0}", run.rt_cpu_percent))),
        column(["", "holds"], &|run| {
            run.holds.map_or("?", |held| if held { "yes" } else { "no" }).to_owned()
        }),
    ];
    table(&columns, width)
}

fn conclusion(answer: &Answer) -> String {
    if let Some(run) = answer.inconclusive() {
        return format!(
            "INCONCLUSIVE: {TRIES} runs of {} decided nothing, the last since {}. Search again when this host is quiet; `rtnet \
             doctor` shows what delays its threads",
            duration(run.cycle_ns.unsigned_abs()),
            run.note.as_deref().unwrap_or_default()
        );
    }
    let limit = percent(f64::from(answer.asked.miss_ppm) / 1e6);
    let outages = outages(answer);
    let Some(proof) = answer.proof() else {
        let least = answer.runs.iter().min_by(|a, b| a.missed_share.total_cmp(&b.missed_share));
        let least = least.map_or(String::new(), |run| {
            format!(
                "; the least, {}, at {}",
                percent(run.missed_share),
                duration(run.cycle_ns.unsigned_abs())
            )
        });
        return format!(
            "NOT FOUND: no cycle that was tried misses at most {limit} of its slots{least}. `rtnet doctor` tells what holds \
             this host's threads up; --miss allows more, --longest tries longer cycles, and fewer --stations need less{outages}"
        );
    };
    let shorter = match answer.next_shorter() {
        None => "a shorter one has no room for the slots".to_owned(),
        Some(run) => run_line(run),
    };
    format!(
        "FOUND: {} is the shortest cycle that this host holds, proven for {}: {} of {} slots missed, {}; {shorter}{outages}",
        duration(proof.cycle_ns.unsigned_abs()),
        duration(proof.duration_ns.unsigned_abs()),
        grouped(proof.missed),
        grouped(proof.slots),
        percent(proof.missed_share),
    )
}

/// Why another search may well say something else.
fn outages(answer: &Answer) -> String {
    let held = answer.decided_by_outages();
    held.map_or(String::new(), |run| {
        let cycle = duration(run.cycle_ns.unsigned_abs());
        format!(
            ". A trial of {cycle} held: outages of this host, which come and go, decided that, more than how much room a cycle \
             has. With ten times what a cycle of 2ms misses as --miss, it is the other way round"
        )
    })
}

/// To what can be told apart of it.
fn percent(share: f64) -> String {
    let percent = share * 100.0;
    match percent {
        0.0 => "0 %".to_owned(),
        10.0.. => format!("{percent:.0} %"),
        1.0.. => format!("{percent:.1} %"),
        0.1.. => format!("{percent:.2} %").replace("0 %", " %"),
        _ => format!("{percent:.4} %"),
    }
}
