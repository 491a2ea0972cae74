//! The head of a package: the same 16 bytes in a mailbox, in a datagram and on TCP (paper 3.1, figure 2).
//!
//! ```text
//! 0      1      2        3    4            8            12             16
//! +------+------+--------+----+------------+------------+--------------+-----------
//! | flags| kind |priority| id | to         | from       | len          | body
//! |      | > 0: |larger: |    | a mailbox  | the reply's| head and body| len - 16
//! |      |a com-|more    |    | name       | mailbox    | 16 to 262144 |
//! |      | mand |urgent  |    |            |            |              |
//! +------+------+--------+----+------------+------------+--------------+-----------
//!   |      0 and less: reply or data
//!   +-- bit 0      to, from and len are little-endian; else big-endian
//!       bit 1      numbers in the body are little-endian; else big-endian
//!       bits 2, 3  which part of a package that takes more than one datagram: see [`split()`]
//!       bits 4-7   unknown: they survive reading and writing, ours are 0
//! ```

mod split;

use zerocopy::byteorder::{BigEndian, LittleEndian, U32};
use zerocopy::{ByteOrder, FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use crate::name::MailboxName;
pub use split::{
    JoinError, Joining, MOST_DATAGRAM, MOST_PARTS, Piece, Placed, Split, SplitError, least_datagram, split,
};

/// Bytes of a head.
pub const HEAD_LEN: usize = size_of::<Layout<LittleEndian>>();
/// The longest package, head and body: 256 KiB, what peers of this protocol take. Exactly that passes.
pub const MAX_LEN: usize = 256 << 10;

/// Kind of a reply: what was asked for is done.
pub const OK: i8 = 0;
/// Kind of a reply: it could not be done.
pub const ERROR: i8 = -1;
/// Kind of a reply: it was not done in time.
pub const TIMEOUT: i8 = -2;
/// Kind of a reply on the way: no component has the mailbox that was named, or a queue on the way there is full.
pub const NOT_AVAILABLE: i8 = -3;

const LITTLE_HEAD: u8 = 0b0001;
const LITTLE_BODY: u8 = 0b0010;
const PART_SHIFT: u32 = 2;
const OTHER_FLAGS: u8 = 0b1111_0000;

#[derive(FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
struct Layout<O: ByteOrder> {
    flags: u8,
    kind: i8,
    priority: u8,
    id: u8,
    to: U32<O>,
    from: U32<O>,
    len: U32<O>,
}

const _: () = assert!(HEAD_LEN == 16 && size_of::<Layout<BigEndian>>() == HEAD_LEN);

/// The order of a number's bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Endian {
    /// The most significant first, as Java peers write.
    Big,
    /// The least significant first, as all others do.
    #[default]
    Little,
}

/// Which part of a package a datagram carries.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Part {
    /// All of it, as everywhere but in datagrams.
    #[default]
    Whole,
    /// The first of several.
    First,
    /// One between the first and the last.
    Middle,
    /// The last of several.
    Last,
}

/// What stands before every body.
///
/// ```
/// use package_router::name::{Class, MailboxName};
/// use package_router::wire::{self, Head};
///
/// let (pilot, joystick) = (MailboxName::new(0, Class::PILOT, 0, 0), MailboxName::new(0, Class::JOYSTICK, 0, 0));
/// let command = Head { priority: 231, id: 7, ..Head::new(21, pilot, joystick) };
/// assert_eq!(Head::parse(&command.to_bytes()), Ok(command));
///
/// let reply = command.answer(wire::OK);
/// assert_eq!((reply.to, reply.from, reply.priority, reply.id), (joystick, pilot, 231, 7));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Head {
    /// Of `to`, `from` and `len`.
    pub head_order: Endian,
    /// Of the numbers in the body.
    pub body_order: Endian,
    /// Which part of a package follows.
    pub part: Part,
    /// Bits 4 to 7 of the flags, in their places: nothing here knows them.
    pub other_flags: u8,
    /// What it says, the wire's `type`: a command above 0, else a reply or data.
    pub kind: i8,
    /// How urgent it is: larger is more.
    pub priority: u8,
    /// Copied into the reply, which belongs to the command of the same `from` and id.
    pub id: u8,
    /// Whose it is.
    pub to: MailboxName,
    /// Where a reply goes.
    pub from: MailboxName,
    /// Bytes of head and body; of a part, but for the first, of that part with its own head.
    pub len: u32,
}

/// Bytes that are no head.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum HeadError {
    /// Some of it is missing.
    #[error("{got} bytes are no head, which has {HEAD_LEN}")]
    TooShort {
        /// How many there are.
        got: usize,
    },
    /// It says that the package is shorter than its own head.
    #[error("a package of {len} bytes: the head alone has {HEAD_LEN}")]
    LenBelowHead {
        /// What it says.
        len: u32,
    },
    /// It says that the package is longer than any.
    #[error("a package of {len} bytes: head and body together have {MAX_LEN} at the most")]
    LenAboveMost {
        /// What it says.
        len: u32,
    },
}

impl Head {
    /// The head of a package without a body, as this host writes them: little-endian, of the least urgent priority, of id 0.
    pub const fn new(kind: i8, to: MailboxName, from: MailboxName) -> Self {
        Self {
            head_order: Endian::Little,
            body_order: Endian::Little,
            part: Part::Whole,
            other_flags: 0,
            kind,
            priority: 0,
            id: 0,
            to,
            from,
            len: HEAD_LEN as u32,
        }
    }

    /// The same in front of so many bytes of body, or an error if no package is so long.
    pub fn with_body(self, bytes: usize) -> Result<Self, HeadError> {
        let len = u32::try_from(bytes.saturating_add(HEAD_LEN)).unwrap_or(u32::MAX);
        check_len(len)?;
        Ok(Self { len, ..self })
    }

    /// The head of a reply of that kind without a body: back to the sender, with the command's priority and id.
    pub const fn answer(&self, kind: i8) -> Self {
        Self { priority: self.priority, id: self.id, ..Self::new(kind, self.from, self.to) }
    }

    /// Reads a head from the first 16 of at least so many bytes. What follows it need not be there.
    #[inline]
    pub fn parse(bytes: &[u8]) -> Result<Self, HeadError> {
        match bytes.first() {
            Some(flags) if flags & LITTLE_HEAD != 0 => Self::read::<LittleEndian>(bytes, Endian::Little),
            _ => Self::read::<BigEndian>(bytes, Endian::Big),
        }
    }

    /// Its 16 bytes, in its own order.
    #[inline]
    pub fn to_bytes(&self) -> [u8; HEAD_LEN] {
        match self.head_order {
            Endian::Little => zerocopy::transmute!(self.layout::<LittleEndian>()),
            Endian::Big => zerocopy::transmute!(self.layout::<BigEndian>()),
        }
    }

    /// Bytes that follow the head: 0 to 262128 once parsed.
    pub const fn body_len(&self) -> usize {
        (self.len as usize).saturating_sub(HEAD_LEN)
    }

    /// Whether it asks for something, and so for a reply if nobody is there.
    pub const fn is_command(&self) -> bool {
        self.kind > 0
    }

    /// Whether it is at the begin of its package: the further parts have other heads.
    pub const fn begins(&self) -> bool {
        matches!(self.part, Part::Whole | Part::First)
    }

    /// Whether it is the whole package's.
    pub const fn is_whole(&self) -> bool {
        matches!(self.part, Part::Whole)
    }

    fn read<O: ByteOrder>(bytes: &[u8], head_order: Endian) -> Result<Self, HeadError> {
        let got = bytes.len();
        let (layout, _) = Layout::<O>::ref_from_prefix(bytes).map_err(|_| HeadError::TooShort { got })?;
        let len = layout.len.get();
        check_len(len)?;
        Ok(Self {
            head_order,
            body_order: if layout.flags & LITTLE_BODY == 0 { Endian::Big } else { Endian::Little },
            part: Part::of(layout.flags),
            other_flags: layout.flags & OTHER_FLAGS,
            kind: layout.kind,
            priority: layout.priority,
            id: layout.id,
            to: MailboxName(layout.to.get()),
            from: MailboxName(layout.from.get()),
            len,
        })
    }

    fn layout<O: ByteOrder>(&self) -> Layout<O> {
        Layout {
            flags: self.flags(),
            kind: self.kind,
            priority: self.priority,
            id: self.id,
            to: U32::new(self.to.0),
            from: U32::new(self.from.0),
            len: U32::new(self.len),
        }
    }

    const fn flags(&self) -> u8 {
        let head = if matches!(self.head_order, Endian::Little) { LITTLE_HEAD } else { 0 };
        let body = if matches!(self.body_order, Endian::Little) { LITTLE_BODY } else { 0 };
        head | body | (self.part as u8) << PART_SHIFT | self.other_flags & OTHER_FLAGS
    }
}

/// What is read where there is nothing: of kind 0, from nobody to nobody, without a body.
impl Default for Head {
    fn default() -> Self {
        Self::new(OK, MailboxName::NOBODY, MailboxName::NOBODY)
    }
}

impl Part {
    const fn of(flags: u8) -> Self {
        match flags >> PART_SHIFT & 0b11 {
            0 => Self::Whole,
            1 => Self::First,
            2 => Self::Middle,
            _ => Self::Last,
        }
    }
}

#[inline]
fn check_len(len: u32) -> Result<(), HeadError> {
    match len as usize {
        ..HEAD_LEN => Err(HeadError::LenBelowHead { len }),
        HEAD_LEN..=MAX_LEN => Ok(()),
        _ => Err(HeadError::LenAboveMost { len }),
    }
}

#[cfg(test)]
mod tests;
