//! Which findings have a record of the same cycle: what a station noticed itself is explained, what it
//! did not is not.

use std::collections::BTreeMap;

use rtnet::discipline::EventKind;
use rtnet::time::Span;

use super::analysis::{Finding, FindingKind};

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
    /// of the same cycle.
    pub fn explain(&self, finding: &Finding) -> Option<(EventKind, Span)> {
        let involved = finding.stations.iter().flatten().copied();
        let by_involved =
            involved.flat_map(|station| causes(finding.kind).iter().map(move |&k| (station, k)));
        // A Synchronisation that was held up moves every station of its cycle.
        let by_master = match finding.kind {
            FindingKind::Overlap | FindingKind::OutOfSlot => Some((0, EventKind::StalledInSend)),
            _ => None,
        };
        by_involved.chain(by_master).find_map(|(station, kind)| {
            self.by_cycle.get(&(finding.cycle, station, kind)).map(|&span| (kind, span))
        })
    }
}

/// What may have caused a finding of this kind at the station itself. A silent slot is a station that did
/// what it must without a sync; one that never recovers fails the verdict by its state.
fn causes(kind: FindingKind) -> &'static [EventKind] {
    match kind {
        FindingKind::Overlap | FindingKind::OutOfSlot => &[EventKind::StalledInSend],
        FindingKind::SyncGap => &[EventKind::SyncSkipped, EventKind::StalledInSend, EventKind::SendFailed],
        FindingKind::SlotMissed => {
            &[EventKind::Overrun, EventKind::SlotSilent, EventKind::StalledInSend, EventKind::SendFailed]
        }
        FindingKind::Repeated => &[],
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
    }
}
