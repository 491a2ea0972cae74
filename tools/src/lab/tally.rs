//! The running account of a lab that stays: what was found is judged once its records have arrived, and then
//! only counted, so that a lab of days needs no more memory than one of a minute.

use std::collections::{BTreeMap, VecDeque};

use crate::judge::analysis::Analysis;
use crate::judge::explain::Records;
use crate::judge::findings::{Finding, FindingKind};

/// Findings without a record that are kept to be shown; the rest is only counted.
const SHOWN_AT_MOST: usize = 10;

/// What was found so far.
#[derive(Default)]
pub struct Tally {
    /// Found since the last judgement: the records of their cycles may still be on their way.
    waiting: Vec<Finding>,
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
    /// Judges what was found before the last judgement, and takes in what was found since. Records more than
    /// `keep` cycles old are forgotten: what is found so late is unexplained.
    pub fn judge(&mut self, analysis: &mut Analysis, records: &mut Records, keep: u32) {
        for finding in std::mem::take(&mut self.waiting) {
            self.count(finding, records);
        }
        self.unexplained += std::mem::take(&mut analysis.findings_dropped);
        self.waiting = analysis.take_findings();
        if let Some(current) = analysis.current() {
            records.forget_before(current.wrapping_sub(keep));
        }
    }

    /// Judges all there is: nothing more will come.
    pub fn close(&mut self, analysis: &mut Analysis, records: &mut Records) {
        self.judge(analysis, records, u32::MAX / 2);
        self.judge(analysis, records, u32::MAX / 2);
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
