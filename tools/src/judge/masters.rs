//! Who gave the time when: take-overs, and two who gave it at once.

use rtnet::wire::ethernet::Address;
use serde::{Deserialize, Serialize};

/// Take-overs that are kept one by one.
const TAKEOVERS_AT_MOST: usize = 1_000;

/// Another station gives the time.
#[derive(Clone, Debug, Deserialize, Eq, PartialEq, Serialize)]
pub struct Takeover {
    /// The cycle of its first Synchronisation.
    pub cycle: u32,
    /// Its address.
    pub by: String,
    /// From the last Synchronisation of the one before: 1 is none missing.
    pub cycles: u32,
}

/// What was seen of the masters.
#[derive(Clone, Debug, Default)]
pub struct Masters {
    /// Who sent the last Synchronisation, of which cycle.
    last: Option<(Address, u32)>,
    /// Take-overs, the first ones one by one.
    pub takeovers: Vec<Takeover>,
    /// How many altogether.
    pub takeovers_all: u64,
    /// The longest of them.
    pub takeover_cycles: u32,
    /// The cycle in which two last gave the time, and in how many in a row.
    rivals: Option<(u32, u32)>,
    /// Most such cycles in a row.
    pub rival_cycles: u32,
    /// The last of those.
    pub rivals_in: Option<u32>,
    /// Whether the medium has fallen apart: then each part may have its master.
    pub is_cut: bool,
}

impl Masters {
    /// A Synchronisation, which counts or not.
    pub fn sync(&mut self, from: Address, cycle: u32, counts: bool) {
        let Some((before, last)) = self.last else {
            self.last = Some((from, cycle));
            return;
        };
        let step = cycle.wrapping_sub(last);
        let is_newer = (step as i32) > 0;
        if from != before && counts && !self.is_cut {
            if is_newer {
                self.take_over(Takeover { cycle, by: from.to_string(), cycles: step });
            } else {
                self.meet(cycle);
            }
        }
        if is_newer {
            self.last = Some((from, cycle));
        }
    }

    fn take_over(&mut self, takeover: Takeover) {
        self.takeovers_all += 1;
        self.takeover_cycles = self.takeover_cycles.max(takeover.cycles);
        if self.takeovers.len() < TAKEOVERS_AT_MOST {
            self.takeovers.push(takeover);
        }
    }

    /// Two have sent a Synchronisation in one cycle.
    fn meet(&mut self, cycle: u32) {
        let run = match self.rivals {
            Some((last, run)) if cycle.wrapping_sub(last) <= 1 => run + cycle.wrapping_sub(last),
            _ => 1,
        };
        self.rivals = Some((cycle, run));
        if run > self.rival_cycles {
            (self.rival_cycles, self.rivals_in) = (run, Some(cycle));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const A: Address = Address([2, 0, 0, 0, 0, 1]);
    const B: Address = Address([2, 0, 0, 0, 0, 2]);

    fn seen(syncs: &[(Address, u32)]) -> Masters {
        let mut masters = Masters::default();
        syncs.iter().for_each(|&(from, cycle)| masters.sync(from, cycle, cycle > 7));
        masters
    }

    #[test]
    fn who_gives_the_time_next_is_told_with_the_cycles_between() {
        let masters = seen(&[(B, 6), (A, 7), (A, 8), (B, 9), (B, 10), (A, 13), (A, 14)]);
        let takeovers: Vec<_> = masters.takeovers.iter().map(|t| (t.cycle, t.cycles)).collect();
        assert_eq!((takeovers, masters.takeover_cycles, masters.rival_cycles), (vec![(9, 1), (13, 3)], 3, 0));
    }

    #[test]
    fn two_who_give_the_time_at_once_are_counted_by_cycles_in_a_row() {
        let both = [(A, 8), (B, 8), (A, 9), (B, 9), (A, 10), (A, 11), (B, 11), (A, 12)];
        let masters = seen(&both);
        assert_eq!((masters.takeovers_all, masters.rival_cycles), (0, 2));
        let mut parted = Masters { is_cut: true, ..Masters::default() };
        both.iter().for_each(|&(from, cycle)| parted.sync(from, cycle, true));
        assert_eq!(parted.rival_cycles, 0, "each part has one");
    }
}
