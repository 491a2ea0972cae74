//! Which cycle it is, when it began, and whether it counts.

use rtnet::clock::True;
use rtnet::time::{GlobalTime, Span};

use super::Analysis;
use crate::judge::findings::Author;
use crate::judge::timetable::before;

impl Analysis {
    /// The cycle of the newest Synchronisation.
    pub fn current(&self) -> Option<u32> {
        self.current
    }

    /// The cycle that it is at a true moment, by the master's grid, be there a master or not.
    pub fn cycle_at(&self, at: True) -> Option<u32> {
        let (first, sched) = self.grid?;
        let gone = (self.truth().global(at) - sched).nanos().div_euclid(self.cycle.nanos());
        Some(first.wrapping_add(gone as u32))
    }

    /// A cycle of the master's grid, and its start.
    pub fn grid(&self) -> Option<(u32, GlobalTime)> {
        let current = self.current?;
        Some((current, self.start_of(current)?))
    }

    /// The cycle of a true moment, and how long after its start that is.
    pub fn place(&self, at: True) -> Option<(u32, Span)> {
        let cycle = self.cycle_at(at)?;
        Some((cycle, self.error(at, self.start_of(cycle)?)))
    }

    /// How long after the begin of its slot a frame is on the medium.
    pub fn slot_error(&self, at: True, of: Author) -> Option<Span> {
        let slot = self.timetable.at(of.station, of.slot?, of.cycle)?;
        Some(self.error(at, self.start_of(of.cycle)? + slot.offset))
    }

    /// A cycle's start on the master's clock.
    pub(super) fn start_of(&self, cycle: u32) -> Option<GlobalTime> {
        let (first, sched) = self.grid?;
        Some(sched + self.cycle * i64::from(cycle.wrapping_sub(first) as i32))
    }

    /// Counts from cycle `from` on, for `cycles` cycles.
    pub fn begin(&mut self, from: u32, cycles: u32) {
        self.window = Some((from, cycles));
    }

    /// Cycles that have not passed yet do not count any more.
    pub fn end(&mut self) {
        let counted = self.cycles();
        self.window = self.window.map(|(from, _)| (from, counted));
    }

    /// When the first cycle that counts begins.
    pub fn begin_of_window(&self) -> Option<True> {
        let (from, _) = self.window?;
        Some(self.truth().truth(self.start_of(from)?))
    }

    /// The cycles that were counted: those of the window that have passed.
    pub fn cycles(&self) -> u32 {
        let (Some((from, cycles)), Some(current)) = (self.window, self.current) else { return 0 };
        (current.wrapping_sub(from) as i32).clamp(0, cycles as i32) as u32
    }

    /// The first cycle that counts, and how many are to; none yet.
    pub fn window(&self) -> Option<(u32, u32)> {
        self.window
    }

    /// The first cycle that was counted, and how many were.
    pub fn window_counted(&self) -> (u32, u32) {
        (self.window.map_or(0, |(from, _)| from), self.cycles())
    }

    /// Whether the window has passed.
    pub fn is_complete(&self) -> bool {
        self.window.is_some_and(|(_, cycles)| self.cycles() == cycles)
    }

    /// It is this cycle, though no Synchronisation says so.
    pub fn advance_to(&mut self, cycle: u32) {
        if self.current.is_some_and(|current| before(current, cycle)) {
            self.current = Some(cycle);
        }
    }

    /// Whether what happens in a cycle counts.
    pub(in crate::judge) fn counts(&self, cycle: u32) -> bool {
        self.window.is_some_and(|(from, cycles)| cycle.wrapping_sub(from) < cycles)
    }

    /// How much later than at a moment of global time that is.
    pub fn error(&self, at: True, scheduled: GlobalTime) -> Span {
        Span::from_nanos(at.wrapping_sub(self.truth().truth(scheduled)) as i64)
    }
}
