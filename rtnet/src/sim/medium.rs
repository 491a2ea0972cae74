//! The medium: when each frame is on the air, and whether two were there at once.

use super::StationId;
use crate::clock::True;
use crate::time::Span;
use crate::wire::ethernet::{GAP, MIN_FRAME, OVERHEAD};

/// What the medium is like.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Medium {
    /// Bits per second.
    pub rate: u64,
    /// From any station to any other; of a switch, from any station to it.
    pub propagation: Span,
    /// What joins the stations.
    pub joint: Joint,
    /// RTmac frames in a million that one receiver does not hear; each receiver has its own luck.
    pub lose_control_ppm: u32,
    /// The same for all other frames.
    pub lose_data_ppm: u32,
}

/// What joins the stations.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Joint {
    /// All hear a frame as soon as it begins, and two at once are only counted: as an emulator's bridge does.
    #[default]
    Bridge,
    /// A hub, one collision domain: frames whose bits meet there destroy each other, and who sends hears nothing that comes
    /// meanwhile.
    Hub,
    /// A store-and-forward switch with a queue for each port.
    Switch {
        /// From a frame's end to its begin at the other port, if that is free.
        latency: Span,
        /// Frames that wait for a port; one more is dropped.
        queue: usize,
    },
}

impl Default for Medium {
    fn default() -> Self {
        let propagation = Span::from_nanos(500);
        let joint = Joint::Bridge;
        Self { rate: 1_000_000_000, propagation, joint, lose_control_ppm: 0, lose_data_ppm: 0 }
    }
}

/// A frame on the air.
#[derive(Clone, Copy, Debug)]
pub struct Aired<'a> {
    /// Who sent it.
    pub from: StationId,
    /// When its first bit left, in true time.
    pub at: True,
    /// When the medium is free again: (frame + 24 bytes) x 8 / rate later.
    pub until: True,
    /// Whether the medium was still occupied when it left.
    pub overlaps: bool,
    /// The frame.
    pub bytes: &'a [u8],
}

/// What has happened on the medium.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct Traffic {
    /// Frames sent.
    pub frames: u64,
    /// Frames that began while another was on the air.
    pub overlaps: u64,
    /// Shortest time that the medium was free between two frames; below zero, for how long it was not.
    pub smallest_gap: Option<Span>,
    /// Deliveries that were lost on the way, by intent: by a wire, or a cut.
    pub lost: u64,
    /// Frames that a hub destroyed, at least for who sent meanwhile.
    pub collided: u64,
    /// Deliveries that a port of a switch had no room for.
    pub queue_full: u64,
    /// Most frames that waited for a port of a switch at once.
    pub longest_queue: usize,
    /// Deliveries that came twice, by intent.
    pub duplicated: u64,
    /// Deliveries of which a bit was changed, by intent.
    pub corrupted: u64,
    /// Deliveries that were held back so that others overtake them, by intent.
    pub reordered: u64,
    /// Either part of a medium that is cut.
    free_from: [True; 2],
}

impl Medium {
    /// How long a frame of `len` bytes occupies the medium, rounded up.
    pub fn air_time(&self, len: usize) -> u64 {
        self.time_of(len.max(MIN_FRAME) + OVERHEAD)
    }

    /// How long its bits take, rounded up: all of that but the gap behind them.
    pub(super) fn bits_time(&self, len: usize) -> u64 {
        self.time_of(len.max(MIN_FRAME) + OVERHEAD - GAP)
    }

    fn time_of(&self, bytes: usize) -> u64 {
        (bytes as u128 * 8 * 1_000_000_000).div_ceil(u128::from(self.rate)) as u64
    }
}

impl Traffic {
    /// A frame of `air` nanoseconds begins at `at`, in one part of a medium that is cut; frames come in the order of their
    /// begins.
    pub(super) fn put_on_air<'a>(
        &mut self,
        (from, part): (StationId, usize),
        at: True,
        air: u64,
        bytes: &'a [u8],
    ) -> Aired<'a> {
        let free_from = &mut self.free_from[part];
        let overlaps = self.frames > 0 && at < *free_from;
        if self.frames > 0 {
            let gap = Span::from_nanos(at.wrapping_sub(*free_from) as i64);
            self.smallest_gap = Some(self.smallest_gap.map_or(gap, |smallest| smallest.min(gap)));
        }
        self.frames += 1;
        self.overlaps += u64::from(overlaps);
        *free_from = (*free_from).max(at + air);
        Aired { from, at, until: at + air, overlaps, bytes }
    }

    /// Forgets the counts, not what is on the air.
    pub(super) fn start_over(&mut self) {
        *self = Traffic { free_from: self.free_from, ..Traffic::default() };
    }
}
