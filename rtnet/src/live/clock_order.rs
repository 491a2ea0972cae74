//! The way to another clock for a running station: what a scenario does to its clock.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use crate::clock::EmulatedClock;
use crate::time::Span;

/// Anchor, offset, drift.
pub(super) const CLOCK_WORDS: usize = 3;

/// A clock on its way to the loop, which takes it at the begin of a turn and never waits for it.
#[derive(Default)]
pub struct ClockOrder {
    words: [AtomicU64; CLOCK_WORDS],
    is_under_way: AtomicBool,
}

impl ClockOrder {
    /// Gives the station this clock from its next turn on; `false`: the one before has not been taken yet. For one thread.
    pub fn give(&self, clock: &EmulatedClock) -> bool {
        if self.is_under_way.load(Ordering::Acquire) {
            return false;
        }
        for (place, word) in self.words.iter().zip(pack(clock)) {
            place.store(word, Ordering::Relaxed);
        }
        self.is_under_way.store(true, Ordering::Release);
        true
    }

    /// The clock that the station is to have from now on, if it is to have another. For the loop.
    #[inline]
    pub(super) fn take(&self) -> Option<EmulatedClock> {
        if !self.is_under_way.load(Ordering::Acquire) {
            return None;
        }
        let clock = unpack(std::array::from_fn(|i| self.words[i].load(Ordering::Relaxed)));
        self.is_under_way.store(false, Ordering::Release);
        Some(clock)
    }
}

pub(super) fn pack(&EmulatedClock { anchor, offset, drift_ppb }: &EmulatedClock) -> [u64; CLOCK_WORDS] {
    [anchor, offset.nanos() as u64, drift_ppb as u64]
}

pub(super) fn unpack([anchor, offset, drift]: [u64; CLOCK_WORDS]) -> EmulatedClock {
    EmulatedClock { anchor, offset: Span::from_nanos(offset as i64), drift_ppb: drift as i64 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_is_taken_once_and_as_it_was_given() {
        let order = ClockOrder::default();
        assert_eq!(order.take(), None);
        let clock =
            |n: i64| EmulatedClock { anchor: u64::MAX, offset: Span::from_nanos(-n), drift_ppb: -50_000 * n };
        assert!(order.give(&clock(1)));
        assert!(!order.give(&clock(2)), "one at a time");
        assert_eq!((order.take(), order.take()), (Some(clock(1)), None));
        assert!(order.give(&clock(2)));
        assert_eq!(order.take(), Some(clock(2)));
    }
}
