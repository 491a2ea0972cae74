//! What the wire of one station does to its frames, in one direction.

use super::latency::{Latency, nanos};
use super::random::Random;
use crate::time::Span;
use crate::wire::ethernet::{EtherType, Header};

/// A direction of a station's wire. By default it does nothing to any frame.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct Link {
    /// RTmac frames in a million that are lost.
    pub lose_control_ppm: u32,
    /// The same for all other frames.
    pub lose_data_ppm: u32,
    /// Frames in a million that come twice.
    pub duplicate_ppm: u32,
    /// Frames in a million of which a bit is not what it was.
    pub corrupt_ppm: u32,
    /// Frames in a million that later ones overtake.
    pub reorder_ppm: u32,
    /// By how much such a frame comes later.
    pub reorder_by: Span,
    /// How much longer than the medium's own time every frame takes.
    pub delay: Latency,
    /// Nothing passes.
    pub down: bool,
}

/// What becomes of one frame on a wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub(super) struct Fate {
    /// How much later than on a wire that does nothing.
    pub later: u64,
    pub comes_twice: bool,
    /// Which bit is not what it was.
    pub corrupt: Option<usize>,
    pub overtaken: bool,
}

impl Link {
    /// What becomes of a frame; `None`: it is lost.
    pub(super) fn carry(&self, frame: &[u8], random: &mut Random) -> Option<Fate> {
        if self.down
            || random.happens(if is_control(frame) { self.lose_control_ppm } else { self.lose_data_ppm })
        {
            return None;
        }
        let overtaken = random.happens(self.reorder_ppm);
        let reordered = if overtaken { nanos(self.reorder_by) } else { 0 };
        let corrupt = random.happens(self.corrupt_ppm);
        Some(Fate {
            later: self.delay.draw(random) + reordered,
            comes_twice: random.happens(self.duplicate_ppm),
            corrupt: corrupt.then(|| random.below(frame.len() as u64 * 8) as usize),
            overtaken,
        })
    }
}

impl Fate {
    /// The byte with the bit that is not what it was.
    pub(super) fn changed_from(&self) -> Option<usize> {
        self.corrupt.map(|bit| bit / 8)
    }

    /// Changes the bit that is not what it was.
    pub(super) fn corrupt(&self, frame: &mut [u8]) {
        if let Some(bit) = self.corrupt {
            frame[bit / 8] ^= 1 << (bit % 8);
        }
    }
}

pub(super) fn is_control(frame: &[u8]) -> bool {
    Header::parse(frame).is_some_and(|(header, _)| header.ether_type() == EtherType::RTMAC)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wire_that_does_nothing_draws_nothing() {
        let (mut random, mut other) = (Random::new(1), Random::new(1));
        assert_eq!(Link::default().carry(&[0; 60], &mut random), Some(Fate::default()));
        assert_eq!(random.bits(), other.bits());
    }

    #[test]
    fn what_always_happens_happens() {
        let link = Link {
            duplicate_ppm: 1_000_000,
            corrupt_ppm: 1_000_000,
            reorder_ppm: 1_000_000,
            reorder_by: Span::from_nanos(70),
            delay: Latency::Constant(Span::from_nanos(5)),
            ..Link::default()
        };
        let mut frame = [0; 60];
        let fate = link.carry(&frame, &mut Random::new(1)).unwrap();
        assert_eq!((fate.later, fate.comes_twice, fate.overtaken), (75, true, true));
        fate.corrupt(&mut frame);
        assert_eq!(frame.iter().map(|byte| byte.count_ones()).sum::<u32>(), 1, "one bit");
        let down = Link { down: true, ..Link::default() };
        assert_eq!(down.carry(&frame, &mut Random::new(1)), None);
    }
}
