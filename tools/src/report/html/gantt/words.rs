//! What is wrong with a cycle, in words.

use std::cmp::Reverse;
use std::fmt::Write;

use rtnet::discipline::{Cause, EventKind};

use super::{ROW, signed};
use crate::judge::closely::captures::{Captured, Fault, FaultKind};
use crate::judge::findings::{Author, FindingKind};
use crate::report::html::markup::us;

/// Everything that was seen on the medium, worst first, each with what its station told of it; and what only was told.
pub fn of(captured: &Captured, name: impl Fn(usize) -> String) -> Vec<String> {
    let mut faults: Vec<&Fault> = captured.faults.iter().collect();
    faults.sort_by_key(|fault| (Reverse(fault.rank()), Reverse(fault.span.nanos().abs())));
    let is_seen = |fault: &&Fault| matches!(fault.kind, FaultKind::Found(_));
    let told_of = |author: Author| faults.iter().copied().filter(move |fault| fault.is_of(author));
    // What a station says of its frame is said once.
    let mut explained: Vec<Author> = Vec::new();
    let mut all = Vec::new();
    for fault in faults.iter().copied().filter(is_seen) {
        let new: Vec<Author> =
            fault.authors.iter().flatten().filter(|of| !explained.contains(of)).copied().collect();
        let why = new.iter().map(|&author| why(told_of(author))).find(|why| !why.is_empty());
        all.push(found(fault, &name) + &why.unwrap_or_default());
        explained.extend(new);
    }
    for fault in faults.iter().copied().filter(|fault| !is_seen(fault)) {
        if let Some(of) = fault.authors[0].filter(|of| !explained.contains(of)) {
            all.push(author(of, &name) + &why([fault].into_iter()));
        }
    }
    all.dedup();
    all
}

/// Whose frame it is.
pub fn author(of: Author, name: impl Fn(usize) -> String) -> String {
    match of.slot {
        Some(slot) => format!("{}, slot {slot}", name(of.station)),
        None => format!("sync of {}", name(of.station)),
    }
}

/// What its station told of it, and why; nothing, if it told nothing.
pub fn why<'a>(faults: impl Iterator<Item = &'a Fault>) -> String {
    let Some(fault) = first_told(faults) else { return String::new() };
    // Being held up there is its own cause.
    let cause = fault.cause.filter(|cause| *cause != Cause::StalledInSend);
    let cause = cause.map(|cause| format!(" ({})", cause.name().replace('_', " "))).unwrap_or_default();
    format!(": {}{cause}", told(fault))
}

/// The same without the cause.
pub fn briefly<'a>(faults: impl Iterator<Item = &'a Fault>) -> String {
    first_told(faults).map_or_else(String::new, |fault| format!(": {}", told(fault)))
}

fn first_told<'a>(mut faults: impl Iterator<Item = &'a Fault>) -> Option<&'a Fault> {
    faults.find(|fault| matches!(fault.kind, FaultKind::Told(_)))
}

fn told(fault: &Fault) -> String {
    let FaultKind::Told(kind) = fault.kind else { return String::new() };
    let by = us(Some(fault.span.nanos())) + " µs past the latest begin";
    match kind {
        EventKind::Overrun | EventKind::SyncSkipped => format!("skipped, {by}"),
        EventKind::StalledInSend | EventKind::ReplyStalled => format!("held up in send, {by}"),
        EventKind::GuardDropped | EventKind::SyncDropped => format!("dropped by the guard, at most {by}"),
        EventKind::SlotSilent => "silent without a sync".into(),
        other => other.name().replace('_', " "),
    }
}

/// Red words in a picture.
#[derive(Debug)]
pub struct Words {
    /// In which row.
    pub row: usize,
    /// From where to where, in per cent, is what they are of.
    pub beside: (f64, f64),
    /// What they say; HTML.
    pub what: String,
}

impl Words {
    /// In their row.
    pub fn draw(&self, area: &mut String, x: f64, anchor: &str) {
        let (dx, y) = (if anchor == "end" { -14 } else { 5 }, self.row * ROW + 13);
        let what = &self.what;
        let _ = writeln!(
            area,
            "<text class=\"why\" x=\"{x:.3}%\" dx=\"{dx}\" y=\"{y}\" text-anchor=\"{anchor}\">{what}</text>"
        );
    }
}

/// Where words stand: right of what they are of, or left, if there is no room; not where others do already.
pub fn place(all: &[Words], letter: f64) -> impl Iterator<Item = (&Words, f64, &'static str)> {
    let mut taken: Vec<(usize, f64, f64)> =
        all.iter().map(|words| (words.row, words.beside.0, words.beside.1)).collect();
    all.iter().filter_map(move |words| {
        let (from, to) = words.beside;
        let width = words.what.chars().count() as f64 * letter + 1.0;
        let places = [(to, to, to + width, "start"), (from, from - width, from, "end")];
        let (x, begin, end, anchor) = places.into_iter().find(|&(_, begin, end, _)| {
            let is_free = |&(row, a, b): &(usize, f64, f64)| row != words.row || end <= a || b <= begin;
            begin >= 0.0 && end <= 100.0 && taken.iter().all(is_free)
        })?;
        taken.push((words.row, begin, end));
        Some((words, x, anchor))
    })
}

fn found(fault: &Fault, name: &impl Fn(usize) -> String) -> String {
    let of = |author_of: Option<Author>| author_of.map_or("another frame".to_owned(), |of| author(of, name));
    let first = of(fault.authors[0]);
    match fault.kind {
        FaultKind::Found(FindingKind::Overlap) => {
            format!("{first} and {} overlap by {} µs", of(fault.authors[1]), us(Some(fault.span.nanos())))
        }
        FaultKind::Found(FindingKind::OutOfSlot) => format!("{first}, is outside, {} µs", signed(fault.span)),
        FaultKind::Found(FindingKind::SyncGap) => format!("no {first}"),
        FaultKind::Found(FindingKind::SlotMissed) => format!("{first}, has no frame"),
        FaultKind::Found(FindingKind::WithoutSync) => format!("{first}, has a frame without a sync"),
        FaultKind::Found(FindingKind::Repeated) => format!("{first}, comes twice"),
        FaultKind::Told(kind) => format!("{first}: {}", kind.name()),
    }
}

#[cfg(test)]
mod tests {
    use rtnet::time::Span;

    use super::*;

    fn fault(kind: FaultKind, stations: [Option<usize>; 2], ns: i64) -> Fault {
        let author = |station| Author { station, cycle: 7, slot: Some(0) };
        let cause = matches!(kind, FaultKind::Told(_)).then_some(Cause::TimerLate);
        Fault { kind, authors: stations.map(|of| of.map(author)), span: Span::from_nanos(ns), cause }
    }

    #[test]
    fn what_was_seen_is_told_with_what_its_station_says_and_worst_first() {
        let faults = vec![
            fault(FaultKind::Told(EventKind::Overrun), [Some(1), None], 312_000),
            fault(FaultKind::Found(FindingKind::SlotMissed), [Some(1), None], 0),
            fault(FaultKind::Found(FindingKind::Overlap), [Some(0), None], 700),
            fault(FaultKind::Told(EventKind::StalledInSend), [Some(2), None], 5_000),
        ];
        let captured = Captured { cycle: 7, faults, ..Captured::default() };
        assert_eq!(
            of(&captured, |station| format!("s{station}")),
            [
                "s0, slot 0 and another frame overlap by 0.70 µs",
                "s1, slot 0, has no frame: skipped, 312 µs past the latest begin (timer late)",
                "s2, slot 0: held up in send, 5.00 µs past the latest begin (timer late)",
            ]
        );
    }

    #[test]
    fn words_stand_where_there_is_room_and_never_upon_each_other() {
        let words = |row, from: f64, what: &str| Words { row, beside: (from, from + 1.0), what: what.into() };
        let long = "0".repeat(60);
        let all = [
            words(1, 10.0, "01234"),
            words(2, 10.0, "01234"),
            // Right of it something is, and then nothing.
            words(3, 10.0, "01234"),
            words(3, 15.0, "01234"),
            // There is no room for so many.
            words(1, 43.0, &long),
            words(1, 95.0, "0123456789"),
            // Right of it those words are by now.
            words(1, 82.0, "01234"),
        ];
        let placed: Vec<_> = place(&all, 1.0).map(|(words, x, anchor)| (words.row, x, anchor)).collect();
        let expected = [(1, 11.0, "start"), (2, 11.0, "start"), (3, 10.0, "end"), (3, 16.0, "start")];
        assert_eq!(placed[..4], expected);
        assert_eq!(placed[4..], [(1, 95.0, "end"), (1, 82.0, "end")]);
    }
}
