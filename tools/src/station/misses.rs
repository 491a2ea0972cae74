//! What a station has missed, and why: counted by cause, the worst and the latest kept.

use std::collections::{BTreeMap, VecDeque};

use rtnet::discipline::{Cause, Event};
use rtnet::live::Record;
use serde::{Deserialize, Serialize};

/// The longest are kept, so that one bad minute does not hide the worst of a week.
pub const WORST: usize = 10;
/// And the latest, since "what was that just now?" is what people ask.
const LATEST: usize = 50;

/// A station's misses.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
pub struct Misses {
    /// How many, by cause.
    pub causes: BTreeMap<String, u64>,
    /// The longest, longest first.
    pub worst: Vec<Miss>,
    /// The latest, oldest first.
    pub latest: VecDeque<Miss>,
}

/// One of them.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
pub struct Miss {
    /// In which cycle.
    pub cycle: u32,
    /// In which slot; none: a Synchronisation, or a calibration reply.
    pub slot: Option<u8>,
    /// `overrun`, `stalled_in_send`, `guard_dropped`, `slot_silent`, `slot_empty`, `send_failed` or `sync_skipped`.
    pub what: String,
    /// By how much, nanoseconds; of a failed send, its error number.
    pub late_ns: i64,
    /// Why.
    pub cause: String,
}

impl Misses {
    /// Takes in what was missed.
    pub fn note(&mut self, records: &[Record]) {
        for record in records {
            let Record::Event(event, Some(cause)) = *record else { continue };
            self.enter(event, cause);
        }
    }

    fn enter(&mut self, event: Event, cause: Cause) {
        *self.causes.entry(cause.name().into()).or_default() += 1;
        let miss = Miss {
            cycle: event.cycle,
            slot: event.slot,
            what: event.kind.name().into(),
            late_ns: event.span.nanos(),
            cause: cause.name().into(),
        };
        let place = self.worst.partition_point(|other| other.late_ns >= miss.late_ns);
        if place < WORST {
            self.worst.insert(place, miss.clone());
            self.worst.truncate(WORST);
        }
        if self.latest.len() == LATEST {
            self.latest.pop_front();
        }
        self.latest.push_back(miss);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rtnet::discipline::EventKind;
    use rtnet::time::Span;

    fn record(cycle: u32, late: i64, cause: Option<Cause>) -> Record {
        let span = Span::from_micros(late);
        Record::Event(Event { cycle, kind: EventKind::Overrun, slot: Some(0), span }, cause)
    }

    #[test]
    fn the_worst_and_the_latest_are_kept_and_all_are_counted() {
        let mut misses = Misses::default();
        for cycle in 0..1_000 {
            misses.note(&[record(cycle, i64::from(cycle % 100), Some(Cause::TimerLate))]);
        }
        misses.note(&[record(1_000, 1_000_000, None)]);
        assert_eq!(misses.causes["timer_late"], 1_000);
        assert!(misses.worst.iter().all(|miss| miss.late_ns == 99_000));
        assert_eq!((misses.worst.len(), misses.latest.len()), (WORST, LATEST));
        assert_eq!(misses.latest.back().unwrap().cycle, 999, "what was no miss is not listed");
    }
}
