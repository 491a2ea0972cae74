//! Counts that go on where what counts begins anew: with another filter, or another device.

use crate::netlink::ShapingStatistics;

/// One count.
#[derive(Clone, Copy, Debug, Default)]
pub struct Sum {
    /// Of those that are gone.
    before: u64,
    /// Of the one that is there.
    last: u64,
}

impl Sum {
    /// So many the one that is there has counted.
    pub fn is_now(&mut self, now: u64) {
        // The kernel counts some in 32 bits.
        if now < self.last {
            self.begins_anew();
        }
        self.last = now;
    }

    /// It is gone.
    pub fn begins_anew(&mut self) {
        self.before += std::mem::take(&mut self.last);
    }

    /// Of all.
    pub fn all(&self) -> u64 {
        self.before + self.last
    }
}

/// What all filters have counted.
#[derive(Clone, Copy, Debug, Default)]
pub struct FilterSums {
    /// The one that is there, as the kernel numbers it.
    number: Option<u32>,
    packets: Sum,
    bytes: Sum,
    drops: Sum,
    waiting: u64,
    backlog: u64,
}

impl FilterSums {
    /// As it is now, if there is one. What waited in another that is gone is lost, as is what waited when the device was set
    /// down: Linux counts neither.
    pub fn is_now(&mut self, now: Option<(u32, ShapingStatistics)>, is_up: bool) {
        let (number, statistics) = now.unzip();
        let ShapingStatistics { bytes, packets, drops, waiting, backlog } = statistics.unwrap_or_default();
        if number != self.number {
            self.drops.before += self.waiting;
            for sum in [&mut self.packets, &mut self.bytes, &mut self.drops] {
                sum.begins_anew();
            }
        } else if !is_up {
            let passed_on = packets.saturating_sub(self.packets.last);
            self.drops.before += self.waiting.saturating_sub(waiting + passed_on);
        }
        self.packets.is_now(packets);
        self.bytes.is_now(bytes);
        self.drops.is_now(drops);
        (self.number, self.waiting, self.backlog) = (number, waiting, backlog);
    }

    /// Whether there is one.
    pub fn is_there(&self) -> bool {
        self.number.is_some()
    }

    /// Of all.
    pub fn all(&self) -> ShapingStatistics {
        let [packets, bytes, drops] = [self.packets, self.bytes, self.drops].map(|sum| sum.all());
        ShapingStatistics { bytes, packets, drops, waiting: self.waiting, backlog: self.backlog }
    }
}
