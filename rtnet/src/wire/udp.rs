//! The UDP header (RFC 768), and what of its checksum is not in it.
//!
//! ```text
//! 0         2         4         6         8
//! +---------+---------+---------+---------+---------
//! | source  | desti-  | length  | checksum| payload
//! | port    | nation  | from 0  | 0: none |
//! +---------+---------+---------+---------+---------
//!
//! 0              4              8         10        12        the pseudo header, which is only summed:
//! +--------------+--------------+---------+---------+         the checksum is over it, header and payload
//! | source       | destination  | 0    17 | length  |
//! +--------------+--------------+---------+---------+
//! ```

use core::net::Ipv4Addr;

use zerocopy::byteorder::network_endian::U16;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use super::checksum::Checksum;
use super::ipv4::{self, Protocol};
use crate::counters::Refusal;

/// Bytes of a UDP header.
pub const HEADER_LEN: usize = size_of::<Header>();
/// Longest payload: what the longest IPv4 packet has room for.
pub const MAX_PAYLOAD: usize = 65_507;

/// The first 8 bytes of every datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
pub struct Header {
    source: U16,
    destination: U16,
    len: U16,
    checksum: U16,
}

const _: () = assert!(HEADER_LEN == 8);
const _: () = assert!(MAX_PAYLOAD == ipv4::MAX_TOTAL - ipv4::HEADER_LEN - HEADER_LEN);

/// Splits a datagram into its header and all that follows, which may be less than [`Header::len`] says (a
/// first fragment) or more.
pub fn parse(datagram: &[u8]) -> Result<(&Header, &[u8]), Refusal> {
    let (header, rest) = Header::ref_from_prefix(datagram).map_err(|_| Refusal::Truncated)?;
    if usize::from(header.len()) < HEADER_LEN {
        return Err(Refusal::UdpLength);
    }
    Ok((header, rest))
}

/// The pseudo header's part of the checksum. What is added to it to be written is the header with a checksum
/// of 0, and the payload; with the checksum that was received, it comes to 0 if that is right.
pub fn pseudo_header(source: Ipv4Addr, destination: Ipv4Addr, udp_len: u16) -> Checksum {
    let mut sum = Checksum::new();
    sum.add(&source.octets());
    sum.add(&destination.octets());
    sum.add(&[0, Protocol::UDP.0]);
    sum.add(&udp_len.to_be_bytes());
    sum
}

/// What is written for a sum. One that comes to 0 is written as 0xFFFF, the other zero of one's complement:
/// 0 says that there is none.
pub fn to_field(sum: Checksum) -> u16 {
    match sum.finish() {
        0 => 0xffff,
        sum => sum,
    }
}

#[expect(clippy::len_without_is_empty, reason = "the field's name; no datagram is without a header")]
impl Header {
    /// A header to be written in front of a payload of at most [`MAX_PAYLOAD`] bytes, without a checksum yet.
    pub fn new(source: u16, destination: u16, payload_len: u16) -> Self {
        debug_assert!(usize::from(payload_len) <= MAX_PAYLOAD, "{payload_len} bytes");
        Self {
            source: U16::new(source),
            destination: U16::new(destination),
            len: U16::new(payload_len.saturating_add(HEADER_LEN as u16)),
            checksum: U16::ZERO,
        }
    }

    /// Where an answer goes.
    pub fn source_port(&self) -> u16 {
        self.source.get()
    }
    /// Whose it is.
    pub fn destination_port(&self) -> u16 {
        self.destination.get()
    }
    /// Bytes of header and payload, as the sender says; at least 8 once parsed.
    pub fn len(&self) -> u16 {
        self.len.get()
    }
    /// What the sender computed; 0: nothing.
    pub fn checksum(&self) -> u16 {
        self.checksum.get()
    }
    /// Writes what [`to_field`] gave.
    pub fn set_checksum(&mut self, checksum: u16) {
        self.checksum = U16::new(checksum);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const SOURCE: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 3);
    const DESTINATION: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 1);
    /// Of example frame 23, in front of 16 zeros.
    const BYTES: [u8; HEADER_LEN] = [0x04, 0x00, 0x8c, 0xa0, 0, 24, 0x5b, 0x1a];

    fn sum(header: &Header, payload: &[u8]) -> Checksum {
        let mut sum = pseudo_header(SOURCE, DESTINATION, header.len());
        sum.add(header.as_bytes());
        sum.add(payload);
        sum
    }

    /// A whole datagram, with its checksum.
    fn datagram(source: u16, destination: u16, payload: &[u8]) -> Vec<u8> {
        let mut header = Header::new(source, destination, payload.len() as u16);
        header.set_checksum(to_field(sum(&header, payload)));
        [header.as_bytes(), payload].concat()
    }

    #[test]
    fn bytes_and_header_are_the_same_thing_in_both_directions() {
        let bytes = [&BYTES[..], &[0; 16]].concat();
        assert_eq!(datagram(1024, 36_000, &[0; 16]), bytes);
        let (header, payload) = parse(&bytes).unwrap();
        assert_eq!((header.as_bytes(), payload), (&BYTES[..], &[0; 16][..]));
        assert_eq!((header.source_port(), header.destination_port()), (1024, 36_000));
        assert_eq!((header.len(), header.checksum()), (24, 0x5b1a));
        assert_eq!(sum(header, payload).finish(), 0);
    }

    #[test]
    fn a_length_below_the_headers_own_is_refused_and_any_other_is_the_callers_business() {
        let mut bytes = datagram(1, 2, b"payload");
        for (len, reason) in [(0, Some(Refusal::UdpLength)), (7, Some(Refusal::UdpLength)), (8, None)] {
            bytes[5] = len;
            assert_eq!(parse(&bytes).err(), reason, "{len}");
        }
        bytes[4..6].fill(0xff);
        assert_eq!(parse(&bytes).map(|(header, rest)| (header.len(), rest)), Ok((0xffff, &b"payload"[..])));
    }

    #[test]
    fn a_checksum_that_comes_to_0_is_written_as_its_other_zero() {
        let zero = Header::new(0, 0, 2);
        // What makes all other words together 0xffff is the complement of their sum.
        let payload = sum(&zero, &[0, 0]).finish().to_be_bytes();
        assert_eq!(sum(&zero, &payload).finish(), 0);
        assert_eq!(to_field(sum(&zero, &payload)), 0xffff);
        let bytes = datagram(0, 0, &payload);
        let (header, payload) = parse(&bytes).unwrap();
        assert_eq!((header.checksum(), sum(header, payload).finish()), (0xffff, 0), "and is right");
    }

    proptest! {
        #[test]
        fn no_bytes_whatever_panic(bytes in prop::collection::vec(any::<u8>(), 0..40)) {
            if let Ok((header, rest)) = parse(&bytes) {
                prop_assert!(usize::from(header.len()) >= HEADER_LEN);
                prop_assert_eq!(rest, &bytes[HEADER_LEN..]);
                let _ = to_field(sum(header, rest));
            }
        }

        #[test]
        fn what_is_built_is_parsed_and_every_part_of_a_header_is_refused(
            (source, destination) in (any::<u16>(), any::<u16>()),
            payload in prop::collection::vec(any::<u8>(), 0..1500),
            (at, bit) in (any::<prop::sample::Index>(), 0u8..8),
        ) {
            let mut bytes = datagram(source, destination, &payload);
            for end in 0..HEADER_LEN {
                prop_assert_eq!(parse(&bytes[..end]).err(), Some(Refusal::Truncated));
            }
            let (header, rest) = parse(&bytes).unwrap();
            prop_assert_eq!((header.source_port(), header.destination_port()), (source, destination));
            prop_assert_eq!((usize::from(header.len()), rest), (bytes.len(), &payload[..]));
            prop_assert_eq!(sum(header, rest).finish(), 0);
            prop_assert_ne!(header.checksum(), 0);

            bytes[at.index(payload.len() + HEADER_LEN)] ^= 1u8 << bit;
            let changed = parse(&bytes).map(|(header, rest)| sum(header, rest).finish());
            prop_assert_ne!(changed, Ok(0));
        }
    }
}
