//! Which findings have a record of the same cycle: what a station noticed itself is explained, what it
//! did not is not. A slot that was silent for want of a sync needs the record of that, too.

use std::collections::BTreeMap;

use rtnet::discipline::EventKind;
use rtnet::time::Span;

use super::analysis::{Finding, FindingKind};

/// A lab's first station is its master.
const MASTER: usize = 0;
/// How far the cause of a silence may be from it, in cycles: one missing sync is bridged, and one that comes
/// after a time step must be confirmed by the next; who slept through several tells of the last first.
const SILENCE_AROUND: u32 = 4;

/// What the stations told of themselves.
#[derive(Debug, Default)]
pub struct Records {
    by_cycle: BTreeMap<(u32, usize, EventKind), Span>,
}

impl Records {
    /// A station noticed something in a cycle. Of several the longest is kept.
    pub fn note(&mut self, cycle: u32, station: usize, kind: EventKind, span: Span) {
        let longest = self.by_cycle.entry((cycle, station, kind)).or_insert(span);
        *longest = (*longest).max(span);
    }

    /// The records of one kind in `cycles` cycles from `from` on, with their station.
    pub fn of_kind(
        &self,
        kind: EventKind,
        from: u32,
        cycles: u32,
    ) -> impl Iterator<Item = (u32, usize, Span)> {
        self.by_cycle.iter().filter_map(move |(&(cycle, station, of), &span)| {
            (of == kind && cycle.wrapping_sub(from) < cycles).then_some((cycle, station, span))
        })
    }

    /// Why something was found, if a station involved, or the master whose time they follow, has told
    /// of it.
    pub fn explain(&self, finding: &Finding) -> Option<(EventKind, Span)> {
        let cycle = finding.cycle;
        let mut involved = finding.stations.iter().flatten().copied();
        match finding.kind {
            // A Synchronisation that was held up moves every station of its cycle.
            FindingKind::Overlap | FindingKind::OutOfSlot => involved
                .chain([MASTER])
                .find_map(|station| self.get(cycle, station, EventKind::StalledInSend)),
            FindingKind::SyncGap => self.get(cycle, MASTER, EventKind::SyncSkipped),
            FindingKind::SlotMissed => involved.find_map(|station| {
                self.get(cycle, station, EventKind::Overrun).or_else(|| self.silence(cycle, station))
            }),
            FindingKind::Repeated => None,
        }
    }

    /// A station that was silent did what it must, but that alone explains nothing: why were there no syncs
    /// to follow? One that was lost on its way has no record.
    fn silence(&self, cycle: u32, station: usize) -> Option<(EventKind, Span)> {
        let silent = self.get(cycle, station, EventKind::SlotSilent)?;
        let near = |station, kinds: &[EventKind]| {
            (0..=2 * SILENCE_AROUND).any(|i| {
                let at = cycle.wrapping_add(i).wrapping_sub(SILENCE_AROUND);
                kinds.iter().any(|&kind| self.get(at, station, kind).is_some())
            })
        };
        let by_master = near(MASTER, &[EventKind::SyncSkipped, EventKind::StalledInSend]);
        let by_itself = near(station, &[EventKind::Overrun, EventKind::TimeStep, EventKind::DuplicateCycle]);
        (by_master || by_itself).then_some(silent)
    }

    fn get(&self, cycle: u32, station: usize, kind: EventKind) -> Option<(EventKind, Span)> {
        self.by_cycle.get(&(cycle, station, kind)).map(|&span| (kind, span))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn finding(cycle: u32, kind: FindingKind, station: usize) -> Finding {
        Finding { cycle, kind, stations: [Some(station), None], span: Span::ZERO }
    }

    #[test]
    fn only_a_record_of_the_same_cycle_and_station_explains() {
        let mut records = Records::default();
        records.note(7, 2, EventKind::Overrun, Span::from_nanos(5));
        let explained = |cycle, kind, station| records.explain(&finding(cycle, kind, station)).is_some();
        assert!(explained(7, FindingKind::SlotMissed, 2));
        assert!(!explained(8, FindingKind::SlotMissed, 2));
        assert!(!explained(7, FindingKind::SlotMissed, 3));
        assert!(!explained(7, FindingKind::Overlap, 2), "who skips a slot overlaps nobody");
    }

    #[test]
    fn a_held_up_synchronisation_explains_what_follows_in_its_cycle() {
        let mut records = Records::default();
        records.note(9, 0, EventKind::StalledInSend, Span::from_nanos(5));
        assert!(records.explain(&finding(9, FindingKind::OutOfSlot, 4)).is_some());
        assert!(records.explain(&finding(9, FindingKind::SlotMissed, 4)).is_none());
        assert!(records.explain(&finding(9, FindingKind::SyncGap, 0)).is_none(), "it was sent");
    }

    #[test]
    fn a_silent_slot_is_explained_by_what_silenced_it() {
        let mut records = Records::default();
        records.note(20, 2, EventKind::SlotSilent, Span::ZERO);
        let explained =
            |records: &Records| records.explain(&finding(20, FindingKind::SlotMissed, 2)).is_some();
        assert!(!explained(&records), "the sync was lost on its way");
        records.note(19, 3, EventKind::Overrun, Span::ZERO);
        records.note(15, 0, EventKind::SyncSkipped, Span::ZERO);
        assert!(!explained(&records), "somebody else's, and long ago");
        records.note(18, 0, EventKind::SyncSkipped, Span::ZERO);
        assert!(explained(&records));
    }
}
