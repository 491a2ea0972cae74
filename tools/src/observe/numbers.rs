//! Which cycle it can be, for an observer that believes no number further than time has passed.
//!
//! ```text
//!   number ▲          o  <- not believed: its cycle cannot have begun
//!          │      x'      the newest that is believed: the anchor's, and one more for each period since
//!          │    x
//!          │  x              o  <- behind: it was seen already, or its master counts anew
//!          └──────────────────────► stamps
//! ```
//!
//! Nor is one whose `sched_xmit` is not of its cycle. Numbers that are not believed are those of a master that counts anew if two follow each other, in time as in number, and
//! none of the others is between.

use rtmac::tdma::line::PERIODS;
use rtnet::clock::True;
use rtnet::time::{GlobalTime, Span};

/// For so many cycles an anchor is kept: clocks drift a fifth of a cycle in them at the most.
const ANCHORED_FOR: i32 = 1_000;

/// How a sync follows those before, how long after the last one it was there, and how long that was to be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Following {
    /// How.
    pub how: Follows,
    /// If both were stamped.
    pub times: Option<[Span; 2]>,
}

/// How a sync follows those before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Follows {
    /// It is the first, or the second of a master that counts anew.
    Anew,
    /// Its cycle is the next one.
    Next,
    /// So many cycles without a sync are between.
    Missing(u32),
    /// Its cycle had one already, or an older one.
    Again,
    /// Its cycle cannot have begun, or not when it says.
    Implausible,
}

/// A sync that was seen.
#[derive(Clone, Copy, Debug)]
struct Seen {
    cycle: u32,
    sched: GlobalTime,
    at: Option<True>,
}

/// The numbers of the syncs that are believed.
#[derive(Debug, Default)]
pub struct Numbers {
    last: Option<Seen>,
    /// Not believed, and seen since the last that was.
    other: Option<Seen>,
    /// One that was not late: later ones are counted from there.
    anchor: Option<(u32, True)>,
    period: Option<Span>,
    /// How often a master has begun to count.
    counts: u64,
}

impl Numbers {
    /// A sync was seen: how it follows the last one that was believed.
    pub fn sync(&mut self, cycle: u32, sched: GlobalTime, at: Option<True>) -> Following {
        let seen = Seen { cycle, sched, at };
        let Some(last) = self.last else {
            self.begin(seen);
            return Following { how: Follows::Anew, times: None };
        };
        let times = seen.times_since(&last);
        let is_longer = times.and_then(as_long_as_said) > self.period;
        let can_be = |ahead: i32, if_unknown| {
            self.can_have_begun(cycle, at).unwrap_or(if_unknown)
                && (self.is_due(sched - last.sched, ahead) || ahead == 1 && is_longer)
        };
        let follows = match cycle.wrapping_sub(last.cycle) as i32 {
            // Without a stamp nobody knows for how many cycles there was time.
            1 if can_be(1, true) => Follows::Next,
            ahead @ 2.. if can_be(ahead, false) => Follows::Missing(ahead as u32 - 1),
            1.. => Follows::Implausible,
            ..=0 => Follows::Again,
        };
        let is_same = cycle == last.cycle && sched == last.sched;
        if matches!(follows, Follows::Next | Follows::Missing(_)) || is_same {
            self.go_on(seen, times.filter(|_| follows == Follows::Next));
            return Following { how: follows, times };
        }
        match self.other.replace(seen).and_then(|other| seen.follows(&other)) {
            Some(times) => {
                self.begin(seen);
                self.period = Some(times[1]);
                Following { how: Follows::Next, times: Some(times) }
            }
            None => Following { how: follows, times: None },
        }
    }

    /// Whether a cycle can have begun at a moment, as far as that is known.
    pub fn can_have_begun(&self, cycle: u32, at: Option<True>) -> Option<bool> {
        let ((anchor, then), period) = (self.anchor?, self.period?);
        // One may seem a little early: it is the next one then.
        let gone = at?.wrapping_sub(then) as i64 / period.nanos() + 1;
        Some(i64::from(cycle.wrapping_sub(anchor) as i32) <= gone)
    }

    /// Whether a sync so many cycles later is to be sent so much later, as far as is known: cycles may become half as long at
    /// once.
    fn is_due(&self, later: Span, cycles: i32) -> bool {
        self.period.is_none_or(|period| (later - period * i64::from(cycles)).abs() <= period / 2)
    }

    /// How often a master has begun to count: numbers of one count have nothing to do with those of another.
    pub fn counts(&self) -> u64 {
        self.counts
    }

    fn begin(&mut self, seen: Seen) {
        self.counts += 1;
        (self.last, self.other) = (Some(seen), None);
        self.anchor = seen.at.map(|at| (seen.cycle, at));
    }

    fn go_on(&mut self, seen: Seen, times: Option<[Span; 2]>) {
        (self.last, self.other) = (Some(seen), None);
        let said =
            times.map(|[_, nominal]| nominal).filter(|said| self.period.is_none() && PERIODS.contains(said));
        if let Some(period) = times.and_then(as_long_as_said).or(said)
            && self.period.is_none_or(|known| (period - known).abs() > known / 1_000)
        {
            self.period = Some(period);
            self.anchor = seen.at.map(|at| (seen.cycle, at));
        }
        let Some((at, period)) = seen.at.zip(self.period) else { return };
        let late = self.anchor.map(|(cycle, then)| {
            let cycles = seen.cycle.wrapping_sub(cycle) as i32;
            (Span::from_nanos(at.wrapping_sub(then) as i64) - period * i64::from(cycles), cycles)
        });
        let is_in_time = |(late, cycles): (Span, i32)| {
            (-period..=Span::ZERO).contains(&late) || cycles >= ANCHORED_FOR && late.abs() <= period / 2
        };
        if late.is_none_or(is_in_time) {
            self.anchor = Some((seen.cycle, at));
        }
    }
}

impl Seen {
    /// How long after another one it was stamped, and was to be sent.
    fn times_since(&self, other: &Seen) -> Option<[Span; 2]> {
        let actual = Span::from_nanos(self.at?.wrapping_sub(other.at?) as i64);
        Some([actual, self.sched - other.sched])
    }

    /// The same, if it is the next one of a master that sent the other.
    fn follows(&self, other: &Seen) -> Option<[Span; 2]> {
        let times = self.times_since(other).filter(|_| self.cycle.wrapping_sub(other.cycle) == 1)?;
        as_long_as_said(times).map(|_| times)
    }
}

/// How long a cycle is by its own account, if it can be, and took about as long.
fn as_long_as_said([actual, nominal]: [Span; 2]) -> Option<Span> {
    (PERIODS.contains(&nominal) && (actual - nominal).abs() <= nominal / 2).then_some(nominal)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const PERIOD: u64 = 1_000_000;

    fn sync(numbers: &mut Numbers, cycle: u32, at: u64) -> Follows {
        numbers.sync(cycle, GlobalTime::from_nanos(u64::from(cycle) * PERIOD), Some(at)).how
    }

    fn running(until: u32) -> Numbers {
        let mut numbers = Numbers::default();
        for cycle in 0..until {
            sync(&mut numbers, cycle, u64::from(cycle) * PERIOD);
        }
        numbers
    }

    #[test]
    fn a_number_goes_no_further_than_time_has_passed() {
        let at = 110 * PERIOD;
        let follows = |cycle| sync(&mut running(100), cycle, at);
        let all = [100, 101, 110, 111, 112, 1 << 30, 99, 3].map(follows);
        let (missing, no) = (Follows::Missing, Follows::Implausible);
        let expected =
            [Follows::Next, missing(1), missing(10), missing(11), no, no, Follows::Again, Follows::Again];
        assert_eq!(all, expected);
    }

    #[test]
    fn a_forged_number_changes_nothing_of_those_that_follow() {
        for forged in [3, 102, 1 << 30, u32::MAX, 1 << 31] {
            let mut numbers = running(100);
            sync(&mut numbers, forged, 99 * PERIOD + 300_000);
            let next = [100, 101].map(|cycle| sync(&mut numbers, cycle, u64::from(cycle) * PERIOD));
            assert_eq!((next, numbers.counts()), ([Follows::Next; 2], 1), "{forged}");
        }
    }

    #[test]
    fn a_late_sync_and_those_behind_it_are_believed() {
        let mut numbers = running(100);
        assert_eq!(sync(&mut numbers, 100, 107 * PERIOD + 900_000), Follows::Next);
        assert_eq!(sync(&mut numbers, 108, 108 * PERIOD), Follows::Missing(7));
        assert_eq!(sync(&mut numbers, 109, 109 * PERIOD), Follows::Next);
    }

    #[test]
    fn a_master_that_counts_anew_is_believed_with_its_second_sync() {
        for first in [7, 1 << 20] {
            let mut numbers = running(100);
            let at = |n: u32| u64::from(100 + n) * PERIOD;
            let follows: Vec<_> = (0..4).map(|n| sync(&mut numbers, first + n, at(n))).collect();
            assert_eq!(follows[1..], [Follows::Next; 3], "{first}");
            assert_eq!(numbers.counts(), 2);
        }
    }

    #[test]
    fn cycles_of_another_length_go_on() {
        let mut numbers = running(100);
        let at = |n: u32| 99 * PERIOD + u64::from(n) * PERIOD * 6 / 5;
        for n in 1..50 {
            let sched = GlobalTime::from_nanos(at(n));
            assert_eq!(numbers.sync(99 + n, sched, Some(at(n))).how, Follows::Next);
        }
        assert_eq!(numbers.can_have_begun(99 + 60, Some(at(59))), Some(true));
        assert_eq!(numbers.can_have_begun(99 + 61, Some(at(59))), Some(false));
    }

    #[test]
    fn syncs_without_a_stamp_go_on_one_by_one() {
        let mut numbers = running(100);
        for cycle in 100..110 {
            let sched = GlobalTime::from_nanos(u64::from(cycle) * PERIOD);
            assert_eq!(numbers.sync(cycle, sched, None).how, Follows::Next);
        }
        assert_eq!(numbers.sync(115, GlobalTime::from_nanos(0), None).how, Follows::Implausible);
        assert_eq!(sync(&mut numbers, 112, 112 * PERIOD), Follows::Missing(2));
    }

    const RUN: u64 = 200;

    /// A sync of each cycle, and forged ones between: when, of which cycle, or how many ahead, and for when.
    fn missing(forged: impl Iterator<Item = (u64, Result<u32, u32>, u64)>) -> u64 {
        let genuine = (0..RUN).map(|cycle| (cycle * PERIOD, cycle as u32, cycle * PERIOD));
        let forged = forged.map(|(at, cycle, sched)| match cycle {
            Ok(wild) => (at, wild, sched),
            Err(ahead) => (at, (at / PERIOD) as u32 + ahead, if sched % 2 == 0 { at } else { sched }),
        });
        let mut all: Vec<_> = genuine.chain(forged).collect();
        all.sort_unstable();
        let mut numbers = Numbers::default();
        let missing =
            |(at, cycle, sched)| match numbers.sync(cycle, GlobalTime::from_nanos(sched), Some(at)).how {
                Follows::Missing(cycles) => u64::from(cycles),
                _ => 0,
            };
        all.into_iter().map(missing).sum()
    }

    fn number() -> impl Strategy<Value = Result<u32, u32>> {
        prop_oneof![any::<u32>().prop_map(Ok), (0..4u32).prop_map(Err)]
    }

    proptest! {
        /// One between each two of the master's may take the number of the next cycle, up to half a cycle early each time, but
        /// numbers are no more than the cycles that passed, and the one that may be about to begin.
        #[test]
        fn forged_syncs_miss_no_more_cycles_than_passed(
            forged in prop::collection::vec((1..PERIOD, number(), any::<u64>()), RUN as usize),
        ) {
            let in_cycles = forged.into_iter().zip(1..).map(|((at, number, sched), cycle)| (cycle * PERIOD + at, number, sched));
            prop_assert!(missing(in_cycles) <= RUN + 1);
        }

        /// Who forges as many as he likes counts anew as often as twice in a cycle of his own, which is as short as cycles can
        /// be; each count is as long as the time that it lasts, and one more.
        #[test]
        fn what_is_missing_is_bounded_by_time(
            forged in prop::collection::vec((0..RUN * PERIOD, number(), any::<u64>()), 0..80),
        ) {
            let cycles = RUN * PERIOD / PERIODS.start().nanos() as u64;
            prop_assert!(missing(forged.into_iter()) <= 2 * cycles + 1);
        }
    }
}
