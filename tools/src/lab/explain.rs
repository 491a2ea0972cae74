//! Which findings have a record of the same cycle and slot: what a station noticed itself is explained, what it
//! did not is not. A slot that was silent for want of a sync needs the record of why there was none. What a
//! station missed that was not there is explained by its absence.

use std::collections::BTreeMap;

use rtmac::tdma::{HOLDOVER_CYCLES, held_up_at_most};
use rtnet::discipline::{Cause, Channel, EventKind};
use rtnet::time::Span;

use super::absences::{Absence, Absences};
use super::findings::{Author, Finding, FindingKind};

/// A lab's first station is its master.
const MASTER: usize = 0;
/// A sync that is missing is bridged for so many cycles.
const BRIDGED: u32 = HOLDOVER_CYCLES as u32;
/// So many cycles after somebody is back a station may still be silent: a line that comes back must be confirmed.
const LOCKED_AFTER: u32 = 4;

/// What the stations told of themselves, and when they could not.
#[derive(Debug, Default)]
pub struct Records {
    by_cycle: BTreeMap<Key, (Span, Option<Cause>)>,
    /// From one cycle's start to the next.
    cycle: Span,
    /// When stations were not there.
    pub absences: Absences,
}

/// Cycle, station, slot, kind.
type Key = (u32, usize, Option<Channel>, EventKind);

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
    /// None yet, of a network with such a cycle.
    pub fn new(cycle: Span) -> Self {
        Self { cycle, ..Self::default() }
    }

    /// A station noticed something in a cycle, in one of its slots or none. Of several the longest is kept.
    pub fn note(&mut self, author: Author, kind: EventKind, span: Span, cause: Option<Cause>) {
        let key = (author.cycle, author.station, author.slot, kind);
        let longest = self.by_cycle.entry(key).or_insert((span, cause));
        *longest = (*longest).max((span, cause));
    }

    /// Forgets what is older than this cycle.
    pub fn forget_before(&mut self, cycle: u32) {
        self.by_cycle.retain(|&(of, ..), _| of.wrapping_sub(cycle) as i32 >= 0);
        self.absences.forget_before(cycle);
    }

    /// The records of one kind in `cycles` cycles from `from` on, with their station.
    pub fn of_kind(&self, kind: EventKind, from: u32, cycles: u32) -> impl Iterator<Item = Record> {
        self.by_cycle.iter().filter_map(move |(&(cycle, station, _, of), &(span, cause))| {
            let record = Record { cycle, station, span, cause };
            (of == kind && cycle.wrapping_sub(from) < cycles).then_some(record)
        })
    }

    /// Why something was found, by the cause's name, if a station involved, or the master whose time they follow,
    /// has told of it, or could not. A send that failed is told of, but excuses nothing: stations are not late
    /// for it.
    pub fn explain(&self, finding: &Finding) -> Option<&'static str> {
        let mut authors = finding.authors.iter().flatten().copied();
        // A calibration reply, whose author nobody knows, meets others when it is late; it moves nobody.
        let hit = finding.kind == FindingKind::Overlap && finding.authors.contains(&None);
        match finding.kind {
            // A Synchronisation that was held up moves every station of its cycle. What a station had to tell
            // of its last moments went with it.
            FindingKind::Overlap | FindingKind::OutOfSlot => authors.find_map(|author| {
                self.told(author, EventKind::StalledInSend)
                    .or_else(|| self.told(master(author), EventKind::StalledInSend))
                    .or_else(|| hit.then(|| self.told(master(author), EventKind::ReplyStalled)).flatten())
                    .or_else(|| self.absence(author).filter(|&why| why == Absence::Down.name()))
            }),
            // One that the kernel guard dropped is skipped, too.
            FindingKind::SyncGap => authors.find_map(|author| {
                self.told(author, EventKind::SyncSkipped).or_else(|| self.absence(author))
            }),
            FindingKind::SlotMissed => authors.find_map(|author| {
                self.told(author, EventKind::Overrun)
                    .or_else(|| self.told(author, EventKind::GuardDropped))
                    .or_else(|| self.absence(author))
                    .or_else(|| self.silence(author))
            }),
            FindingKind::Repeated => None,
        }
    }

    /// A station that was silent did what it must, but that alone explains nothing: why was there no sync to follow,
    /// of this cycle or of the one before, which bridges it? One that was lost on its way has no record. Without a
    /// master for long, a station has no line to tell by which slots it is silent in.
    fn silence(&self, author: Author) -> Option<&'static str> {
        let ago = |cycles| Author { cycle: author.cycle.wrapping_sub(cycles), ..author };
        let absent = (0..=LOCKED_AFTER)
            .any(|i| self.absence(master(ago(i))).or_else(|| self.absence(ago(i))).is_some());
        let silent = self.told(author, EventKind::SlotSilent).or(absent.then_some(Cause::NoSync.name()))?;
        let doubted = self.told_any(of_cycle(author), &[EventKind::DuplicateCycle]) || self.stepped(author);
        let why = absent || doubted || (0..=BRIDGED).all(|i| self.without_sync(ago(i)));
        why.then_some(silent)
    }

    /// Whether somebody told why the author had no sync of this cycle in time, or could not follow it.
    fn without_sync(&self, author: Author) -> bool {
        self.told_any(master(author), &[EventKind::SyncSkipped])
            || self.told_any(of_cycle(author), &[EventKind::SyncLate, EventKind::TimeStep])
    }

    /// Whether the author told of a time step in this cycle that is not bridged, as one is that was held up.
    fn stepped(&self, Author { cycle, station, .. }: Author) -> bool {
        let step = self.by_cycle.get(&(cycle, station, None, EventKind::TimeStep));
        let held_up = Span::ZERO..held_up_at_most(self.cycle);
        step.is_some_and(|(deviation, _)| !held_up.contains(deviation))
    }

    fn told_any(&self, author: Author, kinds: &[EventKind]) -> bool {
        kinds.iter().any(|&kind| self.told(author, kind).is_some())
    }

    fn absence(&self, Author { station, cycle, .. }: Author) -> Option<&'static str> {
        self.absences.of(station, cycle).map(|why| why.name())
    }

    /// The cause that a station told, or what it told of.
    fn told(&self, Author { station, cycle, slot }: Author, kind: EventKind) -> Option<&'static str> {
        let (_, cause) = self.by_cycle.get(&(cycle, station, slot, kind))?;
        Some(cause.map_or(kind.name(), Cause::name))
    }
}

/// Whose Synchronisation the author's station follows.
fn master(author: Author) -> Author {
    Author { station: MASTER, slot: None, ..author }
}

/// What the author's station tells of the cycle as a whole.
fn of_cycle(author: Author) -> Author {
    Author { slot: None, ..author }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// In the station's slot 0; the master's Synchronisation.
    fn author(cycle: u32, station: usize) -> Author {
        Author { station, cycle, slot: (station != MASTER).then_some(0) }
    }

    fn told_of(cycle: u32, station: usize) -> Author {
        Author { station, cycle, slot: None }
    }

    fn finding(cycle: u32, kind: FindingKind, station: usize) -> Finding {
        Finding::of(author(cycle, station), kind, Span::ZERO)
    }

    #[test]
    fn only_a_record_of_the_same_cycle_and_station_explains() {
        let mut records = Records::default();
        records.note(author(7, 2), EventKind::Overrun, Span::from_nanos(5), None);
        let explained = |cycle, kind, station| records.explain(&finding(cycle, kind, station)).is_some();
        assert!(explained(7, FindingKind::SlotMissed, 2));
        assert!(!explained(8, FindingKind::SlotMissed, 2));
        assert!(!explained(7, FindingKind::SlotMissed, 3));
        assert!(!explained(7, FindingKind::Overlap, 2), "who skips a slot overlaps nobody");
    }

    #[test]
    fn a_frame_that_the_guard_dropped_is_missing_and_overlaps_nobody() {
        let mut records = Records::default();
        records.note(author(7, 2), EventKind::GuardDropped, Span::from_nanos(5), None);
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
        records.note(author(9, 0), EventKind::StalledInSend, Span::from_nanos(5), None);
        assert!(records.explain(&finding(9, FindingKind::OutOfSlot, 4)).is_some());
        assert!(records.explain(&finding(9, FindingKind::SlotMissed, 4)).is_none());
        assert!(records.explain(&finding(9, FindingKind::SyncGap, 0)).is_none(), "it was sent");
    }

    #[test]
    fn a_held_up_calibration_reply_explains_what_it_hits_and_nothing_else() {
        let mut records = Records::default();
        records.note(told_of(9, MASTER), EventKind::ReplyStalled, Span::from_nanos(5), None);
        assert!(records.explain(&finding(9, FindingKind::Overlap, 4)).is_some());
        assert!(records.explain(&finding(9, FindingKind::OutOfSlot, 4)).is_none());
        assert!(records.explain(&finding(8, FindingKind::Overlap, 4)).is_none());
        let authors = [4, 5].map(|station| Some(author(9, station)));
        let others = Finding { authors, ..finding(9, FindingKind::Overlap, 4) };
        assert!(records.explain(&others).is_none(), "two others have met");
    }

    #[test]
    fn a_silent_slot_is_explained_by_the_records_of_both_syncs_it_could_have_followed() {
        let silent_by = |span: i64, told: &[(u32, usize, EventKind)]| {
            let mut records = Records::new(Span::from_millis(1));
            records.note(author(20, 2), EventKind::SlotSilent, Span::ZERO, None);
            for &(cycle, station, kind) in told {
                records.note(told_of(cycle, station), kind, Span::from_nanos(span), None);
            }
            records.explain(&finding(20, FindingKind::SlotMissed, 2)).is_some()
        };
        let silent = |told: &[_]| silent_by(0, told);
        use EventKind::*;
        assert!(!silent(&[]), "the syncs were lost on their way");
        assert!(!silent(&[(20, 0, SyncSkipped)]), "that of 19 bridges it");
        assert!(!silent(&[(18, 0, SyncSkipped), (19, 0, SyncSkipped)]), "that of 20 was there");
        assert!(!silent(&[(19, 3, SyncLate), (20, 3, SyncLate)]), "somebody else's");
        assert!(!silent(&[(19, 0, StalledInSend), (20, 0, StalledInSend)]), "late, but they came");
        assert!(!silent(&[(19, 2, DuplicateCycle), (20, 0, SyncSkipped)]), "one of the two bridges it");
        assert!(silent(&[(19, 0, SyncSkipped), (20, 0, SyncSkipped)]));
        assert!(silent(&[(19, 2, SyncLate), (20, 2, SyncLate)]));
        assert!(silent(&[(19, 2, TimeStep), (20, 0, SyncSkipped)]), "no sync confirmed the step");
        assert!(!silent_by(50_000, &[(20, 2, TimeStep)]), "held up: that of 19 bridges it");
        assert!(silent_by(-50_000, &[(20, 2, TimeStep)]), "until it is confirmed");
        assert!(silent_by(400_000, &[(20, 2, TimeStep)]), "this one, too");
        assert!(silent(&[(20, 2, DuplicateCycle)]));
    }

    #[test]
    fn a_frame_that_hits_the_next_cycles_sync_is_explained_by_its_own_cycle() {
        let mut records = Records::default();
        let [late, sync] = [author(9, 5), author(10, MASTER)];
        let authors = [Some(late), Some(sync)];
        let overlap = Finding { cycle: 10, kind: FindingKind::Overlap, authors, span: Span::ZERO };
        records.note(author(10, 5), EventKind::StalledInSend, Span::ZERO, None);
        assert!(records.explain(&overlap).is_none());
        records.note(author(9, 5), EventKind::StalledInSend, Span::ZERO, None);
        assert!(records.explain(&overlap).is_some());
    }

    #[test]
    fn two_slots_of_one_cycle_are_told_of_one_by_one() {
        let mut records = Records::default();
        records.note(author(7, 2), EventKind::Overrun, Span::ZERO, Some(Cause::TimerLate));
        let missed = |slot| {
            Finding::of(Author { slot: Some(slot), ..author(7, 2) }, FindingKind::SlotMissed, Span::ZERO)
        };
        assert_eq!(records.explain(&missed(0)), Some("timer_late"));
        assert_eq!(records.explain(&missed(3)), None, "nobody told of that one");
        records.note(Author { slot: Some(3), ..author(7, 2) }, EventKind::Overrun, Span::ZERO, None);
        assert!(records.explain(&missed(3)).is_some());
        assert_eq!(records.of_kind(EventKind::Overrun, 7, 1).count(), 2);
    }

    #[test]
    fn who_was_not_there_missed_its_slots_for_that_and_nobody_else_did() {
        let mut records = Records::default();
        records.absences.begin(2, Absence::Down, 10);
        let why = |records: &Records, cycle, kind, station| records.explain(&finding(cycle, kind, station));
        assert_eq!(why(&records, 9, FindingKind::SlotMissed, 2), None);
        assert_eq!(why(&records, 10, FindingKind::SlotMissed, 2), Some("station_down"));
        assert_eq!(
            why(&records, 10, FindingKind::OutOfSlot, 2),
            Some("station_down"),
            "its last word is not known"
        );
        assert_eq!(why(&records, 10, FindingKind::SlotMissed, 3), None);
        records.absences.end(2, Absence::Down, 20);
        assert_eq!(
            why(&records, 20, FindingKind::SlotMissed, 2),
            Some("sync_lost_or_late"),
            "until it is locked"
        );
        assert_eq!(why(&records, 30, FindingKind::SlotMissed, 2), None);
    }

    #[test]
    fn without_a_master_there_are_no_syncs_and_all_are_silent() {
        let mut records = Records::default();
        records.absences.begin(MASTER, Absence::Down, 10);
        let why = |cycle, kind, station| records.explain(&finding(cycle, kind, station));
        assert_eq!(why(12, FindingKind::SyncGap, MASTER), Some("station_down"));
        assert_eq!(why(5_000, FindingKind::SlotMissed, 3), Some("sync_lost_or_late"));
        assert_eq!(why(12, FindingKind::OutOfSlot, 3), None, "who sends must know when");
    }
}
