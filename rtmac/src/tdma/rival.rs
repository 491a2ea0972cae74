//! Another primary on the medium of an active one, and which of the two stays.

use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::Address;

use super::line::PERIODS;

/// In so many cycles a primary is heard before one with a higher address makes way: once may be a forgery.
const CYCLES_OF_LOWER: u32 = 3;
/// Ours with a higher address has made way by then; what has not is of another kind, or does not hear us.
const CYCLES_OF_ANY: u32 = 10;

/// Who else gives the time.
#[derive(Clone, Copy, Debug)]
pub struct Rival {
    of: Address,
    since: Instant,
    last: Instant,
    /// From the one before that to the last.
    every: Span,
    /// In a row.
    cycles: u32,
}

impl Rival {
    /// Heard at `rx` for the first time.
    pub fn new(of: Address, rx: Instant) -> Self {
        Self { of, since: rx, last: rx, every: Span::ZERO, cycles: 1 }
    }

    /// One more of its Synchronisations. Two in one cycle are one. After a cycle without, it counts anew, unless it has a
    /// longer cycle of its own: comes as long after the last as that came after the one before.
    pub fn heard(&mut self, of: Address, rx: Instant, period: Span) {
        let gone = rx - self.last;
        let is_its_cycle = (gone - self.every).abs() <= self.every / 4 && PERIODS.contains(&gone);
        if of != self.of {
            *self = Self::new(of, rx);
        } else if gone > period * 2 && !is_its_cycle {
            *self = Self { every: gone, ..Self::new(of, rx) };
        } else if gone > period * 3 / 4 {
            (self.last, self.every, self.cycles) = (rx, gone, self.cycles + 1);
        }
    }

    /// Whether a primary with the address `own` makes way for it. A backup makes way by itself, unless it is deaf.
    pub fn outlasts(&self, own: Address, is_backup: bool) -> bool {
        let patience = if self.of < own && !is_backup { CYCLES_OF_LOWER } else { CYCLES_OF_ANY };
        self.cycles >= patience
    }

    /// Whether it was heard in this cycle or the one before, or no longer ago than its own takes.
    pub fn is_heard(&self, now: Instant, period: Span) -> bool {
        now - self.last <= period.max(self.every) * 2
    }

    pub fn address(&self) -> Address {
        self.of
    }

    /// How long it has been heard.
    pub fn lasted(&self, now: Instant) -> Span {
        now - self.since
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: Span = Span::from_millis(1);
    const LOW: Address = address(1);
    const OWN: Address = address(2);
    const HIGH: Address = address(3);

    const fn address(last: u8) -> Address {
        Address([2, 0, 0, 0, 0, last])
    }

    /// Heard in every so many cycles: in how many until it outlasts us.
    fn patience(of: Address, is_backup: bool, every: u32) -> Option<u32> {
        let at = |cycle: u32| Instant::default() + PERIOD * i64::from(cycle);
        let mut rival = Rival::new(of, at(0));
        (1..100).find(|&heard| {
            // Twice in a cycle counts once.
            rival.heard(of, at((heard - 1) * every), PERIOD);
            rival.outlasts(OWN, is_backup)
        })
    }

    #[test]
    fn the_lower_address_stays_and_who_does_not_know_that_outlasts_ours() {
        assert_eq!(patience(LOW, false, 1), Some(CYCLES_OF_LOWER));
        assert_eq!(patience(HIGH, false, 1), Some(CYCLES_OF_ANY));
        assert_eq!(
            patience(LOW, true, 1),
            Some(CYCLES_OF_ANY),
            "a backup that is not deaf is silent by then"
        );
    }

    #[test]
    fn a_rival_whose_cycle_is_longer_or_shorter_counts_by_its_own() {
        // The first two tell of its cycle.
        assert_eq!(patience(LOW, false, 3), Some(CYCLES_OF_LOWER + 1));
        assert_eq!(patience(HIGH, false, 50), Some(CYCLES_OF_ANY + 1));
        let mut rival = Rival::new(HIGH, Instant::default());
        let heard = (1..100).find(|&n| {
            rival.heard(HIGH, Instant::default() + PERIOD * 2 / 5 * n, PERIOD);
            rival.outlasts(OWN, false)
        });
        assert_eq!(heard, Some(18), "of 0.4 cycles every second counts");
    }

    #[test]
    fn now_and_then_is_nobody() {
        let mut rival = Rival::new(LOW, Instant::default());
        for millis in [7, 10, 30, 36, 51, 55, 300, 303] {
            rival.heard(LOW, Instant::default() + PERIOD * millis, PERIOD);
            assert!(!rival.outlasts(OWN, false));
        }
        // Nor is one a day, by the day.
        let day = Span::from_millis(86_400_000);
        for days in 1..20 {
            rival.heard(LOW, Instant::default() + day * days, PERIOD);
            assert!(!rival.outlasts(OWN, false));
        }
    }

    #[test]
    fn who_is_heard_twice_a_cycle_lasts_no_longer_for_that() {
        let mut rival = Rival::new(HIGH, Instant::default());
        (1..10).for_each(|half| {
            rival.heard(HIGH, Instant::default() + PERIOD / 2 * half + Span::from_micros(half), PERIOD)
        });
        assert!(!rival.outlasts(OWN, false), "five cycles are not ten");
    }

    #[test]
    fn another_one_counts_anew() {
        let at = |cycle: u32| Instant::default() + PERIOD * i64::from(cycle);
        let mut rival = Rival::new(LOW, at(0));
        rival.heard(LOW, at(1), PERIOD);
        rival.heard(HIGH, at(2), PERIOD);
        rival.heard(LOW, at(3), PERIOD);
        assert!(!rival.outlasts(OWN, false));
        assert_eq!(rival.lasted(at(4)), PERIOD);
    }
}
