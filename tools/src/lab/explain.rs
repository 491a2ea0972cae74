//! Which findings have a record of the same cycle: what a station noticed itself is explained, what it
//! did not is not. A slot that was silent for want of a sync needs the record of why there was none.

use std::collections::BTreeMap;

use rtnet::discipline::{Cause, EventKind};
use rtnet::time::Span;

use super::analysis::{Author, Finding, FindingKind};

/// A lab's first station is its master.
const MASTER: usize = 0;
/// How long after its cause a silence may be, in cycles: one missing sync is bridged, and one that comes after
/// a time step must be confirmed by the next.
const SILENCE_AFTER: u32 = 4;

/// What the stations told of themselves.
#[derive(Debug, Default)]
pub struct Records {
    by_cycle: BTreeMap<(u32, usize, EventKind), (Span, Option<Cause>)>,
}

/// What a station told of one cycle.
#[derive(Clone, Copy, Debug)]
pub struct Record {
    /// Which cycle.
    pub cycle: u32,
    /// Which station.
    pub station: usize,
    /// By how much.
    pub span: Span,
    /// Why, if something was missed by it.
    pub cause: Option<Cause>,
}

impl Records {
    /// A station noticed something in a cycle. Of several the longest is kept.
    pub fn note(&mut self, cycle: u32, station: usize, kind: EventKind, span: Span, cause: Option<Cause>) {
        let longest = self.by_cycle.entry((cycle, station, kind)).or_insert((span, cause));
        *longest = (*longest).max((span, cause));
    }

    /// Forgets what is older than this cycle.
    pub fn forget_before(&mut self, cycle: u32) {
        self.by_cycle.retain(|&(of, ..), _| of.wrapping_sub(cycle) as i32 >= 0);
    }

    /// The records of one kind in `cycles` cycles from `from` on, with their station.
    pub fn of_kind(&self, kind: EventKind, from: u32, cycles: u32) -> impl Iterator<Item = Record> {
        self.by_cycle.iter().filter_map(move |(&(cycle, station, of), &(span, cause))| {
            let record = Record { cycle, station, span, cause };
            (of == kind && cycle.wrapping_sub(from) < cycles).then_some(record)
        })
    }

    /// Why something was found, if a station involved, or the master whose time they follow, has told
    /// of it. A send that failed is told of, but excuses nothing: stations are not late for it.
    pub fn explain(&self, finding: &Finding) -> Option<(EventKind, Span)> {
        let mut authors = finding.authors.iter().flatten().copied();
        match finding.kind {
            // A Synchronisation that was held up moves every station of its cycle.
            FindingKind::Overlap | FindingKind::OutOfSlot => authors
                .flat_map(|author| [author, Author { station: MASTER, ..author }])
                .find_map(|author| self.get(author, EventKind::StalledInSend)),
            // One that the kernel guard dropped is skipped, too.
            FindingKind::SyncGap => authors.find_map(|author| self.get(author, EventKind::SyncSkipped)),
            FindingKind::SlotMissed => authors.find_map(|author| {
                self.get(author, EventKind::Overrun)
                    .or_else(|| self.get(author, EventKind::GuardDropped))
                    .or_else(|| self.silence(author))
            }),
            FindingKind::Repeated => None,
        }
    }

    /// A station that was silent did what it must, but that alone explains nothing: why were there no syncs
    /// to follow? One that was lost on its way has no record.
    fn silence(&self, author: Author) -> Option<(EventKind, Span)> {
        let silent = self.get(author, EventKind::SlotSilent)?;
        let before = |author: Author, kind: EventKind| {
            (0..=SILENCE_AFTER)
                .any(|i| self.get(Author { cycle: author.cycle.wrapping_sub(i), ..author }, kind).is_some())
        };
        let master = Author { station: MASTER, ..author };
        let why = before(master, EventKind::SyncSkipped)
            || before(master, EventKind::StalledInSend)
            || before(author, EventKind::SyncLate)
            || before(author, EventKind::TimeStep)
            || before(author, EventKind::DuplicateCycle);
        why.then_some(silent)
    }

    fn get(&self, Author { station, cycle }: Author, kind: EventKind) -> Option<(EventKind, Span)> {
        self.by_cycle.get(&(cycle, station, kind)).map(|&(span, _)| (kind, span))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn finding(cycle: u32, kind: FindingKind, station: usize) -> Finding {
        Finding::of(station, cycle, kind, Span::ZERO)
    }

    #[test]
    fn only_a_record_of_the_same_cycle_and_station_explains() {
        let mut records = Records::default();
        records.note(7, 2, EventKind::Overrun, Span::from_nanos(5), None);
        let explained = |cycle, kind, station| records.explain(&finding(cycle, kind, station)).is_some();
        assert!(explained(7, FindingKind::SlotMissed, 2));
        assert!(!explained(8, FindingKind::SlotMissed, 2));
        assert!(!explained(7, FindingKind::SlotMissed, 3));
        assert!(!explained(7, FindingKind::Overlap, 2), "who skips a slot overlaps nobody");
    }

    #[test]
    fn a_frame_that_the_guard_dropped_is_missing_and_overlaps_nobody() {
        let mut records = Records::default();
        records.note(7, 2, EventKind::GuardDropped, Span::from_nanos(5), None);
        let explained = |cycle, kind, station| records.explain(&finding(cycle, kind, station)).is_some();
        assert!(explained(7, FindingKind::SlotMissed, 2));
        assert!(!explained(8, FindingKind::SlotMissed, 2));
        assert!(!explained(7, FindingKind::SlotMissed, 3));
        assert!(!explained(7, FindingKind::Overlap, 2), "it never left");
        assert!(!explained(7, FindingKind::OutOfSlot, 2), "nor that");
    }

    #[test]
    fn a_held_up_synchronisation_explains_what_follows_in_its_cycle() {
        let mut records = Records::default();
        records.note(9, 0, EventKind::StalledInSend, Span::from_nanos(5), None);
        assert!(records.explain(&finding(9, FindingKind::OutOfSlot, 4)).is_some());
        assert!(records.explain(&finding(9, FindingKind::SlotMissed, 4)).is_none());
        assert!(records.explain(&finding(9, FindingKind::SyncGap, 0)).is_none(), "it was sent");
    }

    #[test]
    fn a_silent_slot_is_explained_by_what_silenced_it() {
        let mut records = Records::default();
        records.note(20, 2, EventKind::SlotSilent, Span::ZERO, None);
        let explained =
            |records: &Records| records.explain(&finding(20, FindingKind::SlotMissed, 2)).is_some();
        assert!(!explained(&records), "the sync was lost on its way");
        records.note(19, 2, EventKind::Overrun, Span::ZERO, None);
        records.note(19, 3, EventKind::TimeStep, Span::ZERO, None);
        records.note(15, 0, EventKind::SyncSkipped, Span::ZERO, None);
        records.note(21, 0, EventKind::SyncSkipped, Span::ZERO, None);
        assert!(!explained(&records), "no cause, somebody else's, long ago, and too late");
        let mut late = Records::default();
        late.note(20, 2, EventKind::SlotSilent, Span::ZERO, None);
        late.note(19, 2, EventKind::SyncLate, Span::ZERO, None);
        assert!(explained(&late));
        records.note(18, 0, EventKind::SyncSkipped, Span::ZERO, None);
        assert!(explained(&records));
    }

    #[test]
    fn a_frame_that_hits_the_next_cycles_sync_is_explained_by_its_own_cycle() {
        let mut records = Records::default();
        let [late, sync] = [Author { station: 5, cycle: 9 }, Author { station: MASTER, cycle: 10 }];
        let authors = [Some(late), Some(sync)];
        let overlap = Finding { cycle: 10, kind: FindingKind::Overlap, authors, span: Span::ZERO };
        records.note(10, 5, EventKind::StalledInSend, Span::ZERO, None);
        assert!(records.explain(&overlap).is_none());
        records.note(9, 5, EventKind::StalledInSend, Span::ZERO, None);
        assert!(records.explain(&overlap).is_some());
    }
}
