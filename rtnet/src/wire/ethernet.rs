//! The Ethernet header.
//!
//! ```text
//! 0            6            12        14
//! +------------+------------+---------+----------------
//! | destination| source     |EtherType| payload, padded so that the frame has at least 60 bytes
//! +------------+------------+---------+----------------
//! ```

use core::fmt;
use core::str::FromStr;

use zerocopy::byteorder::network_endian::U16;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

/// Bytes of an Ethernet header.
pub const HEADER_LEN: usize = size_of::<Header>();
/// Shortest frame on the wire, without its check sequence.
pub const MIN_FRAME: usize = 60;
/// What a frame costs on the medium besides its bytes: preamble 8, check sequence 4, gap 12.
pub const OVERHEAD: usize = 24;
/// Of that, the gap behind the frame: nobody's bits.
pub const GAP: usize = 12;
/// Longest payload of a frame.
pub const MTU: usize = 1500;

/// A station's address on the medium.
#[derive(
    Clone,
    Copy,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    Default,
    FromBytes,
    IntoBytes,
    KnownLayout,
    Immutable,
    Unaligned,
)]
#[repr(transparent)]
pub struct Address(pub [u8; 6]);

/// What a frame carries.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct EtherType(pub u16);

/// The first 14 bytes of every frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
pub struct Header {
    /// Who it is for.
    pub destination: Address,
    /// Who sent it.
    pub source: Address,
    ether_type: U16,
}

const _: () = assert!(HEADER_LEN == 14);

impl Address {
    /// Every station on the medium.
    pub const BROADCAST: Address = Address([0xff; 6]);

    /// Whether it names more than one station.
    pub fn is_group(&self) -> bool {
        self.0[0] & 1 == 1
    }
}

impl EtherType {
    /// Packets of IPv4.
    pub const IPV4: EtherType = EtherType(0x0800);
    /// Who has which IPv4 address.
    pub const ARP: EtherType = EtherType(0x0806);
    /// Packets of IPv6.
    pub const IPV6: EtherType = EtherType(0x86dd);
    /// RTmac: TDMA's control frames and the tunnel.
    pub const RTMAC: EtherType = EtherType(0x9021);
    /// IEEE 802 local experimental 1: the lab's test traffic.
    pub const EXPERIMENTAL: EtherType = EtherType(0x88b5);
}

impl Header {
    /// A header to be written in front of a payload.
    pub fn new(destination: Address, source: Address, ether_type: EtherType) -> Self {
        Self { destination, source, ether_type: U16::new(ether_type.0) }
    }

    /// Splits a frame into its header and the rest; `None` when it is shorter than a header.
    #[inline]
    pub fn parse(frame: &[u8]) -> Option<(&Header, &[u8])> {
        Header::ref_from_prefix(frame).ok()
    }

    /// What follows the header.
    pub fn ether_type(&self) -> EtherType {
        EtherType(self.ether_type.get())
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [a, b, c, d, e, g] = self.0;
        write!(f, "{a:02x}:{b:02x}:{c:02x}:{d:02x}:{e:02x}:{g:02x}")
    }
}

impl fmt::Debug for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl fmt::Debug for EtherType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "0x{:04x}", self.0)
    }
}

/// Not six bytes in hexadecimal.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("'{0}' is not an Ethernet address: write six bytes in hexadecimal, as 02:00:00:00:00:01")]
pub struct NotAnAddress(String);

impl FromStr for Address {
    type Err = NotAnAddress;

    fn from_str(text: &str) -> Result<Self, NotAnAddress> {
        let parse = || {
            let mut bytes = [0; 6];
            let mut parts = text.split(':');
            for byte in &mut bytes {
                let part = parts.next().filter(|p| p.len() == 2)?;
                *byte = u8::from_str_radix(part, 16).ok()?;
            }
            parts.next().is_none().then_some(Address(bytes))
        };
        parse().ok_or_else(|| NotAnAddress(text.to_owned()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BYTES: [u8; 16] = [0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 2, 0, 0, 0, 0, 1, 0x90, 0x21, 0xab, 0xcd];

    #[test]
    fn bytes_and_header_are_the_same_thing_in_both_directions() {
        let source = "02:00:00:00:00:01".parse().unwrap();
        let header = Header::new(Address::BROADCAST, source, EtherType::RTMAC);
        assert_eq!(header.as_bytes(), &BYTES[..HEADER_LEN]);
        let (parsed, rest) = Header::parse(&BYTES).unwrap();
        assert_eq!((parsed, rest), (&header, &BYTES[HEADER_LEN..]));
        assert_eq!(parsed.ether_type(), EtherType::RTMAC);
        assert!(parsed.destination.is_group() && !parsed.source.is_group());
    }

    #[test]
    fn no_prefix_shorter_than_a_header_parses() {
        for len in 0..HEADER_LEN {
            assert!(Header::parse(&BYTES[..len]).is_none());
        }
    }

    #[test]
    fn addresses_are_read_as_they_are_written() {
        let text = "52:54:00:00:0a:ff";
        assert_eq!(text.parse::<Address>().unwrap().to_string(), text);
        for bad in ["", "52:54:00:00:0a", "52:54:00:00:0a:ff:00", "52:54:00:00:0a:fg", "+5:54:00:00:0a:1"] {
            assert!(bad.parse::<Address>().is_err(), "{bad}");
        }
    }
}
