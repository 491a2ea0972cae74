//! A station's clock as an affine map of a true one: what the emulator and the simulator give
//! each station so that synchronisation has something to do.

use crate::time::{Instant, Span};

/// A moment of the true clock: virtual time in the simulator, CLOCK_MONOTONIC in the emulator.
/// Nanoseconds.
pub type True = u64;

const BILLION: i128 = 1_000_000_000;

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
    pub fn local(&self, at: True) -> Instant {
        let elapsed = i128::from(at) - i128::from(self.anchor);
        let gained = (elapsed * i128::from(self.drift_ppb)).div_euclid(BILLION);
        let local = i128::from(at) + i128::from(self.offset.nanos()) + gained;
        Instant::from_nanos(local as u64)
    }

    /// The true moment at which this clock reaches `local`: the first at which it shows it or more.
    pub fn truth(&self, local: Instant) -> True {
        // Modulo 2^64, as local times are: a clock far behind a young true one shows huge times.
        let start = self.anchor.wrapping_add_signed(self.offset.nanos());
        let gone = local.nanos().wrapping_sub(start) as i64;
        let scaled = i128::from(gone) * BILLION;
        let rate = BILLION + i128::from(self.drift_ppb);
        let elapsed = scaled.div_euclid(rate) + i128::from(scaled.rem_euclid(rate) != 0);
        (i128::from(self.anchor) + elapsed).clamp(0, i128::from(u64::MAX)) as u64
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
