//! What comes of a sender's numbered frames: which number is news, and how many are missing.

use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

use serde::{Deserialize, Serialize};

/// Numbers that a restarted sender skips: more than it sends within what a capture ring holds back.
pub const SKIPPED: u64 = 10_000;
/// The least time from one frame to the next: the shortest frame at 1 Gbit/s, with preamble and gap.
const LEAST_NS: u64 = 672;
/// No sender comes to a larger number.
const SEQUENCE_AT_MOST: u64 = 1 << 60;

/// The newest numbers that came. What is queued comes in order, unless its slots are joined or parted meanwhile: what waits
/// stays where it waits, and the next ones may be sooner.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Newest {
    last: Option<u64>,
    /// When the last one came, in ns.
    at: u64,
    /// Bit n: the number n before the last has come; four times what a queue holds.
    came: u128,
}

/// How a frame came that is none of before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Came {
    /// So far behind the last one; 1 is the next.
    Behind(u64),
    /// Later than some that were sent after it: it is not missing any more.
    Late,
}

impl Newest {
    /// The last number that came.
    pub fn last(&self) -> Option<u64> {
        self.last
    }

    /// A number comes, at a time of its receiver's clock in ns, if that is known. `None`: it cannot be genuine. It came
    /// already, or it is further ahead than a sender can come, even with a restart, in the time since the last number.
    pub fn note(&mut self, number: u64, at: Option<u64>) -> Option<Came> {
        (number <= SEQUENCE_AT_MOST).then_some(())?;
        let at = at.unwrap_or(self.at);
        let Some(last) = self.last else {
            // What was before the first one is not missing.
            *self = Self { last: Some(number), at, came: u128::MAX };
            return Some(Came::Behind(1));
        };
        if let Some(step) = number.checked_sub(last) {
            let most = SKIPPED + 1 + at.saturating_sub(self.at) / LEAST_NS;
            (1..=most).contains(&step).then_some(())?;
            let came = self.came.checked_shl(step.min(u32::MAX.into()) as u32).unwrap_or(0);
            *self = Self { last: Some(number), at, came: came | 1 };
            return Some(Came::Behind(step));
        }
        let bit = 1_u128.checked_shl((last - number).min(u32::MAX.into()) as u32)?;
        (self.came & bit == 0).then_some(())?;
        self.came |= bit;
        Some(Came::Late)
    }
}

/// What the control thread may look at while the real-time thread counts.
#[derive(Debug, Default)]
pub struct Arrivals {
    /// Frames received that are what was sent.
    received: AtomicU64,
    /// Frames missing between two that were received.
    missing: AtomicU64,
    /// The sequence number of the first frame received.
    first: AtomicU64,
    /// The numbers that count, if not all do: from the first of these on, and only before the second, if that is not 0.
    within: [AtomicU64; 2],
    /// Frames received with others.
    outside: AtomicU64,
}

/// The same at a moment.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Arrived {
    /// Frames received that are what was sent.
    pub received: u64,
    /// Frames missing between two that were received.
    pub missing: u64,
    /// The sequence number of the first frame received.
    pub first: u64,
}

impl Arrivals {
    /// A frame that is what was sent, behind those that came; none if it cannot be genuine.
    pub(super) fn note(&self, before: &mut Newest, number: u64, at: Option<u64>) -> Option<()> {
        let is_first = before.last().is_none();
        let came = before.note(number, at)?;
        if is_first {
            self.first.store(number, Ordering::Relaxed);
        }
        match came {
            Came::Behind(step) => _ = self.missing.fetch_add(step - 1, Ordering::Relaxed),
            Came::Late => _ = self.missing.fetch_sub(1, Ordering::Relaxed),
        }
        self.received.fetch_add(1, Ordering::Relaxed);
        let [from, until] = self.within.each_ref().map(|number| number.load(Ordering::Relaxed));
        if number < from || (until > 0 && number >= until) {
            self.outside.fetch_add(1, Ordering::Relaxed);
        }
        Some(())
    }

    /// Only frames count that are numbered so, or higher: none of those that came so far is.
    pub fn count_from(&self, number: u64) {
        self.within[0].store(number, Ordering::Relaxed);
        self.outside.store(self.received.load(Ordering::Relaxed), Ordering::Relaxed);
    }

    /// Nor do those from this number on: none has come yet.
    pub fn count_until(&self, number: u64) {
        self.within[1].store(number, Ordering::Relaxed);
    }

    /// The numbers that count, and how many frames came with others.
    pub fn counted(&self) -> (Range<u64>, u64) {
        let [from, until] = self.within.each_ref().map(|number| number.load(Ordering::Relaxed));
        let until = if until > 0 { until } else { u64::MAX };
        (from..until, self.outside.load(Ordering::Relaxed))
    }

    /// As it is now.
    pub fn now(&self) -> Arrived {
        let [received, missing, first] =
            [&self.received, &self.missing, &self.first].map(|count| count.load(Ordering::Relaxed));
        Arrived { received, missing, first }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The counts, and the numbers refused, if the numbers come `ns` nanoseconds apart.
    fn apart(ns: u64, numbers: &[u64]) -> (Arrived, Vec<u64>) {
        let (arrivals, mut newest) = (Arrivals::default(), Newest::default());
        let timed = numbers.iter().zip((1..).map(|n| Some(n * ns)));
        let refused = timed.filter(|&(&number, at)| arrivals.note(&mut newest, number, at).is_none());
        let refused = refused.map(|(&number, _)| number).collect();
        (arrivals.now(), refused)
    }

    fn arrived(numbers: &[u64]) -> (Arrived, Vec<u64>) {
        apart(0, numbers)
    }

    #[test]
    fn what_was_overtaken_is_missing_until_it_comes_and_comes_once() {
        let of = |received, missing| Arrived { received, missing, first: 5 };
        assert_eq!(arrived(&[5, 6, 9, 10]), (of(4, 2), vec![]));
        assert_eq!(arrived(&[5, 6, 9, 10, 7, 8]), (of(6, 0), vec![]));
        assert_eq!(arrived(&[5, 9, 7, 7, 9, 5]), (of(3, 2), vec![7, 9, 5]));
        assert_eq!(arrived(&[5, 7, 4, 0]), (of(2, 1), vec![4, 0]), "nobody listened then");
        assert_eq!(
            arrived(&[5, 5 + 130, 7, 8]),
            (of(3, 128), vec![7]),
            "127 ago is as long as is remembered"
        );
    }

    #[test]
    fn numbers_that_nobody_has_come_to_are_refused() {
        let far = 5 + SKIPPED + 1;
        let expected = Arrived { received: 3, missing: SKIPPED, first: 5 };
        assert_eq!(arrived(&[u64::MAX, 5, far + 1, far, far + 1]), (expected, vec![u64::MAX, far + 1]));
    }

    #[test]
    fn a_number_is_no_further_ahead_than_time_has_passed() {
        // Within 1 ms there is room for 1488 frames.
        let far = 5 + SKIPPED + 1 + 1_488;
        let expected = Arrived { received: 2, missing: far - 6, first: 5 };
        assert_eq!(apart(1_000_000, &[5, far]), (expected, vec![]));
        assert_eq!(apart(1_000_000, &[5, far + 1]).1, [far + 1]);
        // A number that is refused at first is believed once enough time has passed.
        let after_a_minute = 5 + 60_000;
        assert_eq!(apart(20_000_000, &[5, after_a_minute, after_a_minute + 1]).1, [after_a_minute]);
    }

    #[test]
    fn what_comes_late_with_a_number_that_does_not_count_does_not() {
        let (arrivals, mut newest) = (Arrivals::default(), Newest::default());
        let mut come = |numbers: &[u64]| {
            numbers.iter().for_each(|&number| _ = arrivals.note(&mut newest, number, None));
            arrivals.counted()
        };
        assert_eq!(come(&[5, 6]), (0..u64::MAX, 0));
        arrivals.count_from(10);
        assert_eq!(come(&[11, 9, 10, 12]), (10..u64::MAX, 3));
        arrivals.count_until(15);
        assert_eq!(come(&[15, 14, 16]), (10..15, 5));
        assert_eq!(arrivals.now().received, 9);
    }
}
