//! Where the broker shows which mailboxes there are and who sends to them: owners and senders read it for each package, without
//! asking anybody.
//!
//! ```text
//! each place   0  the mailbox's generation, 0: none   1  changes: moves with each   8  lanes
//! behind all   moves: moves when a name may be somewhere else than before   names: moves with each mailbox that comes or goes
//! a lane       sender's name << 32 | the lane's generation << 2 | 0 free, 1 bound, 2 left
//! ```

use core::sync::atomic::{AtomicU64, Ordering};
use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use rtnet::live::sealed::Sealed;

use crate::mailbox::MOST_SENDERS;
use crate::name::MailboxName;
use crate::registry::{LaneState, MOST_MAILBOXES, Registered};

/// Lanes of a mailbox: one for each sender, the LAN router's and the TCP client's.
pub const MOST_LANES: usize = MOST_SENDERS + 2;
const GENERATION: usize = 0;
const CHANGES: usize = 1;
const LANES: usize = 8;
const BLOCK: usize = LANES + MOST_LANES.next_multiple_of(8);
const MOVES: usize = MOST_MAILBOXES * BLOCK;
const NAMES: usize = MOVES + 1;
const WORDS: usize = NAMES + 1;

const FREE: u64 = 0;
const BOUND: u64 = 1;
const LEFT: u64 = 2;
const GENERATIONS: u64 = (1 << 30) - 1;

/// The broker's end.
pub struct Shown(Sealed);

/// What everybody else sees.
pub struct Board(Sealed);

/// A lane, as it is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LaneShown {
    /// Nobody has it, or it is not ready yet.
    Free,
    /// Who has it now.
    Bound {
        /// How many have had it.
        generation: u32,
        /// Whose packages come through it.
        from: MailboxName,
    },
    /// Who had it has gone.
    Left {
        /// How many have had it.
        generation: u32,
        /// Whose packages came through it.
        from: MailboxName,
    },
}

impl Shown {
    /// An empty board.
    pub fn new() -> io::Result<Self> {
        Sealed::new(c"rtnet-mailboxes", WORDS).map(Self)
    }

    /// Shows what is in a place now.
    pub fn show(&self, place: usize, mailbox: Option<&Registered>) {
        let block = &self.0[place * BLOCK..][..BLOCK];
        for (lane, word) in block[LANES..].iter().enumerate() {
            let lane = mailbox.and_then(|mailbox| mailbox.lanes.get(lane));
            let shown = lane.map_or(FREE, |lane| {
                let generation = (u64::from(lane.generation) & GENERATIONS) << 2;
                match lane.state {
                    LaneState::Free | LaneState::Reserved(..) => FREE,
                    LaneState::Bound(_, from) => u64::from(from.0) << 32 | generation | BOUND,
                    LaneState::Left(from) => u64::from(from.0) << 32 | generation | LEFT,
                }
            });
            word.store(shown, Ordering::Relaxed);
        }
        block[GENERATION].store(mailbox.map_or(0, |mailbox| mailbox.generation), Ordering::Release);
        block[CHANGES].fetch_add(1, Ordering::Release);
    }
}

impl Shown {
    /// A mailbox has come, or routes have changed: what is sent elsewhere may belong elsewhere now.
    pub fn moved(&self) {
        self.0[MOVES].fetch_add(1, Ordering::Release);
    }

    /// A mailbox has come or gone.
    pub fn came_or_went(&self) {
        self.0[NAMES].fetch_add(1, Ordering::Release);
    }
}

impl AsFd for Shown {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}

impl Board {
    /// One that a broker has made.
    pub fn open(file: OwnedFd) -> io::Result<Self> {
        Sealed::open(file, WORDS).map(Self)
    }

    /// Whether a mailbox is there still.
    #[inline]
    pub fn has(&self, place: usize, generation: u64) -> bool {
        self.0[place * BLOCK + GENERATION].load(Ordering::Acquire) == generation
    }

    /// What moves when a name may be somewhere else than before.
    #[inline]
    pub fn moves(&self) -> u64 {
        self.0[MOVES].load(Ordering::Acquire)
    }

    /// The count of mailboxes that have come and gone.
    #[inline]
    pub fn names(&self) -> u64 {
        self.0[NAMES].load(Ordering::Acquire)
    }

    /// What moves with each change of a mailbox.
    #[inline]
    pub fn changes(&self, place: usize) -> &AtomicU64 {
        &self.0[place * BLOCK + CHANGES]
    }

    /// A lane of a mailbox.
    pub fn lane(&self, place: usize, lane: usize) -> LaneShown {
        let word = self.0[place * BLOCK + LANES + lane].load(Ordering::Relaxed);
        let generation = (word >> 2 & GENERATIONS) as u32;
        let from = MailboxName((word >> 32) as u32);
        match word & 3 {
            BOUND => LaneShown::Bound { generation, from },
            LEFT => LaneShown::Left { generation, from },
            _ => LaneShown::Free,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mailbox::Shape;
    use crate::registry::{ComponentId, Registry};

    #[test]
    fn everybody_sees_what_is_there_and_that_it_is_there_no_more() {
        let shown = Shown::new().unwrap();
        let board = Board::open(shown.as_fd().try_clone_to_owned().unwrap()).unwrap();
        let (mut registry, owner, name) = (Registry::new(), ComponentId(1), MailboxName(0x0080_0100));
        let place = registry.create(owner, name, Shape::new(1, 1).senders(MOST_SENDERS)).unwrap();
        let changes = || board.changes(place).load(Ordering::Relaxed);
        shown.show(place, registry.get(place));
        let generation = registry.get(place).unwrap().generation;
        assert!(board.has(place, generation) && !board.has(place + 1, generation) && changes() == 1);
        let lane = (0..MOST_SENDERS)
            .map(|_| registry.bind(owner, name, name, |_, _| false).unwrap())
            .last()
            .unwrap();
        shown.show(place, registry.get(place));
        assert_eq!(board.lane(place, lane.lane), LaneShown::Free);
        registry.ready(owner, lane);
        shown.show(place, registry.get(place));
        assert_eq!(board.lane(place, lane.lane), LaneShown::Bound { generation: 1, from: name });
        registry.unbind(owner, lane);
        shown.show(place, registry.get(place));
        assert_eq!(board.lane(place, lane.lane), LaneShown::Left { generation: 1, from: name });
        registry.delete(owner, name).unwrap();
        shown.show(place, registry.get(place));
        assert!(!board.has(place, generation) && changes() == 5);
    }
}
