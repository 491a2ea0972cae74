//! What no single frame shows: who gave the time when, for how long two did, and when all were locked again.

use rtmac::wire::{self, Message, Rtmac};
use rtnet::clock::True;
use rtnet::sim::Aired;
use rtnet::wire::ethernet::Address;
use serde::Serialize;

use super::watch::source;

/// Take-overs that are kept one by one.
const TAKEOVERS_AT_MOST: usize = 1_000;

/// Another station gives the time.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Takeover {
    /// The cycle of its first Synchronisation.
    pub cycle: u32,
    /// Its address.
    pub by: String,
    /// From the last Synchronisation of the one before: 1 is none missing.
    pub cycles: u32,
}

/// What was seen of the masters.
#[derive(Debug, Default)]
pub struct Oracle {
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
    /// Whether the medium has fallen apart: then each part may have its master.
    pub is_cut: bool,
    /// When a station that was to be locked was last seen not to be.
    pub unlocked: Option<True>,
    counting: bool,
}

impl Oracle {
    /// From here on all counts.
    pub fn begin(&mut self) {
        *self = Oracle { last: self.last, counting: true, ..Oracle::default() };
    }

    /// A frame is on the air, in this cycle of the grid.
    pub fn aired(&mut self, aired: &Aired<'_>, current: Option<u32>) {
        let Ok(Rtmac::Tdma(Message::Sync { cycle, .. })) = wire::parse(aired.bytes) else { return };
        let Some(from) = source(aired.bytes) else { return };
        let Some((before, last)) = self.last else {
            self.last = Some((from, cycle));
            return;
        };
        let step = cycle.wrapping_sub(last);
        let is_newer = (step as i32) > 0;
        if from != before && self.counting && !self.is_cut {
            if is_newer {
                self.take_over(Takeover { cycle, by: from.to_string(), cycles: step });
            } else {
                self.meet(current.unwrap_or(cycle));
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
        self.rival_cycles = self.rival_cycles.max(run);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rtnet::buf::Pool;
    use rtnet::time::GlobalTime;

    const A: Address = Address([2, 0, 0, 0, 0, 1]);
    const B: Address = Address([2, 0, 0, 0, 0, 2]);

    fn sync(oracle: &mut Oracle, from: Address, cycle: u32) {
        let mut frame = Pool::new(1).take().unwrap();
        let at = GlobalTime::from_nanos(0);
        Message::Sync { cycle, xmit: at, sched: at }.write(Address::BROADCAST, from, &mut frame);
        oracle.aired(&Aired { from: 0, at: 0, until: 1, overlaps: false, bytes: &frame }, Some(cycle));
    }

    #[test]
    fn who_gives_the_time_next_is_told_with_the_cycles_between() {
        let mut oracle = Oracle::default();
        sync(&mut oracle, A, 7);
        oracle.begin();
        for (from, cycle) in [(A, 8), (B, 9), (B, 10), (A, 13), (A, 14)] {
            sync(&mut oracle, from, cycle);
        }
        let seen: Vec<_> = oracle.takeovers.iter().map(|t| (t.cycle, t.cycles)).collect();
        assert_eq!((seen, oracle.takeover_cycles, oracle.rival_cycles), (vec![(9, 1), (13, 3)], 3, 0));
    }

    #[test]
    fn two_who_give_the_time_at_once_are_counted_by_cycles_in_a_row() {
        let mut oracle = Oracle::default();
        sync(&mut oracle, A, 7);
        oracle.begin();
        for (from, cycle) in [(A, 8), (B, 8), (A, 9), (B, 9), (A, 10), (A, 11), (B, 11), (A, 12)] {
            sync(&mut oracle, from, cycle);
        }
        assert_eq!((oracle.takeovers_all, oracle.rival_cycles), (0, 2));
    }
}
