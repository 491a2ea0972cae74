//! Captured cycles: the slots of the file as outlines, the frames where they were on the air, what is wrong in red and in words.

mod rows;
mod words;

use std::fmt::Write;

use rtnet::time::Span;

use super::Sheet;
use super::markup::{count, escape, section, us};
use super::scale::Linear;
use crate::judge::closely::Shown;
use crate::judge::closely::captures::{Captured, Fault, FaultKind, OnAir};
use crate::judge::findings::{Author, FindingKind};

use rows::{Row, Rows};
use words::Words;

/// Height of a row, in pixels.
const ROW: usize = 18;
const X_STEPS: usize = 10;
/// About as wide is a letter of the words in a picture that is a thousand pixels wide, in per cent of it.
const LETTER: f64 = 0.68;
/// What is wrong with a cycle that is told above it; the picture shows all.
const TOLD_MAX: usize = 4;

/// The worst cycles, worst first, and one in which nothing was wrong.
pub fn html(sheet: &Sheet<'_>) -> String {
    let cycles = &sheet.kept.cycles;
    let (worst, ordinary) = (&cycles.worst, cycles.ordinary.iter());
    let figures: String = worst
        .iter()
        .map(|shown| (shown, None))
        .chain(ordinary.map(|shown| (shown, Some("for comparison, nothing wrong"))))
        .map(|(shown, words)| Picture::new(sheet, shown).html(words))
        .collect();
    let n = match (worst.len() as u64, cycles.faulty) {
        (0, _) => "In no cycle was a frame late, outside its slot, overlapping or missing.".into(),
        (shown, all) if shown < all => format!(
            "In {} cycles something was wrong; here are {}, the worst of every kind, worst first.",
            count(all),
            count(shown)
        ),
        (_, 1) => "In one cycle something was wrong.".into(),
        (_, all) => format!("In {} cycles something was wrong, worst first.", count(all)),
    };
    let keys = "<ul class=\"keys\">\
        <li><i class=\"key slot\"></i>slot of the file, for the longest frame, with its id</li>\
        <li><i class=\"key guard\"></i>guard band, or sync window</li>\
        <li><i class=\"key frame\"></i>frame on the air</li>\
        <li><i class=\"key late\"></i>late, outside, overlapping, or missing</li></ul>\n";
    section("cycles", "Captured cycles", &n, &format!("{keys}{figures}"))
}

/// One cycle.
struct Picture<'a> {
    sheet: &'a Sheet<'a>,
    shown: &'a Shown,
    rows: Rows,
    along: Linear,
    /// Which two frames were on the air at once, from when to when.
    clashes: Vec<(usize, usize, Span, Span)>,
}

impl<'a> Picture<'a> {
    fn new(sheet: &'a Sheet<'a>, shown: &'a Shown) -> Self {
        let along = Linear { from: 0, to: sheet.scenario.cycle.nanos() };
        Self { sheet, shown, rows: Rows::of(shown), along, clashes: clashes(&shown.captured) }
    }

    fn html(&self, words: Option<&str>) -> String {
        let captured = &self.shown.captured;
        let height = self.rows.all.len() * ROW;
        let told = words.map_or_else(|| self.told(), str::to_owned);
        let labels: String =
            self.rows.all.iter().map(|row| format!("<li>{}</li>", self.label(row))).collect();
        let (mut area, mut words) = (String::new(), Vec::new());
        self.axis(&mut area, height);
        self.draw_clashes(&mut area, height);
        self.window(&mut area);
        self.slots(&mut area, &mut words);
        (0..captured.frames.len()).for_each(|place| self.frame(&mut area, place, &mut words));
        words::place(&words, LETTER).for_each(|(words, x, anchor)| words.draw(&mut area, x, anchor));
        let class = if captured.faults.is_empty() { "cycle" } else { "cycle bad" };
        format!(
            "<figure class=\"{class}\">\n<figcaption><b>Cycle {}</b> {told}</figcaption>\n\
             <div class=\"scroll\" tabindex=\"0\"><div class=\"gantt\">\n<ol class=\"rows\">{labels}</ol>\n\
             <svg width=\"100%\" height=\"{}\" role=\"img\" aria-label=\"slots and frames of cycle {}\">\n{area}</svg>\n\
             </div></div>\n</figure>\n",
            count(captured.cycle.into()),
            height + 18,
            captured.cycle,
        )
    }

    /// What was wrong, worst first, in words.
    fn told(&self) -> String {
        let mut told = words::of(&self.shown.captured, |station| escape(self.sheet.name(station)));
        let more = told.len().saturating_sub(TOLD_MAX);
        told.truncate(TOLD_MAX);
        let more = if more > 0 { format!("; and {more} more") } else { String::new() };
        told.join("; ") + &more
    }

    fn label(&self, row: &Row) -> String {
        match row {
            Row::Syncs => "sync".into(),
            Row::Station(station) => escape(self.sheet.name(*station)),
            Row::Stations(n) => format!("{} other stations", count(*n as u64)),
            Row::Others => "of no slot".into(),
        }
    }

    fn percent(&self, at: Span) -> f64 {
        self.along.percent(at.nanos())
    }

    fn axis(&self, area: &mut String, height: usize) {
        for at in self.along.ticks(X_STEPS) {
            let x = self.along.percent(at);
            let anchor = match x {
                ..1.0 => "start",
                97.0.. => "end",
                _ => "middle",
            };
            let _ = write!(
                area,
                "<line class=\"grid\" x1=\"{x:.3}%\" x2=\"{x:.3}%\" y1=\"0\" y2=\"{height}\"/>\
                 <text x=\"{x:.3}%\" y=\"{}\" text-anchor=\"{anchor}\">{}</text>",
                height + 14,
                us_exactly(at)
            );
        }
        let _ = writeln!(area, "<text x=\"0\" dx=\"-8\" y=\"{}\" text-anchor=\"end\">µs</text>", height + 14);
    }

    /// Where two were on the air at once, across all rows.
    fn draw_clashes(&self, area: &mut String, height: usize) {
        for &(_, _, from, until) in &self.clashes {
            let (x, width) = (self.percent(from), self.percent(until - from));
            let _ = writeln!(
                area,
                "<rect class=\"clash\" x=\"{x:.3}%\" width=\"{width:.3}%\" y=\"0\" height=\"{height}\"/>"
            );
        }
    }

    /// The Synchronisation's part of the cycle, and when backups would send it.
    fn window(&self, area: &mut String) {
        let scenario = self.sheet.scenario;
        let _ = writeln!(
            area,
            "<rect class=\"guard\" x=\"0\" width=\"{:.3}%\" y=\"3\" height=\"12\"><title>sync window, {}</title></rect>",
            self.percent(scenario.sync_window),
            scenario.sync_window
        );
        for station in &scenario.stations {
            let Some(after) = station.backup else { continue };
            let x = self.percent(after);
            let _ = writeln!(
                area,
                "<line class=\"backup\" x1=\"{x:.3}%\" x2=\"{x:.3}%\" y1=\"2\" y2=\"16\"><title>sync of the backup {}, if there is none</title></line>",
                escape(&station.name)
            );
        }
    }

    fn slots(&self, area: &mut String, words: &mut Vec<Words>) {
        let scenario = self.sheet.scenario;
        for &(station, slot) in &self.shown.slots {
            let row = self.rows.of_station(station);
            let y = row * ROW;
            let air = scenario.rate.air_time(slot.size + rtnet::wire::ethernet::HEADER_LEN);
            let (x, width) = (self.percent(slot.offset), self.percent(air));
            let author = Author { station, cycle: self.shown.captured.cycle, slot: Some(slot.id) };
            let why = self.missing(author);
            let class = if why.is_some() { "slot missing" } else { "slot" };
            let name = escape(self.sheet.name(station));
            let _ = writeln!(
                area,
                "<rect class=\"guard\" x=\"{:.3}%\" width=\"{:.3}%\" y=\"{}\" height=\"12\"/>\
                 <rect class=\"{class}\" data-slot=\"{name} {}\" x=\"{x:.3}%\" width=\"{width:.3}%\" y=\"{}\" height=\"12\">\
                 <title>{name}, slot {}: at {}, up to {} bytes</title></rect>",
                x + width,
                self.percent(scenario.guard),
                y + 3,
                slot.id,
                y + 3,
                slot.id,
                slot.offset,
                slot.size,
            );
            if matches!(self.rows.all[row], Row::Station(_)) {
                let _ = writeln!(
                    area,
                    "<text class=\"id\" x=\"{x:.3}%\" dx=\"-3\" y=\"{}\" text-anchor=\"end\">{}</text>",
                    y + 13,
                    slot.id
                );
            }
            if let Some(why) = why {
                words.push(Words { row, beside: (x, x + width), what: why });
            }
        }
    }

    /// Why a slot has no frame, if that is so.
    fn missing(&self, author: Author) -> Option<String> {
        let captured = &self.shown.captured;
        let is_there = captured.frames.iter().any(|frame| frame.author == Some(author));
        let its = || captured.faults.iter().filter(|fault| fault.is_of(author));
        let is_missed = its().any(|fault| fault.is_of_nothing());
        (is_missed && !is_there).then(|| format!("no frame{}", words::briefly(its())))
    }

    fn frame(&self, area: &mut String, place: usize, words: &mut Vec<Words>) {
        let captured = &self.shown.captured;
        let frame = &captured.frames[place];
        let is_hit = self.clashes.iter().any(|&(one, other, ..)| [one, other].contains(&place));
        let is_late = frame.author.map_or(is_hit, |author| {
            author.cycle != captured.cycle || captured.faults.iter().any(|fault| fault.is_of(author))
        });
        let row = match frame.author {
            Some(Author { slot: None, .. }) => 0,
            Some(Author { station, .. }) => self.rows.of_station(station),
            None => self.rows.others(),
        };
        let y = row * ROW;
        let name = frame
            .author
            .map_or("of no slot".into(), |author| words::author(author, |of| escape(self.sheet.name(of))));
        let error = frame.error.map_or(String::new(), |error| format!(", {} µs", signed(error)));
        // What is later than the cycle is in another one's picture, too.
        let x = self.percent(frame.at).clamp(0.0, 100.0);
        let width = self.percent(frame.air).min(100.0 - x).max(0.0);
        let class = if is_late { "frame late" } else { "frame" };
        let _ = writeln!(
            area,
            "<rect class=\"{class}\" x=\"{x:.3}%\" width=\"{width:.3}%\" y=\"{}\" height=\"14\"><title>{name}{error}, {} µs on the air</title></rect>",
            y + 2,
            us(Some(frame.air.nanos()))
        );
        if is_late {
            let mut what = self.wrong_with(frame);
            if let Some(author) = frame.author.filter(|author| author.cycle != captured.cycle) {
                let _ = write!(what, ", of cycle {}", count(author.cycle.into()));
            } else if frame.at >= self.sheet.scenario.cycle {
                what += ", in a later cycle";
            }
            words.push(Words { row, beside: (x, x + width), what });
        }
    }

    /// In a word or two.
    fn wrong_with(&self, frame: &OnAir) -> String {
        let is_of = |fault: &&Fault| frame.author.is_some_and(|author| fault.is_of(author));
        let mut its = self.shown.captured.faults.iter().filter(is_of);
        let is = |kind| move |fault: &Fault| fault.kind == FaultKind::Found(kind);
        if its.clone().any(is(FindingKind::Repeated)) {
            return "twice".into();
        }
        // It may be where it ought to be, and another one is not.
        if its.clone().next().is_some() && its.all(is(FindingKind::Overlap)) {
            return "hit".into();
        }
        frame.error.map_or(String::new(), |error| signed(error) + " µs")
    }
}

/// By the frames in the order of time; those in two parts of a cut medium do not meet.
fn clashes(captured: &Captured) -> Vec<(usize, usize, Span, Span)> {
    let frames = &captured.frames;
    let overlaps = |frame: &OnAir| {
        let its = |fault: &&Fault| frame.author.is_some_and(|author| fault.is_of(author));
        captured.faults.iter().filter(its).any(|fault| fault.kind == FaultKind::Found(FindingKind::Overlap))
    };
    let mut clashes = Vec::new();
    for (one, first) in frames.iter().enumerate() {
        let until = first.at + first.air;
        let meet = frames.iter().enumerate().skip(one + 1).take_while(|(_, other)| other.at < until);
        for (other, second) in meet.filter(|(_, second)| overlaps(first) || overlaps(second)) {
            clashes.push((one, other, second.at, until.min(second.at + second.air)));
        }
    }
    clashes
}

/// Lateness with its sign.
fn signed(error: Span) -> String {
    let value = us(Some(error.nanos()));
    if error >= Span::ZERO { format!("+{value}") } else { value }
}

/// Of a tick, all that it has.
fn us_exactly(ns: i64) -> String {
    let us = ns as f64 / 1e3;
    if ns % 1_000 == 0 { count(ns.unsigned_abs() / 1_000) } else { format!("{us}") }
}
