//! Who gave the time when: take-overs, and two who gave it at once.

use std::collections::VecDeque;

use rtnet::wire::ethernet::Address;
use serde::{Deserialize, Serialize};

use crate::scenario::Scenario;

/// Take-overs that are kept one by one.
const TAKEOVERS_AT_MOST: usize = 1_000;

/// Another station gives the time.
#[derive(Clone, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Takeover {
    /// The cycle of its first Synchronisation.
    pub cycle: u32,
    /// Its address.
    pub by: String,
    /// From the last Synchronisation of the one before: 1 is none missing.
    pub cycles: u32,
}

/// Of two who gave the time at once, the last that are kept.
const RIVALS_AT_MOST: usize = 100;

/// Two who gave the time at once.
#[derive(Clone, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Rivals {
    /// The first cycle in which they did.
    pub cycle: u32,
    /// In how many.
    pub cycles: u32,
    /// Their names; of who is no station, its address.
    pub between: [String; 2],
    /// Which was silent then; none if neither was as long as somebody looked.
    pub silent: Option<String>,
}

/// The same, while it goes on.
#[derive(Clone, Debug)]
struct Meeting {
    cycle: u32,
    cycles: u32,
    between: [Address; 2],
    silent: Option<Address>,
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
    meetings: VecDeque<Meeting>,
    /// Who sent the last Synchronisation, counted or not.
    heard: Option<Address>,
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
        self.outlast(from);
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
                self.meet(cycle, [before, from]);
            }
        }
        if is_newer {
            self.last = Some((from, cycle));
        }
    }

    /// Of two who gave the time at once, one does so alone.
    fn outlast(&mut self, from: Address) {
        let is_alone = self.heard.replace(from) == Some(from);
        if let (true, Some(Meeting { between: [a, b], silent, .. })) = (is_alone, self.meetings.back_mut()) {
            let other = if *a == from { *b } else { *a };
            if [*a, *b].contains(&from) && silent.is_none() {
                *silent = Some(other);
            }
        }
    }

    /// Those who gave the time at once, by name.
    pub fn rivals(&self, scenario: &Scenario) -> Vec<Rivals> {
        let name = |of: Address| {
            let station = (0..scenario.stations.len()).find(|&station| scenario.address(station) == of);
            station.map_or_else(|| of.to_string(), |station| scenario.stations[station].name.clone())
        };
        let named = |&Meeting { cycle, cycles, between, silent }: &Meeting| Rivals {
            cycle,
            cycles,
            between: between.map(name),
            silent: silent.map(name),
        };
        self.meetings.iter().map(named).collect()
    }

    fn take_over(&mut self, takeover: Takeover) {
        self.takeovers_all += 1;
        self.takeover_cycles = self.takeover_cycles.max(takeover.cycles);
        if self.takeovers.len() < TAKEOVERS_AT_MOST {
            self.takeovers.push(takeover);
        }
    }

    /// Two have sent a Synchronisation in one cycle.
    fn meet(&mut self, cycle: u32, between: [Address; 2]) {
        let run = match self.rivals {
            Some((last, run)) if cycle.wrapping_sub(last) <= 1 => run + cycle.wrapping_sub(last),
            _ => 1,
        };
        self.rivals = Some((cycle, run));
        let goes_on = |open: &&mut Meeting| run > 1 && between.iter().all(|of| open.between.contains(of));
        if let Some(open) = self.meetings.back_mut().filter(goes_on) {
            (open.cycles, open.silent) = (run, None);
        } else {
            if self.meetings.len() == RIVALS_AT_MOST {
                self.meetings.pop_front();
            }
            self.meetings.push_back(Meeting { cycle, cycles: 1, between, silent: None });
        }
        if run > self.rival_cycles {
            (self.rival_cycles, self.rivals_in) = (run, Some(cycle));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::Source;

    const A: Address = Address([2, 0, 0, 0, 0, 1]);
    const B: Address = Address([2, 0, 0, 0, 0, 2]);
    const STRANGER: Address = Address([2, 0, 0, 0, 9, 9]);

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

    #[test]
    fn two_who_give_the_time_at_once_are_named_with_the_one_that_was_silent_then() {
        let text = "cycle = \"1ms\"\n[[station]]\nname = \"primary\"\nrole = \"master\"\n\
            [[station]]\nname = \"slave\"\nrole = \"slave\"\n";
        let scenario = Source::new("cell.toml", text).parse().unwrap();
        let primary = scenario.address(0);
        let both = [(primary, 8), (STRANGER, 8), (primary, 9), (STRANGER, 9), (primary, 10), (STRANGER, 10)];
        let named = |more: &[(Address, u32)]| seen(&[&both, more].concat()).rivals(&scenario);
        let rivals = |silent: Option<&str>| Rivals {
            cycle: 8,
            cycles: 3,
            between: ["primary".into(), STRANGER.to_string()],
            silent: silent.map(str::to_owned),
        };
        assert_eq!(named(&[]), [rivals(None)]);
        assert_eq!(named(&[(primary, 11)]), [rivals(None)], "the other's may still come");
        assert_eq!(named(&[(primary, 11), (primary, 12)]), [rivals(Some(&STRANGER.to_string()))]);
        assert_eq!(named(&[(STRANGER, 11), (STRANGER, 12), (STRANGER, 13)]), [rivals(Some("primary"))]);
        let again = named(&[(STRANGER, 11), (STRANGER, 12), (primary, 12), (STRANGER, 13)]);
        assert_eq!((again.len(), again[1].cycle, again[1].cycles), (2, 12, 1));
    }

    #[test]
    fn of_many_rivals_the_last_are_kept() {
        let mut masters = Masters::default();
        for cycle in (0..3_000).step_by(3) {
            [A, B].iter().for_each(|&from| masters.sync(from, cycle, true));
        }
        assert_eq!((masters.meetings.len(), masters.meetings[0].cycle), (RIVALS_AT_MOST, 2_700));
    }
}
