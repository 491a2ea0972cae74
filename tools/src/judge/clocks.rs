//! Clocks that were set while somebody looked: until all follow again, frames are where the clock before says.

use rtmac::tdma::line::LINE_GOOD_FOR;
use rtnet::clock::{EmulatedClock, True};
use rtnet::time::Span;

use super::analysis::Analysis;
use super::explain::Records;
use super::findings::{Author, Finding, FindingKind};
use super::timetable::before;

/// Its name in reports.
pub const NAME: &str = "clock_set";
/// Within so many cycles nobody sends by a clock that was set any more: three Synchronisations that agree are another line,
/// and one is bridged. A station that waits for more, as a later line takes, is silent meanwhile, and says so.
const FOLLOWED_WITHIN: u32 = 4;

/// A clock that was set.
#[derive(Debug)]
struct Set {
    station: usize,
    /// Whether it gave the time: then it has moved all.
    gives: bool,
    step: Span,
    /// The same with what it had been set by shortly before.
    off: Span,
    /// Which cycle it was before, and which it was then.
    cycles: [u32; 2],
    /// The first that may be counted twice: who gave the time goes on with its next one, who only had it with its own.
    again_from: u32,
    /// For so many cycles it may show.
    within: u32,
    /// And so many before: frames that are taken in only later are judged by the new one.
    held_back: u32,
}

/// All that were set.
#[derive(Debug, Default)]
pub struct ClocksSet(Vec<Set>);

/// A station has another clock from now on, set by `step`. It may have it, and frames may be taken in, so many cycles
/// later.
pub fn set_clock(
    (analysis, records): (&mut Analysis, &mut Records),
    (station, clock, step): (usize, EmulatedClock, Span),
    at: True,
    late: u32,
) {
    let (was, gives) = (analysis.cycle_at(at), analysis.has_the_time(station));
    let off = step + was.map_or(Span::ZERO, |was| records.clocks.still_off(station, was));
    analysis.set_clock(station, clock);
    let is_heard = analysis.giver() == station;
    let is = match gives && !is_heard {
        // It shows once that one is heard again.
        true => was.map(|was| was.wrapping_add(off.nanos().div_euclid(analysis.cycle().nanos()) as u32)),
        false => analysis.cycle_at(at),
    };
    if let (Some(was), Some(is), true) = (was, is, step != Span::ZERO) {
        records.clocks.0.push(Set {
            station,
            gives,
            step,
            off,
            cycles: [was, is],
            again_from: if is_heard { was } else { is },
            within: FOLLOWED_WITHIN + late,
            held_back: late,
        });
    }
}

impl ClocksSet {
    /// Whether that is why something was found. What is moved is so by as much as the clock; missing is only what
    /// nobody can tell of: whose cycles are numbered so much later leaves out those between.
    pub fn explain(&self, finding: &Finding, in_time: Span) -> Option<&'static str> {
        let explains = |set: &Set, author: &Author| {
            let of_it = set.gives || set.station == author.station;
            of_it
                && match finding.kind {
                    FindingKind::OutOfSlot => {
                        set.shows(author.cycle) && finding.span.abs() <= set.moves_by() + in_time
                    }
                    FindingKind::Overlap => set.shows(author.cycle),
                    FindingKind::SlotMissed | FindingKind::SyncGap => set.leaves_out(author.cycle),
                    FindingKind::WithoutSync | FindingKind::Repeated => set.counts_again(author.cycle),
                }
        };
        let mut authors = finding.authors.iter().flatten();
        authors.any(|author| self.0.iter().any(|set| explains(set, author))).then_some(NAME)
    }

    /// By how much a station's clock was set that still shows: what it is set by now comes besides.
    fn still_off(&self, station: usize, cycle: u32) -> Span {
        let last = self.0.iter().rfind(|set| set.station == station);
        last.filter(|set| set.shows(cycle)).map_or(Span::ZERO, |set| set.off)
    }

    /// Whose clock was set back, if there may be two cycles of this number for that.
    pub fn counts_again(&self, cycle: u32) -> Option<usize> {
        self.0.iter().find(|set| set.counts_from(set.again_from, cycle)).map(|set| set.station)
    }

    /// Forgets what was before this cycle.
    pub fn forget_before(&mut self, cycle: u32) {
        self.0.retain(|set| set.cycles.into_iter().chain(set.counted_again()).any(|at| !before(at, cycle)));
    }
}

impl Set {
    /// At the most: who has followed it meanwhile, and who has not.
    fn moves_by(&self) -> Span {
        self.step.abs().max(self.off.abs())
    }

    fn shows(&self, cycle: u32) -> bool {
        let since = |at: u32| cycle.wrapping_sub(at.wrapping_sub(self.held_back));
        self.cycles.iter().any(|&at| since(at) <= self.held_back + self.within) || self.counts_again(cycle)
    }

    /// Who gave the time and has set it back is silent until its next cycle comes; others may have gone on meanwhile by the
    /// time that was, and then all count again what they had counted.
    fn counts_again(&self, cycle: u32) -> bool {
        self.counts_from(self.cycles[1], cycle)
    }

    fn counts_from(&self, first: u32, cycle: u32) -> bool {
        let first = first.wrapping_sub(self.held_back);
        self.counted_again().is_some_and(|last| cycle.wrapping_sub(first) <= last.wrapping_sub(first))
    }

    /// The last cycle that may be counted for that: as many behind the one that it was as it was set back by.
    fn counted_again(&self) -> Option<u32> {
        let [was, is] = self.cycles;
        let is_back = self.gives && before(is, was);
        is_back.then(|| was.wrapping_add(was.wrapping_sub(is)).wrapping_add(self.within))
    }

    fn leaves_out(&self, cycle: u32) -> bool {
        let [was, is] = self.cycles;
        let all = is.wrapping_sub(was);
        let is_far = (all as i32) > LINE_GOOD_FOR;
        self.gives && is_far && cycle.wrapping_sub(was) <= all.wrapping_add(self.within)
    }
}

/// One that was set.
#[cfg(test)]
pub fn set(station: usize, gives: bool, cycles: [u32; 2]) -> ClocksSet {
    let step = Span::from_millis(i64::from(cycles[1].wrapping_sub(cycles[0]) as i32));
    let (off, [again_from, _]) = (step, cycles);
    let (within, held_back) = (FOLLOWED_WITHIN, 0);
    ClocksSet(vec![Set { station, gives, step, off, cycles, again_from, within, held_back }])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn explained(clocks: &ClocksSet, kind: FindingKind, (station, cycle): (usize, u32), by: Span) -> bool {
        let finding = Finding::of(Author { station, cycle, slot: Some(0) }, kind, by);
        clocks.explain(&finding, Span::from_micros(50)).is_some()
    }

    #[test]
    fn a_masters_clock_that_is_set_moves_all_for_some_cycles_and_by_as_much_at_the_most() {
        use FindingKind::{OutOfSlot, Overlap, Repeated, SlotMissed};
        let masters = set(0, true, [100, 105]);
        let five = Span::from_millis(5);
        let late = |cycle| explained(&masters, OutOfSlot, (2, cycle), five);
        assert_eq!([99, 100, 104, 105, 109, 110].map(late), [false, true, true, true, true, false]);
        assert!(explained(&masters, OutOfSlot, (2, 100), -five));
        assert!(!explained(&masters, OutOfSlot, (2, 100), five + Span::from_micros(51)));
        assert!(explained(&masters, Overlap, (2, 100), Span::ZERO));
        assert!(!explained(&masters, SlotMissed, (2, 102), Span::ZERO), "it can tell of that");
        assert!(!explained(&masters, Repeated, (2, 102), Span::ZERO));
    }

    #[test]
    fn who_only_follows_moves_nobody_else_when_its_clock_is_set() {
        let slaves = set(2, false, [100, 101]);
        let hit = |station| explained(&slaves, FindingKind::Overlap, (station, 101), Span::ZERO);
        assert_eq!([2, 3].map(hit), [true, false]);
    }

    #[test]
    fn cycles_that_a_master_leaves_out_for_its_clock_are_missed_for_that_if_they_are_more_than_a_line_is_good_for()
     {
        let missed = |[was, is]: [u32; 2], cycle| {
            explained(&set(0, true, [was, is]), FindingKind::SlotMissed, (2, cycle), Span::ZERO)
        };
        let far = [u32::MAX - 10, 2_000];
        assert_eq!(
            [u32::MAX - 11, u32::MAX - 10, 700, 2_004, 2_005].map(|cycle| missed(far, cycle)),
            [false, true, true, true, false]
        );
        assert!(!missed([2_000, u32::MAX - 10], 1_000), "set back");
        assert!(!missed([100, 100 + LINE_GOOD_FOR as u32], 500), "those are told of");
    }

    #[test]
    fn cycles_that_are_counted_again_since_the_giver_set_its_clock_back_are_found_for_that() {
        let mut back = set(0, true, [105, 100]);
        let found = |clocks: &ClocksSet, kind, cycle| explained(clocks, kind, (2, cycle), Span::ZERO);
        for kind in [FindingKind::Repeated, FindingKind::WithoutSync, FindingKind::Overlap] {
            let found = |cycle| found(&back, kind, cycle);
            // A backup went on to 110 until the giver came to 106 again.
            assert_eq!([99, 100, 106, 114, 115].map(found), [false, true, true, true, false], "{kind:?}");
            assert!(!explained(&set(2, false, [105, 105]), kind, (2, 100), Span::ZERO), "{kind:?}");
        }
        assert!(!found(&set(0, true, [100, 105]), FindingKind::Repeated, 102), "forth");
        back.0[0].held_back = 3;
        assert!(found(&back, FindingKind::Repeated, 97));
    }

    #[test]
    fn what_a_clock_was_set_by_adds_up_as_long_as_it_shows() {
        let mut back = set(0, true, [105, 100]);
        let five = Span::from_millis(5);
        assert_eq!(
            [99, 105, 114, 115].map(|cycle| back.still_off(0, cycle)),
            [Span::ZERO, -five, -five, Span::ZERO]
        );
        assert_eq!(back.still_off(1, 105), Span::ZERO, "another's");
        back.0.extend(set(0, true, [108, 107]).0);
        assert_eq!(back.still_off(0, 109), Span::from_millis(-1), "the last has what was before");
        back.0[1].off = -five * 2;
        let off = |by| explained(&back, FindingKind::OutOfSlot, (2, 108), by);
        assert_eq!([five * 2, five * 2 + Span::from_micros(51)].map(off), [true, false]);
        back.0[1].off = Span::ZERO;
        assert!(
            explained(&back, FindingKind::OutOfSlot, (2, 108), Span::from_millis(1)),
            "it is back where it was"
        );
    }

    #[test]
    fn frames_that_are_taken_in_late_are_judged_by_a_clock_that_was_set_after_they_were_sent() {
        let mut lab = set(0, true, [100, 100]);
        lab.0[0].held_back = 3;
        let hit = |cycle| explained(&lab, FindingKind::Overlap, (2, cycle), Span::ZERO);
        assert_eq!([96, 97, 104, 105].map(hit), [false, true, true, false]);
    }

    #[test]
    fn what_was_set_long_ago_is_forgotten() {
        let mut clocks = set(0, true, [100, 105]);
        clocks.forget_before(105);
        assert!(explained(&clocks, FindingKind::Overlap, (0, 105), Span::ZERO));
        clocks.forget_before(106);
        assert!(!explained(&clocks, FindingKind::Overlap, (0, 105), Span::ZERO));
        // A backup goes on for as long as it was set back by.
        let mut back = set(0, true, [9_000, 4_000]);
        for (before, is_kept) in [(14_004, true), (14_005, false)] {
            back.forget_before(before);
            assert_eq!(explained(&back, FindingKind::Repeated, (0, 14_000), Span::ZERO), is_kept);
        }
    }
}
