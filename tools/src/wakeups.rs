//! Real-time threads on a core, and how late they wake there.

use std::panic::resume_unwind;
use std::thread;

use rtnet::live::clock::{monotonic, sleep_until};
use rtnet::live::realtime::{RealTime, SLAVE_PRIORITY};
use rtnet::time::Span;

use crate::report::histogram::SignedHistogram;

/// Wake-ups at the begin that do not count: the thread is new.
const SETTLE: u64 = 5;

/// Runs `f` on a thread of its own, set up like a station's real-time thread, and returns with its
/// result what the host refused of that set-up.
pub fn on_core<R: Send>(cpu: usize, f: impl FnOnce() -> R + Send) -> (R, Vec<String>) {
    thread::scope(|scope| {
        let thread = scope.spawn(|| {
            let refused = RealTime { priority: Some(SLAVE_PRIORITY), cpu: Some(cpu) }.apply();
            (f(), refused)
        });
        thread.join().unwrap_or_else(|panic| resume_unwind(panic))
    })
}

/// Lateness of `number` wake-ups of a real-time thread on this core, one a `period`.
pub fn wake_often(cpu: usize, period: Span, number: u64) -> SignedHistogram {
    let mut lateness = SignedHistogram::for_real_time();
    on_core(cpu, || sleep_often(period, number, &mut lateness));
    lateness
}

/// Sleeps to instants a period apart. After an outage longer than the period the missed wake-ups follow at once, each with its
/// own lateness, as each slot has.
fn sleep_often(period: Span, number: u64, lateness: &mut SignedHistogram) {
    let period = period.nanos() as u64;
    let mut due = monotonic();
    for number in 0..SETTLE + number {
        due += period;
        sleep_until(due);
        let late = monotonic().wrapping_sub(due) as i64;
        if number >= SETTLE {
            lateness.record(late);
        }
    }
}
