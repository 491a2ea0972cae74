//! Stations that are there again, and do not know what was while they were not.

use rtnet::discipline::EventKind;
use rtnet::time::Span;

use super::{Absence, MASTER, Records};
use crate::judge::findings::Author;

/// Who follows a line that goes on a little beside comes nearer in each cycle, and is on it after so many: simulated, by
/// 0.3 to 0.5 us of the 20 us that a step limit is.
const COMES_NEARER: u32 = 64;

impl Records {
    /// A station that is there again has no slots before it is locked, and sends in the first that comes then.
    pub(super) fn not_yet(&self, Author { station, cycle, .. }: Author) -> Option<&'static str> {
        let before = cycle.wrapping_sub(1);
        let was_down = self.absences.of(station, before).filter(|&why| why == Absence::Down)?;
        let locked = self.lines.newest_before(station, cycle.wrapping_add(1), true);
        locked.filter(|locked| [before, cycle].contains(locked)).map(|_| was_down.name())
    }

    /// A primary that is there again and hears nobody goes on by its own clock, a little beside the line that its backups
    /// have moved meanwhile.
    pub(super) fn begun_beside(&self, author: Author, beside: Span) -> Option<&'static str> {
        let may_be = !self.backups.is_empty() && beside.abs() <= self.step_limit;
        let mut since = (0..=COMES_NEARER).map(|ago| author.cycle.wrapping_sub(ago)).filter(|_| may_be);
        let begun =
            since.find(|&cycle| self.told(Author::sync(MASTER, cycle), EventKind::MasterActive).is_some())?;
        let mut just_before = self.cycles_ago().map(|ago| self.absences.of(MASTER, begun.wrapping_sub(ago)));
        just_before.find(|&why| why == Some(Absence::Down)).flatten().map(Absence::name)
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{finding, told_of};
    use super::*;
    use crate::judge::findings::{Finding, FindingKind};

    #[test]
    fn a_primary_that_is_there_again_may_begin_a_little_beside_what_its_backups_gave() {
        let [us, ms] = [1, 1_000].map(Span::from_micros);
        let why = |backups: &[usize], (why, until): (Absence, u32), cycle, beside| {
            let backups = backups.to_vec();
            let mut records = Records { backups, cycle: ms, step_limit: us * 20, ..Records::default() };
            records.absences.begin(MASTER, why, 2_000);
            records.absences.end(MASTER, why, until);
            records.note(told_of(2_500, MASTER), EventKind::MasterActive, Span::ZERO, None);
            records.explain(&Finding { span: beside, ..finding(cycle, FindingKind::OutOfSlot, 3) }).is_some()
        };
        let down = (Absence::Down, 2_497);
        assert!([2_500, 2_564].iter().all(|&cycle| why(&[1], down, cycle, -us * 20)), "it is nearer soon");
        assert!([2_499, 2_565].iter().all(|&cycle| !why(&[1], down, cycle, us)), "not yet, and not for long");
        assert!(!why(&[1], down, 2_500, us * 21), "what is farther is a time step, which is told of");
        assert!(!why(&[], down, 2_500, us), "nobody has moved its line");
        assert!(!why(&[1], (Absence::Down, 2_300), 2_500, us), "it was there again long before");
        assert!(!why(&[1], (Absence::Stopped, 2_497), 2_500, us), "who was stopped knows its line");
    }
}
