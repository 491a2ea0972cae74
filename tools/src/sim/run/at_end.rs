//! How stations are when a run ends. One moment does not say it: who misses a Synchronisation repeats it, if it is a
//! backup, and gives the time until it hears the next one; who misses two is not synchronised until then. So all of them are
//! looked at once in each of the last cycles.

use rtmac::tdma::Mastery;
use rtnet::discipline::SyncState;

use super::Run;

/// How one station was in the last cycles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct AtEnd {
    /// Whether it gave the time in all of them.
    pub gives_time: bool,
    /// How it was when it was last synchronised, if it was in any of them.
    pub synchronised: Option<SyncState>,
}

impl AtEnd {
    /// Before anybody has looked.
    pub const UNSEEN: Self = Self { gives_time: true, synchronised: None };

    /// It is looked at once more.
    fn look(&mut self, state: SyncState, gives_time: bool) {
        self.gives_time &= gives_time;
        if is_synchronised(state) {
            self.synchronised = Some(state);
        }
    }
}

/// Locked, or bridging a cycle.
pub(super) fn is_synchronised(state: SyncState) -> bool {
    matches!(state, SyncState::Locked | SyncState::Holdover)
}

impl Run<'_> {
    /// Once in each of the last cycles.
    pub(super) fn look_at_end(&mut self) {
        for id in 0..self.present.len() {
            let status = self.status(id);
            let gives_time = self.present[id] && status.mastery == Some(Mastery::Active);
            self.at_end[id].look(status.state, gives_time);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn after(looks: &[(SyncState, bool)]) -> AtEnd {
        let mut at_end = AtEnd::UNSEEN;
        looks.iter().for_each(|&(state, gives_time)| at_end.look(state, gives_time));
        at_end
    }

    #[test]
    fn backup_that_repeats_one_sync_is_no_master_at_the_end() {
        use SyncState::{Holdover, Locked, Lost};
        assert!(!after(&[(Locked, false), (Locked, false), (Locked, true)]).gives_time);
        assert!(!after(&[(Locked, true), (Locked, false), (Locked, true)]).gives_time);
        assert!(after(&[(Locked, true); 3]).gives_time);
        assert_eq!(after(&[(Locked, false), (Holdover, false), (Lost, false)]).synchronised, Some(Holdover));
        assert_eq!(after(&[(Lost, false), (Locked, false), (Locked, false)]).synchronised, Some(Locked));
        assert_eq!(after(&[(Lost, false); 3]).synchronised, None);
    }
}
