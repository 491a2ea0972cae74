//! The IPv4 header (RFC 791). What is sent has no options; those of others are skipped.
//!
//! ```text
//!    0     4     8           16    19                31
//!    +-----+-----+-----------+-----+-----------------+
//!  0 |  4  | IHL |    TOS    |     total length      |   IHL: header in words of 4 bytes, 5 without options
//!    +-----+-----+-----------+-----+-----------------+
//!  4 |    identification     |flags|     offset      |   flags 0x4000 don't fragment, 0x2000 more fragments
//!    +-----------+-----------+-----+-----------------+   offset in units of 8 bytes
//!  8 |    TTL    | protocol  |       checksum        |   of header and options
//!    +-----------+-----------+-----------------------+
//! 12 |                    source                     |
//!    +-----------------------------------------------+
//! 16 |                  destination                  |
//!    +-----------------------------------------------+
//! 20 |  options, 40 bytes at most; payload; padding behind the total length
//! ```

use core::net::Ipv4Addr;

use zerocopy::byteorder::network_endian::U16;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use super::checksum::checksum;
use crate::counters::Refusal;

/// Bytes of a header without options.
pub const HEADER_LEN: usize = size_of::<Header>();
/// What senders write: nobody here counts hops.
pub const TTL: u8 = 255;
/// Longest packet, header included.
pub const MAX_TOTAL: usize = 65_535;

/// What a packet carries.
#[derive(
    Clone,
    Copy,
    Debug,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    FromBytes,
    IntoBytes,
    KnownLayout,
    Immutable,
    Unaligned,
)]
#[repr(transparent)]
pub struct Protocol(pub u8);

/// The first 20 bytes of every packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
pub struct Header {
    version_ihl: u8,
    tos: u8,
    total_len: U16,
    identification: U16,
    flags_offset: U16,
    ttl: u8,
    protocol: Protocol,
    checksum: U16,
    source: [u8; 4],
    destination: [u8; 4],
}

/// What a sender says of a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fields {
    /// Who sends it.
    pub source: Ipv4Addr,
    /// Who it is for.
    pub destination: Ipv4Addr,
    /// What it carries.
    pub protocol: Protocol,
    /// Type of service, as the socket has it.
    pub tos: u8,
    /// The same in all fragments of a datagram, and in no other datagram for long.
    pub identification: u16,
    /// Nobody on the way may fragment it.
    pub dont_fragment: bool,
    /// It is not the datagram's last fragment.
    pub more_fragments: bool,
    /// Where in the datagram its payload begins: bytes, a multiple of 8.
    pub offset: u16,
    /// Bytes behind the header; with `offset` at most [`MAX_TOTAL`] - [`HEADER_LEN`].
    pub payload_len: u16,
}

const _: () = assert!(HEADER_LEN == 20);

const VERSION: u8 = 4;
const DONT_FRAGMENT: u16 = 0x4000;
const MORE_FRAGMENTS: u16 = 0x2000;
const OFFSET: u16 = 0x1fff;
/// Payloads of fragments begin at multiples of this.
const UNIT: u16 = 8;

impl Protocol {
    /// Echo requests and replies, and what is not spoken here.
    pub const ICMP: Protocol = Protocol(1);
    /// Datagrams.
    pub const UDP: Protocol = Protocol(17);
}

/// Splits a packet, which is what follows the Ethernet header, into its header and its payload: without
/// options, and without what is behind the total length.
///
/// What ends before the 20 bytes do is `Truncated`, before its options do `IpHeaderLength`, before its
/// payload does `IpLength`.
pub fn parse(packet: &[u8]) -> Result<(&Header, &[u8]), Refusal> {
    let (header, _) = Header::ref_from_prefix(packet).map_err(|_| Refusal::Truncated)?;
    if header.version_ihl >> 4 != VERSION {
        return Err(Refusal::IpVersion);
    }
    let begin = header.header_len();
    let with_options = packet.get(..begin).filter(|_| begin >= HEADER_LEN).ok_or(Refusal::IpHeaderLength)?;
    if checksum(with_options) != 0 {
        return Err(Refusal::IpChecksum);
    }
    let payload = packet.get(begin..usize::from(header.total_len())).ok_or(Refusal::IpLength)?;
    if header.ttl == 0 {
        return Err(Refusal::IpTtl);
    }
    if !header.is_part_of_something(payload.len()) {
        return Err(Refusal::IpFragment);
    }
    Ok((header, payload))
}

impl Header {
    /// A header to be written in front of a payload, without options, complete with its checksum.
    pub fn new(fields: &Fields) -> Header {
        let end = usize::from(fields.offset) + usize::from(fields.payload_len);
        debug_assert!(fields.offset.is_multiple_of(UNIT) && HEADER_LEN + end <= MAX_TOTAL, "{fields:?}");
        let flag = |set, flag| if set { flag } else { 0 };
        let flags = flag(fields.dont_fragment, DONT_FRAGMENT) | flag(fields.more_fragments, MORE_FRAGMENTS);
        let mut header = Header {
            version_ihl: VERSION << 4 | (HEADER_LEN / 4) as u8,
            tos: fields.tos,
            total_len: U16::new(fields.payload_len.saturating_add(HEADER_LEN as u16)),
            identification: U16::new(fields.identification),
            flags_offset: U16::new(flags | (fields.offset / UNIT)),
            ttl: TTL,
            protocol: fields.protocol,
            checksum: U16::ZERO,
            source: fields.source.octets(),
            destination: fields.destination.octets(),
        };
        header.checksum = U16::new(checksum(header.as_bytes()));
        header
    }

    /// Who sent it.
    pub fn source(&self) -> Ipv4Addr {
        self.source.into()
    }
    /// What it was made of.
    pub fn fields(&self) -> Fields {
        Fields {
            source: self.source(),
            destination: self.destination(),
            protocol: self.protocol(),
            tos: self.tos(),
            identification: self.identification(),
            dont_fragment: self.dont_fragment(),
            more_fragments: self.more_fragments(),
            offset: self.offset(),
            payload_len: self.total_len().saturating_sub(self.header_len() as u16),
        }
    }
    /// Who it is for.
    pub fn destination(&self) -> Ipv4Addr {
        self.destination.into()
    }
    /// What it carries.
    pub fn protocol(&self) -> Protocol {
        self.protocol
    }
    /// Type of service.
    pub fn tos(&self) -> u8 {
        self.tos
    }
    /// How many hops it had left.
    pub fn ttl(&self) -> u8 {
        self.ttl
    }
    /// Which datagram of its sender it belongs to.
    pub fn identification(&self) -> u16 {
        self.identification.get()
    }
    /// Whether nobody on the way may fragment it.
    pub fn dont_fragment(&self) -> bool {
        self.flags_offset.get() & DONT_FRAGMENT != 0
    }
    /// Whether it is not the datagram's last fragment.
    pub fn more_fragments(&self) -> bool {
        self.flags_offset.get() & MORE_FRAGMENTS != 0
    }
    /// Where in the datagram its payload begins, in bytes.
    pub fn offset(&self) -> u16 {
        (self.flags_offset.get() & OFFSET) * UNIT
    }
    /// Bytes of header, options and payload.
    pub fn total_len(&self) -> u16 {
        self.total_len.get()
    }
    /// Bytes of header and options.
    pub fn header_len(&self) -> usize {
        usize::from(self.version_ihl & 0xf) * 4
    }
    /// Whether it is not a whole datagram.
    pub fn is_fragment(&self) -> bool {
        self.offset() != 0 || self.more_fragments()
    }

    /// Whether a datagram can be put together with it: all but its last fragment end where another can
    /// begin, and none beyond what the longest datagram has.
    fn is_part_of_something(&self, len: usize) -> bool {
        let goes_on = len > 0 && len.is_multiple_of(usize::from(UNIT));
        (goes_on || !self.more_fragments()) && usize::from(self.offset()) + len <= MAX_TOTAL - HEADER_LEN
    }
}

#[cfg(test)]
mod tests;
