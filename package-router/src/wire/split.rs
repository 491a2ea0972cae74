//! Packages that no single datagram holds, in parts: cut without copying, and put together where the body is to lie.
//!
//! ```text
//! package   | head, len L | body ............................................ |
//!
//! datagrams | head, 0x04, L | body[0..m] |                     first: the head as it is, but for the flag
//!           | head, 0x08, 16 + m, id 1 | body[m..2m] |         middle: its own length, numbered from 1
//!           | head, 0x0C, 16 + r, id 2 | body[2m..] |          last
//! ```
//!
//! A package that fits one datagram is one, without flags. Who joins needs a place for the body and a [`Joining`]; a part that
//! is not the expected one ends the package, as nobody sends a part twice.

use core::iter::FusedIterator;
use core::ops::Range;

use super::{HEAD_LEN, Head, MAX_LEN, Part};
use crate::name::MailboxName;

/// Bytes of the longest datagram, with the head that it begins with: what UDP takes.
pub const MOST_DATAGRAM: usize = rtnet::wire::udp::MAX_PAYLOAD;
/// Parts of a package, the first included: the further ones are numbered from 1 in 8 bits.
pub const MOST_PARTS: usize = 1 + u8::MAX as usize;

/// Cuts a package, whose whole head this is, into datagrams of at most `most_datagram` bytes with their heads (at most
/// [`MOST_DATAGRAM`] whatever is asked for).
///
/// ```
/// use package_router::wire::{Head, Part, split};
///
/// let head = Head { id: 42, ..Head::default() }.with_body(2_000)?;
/// let parts: Vec<_> = split(&head, 1_472)?.map(|piece| (piece.head.part, piece.head.id, piece.body)).collect();
/// assert_eq!(parts, [(Part::First, 42, 0..1_456), (Part::Last, 1, 1_456..2_000)]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn split(head: &Head, most_datagram: usize) -> Result<Split, SplitError> {
    if !(HEAD_LEN..=MAX_LEN).contains(&(head.len as usize)) {
        return Err(SplitError::Len(head.len));
    }
    let least = least_datagram(head.body_len());
    if most_datagram < least {
        return Err(SplitError::TooManyParts { len: head.len, most_datagram, least });
    }
    let room = most_datagram.min(MOST_DATAGRAM) - HEAD_LEN;
    let pieces = head.body_len().div_ceil(room.max(1)).max(1);
    Ok(Split { head: Head { part: Part::Whole, ..*head }, room, pieces, next: 0 })
}

/// Bytes of the smallest datagrams, with their heads, that carry a body in at most [`MOST_PARTS`].
pub const fn least_datagram(body_len: usize) -> usize {
    HEAD_LEN + body_len.div_ceil(MOST_PARTS)
}

/// The parts of a package, in their order.
#[derive(Clone, Debug)]
pub struct Split {
    head: Head,
    room: usize,
    pieces: usize,
    next: usize,
}

/// What one datagram carries.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Piece {
    /// What it begins with.
    pub head: Head,
    /// The part of the package's body that follows.
    pub body: Range<usize>,
}

/// A package that cannot be sent in datagrams.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SplitError {
    /// No package has this length.
    #[error("a package of {0} bytes: head and body together have {HEAD_LEN} to {MAX_LEN}")]
    Len(u32),
    /// The numbers of its parts would not do.
    #[error(
        "a package of {len} bytes has more than {MOST_PARTS} parts in datagrams of {most_datagram}: it takes datagrams of {least} \
         or more"
    )]
    TooManyParts {
        /// Bytes of the package.
        len: u32,
        /// Bytes of a datagram.
        most_datagram: usize,
        /// Bytes of a datagram that would do.
        least: usize,
    },
}

impl Iterator for Split {
    type Item = Piece;

    #[inline]
    fn next(&mut self) -> Option<Piece> {
        if self.next == self.pieces {
            return None;
        }
        let number = self.next;
        self.next += 1;
        let begin = number * self.room;
        let body = begin..self.head.body_len().min(begin + self.room);
        let is_last = self.next == self.pieces;
        let head = match number {
            0 if is_last => self.head,
            0 => Head { part: Part::First, ..self.head },
            number => Head {
                part: if is_last { Part::Last } else { Part::Middle },
                id: number as u8,
                len: (HEAD_LEN + body.len()) as u32,
                ..self.head
            },
        };
        Some(Piece { head, body })
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        let left = self.pieces - self.next;
        (left, Some(left))
    }
}

impl ExactSizeIterator for Split {}
impl FusedIterator for Split {}

/// A package of which the first part came: where each further one goes. It holds none of the bytes.
///
/// ```
/// use package_router::wire::{Head, Joining, split};
///
/// let body: Vec<u8> = (0..100).collect();
/// let head = Head::default().with_body(100)?;
/// let mut pieces = split(&head, 76)?;
///
/// let first = pieces.next().expect("there is always one");
/// let (mut joining, place) = Joining::begin(&first.head, first.body.len())?;
/// let mut joined = vec![0; joining.head().body_len()];
/// joined[place].copy_from_slice(&body[first.body]);
/// for piece in pieces {
///     let placed = joining.next(&piece.head, piece.body.len())?;
///     joined[placed.at].copy_from_slice(&body[piece.body]);
///     assert!(placed.is_complete, "two parts");
/// }
/// assert_eq!((joining.head(), joined), (&head, body));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct Joining {
    head: Head,
    /// Bytes of the body that came.
    came: usize,
    /// Of the last part.
    number: u8,
}

/// Where the bytes of a further part go.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Placed {
    /// In the package's body.
    pub at: Range<usize>,
    /// Whether all of it is there now.
    pub is_complete: bool,
}

/// A part that is not the next of the package in the making, which it ends. None of its bytes has a place.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum JoinError {
    /// It is the package that it belongs to.
    #[error("the datagram holds a whole package: it is no part of one")]
    IsWhole,
    /// The first part of its package never came, or what came was dropped.
    #[error("part {0} of a package whose first part is not here")]
    NotFirst(u8),
    /// Another package of the same mailboxes begins.
    #[error("the first part of the next package came before the last of this")]
    FirstAgain,
    /// It is somebody else's.
    #[error("a part from {from} to {to}, which is another package's")]
    OtherPackage {
        /// Who sent it.
        from: MailboxName,
        /// For whom it is.
        to: MailboxName,
    },
    /// One was lost, or came twice, or too early.
    #[error("part {got} of a package came where part {expected} was to come")]
    WrongNumber {
        /// Which is next; 256 if none can be.
        expected: u16,
        /// Which it is.
        got: u8,
    },
    /// Its head says another length than it has.
    #[error("a part that says it has {said} bytes of body and has {got}")]
    WrongLen {
        /// What its head says, without that.
        said: usize,
        /// What there is, without the head.
        got: usize,
    },
    /// It brings nothing.
    #[error("a part without a byte of body")]
    Empty,
    /// More than the whole package has, or as much, where more parts are to come.
    #[error("the parts of a package of {len} bytes of body come to {came}, and are not complete")]
    Overlong {
        /// Of the package's body.
        len: usize,
        /// What came of it, with this part.
        came: usize,
    },
    /// The last part came, and not all is here.
    #[error("the parts of a package of {len} bytes of body come to {came} with the last")]
    Incomplete {
        /// Of the package's body.
        len: usize,
        /// What came of it, with this part.
        came: usize,
    },
}

impl Joining {
    /// Begins with a first part, of which `part_len` bytes came behind the head, and says where they go.
    pub fn begin(head: &Head, part_len: usize) -> Result<(Self, Range<usize>), JoinError> {
        match head.part {
            Part::First => {}
            Part::Whole => return Err(JoinError::IsWhole),
            Part::Middle | Part::Last => return Err(JoinError::NotFirst(head.id)),
        }
        let len = head.body_len();
        match part_len {
            0 => Err(JoinError::Empty),
            came if came >= len => Err(JoinError::Overlong { len, came }),
            came => Ok((Self { head: Head { part: Part::Whole, ..*head }, came, number: 0 }, 0..came)),
        }
    }

    /// Takes the next part, of which `part_len` bytes came behind the head, and says where they go. An error changes nothing,
    /// so that a part of another package, or a reader's second thoughts, need not end this one.
    pub fn next(&mut self, head: &Head, part_len: usize) -> Result<Placed, JoinError> {
        let Head { part, from, to, id: got, .. } = *head;
        if (from, to) != (self.head.from, self.head.to) {
            return Err(JoinError::OtherPackage { from, to });
        }
        match part {
            Part::Whole => return Err(JoinError::IsWhole),
            Part::First => return Err(JoinError::FirstAgain),
            Part::Middle | Part::Last => {}
        }
        let expected = u16::from(self.number) + 1;
        if u16::from(got) != expected {
            return Err(JoinError::WrongNumber { expected, got });
        }
        if head.body_len() != part_len {
            return Err(JoinError::WrongLen { said: head.body_len(), got: part_len });
        }
        if part_len == 0 {
            return Err(JoinError::Empty);
        }
        let (len, came) = (self.head.body_len(), self.came + part_len);
        let is_last = part == Part::Last;
        match came {
            came if came > len || (came == len && !is_last) => return Err(JoinError::Overlong { len, came }),
            came if came < len && is_last => return Err(JoinError::Incomplete { len, came }),
            _ => {}
        }
        let at = self.came..came;
        (self.came, self.number) = (came, got);
        Ok(Placed { at, is_complete: is_last })
    }

    /// The whole package's head, of which the first part had the copy.
    pub fn head(&self) -> &Head {
        &self.head
    }
}

#[cfg(test)]
mod tests;
