//! What a host does to a station: it wakes it late, and holds it up at the worst moment.

use super::latency::{Latency, nanos};
use super::random::Random;
use crate::time::Span;

/// A host's habits.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct Host {
    /// From a timer to the woken thread.
    pub wake: Latency,
    /// Wake-ups in a million that an outage of the host delays.
    pub outage_ppm: u32,
    /// Longest outage; the lengths are evenly distributed.
    pub longest_outage: Span,
    /// From a frame's instant to the last look at the clock before it is sent.
    pub late: Latency,
    /// From that look to the wire.
    pub send: Latency,
    /// Transmissions in a million that are held up between that look and the wire.
    pub stall_ppm: u32,
    /// Longest such hold-up; the lengths are evenly distributed.
    pub longest_stall: Span,
    /// Whether its kernel drops what would leave later than it may, by more than this.
    pub guard: Option<Span>,
}

impl Host {
    /// Nothing is ever late: every action takes place at its instant.
    pub const IDEAL: Host = Host {
        wake: Latency::NONE,
        outage_ppm: 0,
        longest_outage: Span::ZERO,
        late: Latency::NONE,
        send: Latency::NONE,
        stall_ppm: 0,
        longest_stall: Span::ZERO,
        guard: None,
    };

    /// A stock kernel on a virtual machine: wake-ups of 13 us in the mean, and an outage of up to
    /// 4 ms in about one of 13 000 (0.6 a second among eight stations' 1000 wake-ups).
    pub const VIRTUAL_MACHINE: Host = Host {
        wake: Latency::Exponential(Span::from_micros(13)),
        outage_ppm: 75,
        longest_outage: Span::from_millis(4),
        late: Latency::NONE,
        send: Latency::Uniform(Span::ZERO, Span::from_nanos(400)),
        stall_ppm: 2,
        longest_stall: Span::from_millis(4),
        guard: None,
    };

    pub(super) fn wake_delay(&self, random: &mut Random) -> u64 {
        let outage =
            if random.happens(self.outage_ppm) { random.below(nanos(self.longest_outage)) } else { 0 };
        self.wake.draw(random) + outage
    }

    pub(super) fn send_delay(&self, random: &mut Random) -> u64 {
        let stall = if random.happens(self.stall_ppm) { random.below(nanos(self.longest_stall)) } else { 0 };
        stall + self.send.draw(random)
    }
}
