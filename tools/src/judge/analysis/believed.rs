//! Which frames are believed. Whoever is on the medium may write any cycle number into a frame: none is believed that is
//! further ahead than time has passed, so that no forged frame makes more cycles, or more misses, than there were.

use std::collections::BTreeMap;

use rtnet::clock::True;
use rtnet::time::Span;
use rtnet::wire::ethernet::Address;

use super::Analysis;
use crate::judge::findings::{Finding, FindingKind};
use crate::judge::timetable::before;

/// A frame may be on the medium a little before its cycle begins: it is of the next one then, but of none behind that.
const EARLY: u32 = 1;

/// Why a Synchronisation is not one of a station that gives the time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Doubt {
    /// No station that may give the time has its sender's address.
    Stranger,
    /// Its cycle cannot have begun yet.
    CycleAhead,
    /// Its cycle is over for longer than a frame can be held up, and a later one has begun since.
    CycleBehind,
}

impl Doubt {
    /// Its name in reports.
    pub const fn name(self) -> &'static str {
        match self {
            Doubt::Stranger => "stranger",
            Doubt::CycleAhead => "cycle_ahead",
            Doubt::CycleBehind => "cycle_behind",
        }
    }
}

/// How many Synchronisations were doubted, and why.
#[derive(Debug, Default)]
pub struct Doubted(BTreeMap<Doubt, u64>);

impl Doubted {
    /// By the reason's name.
    pub fn named(&self) -> BTreeMap<String, u64> {
        self.0.iter().map(|(doubt, n)| (doubt.name().to_owned(), *n)).collect()
    }
}

impl Analysis {
    /// Whether the cycle that a frame says it is of can have begun at `at`.
    pub(super) fn can_have_begun(&self, cycle: u32, at: True) -> bool {
        let Some(grid) = self.grid.as_ref().filter(|_| self.window.is_some()) else { return true };
        let newest = grid.cycle_at(self.givers.latest_at(at)).wrapping_add(EARLY);
        !before(newest, cycle)
    }

    /// A Synchronisation is not what it says, or is nobody's of this network. It counts where it was seen.
    pub(super) fn doubt(&mut self, doubt: Doubt, at: True) {
        if self.cycle_at(at).is_some_and(|cycle| self.counts(cycle)) {
            *self.doubted.0.entry(doubt).or_default() += 1;
        }
    }

    /// A Synchronisation is nobody's turn, whoever sent it: a frame outside its slot, in the cycle in which it was seen.
    pub(super) fn disbelieve(&mut self, doubt: Doubt, from: Address, at: True) {
        self.doubt(doubt, at);
        self.out_of_its_cycle(from, at);
    }

    /// A frame says another cycle than it can be of.
    pub(super) fn out_of_its_cycle(&mut self, from: Address, at: True) {
        let Some((cycle, place)) = self.place(at) else { return };
        if self.counts(cycle) {
            self.strays(from, cycle);
        }
        let (kind, authors) = (FindingKind::OutOfSlot, [None; 2]);
        self.find(Finding { cycle, kind, authors, span: place.max(Span::ZERO) });
    }
}
