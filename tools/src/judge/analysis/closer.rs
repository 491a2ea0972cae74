//! What is looked at besides for a report with pictures.

use std::ops::Range;

use rtnet::clock::True;
use rtnet::discipline::{Cause, EventKind};
use rtnet::time::Span;

use super::Analysis;
use crate::judge::closely::captures::{Fault, FaultKind, OnAir};
use crate::judge::closely::regular::Regular;
use crate::judge::closely::{Closely, Cycles};
use crate::judge::findings::{Author, Finding};
use crate::scenario::Scenario;

impl Analysis {
    /// From here on looks closely, for a report with pictures.
    pub fn look_closely(&mut self, scenario: &Scenario) {
        self.closely = Some(Box::new(Closely::of(scenario)));
    }

    /// A station has told of something by which a frame may be late or missing.
    pub fn told(&mut self, author: Author, kind: EventKind, span: Span, cause: Option<Cause>) {
        if !kind.is_miss() || !self.counts(author.cycle) {
            return;
        }
        if let Some(closely) = &mut self.closely {
            let fault = Fault { kind: FaultKind::Told(kind), authors: [Some(author), None], span, cause };
            closely.captures.fault(author.cycle, fault);
        }
    }

    /// Something ought not to be.
    pub(super) fn find_closely(&mut self, finding: &Finding) {
        let &Finding { cycle, kind, authors, span } = finding;
        if let Some(closely) = &mut self.closely
            && self.sight.shows(finding)
        {
            closely.captures.fault(cycle, Fault { kind: FaultKind::Found(kind), authors, span, cause: None });
        }
    }

    /// A frame is on the air: in its own cycle, and in another one if it is there.
    pub(super) fn look_closely_at(&mut self, at: True, air: Span, author: Option<Author>) {
        let is_at = self.cycle_at(at);
        let own = author.map(|author| author.cycle).or(is_at);
        let place = |cycle: u32| Some((cycle, self.error(at, self.start_of(cycle)?)));
        let mut places = [own.and_then(place), None];
        if let [Some((cycle, offset)), other] = &mut places
            && !(-self.cycle / 8..self.cycle).contains(offset)
        {
            *other = is_at.filter(|is_at| is_at != cycle).and_then(place);
        }
        let error = author.zip(places[0]).and_then(|(author, (_, offset))| Some(offset - self.due(author)?));
        for (cycle, offset) in places.into_iter().flatten() {
            if self.counts(cycle)
                && let Some(closely) = &mut self.closely
            {
                closely.captures.frame(cycle, OnAir { author, at: offset, air, error });
            }
        }
    }

    /// When in its cycle a frame is to be.
    fn due(&self, author: Author) -> Option<Span> {
        match author.slot {
            Some(id) => Some(self.timetable.at(author.station, id, author.cycle)?.offset),
            None => Some(self.givers.after(*self.addresses.get(author.station)?)),
        }
    }

    /// A frame of a slot whose last one was before these turns, which were missed.
    pub(super) fn look_how_regular(&mut self, of: (usize, u8), at: True, air: Span, missed: Range<u32>) {
        if let Some(closely) = &mut self.closely {
            let missed = self.timetable.count_of(of.0, of.1, missed.start, missed.end);
            closely.regular.frame(of, at, air, missed);
        }
    }

    /// A frame of a slot is so long.
    pub(super) fn carried(&mut self, author: Author, len: usize, is_tunnelled: bool) {
        if self.counts(author.cycle)
            && let Some(closely) = &mut self.closely
        {
            let payload = len.saturating_sub(rtnet::wire::ethernet::HEADER_LEN) as u64;
            closely.regular.carried(author.station, payload, is_tunnelled);
        }
    }

    /// What was seen by looking closely, if anybody did.
    pub fn take_closely(&mut self) -> Option<(Cycles, Regular)> {
        Some(self.closely.take()?.finish(&self.timetable))
    }
}
