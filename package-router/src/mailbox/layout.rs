//! What is where in the memory of a mailbox.
//!
//! ```text
//! a sender's segment: it writes, the owner reads                 the owner's segment: it writes, senders read
//!    0  published: the number of its newest package   1  begun      0  asleep: 1, it waits for packages; 2, for refused commands alone
//!    2  kept: how many refused commands
//!    8  sent, full, too large, replaced                             8  statistics
//!   16  announced: ring of entries, one for each package           16  latencies
//!    …  kept: ring of the heads of refused commands                 …  lanes, one for each sender:
//!    …  slots, each in whole cache lines:                              0  returned: how many   1  taking: a number, 0: none   2  drained
//!       0  number of the package in it, 0: none                        3  answered: how many refused commands
//!       1  sent  2  left  3  came  4  head, 16 bytes  6  origin  8  body   8  ring of entries, one for each that was returned
//!
//! an entry: a package's number << 16 | its slot; of a returned one the highest bit says that nobody has read it
//! ```
//!
//! The slots say what there is; the rings only where to look. So a sender whose mailbox replaces what is old may announce more
//! than the ring holds: who finds that it was overtaken looks at all slots.

use super::shape::{Shape, WhenFull};
use super::word::{Segment, Word};
use crate::wire::HEAD_LEN;

/// Words of a cache line.
pub const LINE: usize = 8;

/// Refused commands of a sender that may wait to be answered: as many as there are ids. A power of two.
pub const MOST_KEPT: usize = 256;
/// Words of a head.
pub const HEAD: usize = HEAD_LEN / size_of::<u64>();

/// Of a sender's segment.
pub mod of_sender {
    /// The number of its newest package.
    pub const PUBLISHED: usize = 0;
    /// How many slots of the lane had been returned when it came.
    pub const BEGUN: usize = 1;
    /// Commands that were refused and kept to be answered.
    pub const KEPT: usize = 2;
    /// Packages that it has sent.
    pub const SENT: usize = 8;
    /// Such that found no slot.
    pub const FULL: usize = 9;
    /// Such that no slot holds.
    pub const TOO_LARGE: usize = 10;
    /// Such that made way for newer ones, unread.
    pub const REPLACED: usize = 11;
    pub(super) const RING: usize = 16;
}

/// Of a slot.
pub mod of_slot {
    /// The number of the package in it.
    pub const NUMBER: usize = 0;
    /// When it was sent, on this host's monotonic clock.
    pub const SENT: usize = 1;
    /// When it left its station for this one, in global time; 0: it never did, or that is not known.
    pub const LEFT: usize = 2;
    /// When it came to this station; 0: it was always here.
    pub const CAME: usize = 3;
    /// The head: two words.
    pub const HEAD: usize = 4;
    /// When its sender sent it elsewhere, in global time; 0: it was sent here, 1: elsewhere, and nobody knows when.
    pub const ORIGIN: usize = 6;
    /// The body.
    pub const BODY: usize = 8;
}

/// Of the owner's segment.
pub mod of_owner {
    /// Whether it waits to be woken: by a package, or, while packages wait that it does not read now, by a refused command.
    pub const ASLEEP: usize = 0;
    pub(in crate::mailbox) const FOR_PACKAGES: u64 = 1;
    pub(in crate::mailbox) const FOR_REFUSED: u64 = 2;
    /// Packages that were received.
    pub const RECEIVED: usize = 8;
    /// Such that were cleaned away.
    pub const CLEANED: usize = 9;
    /// The most that ever waited.
    pub const MOST: usize = 11;
    /// Such that said that somebody else had sent them.
    pub const FORGED: usize = 12;
    /// Such that could not be, and senders that wrote what cannot be.
    pub const NONSENSE: usize = 13;
    /// How long packages took from being sent to being received.
    pub const LATENCIES: usize = 16;
    pub(super) const LANES: usize = LATENCIES + crate::mailbox::statistics::BUCKETS;
}

/// Of a lane in the owner's segment.
pub mod of_lane {
    /// How many slots were ever returned.
    pub const RETURNED: usize = 0;
    /// The number of the package that the owner is about to read: of its slot it may see another one's still.
    pub const TAKING: usize = 1;
    /// Who of those that had the lane was read to the end: written for who sees to lanes.
    pub const DRAINED: usize = 2;
    /// Refused commands that the owner has taken to answer.
    pub const ANSWERED: usize = 3;
    pub(super) const RING: usize = super::LINE;
}

/// Where everything of a mailbox of a shape is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Layout {
    /// Slots of each sender.
    pub slots: usize,
    /// Of each of the rings, a power of two.
    pub ring: usize,
    /// Where the first refused command is kept.
    first_kept: usize,
    /// Where the first slot is, and from one to the next.
    first_slot: usize,
    stride: usize,
    /// From one lane to the next.
    lane_stride: usize,
    /// Bytes of the largest body.
    pub largest_body: usize,
    /// What a sender does that finds no slot.
    pub when_full: WhenFull,
}

impl Layout {
    /// Of a shape that can be.
    pub fn of(shape: &Shape) -> Self {
        let stride = (of_slot::BODY + shape.largest_body.div_ceil(size_of::<u64>())).next_multiple_of(LINE);
        // Between two looks of a sender all that it has there may come back, and what each of them has made way for, too.
        let ring = (2 * shape.slots).next_power_of_two();
        let first_kept = of_sender::RING + ring;
        let kept = if shape.when_full == WhenFull::Answer { MOST_KEPT * HEAD } else { 0 };
        Self {
            slots: shape.slots,
            ring,
            first_kept,
            first_slot: (first_kept + kept).next_multiple_of(LINE),
            stride,
            lane_stride: (of_lane::RING + ring).next_multiple_of(LINE),
            largest_body: shape.largest_body,
            when_full: shape.when_full,
        }
    }

    /// Words of a sender's segment.
    pub fn sender_words(&self) -> usize {
        self.slot(self.slots)
    }
    /// Words of the owner's segment.
    pub fn owner_words(&self, senders: usize) -> usize {
        self.lane(senders)
    }
    /// Where a slot begins in its sender's segment.
    #[inline]
    pub fn slot(&self, slot: usize) -> usize {
        self.first_slot + slot * self.stride
    }
    /// Where the package of a number is announced.
    #[inline]
    pub fn announced(&self, number: u64) -> usize {
        of_sender::RING + self.in_ring(number)
    }
    /// Where the head of a refused command is kept, counted from 0.
    pub fn kept(&self, count: u64) -> usize {
        self.first_kept + (count as usize & (MOST_KEPT - 1)) * HEAD
    }
    /// Where a sender's lane begins in the owner's segment.
    #[inline]
    pub fn lane(&self, lane: usize) -> usize {
        of_owner::LANES.next_multiple_of(LINE) + lane * self.lane_stride
    }
    /// Where the owner says whose packages of a lane are all read.
    pub fn drained(&self, lane: usize) -> usize {
        self.lane(lane) + of_lane::DRAINED
    }
    /// Where the slot is named that was returned as such a one, counted from 0.
    #[inline]
    pub fn returned(&self, lane: usize, count: u64) -> usize {
        self.lane(lane) + of_lane::RING + self.in_ring(count)
    }

    /// How many packages of a lane wait to be read, by what both sides show.
    pub fn waiting(&self, owner: &impl Segment, sender: &impl Segment, lane: usize) -> u64 {
        let returned = owner.at(self.lane(lane) + of_lane::RETURNED).get();
        let back = returned.wrapping_sub(sender.at(of_sender::BEGUN).get());
        // What made way came back, or never will.
        sender.at(of_sender::PUBLISHED).get().saturating_sub(back).min(self.slots as u64)
    }

    fn in_ring(&self, count: u64) -> usize {
        count as usize & (self.ring - 1)
    }
}

const SLOT_BITS: u32 = 16;
const UNREAD: u64 = 1 << 63;

/// Names a package by its number and its slot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Entry(u64);

impl Entry {
    /// Of this number in that slot.
    #[inline]
    pub fn new(number: u64, slot: usize) -> Self {
        Self(number << SLOT_BITS | slot as u64)
    }
    /// The same, of one that nobody has read.
    pub fn unread(self) -> Self {
        Self(self.0 | UNREAD)
    }
    /// As it was written.
    #[inline]
    pub fn from_word(word: u64) -> Self {
        Self(word)
    }
    /// As it is written.
    #[inline]
    pub fn word(self) -> u64 {
        self.0
    }
    /// The package's number.
    #[inline]
    pub fn number(self) -> u64 {
        (self.0 & !UNREAD) >> SLOT_BITS
    }
    /// Whether nobody has read it.
    pub fn is_unread(self) -> bool {
        self.0 & UNREAD != 0
    }
    /// Its slot, whatever it says.
    #[inline]
    pub fn slot(self) -> usize {
        self.0 as usize & ((1 << SLOT_BITS) - 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    /// No word of a segment is two things.
    #[test]
    fn everything_has_a_place_of_its_own() {
        for (slots, largest_body, senders) in [(1, 0, 1), (3, 1, 2), (16, 240, 5), (1024, 1456, 127)] {
            let layout = Layout::of(&Shape { slots, largest_body, senders, when_full: WhenFull::Answer });
            let mut seen = BTreeSet::new();
            let mut take = |range: core::ops::Range<usize>, end: usize| {
                range.for_each(|word| assert!(word < end && seen.insert(word), "word {word}"));
            };
            let end = layout.sender_words();
            take(0..12, end);
            (0..layout.ring as u64)
                .for_each(|number| take(layout.announced(number)..layout.announced(number) + 1, end));
            (0..MOST_KEPT as u64).for_each(|count| take(layout.kept(count)..layout.kept(count) + HEAD, end));
            for slot in 0..slots {
                let begin = layout.slot(slot);
                assert_eq!(begin % LINE, 0);
                take(begin..begin + of_slot::BODY + largest_body.div_ceil(8), end);
            }
            let mut seen = BTreeSet::new();
            let mut take = |range: core::ops::Range<usize>, end: usize| {
                range.for_each(|word| assert!(word < end && seen.insert(word), "word {word}"));
            };
            let end = layout.owner_words(senders);
            take(0..of_owner::LANES, end);
            for lane in 0..senders {
                take(layout.lane(lane)..layout.lane(lane) + 4, end);
                (0..layout.ring as u64)
                    .for_each(|n| take(layout.returned(lane, n)..layout.returned(lane, n) + 1, end));
            }
        }
    }

    #[test]
    fn an_entry_says_number_slot_and_whether_it_was_read() {
        for (number, slot) in [(1, 0), (0x7fff_ffff_ffff, 0xffff), (9, 1023)] {
            let entry = Entry::new(number, slot);
            assert_eq!((entry.number(), entry.slot(), entry.is_unread()), (number, slot, false));
            let unread = Entry::from_word(entry.unread().word());
            assert_eq!((unread.number(), unread.slot(), unread.is_unread()), (number, slot, true));
        }
    }
}
