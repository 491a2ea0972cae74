//! Times at which the medium had fallen in two: either part may have its own master, and its own time, until all follow one
//! again.

use rtmac::tdma::line::DRIFT_PARTS;
use rtnet::time::Span;

use super::findings::{Author, Finding, FindingKind};
use super::timetable::before;

/// Its name in reports.
const NAME: &str = "medium_cut";
/// Within so many cycles nobody sends by another master's line any more: of two backups one waits for two cycles, three
/// Synchronisations that agree are another line, and one is bridged. A station that waits for more, as a later line takes,
/// is silent meanwhile, and says so.
const WHOLE_WITHIN: u32 = 6;
/// A line that another master's is a little beside moves to it little by little, half as fast as two clocks run apart at most.
const SLEWS_FOR_PARTS: u32 = 2;

/// When it had.
#[derive(Debug, Default)]
pub struct Cuts(Vec<Cut>);

#[derive(Debug)]
struct Cut {
    from: u32,
    until: Option<u32>,
}

impl Cuts {
    /// It falls in two in a cycle, or is whole again.
    pub fn note(&mut self, is_cut: bool, cycle: u32) {
        let open = self.0.iter_mut().filter(|cut| cut.until.is_none());
        open.for_each(|cut| cut.until = Some(cycle));
        if is_cut {
            self.0.push(Cut { from: cycle, until: None });
        }
    }

    /// Whether that is why something was found: the parts' times have run apart, by no more than clocks do.
    pub fn explain(&self, finding: &Finding, cycle: Span, in_time: Span) -> Option<&'static str> {
        let explains = |cut: &Cut, author: &Author| {
            let since = author.cycle.wrapping_sub(cut.from);
            let shows = (since as i32) >= 0 && cut.whole_after().is_none_or(|after| since <= after);
            let slews = (since as i32) >= 0 && cut.shown_for().is_none_or(|shown| since <= shown);
            let apart = cycle * i64::from(since) / DRIFT_PARTS + in_time;
            match finding.kind {
                FindingKind::OutOfSlot => slews && finding.span.abs() <= apart,
                FindingKind::Overlap => shows,
                // Who meets another that gives the time hesitates, and the others with it.
                FindingKind::SyncGap | FindingKind::SlotMissed | FindingKind::WithoutSync => {
                    shows && cut.until.is_some_and(|until| before(until, author.cycle))
                }
                FindingKind::Repeated => false,
            }
        };
        let mut authors = finding.authors.iter().flatten();
        authors.any(|author| self.0.iter().any(|cut| explains(cut, author))).then_some(NAME)
    }

    /// Forgets what was before this cycle.
    pub fn forget_before(&mut self, cycle: u32) {
        let is_over =
            |cut: &Cut| cut.shown_for().is_some_and(|shown| before(cut.from.wrapping_add(shown), cycle));
        self.0.retain(|cut| !is_over(cut));
    }
}

impl Cut {
    fn lasted(&self) -> Option<u32> {
        self.until.map(|until| until.wrapping_sub(self.from))
    }

    /// So many cycles after its begin all follow one master.
    fn whole_after(&self) -> Option<u32> {
        self.lasted().map(|lasted| lasted.saturating_add(WHOLE_WITHIN))
    }

    /// And so many after it all are on its line.
    fn shown_for(&self) -> Option<u32> {
        self.lasted()
            .zip(self.whole_after())
            .map(|(lasted, after)| after.saturating_add(lasted / SLEWS_FOR_PARTS))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CYCLE: Span = Span::from_millis(2);
    const IN_TIME: Span = Span::from_micros(50);

    fn explained(cuts: &Cuts, kind: FindingKind, cycle: u32, by: Span) -> bool {
        cuts.explain(&Finding::of(Author { station: 2, cycle, slot: Some(0) }, kind, by), CYCLE, IN_TIME)
            .is_some()
    }

    #[test]
    fn the_parts_of_a_medium_run_apart_as_clocks_do_until_they_follow_one_master_again() {
        let mut cuts = Cuts::default();
        cuts.note(true, 1_000);
        let by = |cuts: &Cuts, cycle, micros| {
            explained(cuts, FindingKind::OutOfSlot, cycle, Span::from_micros(micros))
        };
        assert_eq!([by(&cuts, 999, 0), by(&cuts, 1_000, 50), by(&cuts, 1_000, -51)], [false, true, false]);
        assert_eq!(
            [by(&cuts, 1_500, 250), by(&cuts, 1_500, -250), by(&cuts, 1_500, 251)],
            [true, true, false]
        );
        cuts.note(false, 1_500);
        let overlaps = |cycle| explained(&cuts, FindingKind::Overlap, cycle, Span::ZERO);
        assert_eq!([1_000, 1_506, 1_507].map(overlaps), [true, true, false]);
        let missing = |cycle| explained(&cuts, FindingKind::SyncGap, cycle, Span::ZERO);
        assert_eq!([1_499, 1_500, 1_501, 1_506, 1_507].map(missing), [false, false, true, true, false]);
        assert_eq!(
            [by(&cuts, 1_756, 100), by(&cuts, 1_757, 0)],
            [true, false],
            "a line may have been moved little by little"
        );
        cuts.forget_before(1_756);
        assert!(explained(&cuts, FindingKind::Overlap, 1_506, Span::ZERO));
        cuts.forget_before(1_757);
        assert!(!explained(&cuts, FindingKind::Overlap, 1_506, Span::ZERO));
    }
}
