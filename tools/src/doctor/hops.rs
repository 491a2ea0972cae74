//! How long one thread takes to wake another, on the same core and on another one.

use std::sync::Barrier;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;

use rtnet::live::clock::{monotonic, sleep_until};
use rtnet::live::realtime::{MASTER_PRIORITY, RealTime};
use rtnet::time::Span;

use crate::report::histogram::SignedHistogram;
use crate::wakeups::on_core;

/// From one wake-up to the next: the other core idles in between, as it mostly does.
const PERIOD: Span = Span::from_millis(1);

/// From before the waking call on one core to the other thread running on `to`, in nanoseconds;
/// measures for about `span`. The woken thread goes before the one that wakes it.
pub fn measure(from: usize, to: usize, span: Span) -> SignedHistogram {
    let (called, over, ready) = (AtomicU64::new(0), AtomicBool::new(false), Barrier::new(2));
    let mut took = SignedHistogram::for_real_time();
    thread::scope(|scope| {
        let woken = scope.spawn(|| {
            RealTime { priority: Some(MASTER_PRIORITY), cpu: Some(to) }.apply();
            ready.wait();
            while !over.load(Ordering::Acquire) {
                match called.swap(0, Ordering::AcqRel) {
                    0 => thread::park(),
                    at => took.record(monotonic().saturating_sub(at) as i64),
                }
            }
        });
        let sleeper = woken.thread();
        on_core(from, || {
            // A busy host may start a thread late.
            ready.wait();
            let mut due = monotonic();
            for _ in 0..span.nanos() / PERIOD.nanos() {
                due += PERIOD.nanos() as u64;
                sleep_until(due);
                called.store(monotonic(), Ordering::Release);
                sleeper.unpark();
            }
        });
        over.store(true, Ordering::Release);
        sleeper.unpark();
    });
    took
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thread_is_woken_on_the_same_core() {
        let took = measure(0, 0, Span::from_millis(20));
        assert!((1..=20).contains(&took.len()) && took.min() > 0, "{}", took.len());
    }
}
