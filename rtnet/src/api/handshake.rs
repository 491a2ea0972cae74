//! What a program and a station tell each other when a socket is opened, bound or closed: packets on the station's control
//! socket. A connection is one socket's: who hangs up closes it. One that asks for the time needs no socket, and is told by
//! being hung up on that the station has ended.
//!
//! ```text
//! ask     "RTN2"  what 1  mode 1  port or EtherType 2  address 4  number 4
//! answer  "RTN2"  error 4 (0: done)  port 2  unused 2  address 4  number 4      and, to `Open`: memory, gate, doorbell; to `Time`: page
//! ```

use core::net::{Ipv4Addr, SocketAddrV4};

use zerocopy::byteorder::network_endian::{U16, U32};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use crate::socket::{LinkMode, LinkType};
use crate::wire::ethernet::EtherType;

/// Begins every packet: no other request to a station begins so. Another number, another order of what is in packets or in the
/// memory in common.
pub const MAGIC: [u8; 4] = *b"RTN2";
/// Bytes of an ask.
pub const ASK_LEN: usize = size_of::<RawAsk>();
/// Bytes of an answer.
pub const ANSWER_LEN: usize = size_of::<RawAnswer>();
/// Descriptors that come with the answer to an opening.
pub const DESCRIPTORS: usize = 3;

/// What a program asks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ask {
    /// A UDP socket with so many buffers; 0: the station's default.
    OpenUdp(u32),
    /// A packet socket.
    OpenPacket(LinkMode, LinkType, u32),
    /// Hear at this address and port.
    Bind(SocketAddrV4),
    /// Hear frames of this type.
    BindLink(LinkType),
    /// Send to this peer, and hear nobody else; `None`: nobody, and all.
    Connect(Option<SocketAddrV4>),
    /// So many buffers more.
    Extend(u32),
    /// So many less.
    Shrink(u32),
    /// Where it hears.
    LocalAddress,
    /// Whom it is connected to.
    PeerAddress,
    /// Where the station shows its time.
    Time,
}

/// What the station answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Answer {
    /// Why not, as a number of `errno`; 0: done.
    pub errno: i32,
    /// The address that was asked for.
    pub address: SocketAddrV4,
    /// How many buffers were really added or removed.
    pub number: u32,
}

#[derive(FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
struct RawAsk {
    magic: [u8; 4],
    what: u8,
    mode: u8,
    port: U16,
    address: [u8; 4],
    number: U32,
}

#[derive(FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
struct RawAnswer {
    magic: [u8; 4],
    errno: U32,
    port: U16,
    unused: U16,
    address: [u8; 4],
    number: U32,
}

const OPEN_UDP: u8 = 1;
const OPEN_PACKET: u8 = 2;
const BIND: u8 = 3;
const BIND_LINK: u8 = 4;
const CONNECT: u8 = 5;
const DISCONNECT: u8 = 6;
const EXTEND: u8 = 7;
const SHRINK: u8 = 8;
const LOCAL_ADDRESS: u8 = 9;
const PEER_ADDRESS: u8 = 10;
const TIME: u8 = 11;

const RAW: u8 = 0;
const DATAGRAM: u8 = 1;
/// Beside the mode: which frames.
const OF_ONE_TYPE: u8 = 0;
const OF_ALL: u8 = 2;
const OF_NONE: u8 = 4;

/// Whether a packet is for the sockets' side of a station.
pub fn is_ask(packet: &[u8]) -> bool {
    packet.starts_with(&MAGIC)
}

impl Ask {
    /// As a packet.
    pub fn to_bytes(&self) -> [u8; ASK_LEN] {
        let nowhere = SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0);
        let (what, mode, to, number) = match *self {
            Ask::OpenUdp(n) => (OPEN_UDP, 0, nowhere, n),
            Ask::OpenPacket(mode, link_type, n) => {
                let mode = if mode == LinkMode::Raw { RAW } else { DATAGRAM };
                let (which, ether_type) = pack_type(link_type);
                (OPEN_PACKET, mode | which, SocketAddrV4::new(*nowhere.ip(), ether_type), n)
            }
            Ask::Bind(to) => (BIND, 0, to, 0),
            Ask::BindLink(link_type) => {
                let (which, ether_type) = pack_type(link_type);
                (BIND_LINK, which, SocketAddrV4::new(*nowhere.ip(), ether_type), 0)
            }
            Ask::Connect(Some(to)) => (CONNECT, 0, to, 0),
            Ask::Connect(None) => (DISCONNECT, 0, nowhere, 0),
            Ask::Extend(n) => (EXTEND, 0, nowhere, n),
            Ask::Shrink(n) => (SHRINK, 0, nowhere, n),
            Ask::LocalAddress => (LOCAL_ADDRESS, 0, nowhere, 0),
            Ask::PeerAddress => (PEER_ADDRESS, 0, nowhere, 0),
            Ask::Time => (TIME, 0, nowhere, 0),
        };
        let raw = RawAsk {
            magic: MAGIC,
            what,
            mode,
            port: U16::new(to.port()),
            address: to.ip().octets(),
            number: U32::new(number),
        };
        zerocopy::transmute!(raw)
    }

    /// Reads a packet; `None`: nothing that could be asked.
    pub fn parse(packet: &[u8]) -> Option<Self> {
        let raw = RawAsk::ref_from_bytes(packet).ok().filter(|raw| raw.magic == MAGIC)?;
        let to = SocketAddrV4::new(raw.address.into(), raw.port.get());
        let number = raw.number.get();
        Some(match raw.what {
            OPEN_UDP => Ask::OpenUdp(number),
            OPEN_PACKET => {
                let mode = if raw.mode & DATAGRAM == RAW { LinkMode::Raw } else { LinkMode::Datagram };
                Ask::OpenPacket(mode, unpack_type(raw)?, number)
            }
            BIND => Ask::Bind(to),
            BIND_LINK => Ask::BindLink(unpack_type(raw)?),
            CONNECT => Ask::Connect(Some(to)),
            DISCONNECT => Ask::Connect(None),
            EXTEND => Ask::Extend(number),
            SHRINK => Ask::Shrink(number),
            LOCAL_ADDRESS => Ask::LocalAddress,
            PEER_ADDRESS => Ask::PeerAddress,
            TIME => Ask::Time,
            _ => return None,
        })
    }
}

fn pack_type(link_type: LinkType) -> (u8, u16) {
    match link_type {
        LinkType::Nothing => (OF_NONE, 0),
        LinkType::Only(EtherType(of)) => (OF_ONE_TYPE, of),
        LinkType::All => (OF_ALL, 0),
    }
}

fn unpack_type(raw: &RawAsk) -> Option<LinkType> {
    match raw.mode & !DATAGRAM {
        OF_NONE => Some(LinkType::Nothing),
        OF_ONE_TYPE => Some(LinkType::Only(EtherType(raw.port.get()))),
        OF_ALL => Some(LinkType::All),
        _ => None,
    }
}

impl Answer {
    /// It is done.
    pub const DONE: Answer =
        Answer { errno: 0, address: SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0), number: 0 };

    /// It is not, and why.
    pub const fn refused(errno: i32) -> Self {
        Self { errno, ..Self::DONE }
    }

    /// As a packet.
    pub fn to_bytes(&self) -> [u8; ANSWER_LEN] {
        let raw = RawAnswer {
            magic: MAGIC,
            errno: U32::new(self.errno.unsigned_abs()),
            port: U16::new(self.address.port()),
            unused: U16::ZERO,
            address: self.address.ip().octets(),
            number: U32::new(self.number),
        };
        zerocopy::transmute!(raw)
    }

    /// Reads a packet; `None`: no answer.
    pub fn parse(packet: &[u8]) -> Option<Self> {
        let raw = RawAnswer::ref_from_bytes(packet).ok().filter(|raw| raw.magic == MAGIC)?;
        Some(Self {
            errno: i32::try_from(raw.errno.get()).ok()?,
            address: SocketAddrV4::new(raw.address.into(), raw.port.get()),
            number: raw.number.get(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_ask_and_answer_is_read_as_it_was_written() {
        let to = "10.0.0.3:36000".parse().unwrap();
        let only = LinkType::Only(EtherType(0x88b6));
        let mut asks = vec![
            Ask::OpenUdp(u32::MAX),
            Ask::Bind(to),
            Ask::Connect(Some(to)),
            Ask::Connect(None),
            Ask::Extend(7),
            Ask::Shrink(8),
            Ask::LocalAddress,
            Ask::PeerAddress,
            Ask::Time,
        ];
        for link_type in [LinkType::Nothing, only, LinkType::All] {
            let modes = [LinkMode::Raw, LinkMode::Datagram];
            asks.extend(modes.map(|mode| Ask::OpenPacket(mode, link_type, 16)));
            asks.push(Ask::BindLink(link_type));
        }
        for ask in asks {
            assert!(is_ask(&ask.to_bytes()));
            assert_eq!(Ask::parse(&ask.to_bytes()), Some(ask));
        }
        for answer in
            [Answer::DONE, Answer::refused(libc::EADDRINUSE), Answer { address: to, number: 9, errno: 0 }]
        {
            assert_eq!(Answer::parse(&answer.to_bytes()), Some(answer));
        }
    }

    #[test]
    fn what_is_no_ask_is_none() {
        let good = Ask::LocalAddress.to_bytes();
        for len in 0..good.len() {
            assert_eq!(Ask::parse(&good[..len]), None);
        }
        assert_eq!(Ask::parse(&[&good[..], &[0]].concat()), None);
        for (at, byte) in [(0, b'r'), (4, 0), (4, 12)] {
            let mut bad = good;
            bad[at] = byte;
            assert_eq!(Ask::parse(&bad), None);
        }
        let mut bad = Ask::BindLink(LinkType::All).to_bytes();
        bad[5] = 6;
        assert_eq!(Ask::parse(&bad), None, "all and none");
    }
}
