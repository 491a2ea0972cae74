//! When a core does not run its foremost thread: a thread that only reads the clock sees the gaps.
//!
//! At SCHED_FIFO what is left are interrupts and the host; with ordinary scheduling other threads of
//! this machine make gaps, too.

use rtnet::live::clock::{monotonic, sleep_until};
use rtnet::time::Span;

use crate::report::histogram::SignedHistogram;
use crate::wakeups::on_core;

/// A thread that spins for more than 95 % of a second at SCHED_FIFO is throttled by the kernel, and
/// would take that for an outage: it spins so long ...
const BURST: Span = Span::from_millis(70);
/// ... of so long.
const EVERY: Span = Span::from_millis(100);
/// Shorter gaps are no outages: a reading of the clock takes far less, but a timer's interrupt as much.
const SHORTEST: Span = Span::from_micros(5);

/// What was seen.
pub struct Outages {
    /// Lengths of the gaps between two readings of the clock, from 5 us on, in nanoseconds.
    pub lengths: SignedHistogram,
    /// How long the core was watched.
    pub watched: Span,
}

/// Watches a core for about `span`, 70 % of it.
pub fn watch(cpu: usize, span: Span) -> Outages {
    let mut seen = Outages { lengths: SignedHistogram::for_real_time(), watched: Span::ZERO };
    on_core(cpu, || {
        for _ in 0..(span.nanos() / EVERY.nanos()).max(1) {
            let start = monotonic();
            seen.watched = seen.watched + spin(start, &mut seen.lengths);
            sleep_until(start + EVERY.nanos() as u64);
        }
    });
    seen
}

/// Spins from `start` for a burst; returns how long that was.
fn spin(start: u64, lengths: &mut SignedHistogram) -> Span {
    let mut last = start;
    while last - start < BURST.nanos() as u64 {
        let now = monotonic();
        let gap = (now - last) as i64;
        if gap >= SHORTEST.nanos() {
            lengths.record(gap);
        }
        last = now;
    }
    Span::from_nanos((last - start) as i64)
}

impl Outages {
    /// How many gaps of at least this length there were in a second.
    pub fn per_second(&self, least: Span) -> f64 {
        let long = self.lengths.iter().filter(|&(length, _)| length >= least.nanos());
        let count: u64 = long.map(|(_, count)| count).sum();
        count as f64 * 1e9 / self.watched.nanos().max(1) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_core_is_watched_for_seven_tenths_of_the_time() {
        let seen = watch(0, Span::from_millis(200));
        assert!(seen.watched >= BURST * 2, "{:?}", seen.watched);
        assert!(seen.lengths.is_empty() || seen.lengths.min() >= SHORTEST.nanos());
        assert!(seen.per_second(SHORTEST) >= seen.per_second(SHORTEST * 10));
    }
}
