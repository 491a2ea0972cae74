//! What a mailbox is, as its owner says: all memory follows from it, and is reserved then.

use crate::wire::{HEAD_LEN, MAX_LEN};

/// Slots of each sender: as many numbers as are sorted at once (20 us) for who was overtaken.
pub const MOST_SLOTS: usize = 1024;
/// Senders of a mailbox: each is a lane that every look passes over, and a place on the board.
pub const MOST_SENDERS: usize = 126;
/// The largest body, as on the wire.
pub const LARGEST_BODY: usize = MAX_LEN - HEAD_LEN;
/// Memory of all slots of a mailbox together: what a mistaken number would take from everybody.
pub const MOST_BYTES: usize = 64 << 20;

/// What a mailbox is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// How many packages of each sender may wait: whoever sends too much fills its own slots and nobody else's.
    pub slots: usize,
    /// Bytes of the largest body.
    pub largest_body: usize,
    /// How many may send to it.
    pub senders: usize,
    /// What becomes of a package that finds no slot.
    pub when_full: WhenFull,
}

/// What becomes of a package whose sender has no free slot.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum WhenFull {
    /// It is refused.
    #[default]
    Refuse,
    /// It takes the place of the oldest of the least urgent that its sender has waiting there, unless that is more urgent.
    Replace,
    /// It is refused, but a command counts as sent: its head is kept, and the owner [answers](super::Inbox::take_refused_commands) it.
    /// While 256 of a sender wait for that, its commands are refused, too. The TCP client alone has such a mailbox.
    Answer,
}

/// A mailbox that cannot be.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ShapeError {
    /// Too few or too many slots.
    #[error("{0} slots: a mailbox has 1 to {MOST_SLOTS} for each sender")]
    Slots(usize),
    /// Bodies that no package has.
    #[error("bodies of {0} bytes: a package carries {LARGEST_BODY} at the most")]
    Body(usize),
    /// Too few or too many senders.
    #[error("{0} senders: a mailbox has 1 to {MOST_SENDERS}")]
    Senders(usize),
    /// It would have to answer commands that it has no slot for.
    #[error("only the TCP client answers commands that find its mailbox full")]
    Answers,
    /// More memory than a mailbox may take.
    #[error(
        "{0} bytes for {1} slots of {2} senders: a mailbox takes {MOST_BYTES} at the most; fewer slots, senders or smaller bodies do"
    )]
    Memory(usize, usize, usize),
}

impl Shape {
    /// So many slots for each sender, for bodies of so many bytes; 16 senders, and what finds no slot is refused.
    pub const fn new(slots: usize, largest_body: usize) -> Self {
        Self { slots, largest_body, senders: 16, when_full: WhenFull::Refuse }
    }

    /// The same with so many senders.
    pub const fn senders(self, senders: usize) -> Self {
        Self { senders, ..self }
    }

    /// The same for a mailbox that prefers what is new.
    pub const fn replacing(self) -> Self {
        Self { when_full: WhenFull::Replace, ..self }
    }

    /// The same for a mailbox whose owner answers the commands that find no slot.
    pub(crate) const fn answering(self) -> Self {
        Self { when_full: WhenFull::Answer, ..self }
    }

    /// Its lanes: the first is the LAN router's, then those of its senders, the last is the TCP client's.
    pub const fn lanes(&self) -> usize {
        self.senders + 2
    }

    /// The lane of packages that come from the TCP router.
    pub const fn tcp_lane(&self) -> usize {
        self.senders + 1
    }

    /// Whether there can be such a mailbox.
    pub fn check(&self) -> Result<(), ShapeError> {
        let Self { slots, largest_body, senders, .. } = *self;
        if !(1..=MOST_SLOTS).contains(&slots) {
            return Err(ShapeError::Slots(slots));
        }
        if largest_body > LARGEST_BODY {
            return Err(ShapeError::Body(largest_body));
        }
        if !(1..=MOST_SENDERS).contains(&senders) {
            return Err(ShapeError::Senders(senders));
        }
        let bytes = senders * super::layout::Layout::of(self).sender_words() * size_of::<u64>();
        if bytes > MOST_BYTES {
            return Err(ShapeError::Memory(bytes, slots, senders));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mailbox_that_cannot_be_says_why() {
        assert_eq!(Shape::new(16, 240).check(), Ok(()));
        assert_eq!(Shape::new(1, 0).senders(1).check(), Ok(()));
        assert_eq!(Shape::new(MOST_SLOTS, 0).senders(MOST_SENDERS).check(), Ok(()));
        assert_eq!(Shape::new(1, LARGEST_BODY).check(), Ok(()));
        assert_eq!(Shape::new(0, 1).check(), Err(ShapeError::Slots(0)));
        assert_eq!(Shape::new(MOST_SLOTS + 1, 1).check(), Err(ShapeError::Slots(1025)));
        assert_eq!(Shape::new(1, LARGEST_BODY + 1).check(), Err(ShapeError::Body(262_129)));
        for senders in [0, MOST_SENDERS + 1] {
            assert_eq!(Shape::new(1, 1).senders(senders).check(), Err(ShapeError::Senders(senders)));
        }
        let error = Shape::new(1024, LARGEST_BODY).check().unwrap_err();
        assert!(error.to_string().contains("67108864 at the most; fewer slots"), "{error}");
    }
}
