//! How late a thread wakes: absolute sleeps on one core, the core cold and warm in turns.

use rtnet::live::realtime::WarmCore;
use rtnet::time::Span;

use crate::report::histogram::SignedHistogram;
use crate::wakeups::wake_often;

/// From one wake-up to the next.
pub const PERIOD: Span = Span::from_millis(1);
/// Blocks, cold and warm in turns, are about so long at least: a host's bad second falls on both.
const BLOCK: Span = Span::from_millis(500);
/// Each block has a histogram of its own, half a megabyte: there are no more of either state than this.
const PAIRS_MAX: i64 = 12;

/// Actual - programmed wake-up in nanoseconds, block by block.
pub struct Wakeups {
    /// The core idles between wake-ups.
    pub cold: Vec<SignedHistogram>,
    /// It does not; or why it cannot be kept from it.
    pub warm: Result<Vec<SignedHistogram>, String>,
}

/// Measures for about `span` altogether.
pub fn measure(cpu: usize, span: Span) -> Wakeups {
    let pairs = (span.nanos() / (2 * BLOCK.nanos())).clamp(1, PAIRS_MAX);
    let block = span / (2 * pairs);
    let (mut cold, mut warm) = (Vec::new(), Vec::new());
    let mut refused = None;
    for _ in 0..pairs {
        cold.push(wake_often(cpu, PERIOD, number_in(block)));
        match WarmCore::start(cpu) {
            Ok(_warm) => warm.push(wake_often(cpu, PERIOD, number_in(block))),
            Err(line) => refused = Some(line),
        }
    }
    Wakeups { cold, warm: refused.map_or(Ok(warm), Err) }
}

fn number_in(block: Span) -> u64 {
    (block.nanos() / PERIOD.nanos()) as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_wakeup_counts_and_none_is_early() {
        let wakeups = measure(0, Span::from_millis(40));
        let [cold] = &wakeups.cold[..] else { panic!("{} blocks", wakeups.cold.len()) };
        assert_eq!(cold.len(), 20);
        assert!(cold.min() >= 0);
        assert!(wakeups.warm.is_err() || wakeups.warm.is_ok_and(|warm| warm[0].len() == 20));
    }
}
