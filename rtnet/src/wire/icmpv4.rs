//! ICMP's echo request and reply (RFC 792); nothing else of it is spoken here.
//!
//! ```text
//! 0      1      2          4            6          8
//! +------+------+----------+------------+----------+------------------------------------
//! | 8: request  | checksum | identifier | sequence | data, which the reply gives back
//! | 0: reply    | of all   |            |          |
//! +------+------+----------+------------+----------+------------------------------------
//!          code 0
//! ```

use zerocopy::byteorder::network_endian::U16;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use super::checksum::{Checksum, checksum};
use crate::counters::Refusal;

/// Bytes in front of the data.
pub const HEADER_LEN: usize = size_of::<Echo>();

/// The first 8 bytes of an echo request or reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
pub struct Echo {
    kind: u8,
    code: u8,
    checksum: U16,
    identifier: U16,
    sequence: U16,
}

/// Which of the two.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Give this back.
    Request,
    /// It is given back.
    Reply,
}

const _: () = assert!(HEADER_LEN == 8);

const REQUEST: u8 = 8;
const REPLY: u8 = 0;

/// Splits a message, which is an IPv4 packet's whole payload, into its header and its data. The checksum is
/// looked at first: the type of what was changed on the way says nothing.
pub fn parse(message: &[u8]) -> Result<(&Echo, &[u8]), Refusal> {
    let (echo, data) = Echo::ref_from_prefix(message).map_err(|_| Refusal::Truncated)?;
    if checksum(message) != 0 {
        return Err(Refusal::IcmpChecksum);
    }
    match (echo.kind, echo.code) {
        (REQUEST | REPLY, 0) => Ok((echo, data)),
        _ => Err(Refusal::IcmpType),
    }
}

impl Echo {
    /// A header to be written in front of `data`, complete with the checksum over both.
    pub fn new(kind: Kind, identifier: u16, sequence: u16, data: &[u8]) -> Self {
        let kind = match kind {
            Kind::Request => REQUEST,
            Kind::Reply => REPLY,
        };
        let (identifier, sequence) = (U16::new(identifier), U16::new(sequence));
        let mut echo = Self { kind, code: 0, checksum: U16::ZERO, identifier, sequence };
        let mut sum = Checksum::new();
        sum.add(echo.as_bytes());
        sum.add(data);
        echo.checksum = U16::new(sum.finish());
        echo
    }

    /// Which of the two.
    pub fn kind(&self) -> Kind {
        if self.kind == REQUEST { Kind::Request } else { Kind::Reply }
    }
    /// Whose request it is, or was.
    pub fn identifier(&self) -> u16 {
        self.identifier.get()
    }
    /// Which of theirs.
    pub fn sequence(&self) -> u16 {
        self.sequence.get()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A request to give back the alphabet.
    const BYTES: [u8; 40] = *b"\x08\x00\x4d\x5a\x00\x01\x00\x01abcdefghijklmnopqrstuvwabcdefghi";

    fn message(kind: Kind, identifier: u16, sequence: u16, data: &[u8]) -> Vec<u8> {
        [Echo::new(kind, identifier, sequence, data).as_bytes(), data].concat()
    }

    /// That request with one byte changed, and a right checksum.
    fn changed(at: usize, byte: u8) -> Vec<u8> {
        let mut bytes = BYTES.to_vec();
        bytes[at] = byte;
        bytes[2..4].fill(0);
        let sum = checksum(&bytes);
        bytes[2..4].copy_from_slice(&sum.to_be_bytes());
        bytes
    }

    #[test]
    fn bytes_and_message_are_the_same_thing_in_both_directions() {
        assert_eq!(message(Kind::Request, 1, 1, &BYTES[8..]), BYTES);
        let (echo, data) = parse(&BYTES).unwrap();
        assert_eq!((echo.as_bytes(), data), (&BYTES[..8], &BYTES[8..]));
        assert_eq!((echo.kind(), echo.identifier(), echo.sequence()), (Kind::Request, 1, 1));

        // The reply differs in its type, and in its checksum by as much.
        let reply = message(Kind::Reply, 1, 1, data);
        assert_eq!((&reply[..4], &reply[4..]), (&[0, 0, 0x55, 0x5a][..], &BYTES[4..]));
        assert_eq!(parse(&reply).map(|(echo, _)| echo.kind()), Ok(Kind::Reply));
    }

    #[test]
    fn other_types_and_codes_are_refused() {
        for kind in (0..=u8::MAX).filter(|&kind| kind != REQUEST && kind != REPLY) {
            assert_eq!(parse(&changed(0, kind)).err(), Some(Refusal::IcmpType), "type {kind}");
        }
        assert_eq!(parse(&changed(1, 1)).err(), Some(Refusal::IcmpType), "code 1");
        assert!(parse(&changed(0, REPLY)).is_ok());
    }

    #[test]
    fn any_bit_that_is_changed_on_the_way_is_noticed() {
        for bit in 0..BYTES.len() * 8 {
            let mut bytes = BYTES;
            bytes[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(parse(&bytes).err(), Some(Refusal::IcmpChecksum), "bit {bit}");
        }
    }

    proptest! {
        #[test]
        fn no_bytes_whatever_panic(mut bytes in prop::collection::vec(any::<u8>(), 0..40), right in any::<bool>()) {
            if right && bytes.len() >= HEADER_LEN {
                bytes[2..4].fill(0);
                let sum = checksum(&bytes);
                bytes[2..4].copy_from_slice(&sum.to_be_bytes());
            }
            let parsed = parse(&bytes);
            prop_assert_eq!(parsed == Err(Refusal::Truncated), bytes.len() < HEADER_LEN);
            if let Ok((echo, data)) = parsed {
                prop_assert_eq!(data, &bytes[HEADER_LEN..]);
                let _ = (echo.kind(), echo.identifier(), echo.sequence());
            }
        }

        #[test]
        fn what_is_built_is_parsed_and_every_part_of_it_is_refused(
            request in any::<bool>(),
            (identifier, sequence) in (any::<u16>(), any::<u16>()),
            data in prop::collection::vec(1u8.., 0..300),
        ) {
            let kind = if request { Kind::Request } else { Kind::Reply };
            let bytes = message(kind, identifier, sequence, &data);
            let (echo, parsed) = parse(&bytes).unwrap();
            prop_assert_eq!((echo.kind(), echo.identifier(), echo.sequence()), (kind, identifier, sequence));
            prop_assert_eq!(parsed, &data[..]);
            for end in 0..HEADER_LEN {
                prop_assert_eq!(parse(&bytes[..end]).err(), Some(Refusal::Truncated));
            }
            // A zero that is missing does not show in a checksum; any other byte does.
            if !data.is_empty() {
                prop_assert_eq!(parse(&bytes[..bytes.len() - 1]).err(), Some(Refusal::IcmpChecksum));
            }
        }
    }
}
