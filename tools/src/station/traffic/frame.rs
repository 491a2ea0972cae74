//! A frame of test traffic.
//!
//! ```text
//! 0          14        16     17      18      22         30          38
//! +----------+---------+------+-------+-------+----------+-----------+------+--------+--------+-----
//! | Ethernet | station | slot | queue | cycle | sequence | scheduled | seed | seed+1 | seed+2 | ...
//! | 0x88B5   |         |      |       |       |          | global, ns|      |        |        |
//! +----------+---------+------+-------+-------+----------+-----------+------+--------+--------+-----
//!  \___________________________ head ________________________________/ \________ pattern _________/
//! ```
//!
//! `slot` and `cycle` are the turn that it was chosen for. `queue` is 0; of a frame of a [`Flow`](super::Flow), which leaves
//! in whatever slot its priority brings it to, it is that priority and 1. `scheduled` is then when it was queued, and each
//! flow has its own `sequence`.
//!
//! All fields big-endian. The pattern is words of eight bytes, the last one cut off where the frame ends. Its
//! seed is folded from all of the head: whichever byte is changed on the way, head and pattern no longer go
//! together.

use rtnet::time::GlobalTime;
use rtnet::wire::ethernet::{self, EtherType, Header};
use zerocopy::byteorder::network_endian::{U16, U32, U64};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

/// Bytes in a word of the pattern.
const WORD: usize = size_of::<u64>();

/// What a frame says of itself, behind the Ethernet header.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
pub struct Tag {
    pub(super) station: U16,
    /// The slot's id.
    pub slot: u8,
    pub(super) queue: u8,
    pub(super) cycle: U32,
    pub(super) sequence: U64,
    pub(super) scheduled: U64,
}

const _: () = assert!(size_of::<Tag>() == 24);

impl Tag {
    /// Reads the tag of a frame of test traffic; `None` if it is none.
    pub fn read(frame: &[u8]) -> Option<(&Tag, &[u8])> {
        let (header, payload) = Header::parse(frame)?;
        (header.ether_type() == EtherType::EXPERIMENTAL).then_some(())?;
        Tag::ref_from_prefix(payload).ok()
    }
    /// The same of one that is as it was made: another frame of this EtherType is nobody's.
    pub fn of_intact(frame: &[u8]) -> Option<&Tag> {
        Tag::read(frame).filter(|_| is_intact(frame)).map(|(tag, _)| tag)
    }
    /// Who sent it, by number in the lab.
    pub fn station(&self) -> usize {
        usize::from(self.station.get())
    }
    /// Of which priority a frame of a flow is; none of the usual ones.
    pub fn priority(&self) -> Option<u8> {
        self.queue.checked_sub(1)
    }
    /// In which cycle.
    pub fn cycle(&self) -> u32 {
        self.cycle.get()
    }
    /// The sender's number of the frame.
    pub fn sequence(&self) -> u64 {
        self.sequence.get()
    }
    /// When its slot was to begin, on the master's clock; of a frame of a flow, when it was queued.
    pub fn scheduled(&self) -> GlobalTime {
        GlobalTime::from_nanos(self.scheduled.get())
    }
}

/// Bytes before the pattern.
pub(super) const HEAD: usize = ethernet::HEADER_LEN + size_of::<Tag>();
/// 2^64 divided by the golden ratio: odd, so that multiplying by it can be undone, and its bits are well mixed.
const FACTOR: u64 = 0x9e37_79b9_7f4a_7c15;

/// Where the pattern of a frame with this head begins: from 0 on, `seed = (seed ^ word) * FACTOR` with its halves
/// exchanged, for every word of the head, the last one filled up with zeros. Each step can be undone: two heads
/// that differ in one word never have one seed.
fn seed(head: &[u8]) -> u64 {
    let (words, rest) = head.as_chunks();
    let mut last = [0; WORD];
    last[..rest.len()].copy_from_slice(rest);
    let step = |seed: u64, word: &[u8; WORD]| {
        (seed ^ u64::from_be_bytes(*word)).wrapping_mul(FACTOR).rotate_left(32)
    };
    words.iter().chain([&last]).fold(0, step)
}

/// A word of the pattern. The head decides all of them: 30 ns for a small frame, 0.3 us for the largest.
fn word(seed: u64, i: usize) -> [u8; WORD] {
    seed.wrapping_add(i as u64).to_be_bytes()
}

/// Writes the pattern that goes with the head.
pub(super) fn finish(frame: &mut [u8]) {
    let (head, pattern) = frame.split_at_mut(HEAD);
    let seed = seed(head);
    let (words, rest) = pattern.as_chunks_mut();
    let last = word(seed, words.len());
    words.iter_mut().enumerate().for_each(|(i, bytes)| *bytes = word(seed, i));
    rest.copy_from_slice(&last[..rest.len()]);
}

/// Whether head and pattern go together.
pub(super) fn is_intact(frame: &[u8]) -> bool {
    let Some((head, bytes)) = frame.split_at_checked(HEAD) else { return false };
    let seed = seed(head);
    let (words, rest) = bytes.as_chunks();
    let last = word(seed, words.len());
    words.iter().enumerate().all(|(i, bytes)| *bytes == word(seed, i)) && *rest == last[..rest.len()]
}
