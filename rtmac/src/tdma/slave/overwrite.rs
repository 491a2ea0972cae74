//! A slave without a filter, as RTnet's is: what a Synchronisation says is the line.
//!
//! Cycle, start and offset are overwritten by each, whatever was before: one that was held up, one whose number came
//! before, one of another master. Two things are kept that RTnet does without: no slot is used twice in a cycle whose number
//! is repeated, since its turn has passed; and the period, which two Synchronisations tell, so that silence follows when
//! there are no more. Where numbers go back, or far ahead, slots begin anew; so they do where a loss ends with a number of a
//! cycle that was passed over while it lasted.

use rtnet::discipline::SyncState;
use rtnet::time::Span;
use rtnet::wire::ethernet::Address;

use super::super::line::{Drift, LINE_GOOD_FOR, PERIODS, TimeLine};
use super::super::mark::Mark;
use super::{Followed, Slave, Track};

impl Slave {
    pub(super) fn overwrite(&mut self, from: Address, mark: Mark, age: Span) -> Followed {
        let (before, known) = match &self.track {
            Track::Nothing => (mark, None),
            Track::First(first) => (*first, None),
            Track::On { line, .. } if self.is_numbered_anew(line, &mark) => (mark, None),
            Track::On { line, .. } => {
                let &TimeLine { cycle, sched, offset, .. } = line;
                self.deviation = mark.deviation_from(line);
                (Mark { cycle, sched, offset, sent: Span::ZERO }, Some(line.period))
            }
        };
        let ahead = mark.cycle.wrapping_sub(before.cycle) as i32;
        let Some(period) = mark.period_since(&before, ahead).filter(|&period| age <= period).or(known) else {
            self.track = Track::First(mark);
            return Followed::Pending;
        };
        let Mark { cycle, sched, offset, .. } = mark;
        let line = TimeLine { cycle, start: mark.start(), sched, period, offset, drift: Drift::NONE };
        let goes_on = known.is_some() && (0..=LINE_GOOD_FOR).contains(&ahead);
        if goes_on && from == self.line_of {
            self.disagreement.note(self.deviation);
            self.track = Track::On { line, step: None };
            return Followed::Agrees;
        }
        self.adopt(from, line);
        if goes_on { Followed::Agrees } else { Followed::NewLine }
    }

    /// Whether a loss ends with a number that is behind the line's, and of which no turn was used.
    fn is_numbered_anew(&self, line: &TimeLine, mark: &Mark) -> bool {
        let behind = line.cycle_at(mark.start()).wrapping_sub(mark.cycle) as i32;
        self.state == SyncState::Lost && behind > 0 && line.ahead(mark.cycle) > self.config.holdover as i32
    }
}

impl Mark {
    /// From one cycle's start to the next, as an earlier Synchronisation and this one say, if both clocks say about the same.
    fn period_since(&self, before: &Mark, cycles: i32) -> Option<Span> {
        if !(1..=LINE_GOOD_FOR).contains(&cycles) {
            return None;
        }
        let cycles = i64::from(cycles);
        let (there, here) = ((self.sched - before.sched) / cycles, (self.start() - before.start()) / cycles);
        (PERIODS.contains(&there) && (there - here).abs() <= there / 2).then_some(there)
    }
}
