//! What a host does to a station: it wakes it late, and holds it up at the worst moment.

use super::random::Random;
use crate::time::Span;

/// A host's habits. All zero, it is ideal: every action takes place at its instant.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct Host {
    /// Mean of the exponentially distributed time from a timer to the woken thread.
    pub wake_latency: Span,
    /// Wake-ups in a million that an outage of the host delays.
    pub outage_ppm: u32,
    /// Longest outage; the lengths are evenly distributed.
    pub longest_outage: Span,
    /// Largest time from the last look at the clock to the wire; evenly distributed.
    pub send_jitter: Span,
    /// Transmissions in a million that are held up between that look and the wire.
    pub stall_ppm: u32,
    /// Longest such hold-up; the lengths are evenly distributed.
    pub longest_stall: Span,
}

impl Host {
    /// Nothing is ever late.
    pub const IDEAL: Host = Host {
        wake_latency: Span::ZERO,
        outage_ppm: 0,
        longest_outage: Span::ZERO,
        send_jitter: Span::ZERO,
        stall_ppm: 0,
        longest_stall: Span::ZERO,
    };

    /// A stock kernel on a virtual machine: wake-ups of 13 us in the mean, and an outage of up to
    /// 4 ms in about one of 13 000 (0.6 a second among eight stations' 1000 wake-ups).
    pub const VIRTUAL_MACHINE: Host = Host {
        wake_latency: Span::from_micros(13),
        outage_ppm: 75,
        longest_outage: Span::from_millis(4),
        send_jitter: Span::from_nanos(400),
        stall_ppm: 2,
        longest_stall: Span::from_millis(4),
    };

    pub(super) fn wake_delay(&self, random: &mut Random) -> u64 {
        let outage =
            if random.happens(self.outage_ppm) { random.below(nanos(self.longest_outage)) } else { 0 };
        random.exponential(nanos(self.wake_latency)) + outage
    }

    pub(super) fn send_delay(&self, random: &mut Random) -> u64 {
        let stall = if random.happens(self.stall_ppm) { random.below(nanos(self.longest_stall)) } else { 0 };
        stall + if self.send_jitter > Span::ZERO { random.below(nanos(self.send_jitter)) } else { 0 }
    }
}

fn nanos(span: Span) -> u64 {
    span.nanos().max(0) as u64
}
