//! Frames as a sending kernel hands them to a card that cuts and sums: `struct virtio_net_hdr` of linux/virtio_net.h, which
//! the kernel writes in front of each frame of a packet socket with `PACKET_VNET_HDR`.
//!
//! ```text
//!  0       1          2         4          6            8             10
//!  +-------+----------+---------+----------+------------+-------------+------
//!  | flags | GSO type | headers | GSO size | sum begins | sum's field | frame
//!  | 1: sum| 0: whole | bytes   | bytes of | at         | behind that |
//!  +-------+----------+---------+----------+------------+-------------+------   in the machine's byte order
//!
//!  one frame, uncut:   headers | payload of 2300 bytes              GSO size 1000
//!  what is meant:      headers | 1000    headers | 1000    headers | 300
//! ```
//!
//! Over a veth, and from a card that puts datagrams together (GRO), such frames come as they are. Here each is cut into what
//! was meant. UDP needs no checksum then, a field of 0 says so; all other missing sums are computed. A jumbo frame, which is
//! whole and longer than a buffer, is cut into the fragments that a router would have made of its packet.

use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

use super::checksum::{Checksum, checksum};
use super::ethernet::{self, EtherType};
use super::ipv4::{self, Protocol};
use crate::buf::ROOM;

/// Bytes in front of each frame.
pub const HEADER_LEN: usize = size_of::<Offload>();
/// The longest frame that is left uncut: the longest IPv4 packet behind an Ethernet header.
pub const LONGEST: usize = ethernet::HEADER_LEN + ipv4::MAX_TOTAL;

const NEEDS_SUM: u8 = 1;
const WHOLE: u8 = 0;
const TCP: u8 = 1;
const UDP: u8 = 5;
/// TCP's congestion notification, a flag of the GSO type.
const ECN: u8 = 0x80;

const UDP_HEADER_LEN: usize = 8;
const UDP_LEN_AT: usize = 4;
const UDP_SUM_AT: usize = 6;
const TCP_LEAST: usize = 20;
const TCP_SEQUENCE_AT: usize = 4;
const TCP_OFFSET_AT: usize = 12;
const TCP_FLAGS_AT: usize = 13;
const TCP_SUM_AT: usize = 16;
/// FIN and PSH are of the last segment, CWR is of the first.
const TCP_OF_THE_LAST: u8 = 0x01 | 0x08;
const TCP_OF_THE_FIRST: u8 = 0x80;
const PROTOCOL_TCP: Protocol = Protocol(6);

const IP_TOTAL_AT: usize = 2;
const IP_ID_AT: usize = 4;
const IP_FLAGS_AT: usize = 6;
const IP_DONT_FRAGMENT: u16 = 0x4000;
const IP_MORE_FRAGMENTS: u16 = 0x2000;
/// Offsets of fragments are in units of this.
const IP_UNIT: usize = 8;
const IP_PROTOCOL_AT: usize = 9;
const IP_SUM_AT: usize = 10;
const IP_ADDRESSES_AT: usize = 12;

/// The work on a frame that its sender left to a card.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, FromBytes, IntoBytes, KnownLayout, Immutable)]
#[repr(C)]
pub struct Offload {
    flags: u8,
    gso_type: u8,
    header_len: u16,
    gso_size: u16,
    sum_start: u16,
    sum_offset: u16,
}

const _: () = assert!(HEADER_LEN == 10);

/// How a frame is cut into those that were meant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Cut {
    /// Where its transport header begins, and its payload.
    transport: usize,
    payload: usize,
    /// Bytes of payload in all frames but the last.
    size: usize,
    /// Bytes of the whole frame.
    end: usize,
    into: Into,
}

/// The kinds of frames that a frame is cut into.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Into {
    Datagrams,
    Segments,
    Fragments,
}

/// A frame that nobody here can cut: of another protocol than UDP and TCP over IPv4, cut to more than a buffer holds, or with
/// fields that contradict each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CannotCut;

impl Offload {
    /// Whether the frame is several, which were not cut yet.
    pub fn is_uncut(&self) -> bool {
        self.gso_type & !ECN != WHOLE
    }

    /// How the frame, which is uncut, is cut.
    ///
    /// # Errors
    /// It cannot be.
    pub fn cut(&self, frame: &[u8]) -> Result<Cut, CannotCut> {
        let (transport, protocol) = transport(frame)?;
        let (into, expected) = match self.gso_type & !ECN {
            UDP => (Into::Datagrams, Protocol::UDP),
            TCP => (Into::Segments, PROTOCOL_TCP),
            _ => return Err(CannotCut),
        };
        let (head, least) = match into {
            Into::Segments => {
                let offset = frame.get(transport + TCP_OFFSET_AT).map_or(0, |byte| byte >> 4);
                (usize::from(offset) * 4, TCP_LEAST)
            }
            Into::Datagrams | Into::Fragments => (UDP_HEADER_LEN, UDP_HEADER_LEN),
        };
        let is_one = protocol == expected && head >= least;
        let cut =
            Cut { transport, payload: transport + head, size: self.gso_size.into(), end: frame.len(), into };
        Some(cut).filter(|cut| is_one && cut.fits()).ok_or(CannotCut)
    }

    /// Completes the checksum of a whole frame, if its sender has left that to a card. A datagram of IPv4's UDP gets none.
    pub fn complete(&self, frame: &mut [u8]) {
        if self.flags & NEEDS_SUM == 0 {
            return;
        }
        let (start, at) =
            (usize::from(self.sum_start), usize::from(self.sum_start) + usize::from(self.sum_offset));
        let is_ipv4 =
            ethernet::Header::parse(frame).is_some_and(|(link, _)| link.ether_type() == EtherType::IPV4);
        let sum = match frame.get(start..) {
            Some(_) if is_ipv4 && usize::from(self.sum_offset) == UDP_SUM_AT => 0,
            // The field holds the pseudo header's part.
            Some(summed) => checksum(summed),
            None => return,
        };
        if let Some(field) = frame.get_mut(at..at + 2) {
            field.copy_from_slice(&sum.to_be_bytes());
        }
    }
}

/// Where the transport header of a frame begins, and of which protocol.
fn transport(frame: &[u8]) -> Result<(usize, Protocol), CannotCut> {
    let (link, packet) = ethernet::Header::parse(frame).ok_or(CannotCut)?;
    let (first, protocol) = (packet.first().ok_or(CannotCut)?, packet.get(IP_PROTOCOL_AT).ok_or(CannotCut)?);
    let ip_len = usize::from(first & 0xf) * 4;
    let is_ipv4 = link.ether_type() == EtherType::IPV4 && ip_len >= ipv4::HEADER_LEN;
    is_ipv4.then_some((ethernet::HEADER_LEN + ip_len, Protocol(*protocol))).ok_or(CannotCut)
}

impl Cut {
    /// How a frame that is whole, and longer than a buffer, is cut into fragments.
    ///
    /// # Errors
    /// It holds no IPv4 packet.
    pub fn into_fragments(frame: &[u8]) -> Result<Self, CannotCut> {
        let (payload, _) = transport(frame)?;
        let size = ROOM.saturating_sub(payload) / IP_UNIT * IP_UNIT;
        let total = ethernet::HEADER_LEN + usize::from(get(frame, ethernet::HEADER_LEN + IP_TOTAL_AT));
        let cut =
            Cut { transport: payload, payload, size, end: frame.len().min(total), into: Into::Fragments };
        Some(cut).filter(Cut::fits).ok_or(CannotCut)
    }

    fn fits(&self) -> bool {
        let Self { payload, size, end, .. } = *self;
        size > 0 && payload < end && end <= LONGEST && payload + size <= ROOM
    }

    /// How many frames there are in it; at least one.
    pub fn count(&self) -> usize {
        (self.end - self.payload).div_ceil(self.size)
    }

    /// Writes the frame of this number, of those that were meant, and tells its length. `uncut` is what was cut.
    pub fn write(&self, uncut: &[u8], number: usize, into: &mut [u8; ROOM]) -> usize {
        let Self { transport, payload, size, end, into: kind } = *self;
        let begin = payload + number * size;
        let content = &uncut[begin..end.min(begin + size)];
        let len = payload + content.len();
        into[..payload].copy_from_slice(&uncut[..payload]);
        into[payload..len].copy_from_slice(content);
        let (head, rest) = into[ethernet::HEADER_LEN..len].split_at_mut(transport - ethernet::HEADER_LEN);
        let (behind, is_last) = (number * size, begin + size >= end);
        match kind {
            Into::Fragments => write_fragment(head, behind, is_last),
            Into::Datagrams | Into::Segments => {
                put(head, IP_ID_AT, get(head, IP_ID_AT).wrapping_add(number as u16));
            }
        }
        write_ip(head, rest.len());
        match kind {
            Into::Segments => write_tcp(head, rest, behind as u32, number == 0, is_last),
            Into::Datagrams => {
                put(rest, UDP_LEN_AT, rest.len() as u16);
                put(rest, UDP_SUM_AT, 0);
            }
            Into::Fragments => {}
        }
        len
    }
}

/// Where in its datagram a fragment is that begins so many bytes behind its packet's payload; that may be a fragment itself.
fn write_fragment(head: &mut [u8], behind: usize, is_last: bool) {
    let more = if is_last { 0 } else { IP_MORE_FRAGMENTS };
    let flags = get(head, IP_FLAGS_AT) & !IP_DONT_FRAGMENT | more;
    put(head, IP_FLAGS_AT, flags.wrapping_add((behind / IP_UNIT) as u16));
}

/// Length and checksum of the IP header in front of so many bytes.
fn write_ip(head: &mut [u8], behind: usize) {
    put(head, IP_TOTAL_AT, (head.len() + behind) as u16);
    put(head, IP_SUM_AT, 0);
    put(head, IP_SUM_AT, checksum(head));
}

/// The TCP header of the segment that begins so many bytes behind the first, and its checksum.
fn write_tcp(ip: &[u8], segment: &mut [u8], begin: u32, is_first: bool, is_last: bool) {
    let sequence = &mut segment[TCP_SEQUENCE_AT..TCP_SEQUENCE_AT + 4];
    let first = u32::from_be_bytes([sequence[0], sequence[1], sequence[2], sequence[3]]);
    sequence.copy_from_slice(&first.wrapping_add(begin).to_be_bytes());
    let flags = &mut segment[TCP_FLAGS_AT];
    *flags &= if is_last { 0xff } else { !TCP_OF_THE_LAST };
    *flags &= if is_first { 0xff } else { !TCP_OF_THE_FIRST };
    put(segment, TCP_SUM_AT, 0);
    let mut sum = Checksum::new();
    sum.add(&ip[IP_ADDRESSES_AT..IP_ADDRESSES_AT + 8]);
    sum.add(&[0, PROTOCOL_TCP.0]);
    sum.add(&(segment.len() as u16).to_be_bytes());
    sum.add(segment);
    put(segment, TCP_SUM_AT, sum.finish());
}

fn get(bytes: &[u8], at: usize) -> u16 {
    u16::from_be_bytes([bytes[at], bytes[at + 1]])
}

fn put(bytes: &mut [u8], at: usize, value: u16) {
    bytes[at..at + 2].copy_from_slice(&value.to_be_bytes());
}

#[cfg(test)]
mod tests;
