//! Which cycle it is, when it began, and whether it counts.

use rtnet::clock::True;
use rtnet::time::{GlobalTime, Span};

use super::Analysis;
use crate::judge::findings::Author;
use crate::judge::timetable::before;

/// Lengths of cycles that are remembered.
const STRETCHES: usize = 16;

/// The starts of all cycles, which follow from the first one's and from how long they are.
#[derive(Debug)]
pub struct Grid {
    /// In their order; never empty.
    stretches: Vec<Stretch>,
}

/// Cycles of one length.
#[derive(Clone, Copy, Debug)]
struct Stretch {
    first: u32,
    start: GlobalTime,
    length: Span,
}

impl Grid {
    /// Cycles of this length, of which one starts then.
    pub fn new(first: u32, start: GlobalTime, length: Span) -> Self {
        Self { stretches: vec![Stretch { first, start, length }] }
    }

    fn change(&mut self, length: Span, from: u32) {
        if self.stretch(from).length == length {
            return;
        }
        let start = self.start_of(from);
        // What was before the last few is not asked for any more, but for the first.
        if self.stretches.len() == STRETCHES {
            self.stretches.remove(1);
        }
        self.stretches.push(Stretch { first: from, start, length });
    }

    fn stretch(&self, cycle: u32) -> Stretch {
        let has_begun = |stretch: &&Stretch| !before(cycle, stretch.first);
        *self.stretches.iter().rev().find(has_begun).unwrap_or(&self.stretches[0])
    }

    fn start_of(&self, cycle: u32) -> GlobalTime {
        let Stretch { first, start, length } = self.stretch(cycle);
        start + length * i64::from(cycle.wrapping_sub(first) as i32)
    }

    /// The cycle that it is then.
    pub fn cycle_at(&self, now: GlobalTime) -> u32 {
        let has_begun = |stretch: &&Stretch| (now - stretch.start) >= Span::ZERO;
        let stretch = self.stretches.iter().rev().find(has_begun).unwrap_or(&self.stretches[0]);
        let gone = (now - stretch.start).nanos().div_euclid(stretch.length.nanos());
        stretch.first.wrapping_add(gone as u32)
    }
}

impl Analysis {
    /// The cycle of the newest Synchronisation.
    pub fn current(&self) -> Option<u32> {
        self.current
    }

    /// The cycle that it is at a true moment, by the master's grid, be there a master or not.
    pub fn cycle_at(&self, at: True) -> Option<u32> {
        Some(self.grid.as_ref()?.cycle_at(self.truth().global(at)))
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
        Some(self.grid.as_ref()?.start_of(cycle))
    }

    /// From a cycle's start to the next.
    pub(super) fn length_of(&self, cycle: u32) -> Span {
        self.grid.as_ref().map_or(self.cycle, |grid| grid.stretch(cycle).length)
    }

    /// From cycle `from` on they are this long.
    pub(super) fn run_at(&mut self, length: Span, from: u32) {
        if let Some(grid) = &mut self.grid {
            grid.change(length, from);
        }
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

    /// When a cycle begins, by the clock of who gives the time.
    pub fn begin_of(&self, cycle: u32) -> Option<True> {
        Some(self.truth().truth(self.start_of(cycle)?))
    }

    /// When the first cycle that counts begins.
    pub fn begin_of_window(&self) -> Option<True> {
        self.begin_of(self.window?.0)
    }

    /// When the last one that counts is over, by the clock of who gives the time.
    pub fn end_of_window(&self) -> Option<True> {
        let (from, cycles) = self.window?;
        self.begin_of(from.wrapping_add(cycles))
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cycles_of_another_length_begin_where_the_last_of_the_old_one_ends() {
        let start = GlobalTime::from_nanos(1_000_000);
        let mut grid = Grid::new(u32::MAX, start, Span::from_micros(100));
        grid.change(Span::from_micros(250), 4);
        grid.change(Span::from_micros(250), 6);
        grid.change(Span::from_micros(50), 8);
        let begins = |cycle: u32| (grid.start_of(cycle) - start).nanos() / 1_000;
        let cycles = [u32::MAX - 1, u32::MAX, 0, 3, 4, 5, 7, 8, 9];
        assert_eq!(cycles.map(begins), [-100, 0, 100, 400, 500, 750, 1_250, 1_500, 1_550]);
        for cycle in cycles {
            let begin = grid.start_of(cycle);
            assert_eq!(grid.cycle_at(begin), cycle);
            assert_eq!(grid.cycle_at(begin + Span::from_nanos(-1)), cycle.wrapping_sub(1));
        }
    }

    #[test]
    fn of_many_lengths_the_last_ones_are_remembered() {
        let mut grid = Grid::new(0, GlobalTime::from_nanos(0), Span::from_micros(100));
        for i in 1..=100 {
            grid.change(Span::from_micros(100 + 100 * (i64::from(i) % 2)), i * 10);
        }
        assert_eq!(grid.stretches.len(), STRETCHES);
        assert_eq!((grid.start_of(1_000) - grid.start_of(990)).nanos(), 2_000_000);
    }
}
