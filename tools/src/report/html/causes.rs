//! What was missed, and why; what was expected; and what else there is to know.

use super::Sheet;
use super::markup::{Table, count, escape, section, us};
use crate::report::screen::{latest, miss_counts, notes};
use crate::sim::screen::{medium, of_expectation};

/// The worst misses that are listed; more are in the JSON report.
const MISSES_MAX: usize = 20;
/// A note is a line, however long.
const WIDTH: usize = 100_000;

/// Everything that was counted as missed, its causes, and the worst one by one.
pub fn html(sheet: &Sheet<'_>) -> String {
    let figures = sheet.figures;
    let mut counts = Table::new("", 1, &["what", "n"]);
    for (n, what) in miss_counts(figures) {
        counts.row_of(if n == 0 { "none" } else { "" }, [what.to_owned(), count(n)]);
    }
    let mut causes = Table::new("", 1, &["cause", "slots missed", "syncs missing"]);
    let (slots, syncs) = (&figures.causes, &figures.sync_causes);
    let names: std::collections::BTreeSet<&String> = slots.keys().chain(syncs.keys()).collect();
    for name in names {
        let n = |of: &std::collections::BTreeMap<String, u64>| count(of.get(name).copied().unwrap_or(0));
        causes.row([escape(&name.replace('_', " ")), n(slots), n(syncs)]);
    }
    let mut worst = Table::new("The worst, one by one", 3, &["kind", "station", "cause", "cycle", "by µs"]);
    for miss in figures.misses.iter().take(MISSES_MAX) {
        let cause = miss.found.clone().unwrap_or_else(|| miss.cause.replace('_', " "));
        worst.row([
            miss.kind.to_string(),
            escape(&miss.station),
            escape(&cause),
            count(miss.cycle),
            us(Some(miss.span_ns)),
        ]);
    }
    let note =
        figures.latest_frame_ns.map_or_else(String::new, |ns| format!("The latest of all: {}.", latest(ns)));
    let body = format!("<div class=\"side\">{}{}</div>\n{}", counts.html(), causes.html(), worst.html());
    section("causes", "What was missed, and why", &escape(&note), &body)
}

/// What the scenario expected, and what only a simulation knows; nothing of a lab that expects nothing.
pub fn expected(sheet: &Sheet<'_>) -> String {
    let Some(simulation) = sheet.simulation else { return String::new() };
    let mut table = Table::new("", 3, &["expected", "found", "verdict"]).of_prose();
    for checked in &simulation.expectations {
        let (what, found, verdict) = of_expectation(checked);
        table
            .row_of(if checked.holds { "" } else { "bad" }, [what, found, verdict].map(|text| escape(&text)));
    }
    let medium = medium(simulation).join(", ");
    let note = if medium.is_empty() { String::new() } else { format!("Medium: {}.", escape(&medium)) };
    if note.is_empty() && simulation.expectations.is_empty() {
        return String::new();
    }
    let head = if simulation.expectations.is_empty() { "Medium" } else { "As expected?" };
    section("expected", head, &note, &table.html())
}

/// What stations refused and told, each once.
pub fn told(sheet: &Sheet<'_>) -> String {
    let notes = notes(sheet.figures, WIDTH);
    if notes.is_empty() {
        return String::new();
    }
    let items: String = notes.iter().map(|line| format!("<li>{}</li>", escape(line))).collect();
    section("notes", "Notes", "", &format!("<ul class=\"notes\">{items}</ul>\n"))
}
