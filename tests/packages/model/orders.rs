//! What processes are told to do, and what they tell of it.

use super::*;

/// What a process is told to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Do {
    Send,
    Receive,
    TryReceive,
    /// The length is that of the room.
    ReceiveInto,
    PutBack,
    Clean,
    Depth,
    /// It sleeps until there is something.
    Wait,
    /// The new sender is there before the old one of that handle has gone.
    Bind,
    Unbind,
    Create,
    Delete,
    /// A mailbox of another's name.
    CreateOthers,
}

pub const ALL: [Do; 13] = [
    Do::Send,
    Do::Receive,
    Do::TryReceive,
    Do::ReceiveInto,
    Do::PutBack,
    Do::Clean,
    Do::Depth,
    Do::Wait,
    Do::Bind,
    Do::Unbind,
    Do::Create,
    Do::Delete,
    Do::CreateOthers,
];

#[derive(Clone, Copy, Debug)]
pub struct Order {
    pub what: Do,
    pub handle: u8,
    /// Which process' mailbox, or which shape.
    pub target: u8,
    pub priority: u8,
    pub len: u16,
    /// Of a package, which its body follows from.
    pub number: u32,
}

pub const ORDER_LEN: usize = 10;

impl Order {
    pub fn to_bytes(self) -> [u8; ORDER_LEN] {
        let mut bytes = [self.what as u8, self.handle, self.target, self.priority, 0, 0, 0, 0, 0, 0];
        bytes[4..6].copy_from_slice(&self.len.to_le_bytes());
        bytes[6..].copy_from_slice(&self.number.to_le_bytes());
        bytes
    }

    pub fn parse(bytes: &[u8; ORDER_LEN]) -> Self {
        let [what, handle, target, priority, len @ .., a, b, c, d] = *bytes;
        let what = ALL[usize::from(what)];
        let (len, number) = (u16::from_le_bytes(len), u32::from_le_bytes([a, b, c, d]));
        Self { what, handle, target, priority, len, number }
    }
}

/// What comes of it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Told {
    Done,
    /// The number that a package was sent with.
    Sent(u8),
    Received(Came),
    Nothing,
    TooSmall(TooSmall),
    Count(usize),
    NotSent(SendError),
    Refused(Refused),
    /// A sender that goes, and what it has sent, and what of it not: full, too large, replaced.
    Gone([u64; 4]),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Came {
    pub from: MailboxName,
    pub to: MailboxName,
    pub kind: i8,
    pub priority: u8,
    pub id: u8,
    pub len: usize,
    pub sum: u64,
}

pub type Words = [u64; 6];
pub const TOLD_LEN: usize = size_of::<Words>();

impl Told {
    /// So that two of them are the same if their words are.
    pub fn words(&self) -> Words {
        let text = |text: String| sum(text.as_bytes());
        match self {
            Told::Done => [0; 6],
            Told::Sent(id) => [1, u64::from(*id), 0, 0, 0, 0],
            Told::Received(Came { from, to, kind, priority, id, len, sum }) => {
                let marks = u64::from_le_bytes([*kind as u8, *priority, *id, 0, 0, 0, 0, 0]);
                [2, from.0.into(), to.0.into(), marks, *len as u64, *sum]
            }
            Told::Nothing => [3, 0, 0, 0, 0, 0],
            Told::TooSmall(TooSmall { got, needed }) => [4, *got as u64, *needed as u64, 0, 0, 0],
            Told::Count(count) => [5, *count as u64, 0, 0, 0, 0],
            Told::NotSent(error) => [6, text(format!("{error:?}")), 0, 0, 0, 0],
            Told::Refused(refused) => [7, text(format!("{refused:?}")), 0, 0, 0, 0],
            Told::Gone([sent, full, too_large, replaced]) => [8, *sent, *full, *too_large, *replaced, 0],
        }
    }
}

pub fn sum(bytes: &[u8]) -> u64 {
    bytes
        .iter()
        .fold(0xcbf2_9ce4_8422_2325, |sum, byte| (sum ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3))
}

pub fn body(number: u32, len: usize) -> impl Iterator<Item = u8> {
    (0..len as u32)
        .map(move |at| (number.wrapping_mul(0x9e37_79b1).wrapping_add(at * 0x0101_6b01) >> 16) as u8)
}

pub fn kind(number: u32) -> i8 {
    (number % 251) as u8 as i8
}

pub fn member_name(member: usize) -> MailboxName {
    name(0x30 + member as u8, 7)
}

// ---- one of the processes ----
