//! Which findings have a record of the same cycle and slot, or of an earlier turn whose frame it was that came late:
//! what a station noticed itself is explained, what it did not is not. A slot that was silent for want of a sync needs the
//! record of why there was none. What a station missed that was not there is explained by its absence only if it could not
//! tell of it later.

use std::collections::{BTreeMap, BTreeSet};

use rtmac::tdma::{HOLDOVER_CYCLES, bridged_below, schedule};
use rtnet::discipline::{Cause, Channel, EventKind};
use rtnet::time::Span;
use rtnet::wire::ethernet::Address;

use super::absences::{Absence, Absences};
use super::clocks::{self, ClocksSet};
use super::cuts::Cuts;
use super::findings::{Author, Finding, FindingKind};
use super::spells::Spells;
use super::syncs::{Syncs, sync_of};
use super::timetable::before;
use crate::report::figures::Role;
use crate::scenario::{Scenario, StationPlan};

pub use held_up::HELD_UP_FOR;
use held_up::nearest_turns;

/// A lab's first station is its master.
const MASTER: usize = 0;
/// A sync that is missing is bridged for so many cycles.
const BRIDGED: u32 = HOLDOVER_CYCLES as u32;

/// By what a slot is missed.
const MISSED_BY: [EventKind; 8] = [
    EventKind::Overrun,
    EventKind::GuardDropped,
    EventKind::SendFailed,
    EventKind::TurnLeft,
    EventKind::SlotEmpty,
    EventKind::CalibrationTurn,
    EventKind::AnswerTurn,
    EventKind::ScheduleUnsure,
];
/// By what a cycle has no Synchronisation.
const NO_SYNC_BY: [EventKind; 3] = [EventKind::SyncSkipped, EventKind::SyncDropped, EventKind::SendFailed];

/// What the stations told of themselves, and when they could not.
#[derive(Debug, Default)]
pub struct Records {
    by_cycle: BTreeMap<Key, (Span, Option<Cause>)>,
    /// When stations told that they have a line, or none any more.
    lines: Spells,
    /// When backups told that they give the time, or do so no more.
    reigns: Spells,
    /// Synchronisations, as far as somebody knows which were lost on their way to a station.
    syncs: Syncs,
    /// Whose address is which, by station.
    addresses: Vec<Address>,
    /// From one cycle's start to the next.
    cycle: Span,
    /// How long after its instant a frame that is not held up is sent, and another behind it.
    in_time: Span,
    /// What is beside a line by no more is taken for the same.
    step_limit: Span,
    /// Who may give the time instead of the master.
    backups: Vec<usize>,
    /// Who may send frames that do not say of which turn they are, of sockets or tunnelled ones; and how soon one of its
    /// turns can follow another.
    unmarked: Vec<(usize, Span)>,
    /// When stations were not there.
    pub absences: Absences,
    /// Whose clocks were set.
    pub clocks: ClocksSet,
    /// When the medium had fallen in two.
    pub cuts: Cuts,
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
        let unmarked = |plan: &StationPlan| plan.ip.is_some() || plan.has_tunnel();
        let unmarked = scenario.stations.iter().enumerate().filter(|(_, plan)| unmarked(plan));
        let unmarked = unmarked.map(|(of, plan)| (of, nearest_turns(plan, scenario.cycle))).collect();
        let addresses = (0..scenario.stations.len()).map(|station| scenario.address(station)).collect();
        let step_limit = schedule::step_limit(scenario.guard);
        Self { cycle: scenario.cycle, in_time, step_limit, backups, unmarked, addresses, ..Self::default() }
    }

    /// The network has other slots, and a cycle of its own, now; what is looked for may be of before.
    pub fn follow(&mut self, scenario: &Scenario) {
        self.cycle = scenario.cycle;
        self.step_limit = schedule::step_limit(scenario.guard).max(self.step_limit);
        for (station, nearest) in &mut self.unmarked {
            *nearest = nearest_turns(&scenario.stations[*station], scenario.cycle).min(*nearest);
        }
    }

    /// A station noticed something in a cycle, in one of its slots or none. Of several the longest is kept.
    pub fn note(&mut self, author: Author, kind: EventKind, span: Span, cause: Option<Cause>) {
        if matches!(kind, EventKind::Locked | EventKind::LineGivenUp) {
            self.lines.note(author.station, author.cycle, kind == EventKind::Locked);
        }
        if matches!(kind, EventKind::TookOver | EventKind::SteppedDown) {
            self.reigns.note(author.station, author.cycle, kind == EventKind::TookOver);
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
        self.clocks.forget_before(cycle);
        self.cuts.forget_before(cycle);
        self.syncs.forget_before(cycle);
        self.lines.forget_before(cycle);
        self.reigns.forget_before(cycle);
    }

    /// All that are kept, each with its kind.
    pub fn all(&self) -> impl Iterator<Item = (EventKind, Record)> {
        self.by_cycle.iter().map(|(&(cycle, station, _, kind), &(span, cause))| {
            (kind, Record { cycle, station, span, cause })
        })
    }

    /// Slots that stations told to have missed, in such cycles, each once.
    pub fn slots_missed(&self, is_such: impl Fn(u32) -> bool) -> BTreeSet<Author> {
        let is_miss = |kind| kind == EventKind::SlotSilent || MISSED_BY.contains(&kind);
        let told = self
            .by_cycle
            .keys()
            .filter(|&&(cycle, _, slot, kind)| slot.is_some() && is_miss(kind) && is_such(cycle));
        told.map(|&(cycle, station, slot, _)| Author { station, cycle, slot }).collect()
    }

    /// Why something was found, by the cause's name, if a station involved, or the master whose time they follow,
    /// has told of it, or could not; or a clock was set, or the medium had fallen in two.
    pub fn explain(&self, finding: &Finding) -> Option<&'static str> {
        self.told_why(finding)
            .or_else(|| self.clocks.explain(finding, self.in_time))
            .or_else(|| self.cuts.explain(finding, self.cycle, self.in_time))
    }

    fn told_why(&self, finding: &Finding) -> Option<&'static str> {
        let mut authors = finding.authors.iter().flatten().copied();
        match finding.kind {
            FindingKind::OutOfSlot => authors.find_map(|author| {
                self.held_up(author, finding.span)
                    .or_else(|| self.of_an_earlier_turn(author, finding.span))
                    .or_else(|| self.moved_by(author).find_map(|master| self.held_up(master, finding.span)))
                    .or_else(|| self.held_up_twice(author, finding.span))
                    .or_else(|| self.moved_to_another_turn(author, finding.span))
                    .or_else(|| self.last_words(author))
                    .or_else(|| self.begun_beside(author, finding.span))
            }),
            FindingKind::Overlap => authors
                .find_map(|author| {
                    self.stalled(author)
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
                .or_else(|| self.told_of(Author::sync(MASTER, finding.cycle), &NO_SYNC_BY))
                // It came when that of a later cycle had been there.
                .or_else(|| {
                    let mut masters = self.masters(Author::sync(MASTER, finding.cycle));
                    masters.find_map(|of| self.held_up(of, self.cycle / 2))
                })
                .or_else(|| self.next_reign(finding))
                .or_else(|| self.both_made_way(finding))
                .or_else(|| finding.authors.iter().flatten().find_map(|author| self.another_time(*author))),
            FindingKind::SlotMissed => authors.find_map(|author| {
                // Who is gone is silent for that, not for want of a sync.
                let gone =
                    || self.untold(author).filter(|_| self.told(author, EventKind::SlotSilent).is_none());
                let told = self.told_of(author, &MISSED_BY).or_else(|| self.unmarked_frame(author));
                let told =
                    told.or_else(gone).or_else(|| self.not_yet(author)).or_else(|| self.silence(author));
                self.missing(author, told)
            }),
            // One that was held up for so long that its slot was taken for missed; and a backup that heard nobody.
            FindingKind::Repeated => authors.find_map(|author| {
                let reigns = self.reigns.holds(author.station, author.cycle).then_some(Cause::NoSync.name());
                self.stalled(author).or(reigns).or_else(|| self.moved_to_another_turn(author, Span::ZERO))
            }),
            // Who gives the time needs no sync, though nobody heard its own while another's was the last. What was held up
            // had the sync of its own turn.
            FindingKind::WithoutSync => authors.find_map(|author| {
                let may_give = author.station == MASTER || self.backups.contains(&author.station);
                self.gave_time_itself(author)
                    .or_else(|| self.last_words(author).filter(|_| may_give))
                    .or_else(|| self.of_an_earlier_turn(author, Span::ZERO))
            }),
        }
    }

    /// What a station had to tell of its last moments went with it.
    fn last_words(&self, author: Author) -> Option<&'static str> {
        self.untold(author).filter(|&why| why == Absence::Down.name())
    }

    /// A station that was silent did what it must, but that alone explains nothing: why was there no sync to follow,
    /// of this cycle or of the one before, which bridges it? One that was lost on its way has no record. Without a
    /// master for long, a station has no line to tell by which slots it is silent in. Of two cycles of one number nobody
    /// knows which had one.
    fn silence(&self, author: Author) -> Option<&'static str> {
        let Author { station, cycle, .. } = author;
        let absences = &self.absences;
        let has_no_line = self.follows_nobody(station, cycle);
        let silent =
            self.told(author, EventKind::SlotSilent).or(has_no_line.then_some(Cause::NoSync.name()))?;
        let nobody = self.only_master().is_some_and(|master| absences.just_now(master, cycle));
        let absent = nobody || absences.just_now(station, cycle);
        let doubted = self.told_of(of_cycle(author), &[EventKind::DuplicateCycle]).is_some()
            || self.stepped(author)
            || self.clocks.counts_again(cycle).is_some();
        let without = |ago| {
            let of = Author { cycle: cycle.wrapping_sub(ago), ..author };
            self.without_sync(of) || self.syncs_are_held_up(of, ago)
        };
        let why = has_no_line || absent || doubted || (0..=BRIDGED).all(without);
        why.then_some(silent)
    }

    /// Why a station had a time to follow without a sync of this cycle, or the one that it bridges: its own, which it gave
    /// and was too late to send, or gives from the next cycle on.
    fn gave_time_itself(&self, author: Author) -> Option<&'static str> {
        let skipped = |of| self.told_of(of_cycle(of), &[EventKind::SyncSkipped, EventKind::SyncDropped]);
        let has_stepped_down = self.reigns.has_ended(author.station, author.cycle);
        let bridged = (1..=BRIDGED).filter(|_| has_stepped_down);
        let next = Author { cycle: author.cycle.wrapping_add(1), ..author };
        skipped(author)
            .or_else(|| {
                bridged
                    .map(|ago| Author { cycle: author.cycle.wrapping_sub(ago), ..author })
                    .find_map(skipped)
            })
            .or_else(|| self.told(of_cycle(next), EventKind::MasterActive))
    }

    /// Why a sync is missing whose author has told that it gives the time no more: by a backup that has not heard its
    /// last one, has repeated it, and was to send the next.
    fn next_reign(&self, finding: &Finding) -> Option<&'static str> {
        let author = finding.authors[0].filter(|of| self.backups.contains(&of.station))?;
        let of = |station: usize| Author::sync(station, finding.cycle);
        let mut next = self.syncs.last_senders(finding.cycle).filter_map(|from| {
            let station = self.addresses.iter().position(|address| *address == from)?;
            self.reigns.holds(station, finding.cycle).then_some(of(station))
        });
        let has_stepped_down = self.reigns.has_ended(author.station, author.cycle);
        next.find_map(|next| self.missing(next, self.told_of(next, &NO_SYNC_BY))).filter(|_| has_stepped_down)
    }

    /// Why a sync is missing in one of two cycles of its number: it came in the other, from its author or from who has set
    /// its clock back, or that one has not come to this number yet.
    fn another_time(&self, Author { station, cycle, .. }: Author) -> Option<&'static str> {
        let counts = self.clocks.counts_again(cycle)?;
        let is_sent = |of: usize| {
            let from = self.addresses.get(of);
            from.is_some_and(|&from| !self.syncs.passed_over(from, cycle))
        };
        [station, counts].into_iter().any(is_sent).then_some(clocks::NAME)
    }

    /// Whether a slave has told that it has no line, or had none any more, and has told of none since.
    fn follows_nobody(&self, station: usize, cycle: u32) -> bool {
        let followed = self.lines.newest_before(station, cycle, true);
        let given_up = self.lines.newest_before(station, cycle.wrapping_add(1), false);
        let gone = self.only_master().into_iter().chain([station]);
        let absent = gone.flat_map(|of| self.absences.without_line(of, cycle));
        let is_newer = |since| followed.is_none_or(|at| !before(since, at));
        station != MASTER && given_up.into_iter().chain(absent).any(is_newer)
    }

    /// Whether somebody told why the author had no sync of this cycle in time, or could not follow it. What one master
    /// did not send is no reason where another's came.
    fn without_sync(&self, author: Author) -> bool {
        let Author { station, cycle, .. } = author;
        let not_sent = || self.masters(author).any(|master| self.told_of(master, &NO_SYNC_BY).is_some());
        self.syncs.is_without(station, cycle)
            || !self.syncs.had(station, cycle)
                && (not_sent() || self.follows_who_is_away(station, cycle) || self.nobody_gives_time(cycle))
            || self.told_of(of_cycle(author), &[EventKind::SyncLate, EventKind::TimeStep]).is_some()
    }

    /// Whether the primary is not there, and no backup has told that it gives the time.
    fn nobody_gives_time(&self, cycle: u32) -> bool {
        let gives = |&backup: &usize| self.reigns.holds(backup, cycle);
        self.absences.of(MASTER, cycle).is_some()
            && !self.backups.is_empty()
            && !self.backups.iter().any(gives)
    }

    /// Whether the one whose Synchronisations a station had is not there.
    fn follows_who_is_away(&self, station: usize, cycle: u32) -> bool {
        let of = self.syncs.follows(station, cycle);
        let of = of.and_then(|of| self.addresses.iter().position(|address| *address == of));
        of.is_some_and(|of| self.absences.of(of, cycle).is_some())
    }

    /// Whether the author reported a time step in this cycle that is not bridged, as that of a delayed sync is.
    fn stepped(&self, author: Author) -> bool {
        let step = self.by_cycle.get(&key(of_cycle(author), EventKind::TimeStep));
        let bridged = Span::ZERO..bridged_below(self.cycle);
        step.is_some_and(|(deviation, _)| !bridged.contains(deviation))
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

fn key(Author { station, cycle, slot }: Author, kind: EventKind) -> Key {
    (cycle, station, slot, kind)
}

/// What the author's station tells of the cycle as a whole.
fn of_cycle(author: Author) -> Author {
    Author { slot: None, ..author }
}

mod again;
mod held_up;
#[cfg(test)]
mod tests;
