//! How Linux is held back to what slots allow: a filter in front of the device, which follows them; and what is counted there,
//! which goes on where a filter or a device begins anew.

mod sums;

use std::sync::PoisonError;

use rtnet::wire::ethernet;

use super::super::{Mode, Shaped, Turns};
use super::Vnic;
use crate::netlink::{Link, Links, Refused, Shaping, ShapingStatistics};
use sums::{FilterSums, Sum};

/// The driver's queue: what waits behind the filter, which lets through less than the slots do.
const DRIVER_QUEUE: u32 = 64;
/// Of what slots allow, in per mille: so that a queue forms where Linux feels it, not behind.
const SHAPED: u64 = 985;
/// The filter's queue, in the time that it takes to empty it.
const QUEUE_MILLIS: u64 = 100;
/// At least so many frames.
const QUEUE_LEAST: u64 = 16;
/// What may leave at once after a pause, of the largest frames.
const BURST: u32 = 4;

/// What Linux is held back by.
pub(super) struct HeldBack {
    /// For what it was set last, or tried to be: turns, and the largest frame.
    tried: Option<(Turns, usize)>,
    /// Turns in 1000 seconds when some were known last.
    known: Option<u64>,
    /// What came of it.
    outcome: Result<Shaped, String>,
    /// Whether there was a device at the last look.
    has_device: bool,
    filter: FilterSums,
    queue_full: Sum,
}

impl Default for HeldBack {
    fn default() -> Self {
        let outcome = Err("no cycle is known yet".into());
        let (filter, queue_full) = Default::default();
        Self { tried: None, known: None, outcome, has_device: false, filter, queue_full }
    }
}

/// What is asked of the kernel; tests answer themselves.
trait Kernel {
    fn link(&mut self, index: u32) -> Result<Option<Link>, Refused>;
    fn filter(&mut self, index: u32) -> Result<Option<(u32, ShapingStatistics)>, Refused>;
    fn limit(&mut self, index: u32, shaping: &Shaping) -> Result<Option<Refused>, Refused>;
    fn unlimit(&mut self, index: u32) -> Result<(), Refused>;
}

impl Kernel for Links {
    fn link(&mut self, index: u32) -> Result<Option<Link>, Refused> {
        self.get(index)
    }
    fn filter(&mut self, index: u32) -> Result<Option<(u32, ShapingStatistics)>, Refused> {
        self.bucket(index)
    }
    fn limit(&mut self, index: u32, shaping: &Shaping) -> Result<Option<Refused>, Refused> {
        let only_bytes = self.limit_rate(index, shaping)?;
        self.set_queue_length(index, DRIVER_QUEUE).map(|()| only_bytes)
    }
    fn unlimit(&mut self, index: u32) -> Result<(), Refused> {
        self.unlimit_rate(index)
    }
}

impl Vnic {
    /// Holds Linux back to what slots allow.
    pub(super) fn shape(&mut self) {
        let turns = *self.turns.lock().unwrap_or_else(PoisonError::into_inner);
        let frame = self.frame_len();
        if let Some(refused) = self.held_back.follow(&mut self.links, self.index, turns, frame) {
            self.report(format!("short packets may wait longer in front of '{}': {refused}", self.name));
        }
    }

    /// Looks what the filter and the device have counted.
    pub(super) fn count(&mut self) -> Result<(), Refused> {
        let index = self.device.is_some().then_some(self.index);
        self.held_back.count(&mut self.links, index)
    }

    /// The largest frame of the device as Linux counts it.
    fn frame_len(&self) -> usize {
        match self.options.mode {
            Mode::Tap => self.mtu + ethernet::HEADER_LEN,
            Mode::Tun => self.mtu,
        }
    }
}

impl HeldBack {
    /// Sets the filter, if turns or frames are others. Told is why what waits is not bounded in packets, if it is not.
    fn follow(
        &mut self,
        kernel: &mut impl Kernel,
        index: u32,
        turns: Turns,
        frame: usize,
    ) -> Option<Refused> {
        if self.tried.replace((turns, frame)) == Some((turns, frame)) {
            return None;
        }
        let why = match turns {
            Turns::In1000Seconds(known) => {
                self.known = Some(known);
                None
            }
            Turns::AtOnce => {
                self.known = None;
                Some("there are no slots")
            }
            Turns::NoSlot => Some("the station has no slot 1 or 0 for it"),
            Turns::NoCycle if self.known.is_none() => Some("no cycle is known yet"),
            Turns::NoCycle => Some("no cycle is known any more"),
        };
        let mut only_bytes = None;
        let set = match self.known {
            // Nothing leaves meanwhile, and what waits would be lost with the filter: it stays.
            Some(known) => {
                let shaping = shaping(known, frame);
                kernel.limit(index, &shaping).map(|why_not_packets| {
                    only_bytes = why_not_packets;
                    let as_before = why.map(str::to_owned);
                    Ok(Shaped { bytes_per_second: shaping.bytes_per_second, as_before })
                })
            }
            None => self
                .count(kernel, Some(index))
                .and_then(|()| kernel.unlimit(index))
                .map(|()| Err(why.unwrap_or_default().into())),
        };
        self.outcome = set.unwrap_or_else(|refused| Err(format!("{refused}: `rtnet vnic up` tries again")));
        only_bytes
    }

    /// Whatever it was set to, it is set again.
    pub(super) fn try_again(&mut self) {
        self.tried = None;
    }

    /// Looks what filter and device have counted, if there is a device.
    fn count(&mut self, kernel: &mut impl Kernel, index: Option<u32>) -> Result<(), Refused> {
        let link = index.map(|index| kernel.link(index)).transpose()?.flatten();
        self.has_device = link.is_some();
        let Some(link) = link else {
            self.filter.is_now(None, false);
            self.queue_full.begins_anew();
            return Ok(());
        };
        self.queue_full.is_now(link.statistics.send_dropped);
        self.filter.is_now(kernel.filter(link.index)?, link.is_up);
        Ok(())
    }

    /// What holds Linux back, or why nothing does, as of the last look.
    pub(super) fn shaping(&self) -> Result<Shaped, String> {
        match &self.outcome {
            _ if !self.has_device => Err("there is no device".into()),
            Ok(_) if !self.filter.is_there() => {
                Err("somebody has taken the filter away: `rtnet vnic up` puts it back".into())
            }
            outcome => outcome.clone(),
        }
    }

    /// What all filters have counted.
    pub(super) fn filter(&self) -> ShapingStatistics {
        self.filter.all()
    }

    /// Frames for which the drivers' queues had no room.
    pub(super) fn queue_full(&self) -> u64 {
        self.queue_full.all()
    }
}

/// What Linux is fed where so many of the largest frames may leave in 1000 seconds, in bytes a second: a little less than those
/// hold, and at least 1. A small one takes a turn, too.
pub fn fed(turns: u64, frame: usize) -> u64 {
    (turns * SHAPED / 1000 * frame as u64 / 1000).max(1)
}

fn shaping(turns: u64, frame: usize) -> Shaping {
    let bytes_per_second = fed(turns, frame);
    let limit = (turns * QUEUE_MILLIS / 1_000_000).max(QUEUE_LEAST) as u32;
    Shaping { bytes_per_second, burst: BURST * frame as u32, longest: frame as u16, limit }
}

#[cfg(test)]
mod tests;
