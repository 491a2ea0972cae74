//! Packages and bytes a second.

use super::Counters;

/// Milliseconds of the shortest time that rates are measured over: a few packages of a shorter one are no rate.
const SHORTEST: u64 = 1_000;

/// Packages and bytes a second over the router's last round, rounded up, so that 0 means none. They count one connection, or all.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Rates {
    /// Packages that came and were passed on.
    pub packages_in: u64,
    /// Their bytes.
    pub bytes_in: u64,
    /// Packages that were queued.
    pub packages_out: u64,
    /// Their bytes.
    pub bytes_out: u64,
}

impl Rates {
    /// The counts so far.
    fn counted(counters: &Counters) -> Self {
        let Counters { packages_in, bytes_in, packages_out, bytes_out, .. } = *counters;
        Self { packages_in, bytes_in, packages_out, bytes_out }
    }

    /// Applies `of` to each two fields.
    fn with(self, other: Self, of: impl Fn(u64, u64) -> u64) -> Self {
        Self {
            packages_in: of(self.packages_in, other.packages_in),
            bytes_in: of(self.bytes_in, other.bytes_in),
            packages_out: of(self.packages_out, other.packages_out),
            bytes_out: of(self.bytes_out, other.bytes_out),
        }
    }
}

/// Measures rates from one round to the next.
#[derive(Debug)]
pub(super) struct Meter {
    /// The start of this round, in milliseconds, and what had been counted by then.
    begun: (u64, Rates),
    /// The rates of the last round; none before the end of the first.
    rates: Option<Rates>,
}

impl Meter {
    pub(super) fn new(now: u64) -> Self {
        Self { begun: (now, Rates::default()), rates: None }
    }

    /// The end of a round, and the start of the next. A connection that is younger than [`SHORTEST`] has its first round later.
    pub(super) fn round(&mut self, counters: &Counters, now: u64) {
        let passed = now - self.begun.0;
        if passed < SHORTEST {
            return;
        }
        let counted = Rates::counted(counters);
        let (_, before) = core::mem::replace(&mut self.begun, (now, counted));
        self.rates = Some(counted.with(before, |now, before| {
            let a_second = (u128::from(now - before) * 1_000).div_ceil(u128::from(passed));
            u64::try_from(a_second).unwrap_or(u64::MAX)
        }));
    }

    pub(super) fn rates(&self) -> Option<Rates> {
        self.rates
    }
}
