//! What is wrong with a cycle, in words.

use std::cmp::Reverse;
use std::fmt::Write;

use rtnet::discipline::EventKind;

use super::{ROW, signed};
use crate::judge::closely::captures::{Captured, Fault, FaultKind};
use crate::judge::findings::{Author, FindingKind};
use crate::report::html::markup::us;

/// Everything that was seen on the medium, worst first, each with what its station told of it; and what only was told.
pub fn of(captured: &Captured, name: impl Fn(usize) -> String) -> Vec<String> {
    let mut faults: Vec<&Fault> = captured.faults.iter().collect();
    faults.sort_by_key(|fault| (Reverse(fault.rank()), Reverse(fault.span.nanos().abs())));
    let is_seen = |fault: &&&Fault| matches!(fault.kind, FaultKind::Found(_));
    let seen: Vec<&Fault> = faults.iter().filter(is_seen).copied().collect();
    let told_of = |author: Author| faults.iter().copied().filter(move |fault| fault.is_of(author));
    let in_words = |fault: &&Fault| {
        let why =
            fault.authors.iter().flatten().map(|&author| why(told_of(author))).find(|why| !why.is_empty());
        found(fault, &name) + &why.unwrap_or_default()
    };
    let only_told = faults.iter().filter(|fault| {
        !is_seen(fault) && !fault.authors.iter().flatten().any(|&of| seen.iter().any(|seen| seen.is_of(of)))
    });
    let only_told = only_told.filter_map(|fault| {
        let of = fault.authors[0].map(|of| author(of, &name))?;
        Some(of + &why([*fault].into_iter()))
    });
    let mut all: Vec<String> = seen.iter().map(in_words).chain(only_told).collect();
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
    let cause = fault.cause.map(|cause| format!(" ({})", cause.name().replace('_', " "))).unwrap_or_default();
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
    let by = us(Some(fault.span.nanos())) + " µs";
    match kind {
        EventKind::Overrun | EventKind::SyncSkipped => format!("{by} late, skipped"),
        EventKind::StalledInSend | EventKind::ReplyStalled => format!("held up in send for {by}"),
        EventKind::GuardDropped | EventKind::SyncDropped => format!("{by} late, dropped by the guard"),
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
    let mut taken: Vec<(usize, f64, f64)> = Vec::new();
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
    use rtnet::discipline::Cause;
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
                "s1, slot 0, has no frame: 312 µs late, skipped (timer late)",
                "s2, slot 0: held up in send for 5.00 µs (timer late)",
            ]
        );
    }

    #[test]
    fn words_stand_where_there_is_room_and_never_upon_each_other() {
        let words = |row, from: f64, what: &str| Words { row, beside: (from, from + 1.0), what: what.into() };
        let all = [
            words(1, 10.0, "0123456789"),
            words(1, 15.0, "01234"),
            words(1, 16.0, "01234"),
            words(2, 16.0, "01234"),
            words(1, 95.0, "0123456789"),
        ];
        let placed: Vec<_> = place(&all, 1.0).map(|(words, x, anchor)| (words.row, x, anchor)).collect();
        assert_eq!(placed, [(1, 11.0, "start"), (2, 17.0, "start"), (1, 95.0, "end")]);
    }
}
