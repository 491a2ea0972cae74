//! The running account of a lab that stays: what was found is judged once its records have arrived, and then
//! only counted, so that a lab of days needs no more memory than one of a minute.

use std::collections::{BTreeMap, VecDeque};

use rtnet::clock::True;

use crate::judge::explain::Records;
use crate::judge::findings::{Finding, FindingKind};

/// Findings without a record that are kept to be shown; the rest is only counted.
const SHOWN_AT_MOST: usize = 10;
/// Findings that wait for the records of their cycles. Where a station reports nothing for so long that there are more, the
/// oldest are judged without its records.
const WAITING_AT_MOST: usize = 1_000_000;

/// What was found so far.
#[derive(Default)]
pub struct Tally {
    /// Findings, and up to when stations must have reported before they are judged; oldest first.
    waiting: VecDeque<(True, Vec<Finding>)>,
    /// Two frames on the air at once.
    pub overlaps: u64,
    /// Frames outside their slot.
    pub out_of_slot: u64,
    /// Cycles without a Synchronisation.
    pub syncs_missing: u64,
    /// Findings without a record.
    pub unexplained: u64,
    /// Those with one, by the cause that it tells.
    pub causes: BTreeMap<String, u64>,
    /// The newest of those without.
    pub shown: VecDeque<Finding>,
}

impl Tally {
    /// Takes findings to be judged once all stations have reported up to `at`. `dropped` more had no room.
    pub fn find(&mut self, at: True, found: Vec<Finding>, dropped: u64) {
        self.unexplained += dropped;
        if !found.is_empty() {
            self.waiting.push_back((at, found));
        }
    }

    /// Judges the findings that wait for what stations report up to `reported`.
    pub fn judge(&mut self, reported: True, records: &Records) {
        let mut waiting: usize = self.waiting.iter().map(|(_, found)| found.len()).sum();
        while let Some((at, found)) = self.waiting.front()
            && (*at <= reported || waiting > WAITING_AT_MOST)
        {
            waiting -= found.len();
            let (_, found) = self.waiting.pop_front().unwrap_or_default();
            found.into_iter().for_each(|finding| self.count(finding, records));
        }
    }

    /// So much was missed for this cause.
    pub fn add(&mut self, cause: &str, missed: u64) {
        if missed > 0 {
            *self.causes.entry(cause.into()).or_default() += missed;
        }
    }

    fn count(&mut self, finding: Finding, records: &Records) {
        match finding.kind {
            FindingKind::Overlap => self.overlaps += 1,
            FindingKind::OutOfSlot => self.out_of_slot += 1,
            FindingKind::SyncGap => self.syncs_missing += 1,
            _ => {}
        }
        if let Some(cause) = records.explain(&finding) {
            self.add(cause, 1);
        } else {
            self.unexplained += 1;
            if self.shown.len() == SHOWN_AT_MOST {
                self.shown.pop_front();
            }
            self.shown.push_back(finding);
        }
    }
}

#[cfg(test)]
mod tests {
    use rtnet::discipline::{Cause, EventKind};
    use rtnet::time::Span;

    use super::*;
    use crate::judge::findings::Author;

    fn missed(cycle: u32) -> (Author, Finding) {
        let author = Author { station: 1, cycle, slot: Some(0) };
        (author, Finding::of(author, FindingKind::SlotMissed, Span::ZERO))
    }

    #[test]
    fn a_miss_is_judged_once_its_station_has_reported() {
        let (mut tally, mut records) = (Tally::default(), Records::default());
        let (author, finding) = missed(7);
        tally.find(1_000, vec![finding], 0);
        for reported in [0, 400, 999] {
            tally.judge(reported, &records);
            assert_eq!((tally.unexplained, tally.waiting.len()), (0, 1), "reported up to {reported}");
        }
        records.note(author, EventKind::Overrun, Span::ZERO, Some(Cause::TimerLate));
        tally.judge(1_000, &records);
        assert_eq!((tally.unexplained, tally.waiting.len()), (0, 0));
        assert_eq!(tally.causes["timer_late"], 1);
    }

    #[test]
    fn a_miss_that_no_station_reports_is_unexplained() {
        let (mut tally, records) = (Tally::default(), Records::default());
        tally.find(1_000, vec![missed(7).1], 3);
        tally.find(2_000, vec![missed(8).1], 0);
        tally.judge(1_000, &records);
        assert_eq!((tally.unexplained, tally.waiting.len()), (4, 1));
    }

    #[test]
    fn for_a_silent_station_only_so_many_findings_wait() {
        let (mut tally, records) = (Tally::default(), Records::default());
        tally.find(1_000, vec![missed(7).1; 2], 0);
        tally.find(2_000, vec![missed(8).1; WAITING_AT_MOST], 0);
        tally.judge(0, &records);
        assert_eq!((tally.unexplained, tally.waiting.len()), (2, 1));
    }
}
