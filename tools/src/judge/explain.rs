//! Which findings have a record of the same cycle and slot: what a station noticed itself is explained, what it
//! did not is not. A slot that was silent for want of a sync needs the record of why there was none. What a
//! station missed that was not there is explained by its absence only if it could not tell of it later.

use std::collections::BTreeMap;

use rtmac::tdma::{HOLDOVER_CYCLES, held_up_at_most};
use rtnet::discipline::{Cause, Channel, EventKind};
use rtnet::time::Span;
use rtnet::wire::ethernet::Address;

use super::absences::{Absence, Absences};
use super::findings::{Author, Finding, FindingKind};
use super::syncs::{Syncs, sync_of};
use super::timetable::before;
use crate::report::figures::Role;
use crate::scenario::Scenario;

/// A lab's first station is its master.
const MASTER: usize = 0;
/// A sync that is missing is bridged for so many cycles.
const BRIDGED: u32 = HOLDOVER_CYCLES as u32;

/// By what a slot is missed.
const MISSED_BY: [EventKind; 6] = [
    EventKind::Overrun,
    EventKind::GuardDropped,
    EventKind::SendFailed,
    EventKind::TurnLeft,
    EventKind::SlotEmpty,
    EventKind::CalibrationTurn,
];
/// By what a cycle has no Synchronisation.
const NO_SYNC_BY: [EventKind; 3] = [EventKind::SyncSkipped, EventKind::SyncDropped, EventKind::SendFailed];

/// What the stations told of themselves, and when they could not.
#[derive(Debug, Default)]
pub struct Records {
    by_cycle: BTreeMap<Key, (Span, Option<Cause>)>,
    /// When stations told that they have a line, or none any more.
    lines: Vec<(usize, u32, bool)>,
    /// When backups told that they give the time, or do so no more.
    reigns: Vec<(usize, u32, bool)>,
    /// Synchronisations, as far as somebody knows which were lost on their way to a station.
    syncs: Syncs,
    /// Whose address is which, by station.
    addresses: Vec<Address>,
    /// From one cycle's start to the next.
    cycle: Span,
    /// How long after its instant a frame that is not held up is sent, and another behind it.
    in_time: Span,
    /// Who may give the time instead of the master.
    backups: Vec<usize>,
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
    /// None yet, of such a network.
    pub fn new(scenario: &Scenario) -> Self {
        let in_time = scenario.sync_window + scenario.latest();
        let all = scenario.stations.iter().enumerate();
        let backups = all.filter(|(_, plan)| plan.role == Role::Backup).map(|(station, _)| station).collect();
        let addresses = (0..scenario.stations.len()).map(|station| scenario.address(station)).collect();
        Self { cycle: scenario.cycle, in_time, backups, addresses, ..Self::default() }
    }

    /// A station noticed something in a cycle, in one of its slots or none. Of several the longest is kept.
    pub fn note(&mut self, author: Author, kind: EventKind, span: Span, cause: Option<Cause>) {
        if matches!(kind, EventKind::Locked | EventKind::LineGivenUp) {
            self.lines.push((author.station, author.cycle, kind == EventKind::Locked));
        }
        if matches!(kind, EventKind::TookOver | EventKind::SteppedDown) {
            self.reigns.push((author.station, author.cycle, kind == EventKind::TookOver));
        }
        let longest = self.by_cycle.entry(key(author, kind)).or_insert((span, cause));
        *longest = (*longest).max((span, cause));
    }

    /// A frame was on the medium: it may be a Synchronisation.
    pub fn note_frame(&mut self, frame: &[u8]) {
        if let Some((from, cycle)) = sync_of(frame) {
            self.syncs.note(from, cycle);
        }
    }

    /// A Synchronisation was lost on its way to a station, or since the medium was cut between it and its sender.
    pub fn note_sync_lost(&mut self, station: usize, (from, cycle): (Address, u32), is_cut: bool) {
        self.syncs.note_lost(station, from, cycle, is_cut);
    }

    /// Forgets what is older than this cycle.
    pub fn forget_before(&mut self, cycle: u32) {
        self.by_cycle.retain(|&(of, ..), _| of.wrapping_sub(cycle) as i32 >= 0);
        self.absences.forget_before(cycle);
        self.syncs.forget_before(cycle);
        keep_newest(&mut self.lines, cycle);
        keep_newest(&mut self.reigns, cycle);
    }

    /// The records of one kind in `cycles` cycles from `from` on, with their station.
    pub fn of_kind(&self, kind: EventKind, from: u32, cycles: u32) -> impl Iterator<Item = Record> {
        self.by_cycle.iter().filter_map(move |(&(cycle, station, _, of), &(span, cause))| {
            let record = Record { cycle, station, span, cause };
            (of == kind && cycle.wrapping_sub(from) < cycles).then_some(record)
        })
    }

    /// Why something was found, by the cause's name, if a station involved, or the master whose time they follow,
    /// has told of it, or could not.
    pub fn explain(&self, finding: &Finding) -> Option<&'static str> {
        let mut authors = finding.authors.iter().flatten().copied();
        match finding.kind {
            FindingKind::OutOfSlot => authors.find_map(|author| {
                self.held_up(author, finding.span)
                    .or_else(|| self.moved_by(author).find_map(|master| self.held_up(master, finding.span)))
                    .or_else(|| self.last_words(author))
            }),
            FindingKind::Overlap => authors
                .find_map(|author| {
                    self.told(author, EventKind::StalledInSend)
                        .or_else(|| {
                            self.moved_by(author)
                                .find_map(|master| self.told(master, EventKind::StalledInSend))
                        })
                        .or_else(|| self.last_words(author))
                })
                .or_else(|| self.late_reply(finding)),
            // By who gave the time; or the master was to be that again.
            FindingKind::SyncGap => authors
                .find_map(|author| self.missing(author, self.told_of(author, &NO_SYNC_BY)))
                .or_else(|| self.told_of(Author::sync(finding.cycle), &NO_SYNC_BY)),
            FindingKind::SlotMissed => authors.find_map(|author| {
                let told = self.told_of(author, &MISSED_BY).or_else(|| self.silence(author));
                self.missing(author, told)
            }),
            // One that was held up for so long that its slot was taken for missed; and a backup that heard nobody.
            FindingKind::Repeated => authors.find_map(|author| {
                let reigns = self.reigns(author.station, author.cycle).then_some(Cause::NoSync.name());
                self.told(author, EventKind::StalledInSend).or(reigns)
            }),
            // Who gives the time needs no sync, though nobody heard its own while another's was the last.
            FindingKind::WithoutSync => authors.find_map(|author| {
                self.told_of(of_cycle(author), &[EventKind::SyncSkipped, EventKind::SyncDropped])
            }),
        }
    }

    /// Whether the explanation is a record, not that there can be none.
    pub fn has_told_of(&self, finding: &Finding) -> bool {
        let told = |&author: &Author| {
            let kinds = [&MISSED_BY[..], &NO_SYNC_BY[..], &[EventKind::SlotSilent]].concat();
            self.told_of(author, &kinds).is_some()
        };
        finding.authors.iter().flatten().any(told)
    }

    /// Whether a frame was held up, and by enough. A Synchronisation that was moves every station of its cycle.
    fn held_up(&self, author: Author, late: Span) -> Option<&'static str> {
        let (by, _) = self.by_cycle.get(&key(author, EventKind::StalledInSend))?;
        let explains = Span::ZERO < late && late <= *by + self.in_time;
        explains.then(|| self.told(author, EventKind::StalledInSend)).flatten()
    }

    /// A calibration reply, whose author nobody knows, meets others when it is late, of the next cycle, too; it moves
    /// nobody.
    fn late_reply(&self, finding: &Finding) -> Option<&'static str> {
        let of = |cycle| Author { station: MASTER, cycle, slot: None };
        let told = |cycle| self.told(of(cycle), EventKind::ReplyStalled);
        let is_hit = finding.authors.contains(&None);
        is_hit.then(|| told(finding.cycle).or_else(|| told(finding.cycle.wrapping_sub(1)))).flatten()
    }

    /// What a station had to tell of its last moments went with it.
    fn last_words(&self, author: Author) -> Option<&'static str> {
        self.untold(author).filter(|&why| why == Absence::Down.name())
    }

    /// A station that was silent did what it must, but that alone explains nothing: why was there no sync to follow,
    /// of this cycle or of the one before, which bridges it? One that was lost on its way has no record. Without a
    /// master for long, a station has no line to tell by which slots it is silent in.
    fn silence(&self, author: Author) -> Option<&'static str> {
        let Author { station, cycle, .. } = author;
        let absences = &self.absences;
        let has_no_line = self.follows_nobody(station, cycle);
        let silent =
            self.told(author, EventKind::SlotSilent).or(has_no_line.then_some(Cause::NoSync.name()))?;
        let nobody = self.only_master().is_some_and(|master| absences.just_now(master, cycle));
        let absent = nobody || absences.just_now(station, cycle);
        let doubted =
            self.told_of(of_cycle(author), &[EventKind::DuplicateCycle]).is_some() || self.stepped(author);
        let ago = |cycles| Author { cycle: cycle.wrapping_sub(cycles), ..author };
        let why = has_no_line || absent || doubted || (0..=BRIDGED).all(|i| self.without_sync(ago(i)));
        why.then_some(silent)
    }

    /// Whether a backup has told that it gives the time from this cycle on, or before it and not since that it does so no
    /// more.
    fn reigns(&self, station: usize, cycle: u32) -> bool {
        let told = || self.reigns.iter().filter(move |&&(of, ..)| of == station);
        let mut earlier = told().filter(|&&(_, at, _)| before(at, cycle));
        told().any(|&(_, at, begins)| begins && at == cycle)
            || earlier.next_back().is_some_and(|&(.., begins)| begins)
    }

    /// Whether a slave has told that it has no line, or had none any more, and has told of none since.
    fn follows_nobody(&self, station: usize, cycle: u32) -> bool {
        let told = || self.lines.iter().filter(move |&&(of, ..)| of == station);
        let followed = |since: u32| told().any(|&(_, at, has)| has && before(since, at) && before(at, cycle));
        let given_up = told().filter(|&&(_, at, has)| !has && !before(cycle, at)).map(|&(_, at, _)| at);
        let gone = self.only_master().into_iter().chain([station]);
        let absent = gone.flat_map(|of| self.absences.without_line(of, cycle));
        station != MASTER && given_up.chain(absent).any(|since| !followed(since))
    }

    /// Whether somebody told why the author had no sync of this cycle in time, or could not follow it. What one master
    /// did not send is no reason where another's came.
    fn without_sync(&self, author: Author) -> bool {
        let Author { station, cycle, .. } = author;
        let not_sent = || self.masters(author).any(|master| self.told_of(master, &NO_SYNC_BY).is_some());
        self.syncs.is_without(station, cycle)
            || !self.syncs.had(station, cycle) && (not_sent() || self.follows_who_is_away(station, cycle))
            || self.told_of(of_cycle(author), &[EventKind::SyncLate, EventKind::TimeStep]).is_some()
    }

    /// Whether the one whose Synchronisations a station had is not there.
    fn follows_who_is_away(&self, station: usize, cycle: u32) -> bool {
        let of = self.syncs.follows(station, cycle);
        let of = of.and_then(|of| self.addresses.iter().position(|address| *address == of));
        of.is_some_and(|of| self.absences.of(of, cycle).is_some())
    }

    /// Whether the author told of a time step in this cycle that is not bridged, as one is that was held up.
    fn stepped(&self, author: Author) -> bool {
        let step = self.by_cycle.get(&key(of_cycle(author), EventKind::TimeStep));
        let held_up = Span::ZERO..held_up_at_most(self.cycle);
        step.is_some_and(|(deviation, _)| !held_up.contains(deviation))
    }

    /// Why something is missing, by what its author told or could not: whatever is told of while a wire is cut is for
    /// that.
    fn missing(&self, author: Author, told: Option<&'static str>) -> Option<&'static str> {
        let absence = self.absences.of(author.station, author.cycle);
        let cut = absence.filter(|&why| why == Absence::NoCarrier).map(Absence::name);
        told.map(|told| cut.unwrap_or(told)).or_else(|| self.untold(author))
    }

    /// Whose Synchronisation the author's station follows, any of which may be the one.
    fn masters(&self, author: Author) -> impl Iterator<Item = Author> {
        core::iter::once(&MASTER).chain(&self.backups).map(move |&station| Author {
            station,
            slot: None,
            ..author
        })
    }

    /// The same, but those whose Synchronisation of the cycle did not get to it: they moved nothing there.
    fn moved_by(&self, author: Author) -> impl Iterator<Item = Author> {
        self.masters(author).filter(move |master| {
            let from = self.addresses.get(master.station);
            !from.is_some_and(|&from| self.syncs.is_lost(author.station, from, author.cycle))
        })
    }

    /// Where nobody takes its place, nobody has a line without it.
    fn only_master(&self) -> Option<usize> {
        self.backups.is_empty().then_some(MASTER)
    }

    fn untold(&self, Author { station, cycle, .. }: Author) -> Option<&'static str> {
        self.absences.untold(station, cycle).map(Absence::name)
    }

    /// The cause that a station told, or what it told of: the first of these.
    fn told_of(&self, author: Author, kinds: &[EventKind]) -> Option<&'static str> {
        kinds.iter().find_map(|&kind| self.told(author, kind))
    }

    fn told(&self, author: Author, kind: EventKind) -> Option<&'static str> {
        let (_, cause) = self.by_cycle.get(&key(author, kind))?;
        Some(cause.map_or(kind.name(), Cause::name))
    }
}

/// Forgets what was told before this cycle, but for what each station told last: it still holds.
fn keep_newest(told: &mut Vec<(usize, u32, bool)>, cycle: u32) {
    let newest: BTreeMap<usize, usize> =
        told.iter().enumerate().map(|(index, &(station, ..))| (station, index)).collect();
    let mut index = 0;
    told.retain(|&(station, of, _)| {
        index += 1;
        !before(of, cycle) || newest[&station] == index - 1
    });
}

fn key(Author { station, cycle, slot }: Author, kind: EventKind) -> Key {
    (cycle, station, slot, kind)
}

/// What the author's station tells of the cycle as a whole.
fn of_cycle(author: Author) -> Author {
    Author { slot: None, ..author }
}

#[cfg(test)]
mod tests;
