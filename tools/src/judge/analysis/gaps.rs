//! What is missing from the medium: turns of slots without a frame, cycles without a Synchronisation.

use rtnet::clock::True;
use rtnet::time::Span;

use super::{Analysis, FINDINGS_MAX};
use crate::judge::findings::{Author, Finding, FindingKind};
use crate::judge::timetable::{before, turns};

impl Analysis {
    /// Every turn of a station before cycle `end` has been seen, or is missed: nothing more of it will come.
    pub fn look_back(&mut self, station: usize, end: u32) {
        let Some((from, _)) = self.window else { return };
        for id in self.timetable.ids(station) {
            let next = self.next_turn(station, id, from);
            if before(next, end) {
                self.slot_gaps(station, id, next, end);
                self.stations[station].last.insert(id, end.wrapping_sub(1));
            }
        }
    }

    /// Nothing more of the cycles before `end` will come: what is missing of them is found.
    pub fn look_back_on_all(&mut self, end: u32) {
        (0..self.stations.len()).for_each(|station| self.look_back(station, end));
        if let Some(last) = self.last_sync
            && before(last.wrapping_add(1), end)
            && self.window.is_some()
        {
            self.sync_gaps(self.givers.now(), last.wrapping_add(1), end);
            self.last_sync = Some(end.wrapping_sub(1));
        }
    }

    /// What a station misses from cycle `begin` up to `end` is counted by somebody else, and is no finding: how many
    /// turns of its slots that is, from the last that was seen on.
    pub fn pass_over(&mut self, station: usize, begin: u32, end: u32) -> u64 {
        let Some((from, _)) = self.window else { return 0 };
        self.look_back(station, if before(begin, end) { begin } else { end });
        let mut passed = 0;
        for id in self.timetable.ids(station) {
            let next = self.next_turn(station, id, from);
            if before(next, end) {
                passed += self.timetable.count_of(station, id, next, end);
                self.stations[station].last.insert(id, end.wrapping_sub(1));
            }
        }
        passed
    }

    /// The same of Synchronisations.
    pub fn pass_over_syncs(&mut self, begin: u32, end: u32) -> u64 {
        let Some(last) = self.last_sync else { return 0 };
        let next = last.wrapping_add(1);
        if self.window.is_none() || !before(next, end) {
            return 0;
        }
        let begin = if before(begin, end) { begin } else { end };
        let first = if before(next, begin) { begin } else { next };
        self.sync_gaps(self.givers.now(), next, first);
        self.last_sync = Some(end.wrapping_sub(1));
        end.wrapping_sub(first).into()
    }

    /// The first cycle in which a slot may have a turn that was neither seen nor missed.
    pub(super) fn next_turn(&self, station: usize, id: u8, from: u32) -> u32 {
        self.stations[station].last.get(&id).map_or(from, |last| last.wrapping_add(1))
    }

    /// Every turn of a slot from `next` up to `end` was missed.
    pub(super) fn slot_gaps(&mut self, station: usize, id: u8, next: u32, end: u32) {
        let Some((next, end)) = self.in_window(next, end) else { return };
        let turns: Vec<u32> = self.timetable.turns(station, id, next, end).take(self.room()).collect();
        let all = self.timetable.count_of(station, id, next, end);
        let author = |cycle| Author { station, cycle, slot: Some(id) };
        self.gaps(turns.into_iter().map(author), FindingKind::SlotMissed, all);
    }

    /// Every Synchronisation from `next` up to `end` was missing, by who gave the time before.
    pub(super) fn sync_gaps(&mut self, giver: usize, next: u32, end: u32) {
        let Some((next, end)) = self.in_window(next, end) else { return };
        let missing = turns(next, end, 0, 1).take(self.room()).map(|cycle| Author::sync(giver, cycle));
        self.gaps(missing, FindingKind::SyncGap, end.wrapping_sub(next).into());
    }

    /// From the last Synchronisation that was seen to this one.
    pub(super) fn note_period(&mut self, cycle: u32, at: True) {
        let Some((last, last_at)) = self.period_from.replace((cycle, Some(at))) else { return };
        if !before(last, cycle) || !self.counts(cycle) {
            return;
        }
        let clock = self.truth().clock;
        let actual = last_at.map(|last_at| clock.local(at) - clock.local(last_at));
        match actual.filter(|_| cycle.wrapping_sub(last) == 1) {
            Some(actual) => self.sync_period.next(actual, self.length_of(last)),
            None => self.sync_period.gap(actual),
        }
    }

    /// No Synchronisation came any more up to this cycle's begin: that is a gap, too.
    pub(super) fn end_periods(&mut self, end: u32) {
        let Some((last, last_at)) = self.period_from.take() else { return };
        if !before(last.wrapping_add(1), end) {
            return;
        }
        let over = self.begin_of(end).zip(last_at);
        let clock = self.truth().clock;
        self.sync_period.gap(over.map(|(over, last_at)| clock.local(over) - clock.local(last_at)));
    }

    /// What of a range of cycles counts, if anything does.
    fn in_window(&self, next: u32, end: u32) -> Option<(u32, u32)> {
        let (from, cycles) = self.window?;
        let over = from.wrapping_add(cycles);
        let next = if before(next, from) { from } else { next };
        let end = if before(over, end) { over } else { end };
        before(next, end).then_some((next, end))
    }

    fn room(&self) -> usize {
        FINDINGS_MAX.saturating_sub(self.findings.len())
    }

    /// Finds so many that are missing; those for which there is no room are only counted.
    fn gaps(&mut self, missing: impl Iterator<Item = Author>, kind: FindingKind, mut all: u64) {
        for author in missing {
            self.find(Finding::of(author, kind, Span::ZERO));
            all -= 1;
        }
        self.findings_dropped += all;
    }
}
