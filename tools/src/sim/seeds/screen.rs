//! What many runs have shown, as a person reads it.

use super::{OfFile, SeedsReport, WorstFound};
use crate::report::text::{Column, cut, grouped, list, table};

/// So many failed seeds of a file are listed; the JSON report has all.
const LISTED_MAX: usize = 10;
/// Columns of the table beside the file's name.
const BESIDE_NAME: usize = 40;

/// A table of the files; then, of each, the worst value of each expectation and figure; lines of about `width` columns.
pub fn render(report: &SeedsReport, width: usize) -> String {
    let mut lines = files(report, width);
    for of in &report.files {
        lines.push(String::new());
        lines.extend(of_file(of, width));
    }
    lines.join("\n") + "\n"
}

/// One line while runs are still to come.
pub fn progress(runs: u64, all: u64, failed: u64, seconds: u64) -> String {
    let rest = (seconds * (all - runs))
        .checked_div(runs)
        .map_or(String::new(), |left| format!(", about {left}s left"));
    format!("{} of {} runs, {} failed, {seconds}s{rest}", grouped(runs), grouped(all), grouped(failed))
}

fn files(report: &SeedsReport, width: usize) -> Vec<String> {
    let files = || report.files.iter();
    let number = |of: fn(&OfFile) -> u64| files().map(move |file| grouped(of(file)));
    let first = files().map(|of| of.failures.first().map_or(String::new(), |failed| failed.seed.to_string()));
    let name_at_most = width.saturating_sub(BESIDE_NAME);
    let columns = [
        Column::left(["", "file"], files().map(|of| cut(&of.file, name_at_most))),
        Column::right(["", "runs"], number(|of| of.runs)),
        Column::right(["", "met"], number(|of| of.met)),
        Column::right(["", "failed"], number(|of| of.failed)),
        Column::right(["first", "failed"], first),
    ];
    table(&columns, width)
}

fn of_file(of: &OfFile, width: usize) -> Vec<String> {
    let found = || of.expectations.iter().chain(&of.figures);
    let not_met = |found: &WorstFound| match found.not_met {
        Some(n) if n > 0 => grouped(n),
        _ => String::new(),
    };
    let seed = |found: &WorstFound| match found.seed {
        Some(_) if found.in_all && of.runs > 1 => "all".to_owned(),
        Some(seed) => seed.to_string(),
        None => String::new(),
    };
    let columns = [
        Column::left(["", "  expected, and figures"], found().map(what)),
        Column::right(["", "not met"], found().map(not_met)),
        Column::right(["", "worst"], found().map(|found| found.shown.clone())),
        Column::right(["", "seed"], found().map(seed)),
    ];
    let mut lines = vec![format!("{}:", of.file)];
    lines.extend(table(&columns, width));
    if let Some(first) = of.failures.first() {
        let seeds = of.failures.iter().take(LISTED_MAX).map(|failed| failed.seed.to_string());
        let more = of.failures.len().saturating_sub(LISTED_MAX);
        let more = (more > 0).then(|| format!("and {} more", grouped(more as u64)));
        lines.extend(list("  FAILED with seeds ", &seeds.chain(more).collect::<Vec<_>>(), width));
        lines.push(format!("  $ {}", first.command));
        lines.extend(first.reasons.iter().map(|reason| format!("    {reason}")));
    }
    lines
}

fn what(found: &WorstFound) -> String {
    let line = found.line.map_or(String::new(), |line| format!("line {line}: "));
    let of = found.station.as_ref().map_or(String::new(), |name| format!(" of {name}"));
    let at = found.priority.map_or(String::new(), |priority| format!(" at priority {priority}"));
    format!("  {line}{}{of}{at}", found.what)
}
