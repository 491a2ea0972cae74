//! Sockets: where datagrams and frames wait for programs, and how programs send.
//!
//! ```text
//!   medium ─► NIC's buffer ══ hand_over ══► the socket's buffer ─► received ─► receive
//!   send ─► a buffer of the socket's ─► the discipline's queue ─► medium, and home again
//! ```
//!
//! A socket owns a pool, and everything that waits for it or was sent by it lies in buffers of that pool: who does not
//! read loses what comes for it, who sends too much is refused, and no other socket notices.

mod access;
mod error;
mod packet;
mod table;
mod udp;

use core::fmt;
use core::net::SocketAddrV4;
use core::ops::BitOr;
use std::collections::VecDeque;
use std::sync::Arc;

use crate::buf::{Chain, Pool};
use crate::discipline::{Channel, TimeView};
use crate::queue::Priority;
use crate::room;
use crate::time::{GlobalTime, Instant};

pub use access::{Access, Program};
pub use error::SocketError;
pub(crate) use packet::Packet;
pub use packet::{LinkAddress, LinkMode, LinkType};
pub(crate) use table::Table;
pub use udp::Lack;
pub(crate) use udp::Udp;

pub use crate::wire::udp_options::Times;

/// Buffers of a socket, unless it is said otherwise: RTnet's `socket_rtskbs`.
pub const DEFAULT_BUFFERS: usize = 16;
/// Buffers that a socket may be extended to, unless it was made with more: five of the longest datagrams.
pub const ROOM_TO_EXTEND: usize = 256;
/// Buffers that a socket may be made with.
pub const MOST_BUFFERS: usize = 4096;

/// Names a socket of a station; one that was closed is not named again for a long time.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SocketId {
    place: u16,
    generation: u32,
}

/// A socket that nobody has opened yet, made where memory may be taken: not in the real-time thread.
pub struct Socket {
    pub(crate) kind: Kind,
    pub(crate) pool: Arc<Pool>,
    pub(crate) received: VecDeque<Datagram>,
    pub(crate) options: Options,
    pub(crate) counters: SocketCounters,
}

pub(crate) enum Kind {
    Udp(Udp),
    Packet(Packet),
}

/// How a socket sends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Options {
    /// How urgent its frames are: 0 first, 30 last.
    pub priority: Priority,
    /// The slot that they leave in.
    pub channel: Channel,
    /// The type of service in their IP headers.
    pub tos: u8,
}

/// What a socket has counted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct SocketCounters {
    /// Datagrams or frames that came for it and are, or were, there to be read.
    pub received: u64,
    /// Such that found none of its buffers free.
    pub dropped: u64,
    /// Datagrams or frames that it sent.
    pub sent: u64,
    /// Sends that were refused for want of a buffer.
    pub no_buffers: u64,
    /// Sends that were refused for another reason...
    pub refused: u64,
    /// ... of them, for want of a route...
    pub no_route: u64,
    /// ... since no datagram, or no slot, takes as much...
    pub too_long: u64,
    /// ... and since the station has no such slot.
    pub no_slot: u64,
    /// Datagrams whose later fragments the discipline did not take: what had left is no datagram.
    pub cut_short: u64,
}

/// What waits to be read.
pub(crate) struct Datagram {
    pub chain: Chain,
    /// Where its content begins in the chain, and how long it is.
    pub begin: usize,
    pub len: usize,
    pub from: Sender,
    pub rx: Option<Instant>,
    pub times: Option<Times>,
}

/// Who sent what was received.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sender {
    /// To a UDP socket.
    Udp(SocketAddrV4),
    /// To a packet socket.
    Link(LinkAddress),
}

/// What a receive has found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Received {
    /// Bytes that were copied.
    pub len: usize,
    /// Bytes that there were: what did not fit is gone, unless it was only peeked at.
    pub whole: usize,
    /// Who sent it.
    pub from: Sender,
    /// When its last frame came, on this station's clock; `None` where the stamp could not be trusted.
    pub rx: Option<Instant>,
    /// The same on the master's clock, as far as that is known.
    pub global: Option<GlobalTime>,
    /// When it was sent, and left its sender's station, as that says; `None`: it does not.
    pub times: Option<Times>,
}

impl Received {
    /// Whether it was longer than the room for it (`MSG_TRUNC`).
    pub fn is_truncated(&self) -> bool {
        self.whole > self.len
    }
}

/// Flags of a send or a receive.
#[derive(Clone, Copy, PartialEq, Eq, Default)]
pub struct Flags(i32);

impl Flags {
    /// None.
    pub const NONE: Flags = Flags(0);
    /// Leave what is received where it is.
    pub const PEEK: Flags = Flags(libc::MSG_PEEK);
    /// Do not wait.
    pub const DONTWAIT: Flags = Flags(libc::MSG_DONTWAIT);
    /// Do not use a gateway.
    pub const DONTROUTE: Flags = Flags(libc::MSG_DONTROUTE);

    /// As a C program would write them.
    pub const fn from_bits(bits: i32) -> Self {
        Self(bits)
    }
    /// The same way round.
    pub const fn bits(self) -> i32 {
        self.0
    }
    /// Whether all of `other` are among these.
    pub const fn contains(self, other: Flags) -> bool {
        self.0 & other.0 == other.0
    }

    /// An error unless there are none but `known`.
    pub(crate) fn check(self, known: Flags) -> Result<(), SocketError> {
        match self.0 & !known.0 {
            0 => Ok(()),
            unknown if unknown & libc::MSG_OOB != 0 => Err(SocketError::NoUrgentData),
            unknown => Err(SocketError::WrongFlags(unknown)),
        }
    }
}

impl BitOr for Flags {
    type Output = Flags;
    fn bitor(self, other: Flags) -> Flags {
        Flags(self.0 | other.0)
    }
}

impl fmt::Debug for Flags {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Flags({:#x})", self.0)
    }
}

impl SocketId {
    /// The name of none.
    pub(crate) const NOBODY: SocketId = SocketId { place: u16::MAX, generation: 0 };
}

impl fmt::Debug for SocketId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "SocketId({}.{})", self.place, self.generation)
    }
}

impl Default for Options {
    fn default() -> Self {
        Self { priority: Priority::DEFAULT, channel: 0, tos: 0 }
    }
}

impl Socket {
    /// A UDP socket with this pool.
    pub fn udp(pool: Arc<Pool>) -> Box<Self> {
        Self::new(Kind::Udp(Udp::default()), pool)
    }

    /// A packet socket for frames of one EtherType, or for all.
    pub fn packet(mode: LinkMode, link_type: LinkType, pool: Arc<Pool>) -> Box<Self> {
        Self::new(Kind::Packet(Packet { mode, link_type }), pool)
    }

    /// Its buffers: to be extended or shrunk beside the real-time thread.
    pub fn pool(&self) -> &Arc<Pool> {
        &self.pool
    }
    /// What it has counted.
    pub fn counters(&self) -> SocketCounters {
        self.counters
    }

    /// Buffers in which something waits to be read.
    pub fn waiting(&self) -> usize {
        self.received.iter().map(|datagram| datagram.chain.count()).sum()
    }

    fn new(kind: Kind, pool: Arc<Pool>) -> Box<Self> {
        // Each of what waits takes a buffer at the least.
        let received = VecDeque::from(room::vec(pool.room()));
        let (options, counters) = (Options::default(), SocketCounters::default());
        Box::new(Self { kind, pool, received, options, counters })
    }

    /// Notes what has come, in buffers of its own.
    pub(crate) fn keep(&mut self, datagram: Datagram) {
        self.counters.received += 1;
        self.received.push_back(datagram);
    }

    pub(crate) fn as_udp(&self) -> Result<&Udp, SocketError> {
        match &self.kind {
            Kind::Udp(udp) => Ok(udp),
            Kind::Packet(_) => Err(SocketError::OtherKind("this is a packet socket, not one of UDP's")),
        }
    }

    pub(crate) fn as_udp_mut(&mut self) -> Result<&mut Udp, SocketError> {
        match &mut self.kind {
            Kind::Udp(udp) => Ok(udp),
            Kind::Packet(_) => Err(SocketError::OtherKind("this is a packet socket, not one of UDP's")),
        }
    }

    pub(crate) fn as_packet(&self) -> Result<&Packet, SocketError> {
        match &self.kind {
            Kind::Packet(packet) => Ok(packet),
            Kind::Udp(_) => Err(SocketError::OtherKind("this is a UDP socket, not a packet socket")),
        }
    }

    pub(crate) fn as_packet_mut(&mut self) -> Result<&mut Packet, SocketError> {
        match &mut self.kind {
            Kind::Packet(packet) => Ok(packet),
            Kind::Udp(_) => Err(SocketError::OtherKind("this is a UDP socket, not a packet socket")),
        }
    }

    /// The oldest that has come, copied as far as it fits. It goes unless it was only peeked at.
    pub(crate) fn read(&mut self, into: &mut [u8], flags: Flags) -> Result<Received, SocketError> {
        flags.check(Flags::PEEK | Flags::DONTWAIT)?;
        let datagram = self.received.front().ok_or(SocketError::WouldBlock)?;
        let room = into.len().min(datagram.len);
        let len = datagram.chain.copy_to(datagram.begin, &mut into[..room]);
        let received = Received { len, ..datagram.described() };
        if !flags.contains(Flags::PEEK) {
            self.received.pop_front();
        }
        Ok(received)
    }

    /// The same for who takes it as it lies.
    pub(crate) fn pass_on(
        &mut self,
        time: &TimeView,
        take: impl FnOnce(&Received, &mut dyn Iterator<Item = &[u8]>) -> bool,
    ) -> Result<(), SocketError> {
        let datagram = self.received.front().ok_or(SocketError::WouldBlock)?;
        let received = datagram.described();
        let global = received.rx.and_then(|rx| time.to_global(rx));
        if take(&Received { global, ..received }, &mut datagram.parts()) {
            self.received.pop_front();
        }
        Ok(())
    }
}

impl Datagram {
    fn described(&self) -> Received {
        let Datagram { len, from, rx, times, .. } = *self;
        Received { len, whole: len, from, rx, global: None, times }
    }

    /// Its content, without what is around it.
    fn parts(&self) -> impl Iterator<Item = &[u8]> {
        let (mut skip, mut left) = (self.begin, self.len);
        self.chain.parts().map(move |part| {
            let (whole, part) = (part.len(), &part[skip.min(part.len())..]);
            skip = skip.saturating_sub(whole);
            let part = &part[..left.min(part.len())];
            left -= part.len();
            part
        })
    }
}
