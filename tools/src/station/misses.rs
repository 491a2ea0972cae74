//! What a station has missed, and why: counted by cause, the worst and the latest kept.

use std::collections::{BTreeMap, VecDeque};

use nix::errno::Errno;
use rtnet::discipline::{Cause, Event, EventKind};
use rtnet::live::Record;
use serde::{Deserialize, Serialize};

/// The longest are kept, so that one bad minute does not hide the worst of a week.
pub const WORST: usize = 10;
/// And the latest, since "what was that just now?" is what people ask.
const LATEST: usize = 50;

/// A station's misses.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Misses {
    /// How many, by cause.
    pub causes: BTreeMap<String, u64>,
    /// The longest, longest first. Frames that the kernel refused are not among them: those are late by nothing.
    pub worst: Vec<Miss>,
    /// The latest, oldest first.
    pub latest: VecDeque<Miss>,
    /// Frames that the kernel refused, by its reason.
    #[serde(default)]
    pub refused: Vec<Refusal>,
}

/// How often the kernel refused a frame for this reason.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Refusal {
    /// Its error number.
    pub errno: i32,
    /// The same in words, as in `ENETDOWN: Network is down`.
    pub error: String,
    /// How often.
    pub frames: u64,
    /// The last time, in which cycle.
    pub last_cycle: u32,
}

/// One of them.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Miss {
    /// In which cycle.
    pub cycle: u32,
    /// In which slot; none: a Synchronisation, or a calibration reply.
    pub slot: Option<u8>,
    /// The name of its kind of event: `overrun`, `stalled_in_send`, ...
    pub what: String,
    /// By how much, nanoseconds; 0 of a failed send.
    pub late_ns: i64,
    /// Of a failed send, its error number.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub errno: Option<i32>,
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
        // The span of a failed send is no time.
        let errno = matches!(event.kind, EventKind::SendFailed | EventKind::ReplyFailed)
            .then_some(event.span.nanos() as i32);
        let miss = Miss {
            cycle: event.cycle,
            slot: event.slot,
            what: event.kind.name().into(),
            late_ns: if errno.is_some() { 0 } else { event.span.nanos() },
            errno,
            cause: cause.name().into(),
        };
        match errno {
            Some(errno) => self.refuse(errno, event.cycle),
            None => self.rank(&miss),
        }
        if self.latest.len() == LATEST {
            self.latest.pop_front();
        }
        self.latest.push_back(miss);
    }

    fn rank(&mut self, miss: &Miss) {
        let place = self.worst.partition_point(|other| other.late_ns >= miss.late_ns);
        if place < WORST {
            self.worst.insert(place, miss.clone());
            self.worst.truncate(WORST);
        }
    }

    /// There are no more reasons than the kernel has error numbers.
    fn refuse(&mut self, errno: i32, cycle: u32) {
        let known = self.refused.iter_mut().find(|refusal| refusal.errno == errno);
        match known {
            Some(refusal) => (refusal.frames, refusal.last_cycle) = (refusal.frames + 1, cycle),
            None => {
                let error = Errno::from_raw(errno).to_string();
                self.refused.push(Refusal { errno, error, frames: 1, last_cycle: cycle });
            }
        }
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

    #[test]
    fn what_the_kernel_refused_is_no_lateness() {
        let mut misses = Misses::default();
        // 100 is ENETDOWN, and no hundred nanoseconds.
        let (kind, span) = (EventKind::SendFailed, Span::from_nanos(Errno::ENETDOWN as i64));
        let failed = |cycle| Record::Event(Event { cycle, kind, slot: None, span }, Some(Cause::Refused));
        misses.note(&[failed(1), failed(2), record(3, 0, Some(Cause::TimerLate))]);
        assert_eq!(misses.worst.iter().map(|miss| miss.cycle).collect::<Vec<_>>(), [3]);
        let first = &misses.latest[0];
        assert_eq!(
            (first.late_ns, first.errno, misses.latest[2].errno),
            (0, Some(Errno::ENETDOWN as i32), None)
        );
        let error = "ENETDOWN: Network is down".to_owned();
        assert_eq!(
            misses.refused,
            [Refusal { errno: Errno::ENETDOWN as i32, error, frames: 2, last_cycle: 2 }]
        );
        assert_eq!(misses.causes["refused"], 2);
    }
}
