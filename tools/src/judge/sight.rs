//! Which cycles the observer could judge: while the wall clock is set, stamps say nothing.

use super::findings::{Finding, FindingKind};

/// Times that are remembered; a wall clock that is set more often is seen as one long time.
const BLIND_MAX: usize = 100_000;

/// What was in sight.
#[derive(Debug, Default)]
pub struct Sight {
    /// Cycles of which not every frame could be judged, first and last.
    blind: Vec<(u32, u32)>,
    /// Whether it is so now.
    is_lost: bool,
}

impl Sight {
    /// From cycle `current` on, until further notice.
    pub fn lose(&mut self, current: u32) {
        if !self.is_lost && self.blind.len() < BLIND_MAX {
            // Further than any window, until the next Synchronisation tells how far.
            self.blind.push((current, current.wrapping_add(i32::MAX as u32)));
        }
        self.is_lost = true;
    }

    /// A Synchronisation is seen, of this cycle.
    pub fn regain(&mut self, cycle: u32) {
        if let (true, Some((_, last))) = (self.is_lost, self.blind.last_mut()) {
            *last = cycle;
            self.is_lost = false;
        }
    }

    /// What is missing from cycles that nobody saw is no finding.
    pub fn shows(&self, finding: &Finding) -> bool {
        let missing = matches!(finding.kind, FindingKind::SlotMissed | FindingKind::SyncGap);
        let in_sight =
            |&(first, last): &(u32, u32)| finding.cycle.wrapping_sub(first) > last.wrapping_sub(first);
        !missing || self.blind.iter().all(in_sight)
    }
}
