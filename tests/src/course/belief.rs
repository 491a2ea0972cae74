//! What stations take for the time, for some cycles back: whether the lines of two agree.

use rtmac::tdma::Mastery;
use rtnet::clock::{EmulatedClock, True};
use rtnet::discipline::{Discipline, SyncState, TimeView};
use rtnet::sim::StationId;
use rtnet::time::Span;

use crate::networks::Lab;

/// Looks that are kept: one before and one behind each of the last three cycles, and of the one that is judged.
const LOOKS: usize = 8;

/// What a station takes for the time.
#[derive(Clone, Copy, Debug)]
pub struct Belief {
    time: TimeView,
    clock: EmulatedClock,
    /// Whether it gives it.
    pub is_master: bool,
    is_backup: bool,
}

impl Belief {
    /// A station's, now.
    pub fn of(lab: &Lab, id: StationId, member: StationId) -> Self {
        let there = lab.network.member(member);
        let is_master = lab.status(member).mastery == Some(Mastery::Active);
        let is_backup = lab.plan.backups.iter().any(|&(backup, _)| backup == id);
        Self { time: there.station.discipline().time(), clock: there.clock, is_master, is_backup }
    }

    /// Whether it is locked. What a backup tells late in the cycle is missing for a moment each time.
    pub fn is_locked_to(&self, master: &Belief) -> bool {
        let bridges = self.time.state == SyncState::Holdover && master.is_backup;
        self.time.state == SyncState::Locked || bridges
    }

    /// By how much its cycle began later than that of the same number of another, in true time; `None` unless both have a
    /// line.
    pub fn later_than(&self, other: &Belief, now: True) -> Option<Span> {
        let (next, _) = self.time.next_moment(self.clock.local(now), Span::ZERO, None)?;
        let cycle = next.wrapping_sub(1);
        let begins = |of: &Belief| Some(of.clock.truth(of.time.start_of(cycle)?) as i64);
        Some(Span::from_nanos(begins(self)?.wrapping_sub(begins(other)?)))
    }
}

/// What all stations took for the time in the last cycles; those that are dead, for nothing.
pub struct Beliefs {
    looks: [(True, Vec<Option<Belief>>); LOOKS],
    newest: usize,
    /// Lines agree that are no further apart.
    share: Span,
}

impl Beliefs {
    /// Of so many stations, of which nothing is known.
    pub fn new(stations: usize, share: Span) -> Self {
        let looks = core::array::from_fn(|_| (0, vec![None; stations]));
        Self { looks, newest: 0, share }
    }

    /// Looks at all of them; `members`: which member of the network each is.
    pub fn look(&mut self, lab: &Lab, members: &[Option<StationId>]) {
        self.newest = (self.newest + 1) % LOOKS;
        let (at, seen) = &mut self.looks[self.newest];
        *at = lab.network.now();
        seen.clear();
        let there = members.iter().enumerate();
        seen.extend(there.map(|(id, member)| member.map(|member| Belief::of(lab, id, member))));
    }

    /// What a station took for the time when it was looked at last.
    pub fn of(&self, id: StationId) -> Option<&Belief> {
        self.looks[self.newest].1[id].as_ref()
    }

    /// Who gives the time, of those that are there.
    pub fn masters(&self) -> impl Iterator<Item = &Belief> {
        self.looks[self.newest].1.iter().flatten().filter(|belief| belief.is_master)
    }

    /// By how much the cycles of one begin later than another's.
    pub fn later(&self, one: &Belief, other: &Belief) -> Option<Span> {
        one.later_than(other, self.looks[self.newest].0)
    }

    /// Whether that is nothing but for the clocks' share of a guard band, and for what lies between one master's sync window
    /// and the next one's.
    pub fn agree(&self, one: &Belief, other: &Belief) -> bool {
        self.later(one, other).is_some_and(|later| later.abs() <= self.share)
    }

    /// Whether two were further apart, now or within three cycles.
    pub fn were_apart(&self, one: StationId, other: StationId) -> bool {
        self.looks.iter().any(|(at, seen)| {
            let pair = seen[one].as_ref().zip(seen[other].as_ref());
            let later = pair.and_then(|(one, other)| one.later_than(other, *at));
            later.is_some_and(|later| later.abs() > self.share)
        })
    }
}
