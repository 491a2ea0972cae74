//! A station's clock as an affine map of a true one: what the emulator and the simulator give
//! each station so that synchronisation has something to do.

use crate::time::{Instant, Span};

/// A moment of the true clock: virtual time in the simulator, CLOCK_MONOTONIC in the emulator.
/// Nanoseconds.
pub type True = u64;

pub(crate) const BILLION: i64 = 1_000_000_000;

/// `local = true + offset + (true - anchor) * drift`, exact to the nanosecond in both directions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct EmulatedClock {
    /// True time at which only the offset applies.
    pub anchor: True,
    /// Lead over the true clock at the anchor.
    pub offset: Span,
    /// Rate error in parts per billion, above -10^9; positive runs fast.
    pub drift_ppb: i64,
}

impl EmulatedClock {
    /// What this clock shows at a true moment.
    #[inline]
    pub fn local(&self, at: True) -> Instant {
        let elapsed = at.wrapping_sub(self.anchor) as i64;
        let gained = floor_of_product(elapsed, self.drift_ppb, BILLION);
        Instant::from_nanos(at) + self.offset + Span::from_nanos(gained)
    }

    /// The true moment at which this clock reaches `local`: the first at which it shows it or more.
    #[inline]
    pub fn truth(&self, local: Instant) -> True {
        // Modulo 2^64, as local times are: a clock far behind a young true one shows huge times.
        let gone = (local - (Instant::from_nanos(self.anchor) + self.offset)).nanos();
        let gained = floor_of_product(gone, self.drift_ppb, BILLION + self.drift_ppb);
        self.anchor.saturating_add_signed(gone.wrapping_sub(gained))
    }

    /// The clock that shows the same at a true moment, and goes on at another rate.
    pub fn at_rate(&self, at: True, drift_ppb: i64) -> Self {
        Self { anchor: at, offset: self.local(at) - Instant::from_nanos(at), drift_ppb }
    }

    /// The clock that shows so much more, or less.
    pub fn stepped(&self, by: Span) -> Self {
        Self { offset: self.offset + by, ..*self }
    }
}

/// `a * b / c`, rounded down. This stands before every send, where a 128-bit division costs a third of
/// what is ours: it is done only when the product does not fit 64 bits (days from the anchor on).
#[inline]
pub(crate) fn floor_of_product(a: i64, b: i64, c: i64) -> i64 {
    match a.checked_mul(b) {
        Some(product) => product.div_euclid(c),
        None => (i128::from(a) * i128::from(b)).div_euclid(i128::from(c)) as i64,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_clock_100_ppm_fast_gains_100_us_per_second() {
        let clock = EmulatedClock { anchor: 1_000, offset: Span::from_nanos(7), drift_ppb: 100_000 };
        assert_eq!(clock.local(1_000).nanos(), 1_007);
        assert_eq!(clock.local(1_000_001_000).nanos(), 1_000_101_007);
    }

    #[test]
    fn a_clock_that_changes_its_rate_goes_on_from_where_it_was() {
        let clock = EmulatedClock { anchor: 1_000, offset: Span::from_nanos(7), drift_ppb: 100_000 };
        let changed = clock.at_rate(2_000_001_000, -50_000);
        assert_eq!(changed.local(2_000_001_000), clock.local(2_000_001_000));
        assert_eq!(changed.local(3_000_001_000).nanos(), clock.local(2_000_001_000).nanos() + 999_950_000);
        assert_eq!(clock.stepped(Span::from_nanos(-5)).local(1_000).nanos(), 1_002);
    }

    proptest! {
        #[test]
        fn truth_is_the_first_moment_that_shows_the_local_time(
            anchor in 0u64..1 << 50, ahead in 1u64..1 << 50,
            offset in i64::MIN / 4..i64::MAX / 4, drift_ppb in -500_000i64..500_000,
        ) {
            let clock = EmulatedClock { anchor, offset: Span::from_nanos(offset), drift_ppb };
            let local = Instant::from_nanos(anchor.wrapping_add_signed(offset).wrapping_add(ahead));
            let at = clock.truth(local);
            prop_assert!(clock.local(at) - local >= Span::ZERO);
            prop_assert!(clock.local(at - 1) - local < Span::ZERO);
        }
    }
}
