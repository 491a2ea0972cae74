//! How Linux is held back to what slots allow: a filter in front of the device, which follows them.

use std::sync::atomic::Ordering;

use rtnet::wire::ethernet;

use super::super::{Mode, Shaped};
use super::Vnic;
use crate::netlink::{Refused, Shaping};

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

impl Vnic {
    /// Holds Linux back to what slots allow.
    pub(super) fn shape(&mut self) {
        let turns = self.turns.load(Ordering::Relaxed);
        if self.tried.replace((turns, self.mtu)) == Some((turns, self.mtu)) {
            return;
        }
        let set = if turns == 0 {
            self.links
                .unlimit_rate(self.index)
                .map(|()| Err("there are no slots: nothing is held back".into()))
        } else {
            self.feed(&shaping(turns, self.frame_len())).map(Ok)
        };
        self.shaped = set.unwrap_or_else(|refused| Err(refused.to_string()));
    }

    /// At so many bytes a second.
    fn feed(&mut self, shaping: &Shaping) -> Result<u64, Refused> {
        if let Some(refused) = self.links.limit_rate(self.index, shaping)? {
            self.report(format!("short packets may wait longer in front of '{}': {refused}", self.name));
        }
        self.links.set_queue_length(self.index, DRIVER_QUEUE)?;
        Ok(shaping.bytes_per_second)
    }

    /// The largest frame of the device as Linux counts it.
    fn frame_len(&self) -> usize {
        match self.options.mode {
            Mode::Tap => self.mtu + ethernet::HEADER_LEN,
            Mode::Tun => self.mtu,
        }
    }

    /// What holds it back, or why nothing does.
    pub(super) fn shaping(&mut self, has_device: bool) -> Result<Result<Shaped, String>, Refused> {
        Ok(match &self.shaped {
            _ if !has_device => Err("there is no device".into()),
            Err(why) => Err(why.clone()),
            &Ok(bytes_per_second) => match self.links.shaping(self.index)? {
                Some(statistics) => Ok(Shaped { bytes_per_second, statistics }),
                None => Err("somebody has taken the filter away".into()),
            },
        })
    }
}

/// What lets through a little less than so many of the largest frames in 1000 seconds: a small one takes a turn, too.
fn shaping(turns: u64, frame: usize) -> Shaping {
    let bytes_per_second = (turns * SHAPED / 1000 * frame as u64 / 1000).max(1);
    let limit = (turns * QUEUE_MILLIS / 1_000_000).max(QUEUE_LEAST) as u32;
    Shaping { bytes_per_second, burst: BURST * frame as u32, longest: frame as u16, limit }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn linux_is_held_back_to_a_little_less_than_the_turns_of_the_slots() {
        let every_millisecond = shaping(1_000_000, 1510);
        assert_eq!(every_millisecond.bytes_per_second, 985 * 1510);
        assert_eq!((every_millisecond.limit, every_millisecond.longest), (100, 1510));
        let seldom = shaping(1_000, 500);
        assert_eq!((seldom.bytes_per_second, seldom.limit, seldom.burst), (492, 16, 2000));
        assert_eq!(shaping(1, 60).bytes_per_second, 1);
    }
}
