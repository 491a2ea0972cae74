//! The frame of the token discipline; all fields big-endian. It is not RTmac's: EtherType 0x88B6, IEEE 802 local
//! experimental 2, so that RTnet stations on the segment ignore it.
//!
//! ```text
//! 0          14      16     17      18       22           26         30     31   32      34       35   36        44
//! +----------+-------+------+-------+--------+------------+----------+------+----+-------+--------+----+---------+
//! | Ethernet |version| kind | size  | digest | generation | sequence | from | to | since | invite | 0  | present |
//! | 0x88B6   |0x0100 | 1, 2 | 1..64 | 4      | 4          | 4        | 1    | 1  | 2     | 1      | 1  | 8       |
//! +----------+-------+------+-------+--------+------------+----------+------+----+-------+--------+----+---------+
//! ```
//!
//! It goes to all: who passed it on hears whether it is passed on, and all others that it is not lost.

use core::cmp::Ordering;

use rtnet::buf::Buf;
use rtnet::counters::Refusal;
use rtnet::wire::ethernet::{self, Address, EtherType};
use zerocopy::byteorder::network_endian::{U16, U32, U64};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

/// IEEE 802 local experimental 2.
pub const TOKEN: EtherType = EtherType(0x88b6);
/// The only version there is.
pub const VERSION: u16 = 0x0100;
/// Stations of a ring at the most: one bit each in `present`.
pub const MAX_STATIONS: usize = 64;

/// A frame of the token discipline.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Token {
    /// What it says.
    pub kind: Kind,
    /// Stations of the ring, present or not.
    pub size: u8,
    /// Of the ring as its sender has it configured: all must have the same.
    pub digest: u32,
    /// Counts claims, modulo 2^32.
    pub generation: u32,
    /// Counts passes since the claim, modulo 2^32.
    pub sequence: u32,
    /// The sender's place in the ring, from 0 on.
    pub from: u8,
    /// Who has the right to send from now on; of a claim, the sender.
    pub to: u8,
    /// Passes since a station was invited last; it stays at the highest.
    pub since: u16,
    /// The first place from which on the next one is invited that is absent.
    pub invite: u8,
    /// A bit for each place, the lowest for 0: who takes part, `from` and `to` among them.
    pub present: u64,
}

/// What a [`Token`] says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// The right to send goes from `from` to `to`.
    Pass = 1,
    /// It was lost: `from` takes it.
    Claim = 2,
}

/// Which token it is, and which way it goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mark {
    /// See [`Token::generation`].
    pub generation: u32,
    /// See [`Token::sequence`].
    pub sequence: u32,
    /// See [`Token::from`].
    pub from: u8,
    /// See [`Token::to`].
    pub to: u8,
}

impl Mark {
    /// Whether of two tokens this one stays: that of the later claim, of these the one that was passed on more often. Of
    /// two that differ in neither, and go to different stations, the one whose sender comes first in the ring: so one of any
    /// two stays, whoever looks.
    pub fn outlasts(&self, other: &Mark) -> bool {
        let generations = later(self.generation, other.generation);
        match generations.then(later(self.sequence, other.sequence)) {
            Ordering::Greater => true,
            Ordering::Less => false,
            Ordering::Equal => self.to != other.to && self.from < other.from,
        }
    }

    /// Whether it is the same right for the same station, told once more: a repetition, or by who skipped the one that told
    /// of it before.
    pub fn repeats(&self, other: &Mark) -> bool {
        (self.generation, self.sequence, self.to) == (other.generation, other.sequence, other.to)
    }
}

/// Which of two counts modulo 2^32 comes later, by the shorter way round.
fn later(a: u32, b: u32) -> Ordering {
    (a.wrapping_sub(b) as i32).cmp(&0)
}

#[derive(FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
struct Body {
    version: U16,
    kind: u8,
    size: u8,
    digest: U32,
    generation: U32,
    sequence: U32,
    from: u8,
    to: u8,
    since: U16,
    invite: u8,
    reserved: u8,
    present: U64,
}

const END: usize = ethernet::HEADER_LEN + size_of::<Body>();
const _: () = assert!(END == 44);

impl Token {
    /// Which one it is.
    pub fn mark(&self) -> Mark {
        Mark { generation: self.generation, sequence: self.sequence, from: self.from, to: self.to }
    }

    /// Reads a frame from its first byte on. The caller has checked the EtherType. What it says can be of a ring with its
    /// size: no place lies outside.
    pub fn parse(frame: &[u8]) -> Result<Token, Refusal> {
        let behind = frame.get(ethernet::HEADER_LEN..).ok_or(Refusal::Runt)?;
        let (body, _) = Body::ref_from_prefix(behind).map_err(|_| Refusal::Truncated)?;
        if body.version.get() != VERSION {
            return Err(Refusal::TokenVersion);
        }
        let kind = match body.kind {
            1 => Kind::Pass,
            2 => Kind::Claim,
            _ => return Err(Refusal::TokenKind),
        };
        let token = Token {
            kind,
            size: body.size,
            digest: body.digest.get(),
            generation: body.generation.get(),
            sequence: body.sequence.get(),
            from: body.from,
            to: body.to,
            since: body.since.get(),
            invite: body.invite,
            present: body.present.get(),
        };
        if token.is_sound() { Ok(token) } else { Err(Refusal::TokenFields) }
    }

    fn is_sound(&self) -> bool {
        let size = usize::from(self.size);
        let places = [self.from, self.to, self.invite];
        let is_there = |place: u8| self.present >> place & 1 == 1;
        (1..=MAX_STATIONS).contains(&size)
            && places.iter().all(|&place| place < self.size)
            && self.present & !all(size) == 0
            && is_there(self.from)
            && is_there(self.to)
            && (self.kind == Kind::Pass || self.from == self.to)
    }

    /// Writes the whole frame, padded with zeros to the Ethernet minimum.
    pub fn write(&self, source: Address, frame: &mut Buf) {
        let header = ethernet::Header::new(Address::BROADCAST, source, TOKEN);
        let body = Body {
            version: U16::new(VERSION),
            kind: self.kind as u8,
            size: self.size,
            digest: U32::new(self.digest),
            generation: U32::new(self.generation),
            sequence: U32::new(self.sequence),
            from: self.from,
            to: self.to,
            since: U16::new(self.since),
            invite: self.invite,
            reserved: 0,
            present: U64::new(self.present),
        };
        let room = frame.room_mut();
        room[..ethernet::HEADER_LEN].copy_from_slice(header.as_bytes());
        room[ethernet::HEADER_LEN..END].copy_from_slice(body.as_bytes());
        frame.set_len(END);
        frame.pad_to(ethernet::MIN_FRAME);
    }
}

/// A bit for each of so many places, 1 to 64.
pub fn all(size: usize) -> u64 {
    u64::MAX >> (MAX_STATIONS - size)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rtnet::buf::Pool;

    const SOURCE: Address = Address([2, 0, 0, 0, 0, 3]);
    const PASS: &str =
        "ffffffffffff02000000000388b601000104c0ffee110000000700000102020300050100000000000000000d";
    const CLAIM: &str =
        "ffffffffffff02000000000388b601000204c0ffee110000000800000000020200000000000000000000000f";

    fn pass() -> Token {
        Token {
            kind: Kind::Pass,
            size: 4,
            digest: 0xc0ff_ee11,
            generation: 7,
            sequence: 258,
            from: 2,
            to: 3,
            since: 5,
            invite: 1,
            present: 0b1101,
        }
    }

    fn claim() -> Token {
        let token = pass();
        let (kind, generation, sequence) = (Kind::Claim, 8, 0);
        Token { kind, generation, sequence, to: 2, since: 0, invite: 0, present: 0b1111, ..token }
    }

    fn bytes(hex: &str) -> Vec<u8> {
        (0..hex.len()).step_by(2).map(|i| u8::from_str_radix(&hex[i..i + 2], 16).unwrap()).collect()
    }

    #[test]
    fn tokens_and_bytes_are_the_same_thing_in_both_directions() {
        let pool = Pool::new(1);
        for (hex, token) in [(PASS, pass()), (CLAIM, claim())] {
            let mut padded = bytes(hex);
            padded.resize(ethernet::MIN_FRAME, 0);
            let mut frame = pool.take().unwrap();
            token.write(SOURCE, &mut frame);
            assert_eq!(frame[..], padded[..]);
            assert_eq!(Token::parse(&frame), Ok(token));
        }
    }

    #[test]
    fn every_prefix_is_refused_and_padding_changes_nothing() {
        let mut whole = bytes(PASS);
        for len in 0..whole.len() {
            let expected = if len < ethernet::HEADER_LEN { Refusal::Runt } else { Refusal::Truncated };
            assert_eq!(Token::parse(&whole[..len]), Err(expected), "{len} bytes");
        }
        whole.resize(1514, 0xaa);
        assert_eq!(Token::parse(&whole), Ok(pass()));
    }

    #[test]
    fn what_no_station_of_a_ring_says_is_refused_by_reason() {
        for (at, byte, reason, why) in [
            (14, 2, Refusal::TokenVersion, "a version to come"),
            (16, 0, Refusal::TokenKind, "no kind"),
            (16, 3, Refusal::TokenKind, "no kind"),
            (17, 0, Refusal::TokenFields, "a ring of nobody"),
            (17, 65, Refusal::TokenFields, "a ring of too many"),
            (30, 4, Refusal::TokenFields, "from outside the ring"),
            (30, 1, Refusal::TokenFields, "from a station that is absent"),
            (31, 4, Refusal::TokenFields, "to the outside of the ring"),
            (31, 1, Refusal::TokenFields, "to a station that is absent"),
            (16, 2, Refusal::TokenFields, "a claim for another station"),
            (34, 4, Refusal::TokenFields, "an invitation to the outside of the ring"),
            (43, 0x1d, Refusal::TokenFields, "a station outside the ring is present"),
        ] {
            let mut frame = bytes(PASS);
            frame[at] = byte;
            assert_eq!(Token::parse(&frame), Err(reason), "{why}");
        }
    }

    #[test]
    fn the_later_claim_stays_then_what_was_passed_on_more_often_then_who_comes_first() {
        let mark = |generation, sequence, from, to| Mark { generation, sequence, from, to };
        let ordered = [
            mark(u32::MAX, 9, 0, 1),
            mark(0, u32::MAX, 0, 1),
            mark(0, 0, 3, 0),
            mark(0, 0, 2, 3),
            mark(0, 1, 3, 0),
            mark(1, 0, 2, 2),
            mark(1, 0, 1, 1),
        ];
        for pair in ordered.windows(2) {
            assert!(pair[1].outlasts(&pair[0]) && !pair[0].outlasts(&pair[1]), "{pair:?}");
        }
        let (passed, skipped) = (mark(4, 8, 2, 3), mark(4, 8, 1, 3));
        assert!(!passed.outlasts(&skipped) && !skipped.outlasts(&passed));
        assert!(passed.repeats(&skipped) && !passed.repeats(&mark(4, 8, 2, 0)));
    }

    proptest! {
        #[test]
        fn of_two_tokens_for_different_stations_exactly_one_stays(
            generation in any::<u32>(), apart in 0u32..3, sequence in any::<u32>(), more in 0u32..3,
            (from, other) in (0u8..64, 0u8..64), (to, for_other) in (0u8..64, 0u8..64),
        ) {
            prop_assume!(from != other && to != for_other);
            let a = Mark { generation, sequence, from, to };
            let (generation, sequence) = (generation.wrapping_add(apart), sequence.wrapping_add(more));
            let b = Mark { generation, sequence, from: other, to: for_other };
            prop_assert!(a.outlasts(&b) != b.outlasts(&a));
        }

        #[test]
        fn whatever_bytes_come_are_refused_or_written_back_as_they_were(
            mut frame in prop::collection::vec(any::<u8>(), 0..70), version in any::<bool>(), kind in 1u8..3,
        ) {
            if let (true, Some(head)) = (version, frame.get_mut(14..17)) {
                head.copy_from_slice(&[1, 0, kind]);
            }
            if let Ok(token) = Token::parse(&frame) {
                let pool = Pool::new(1);
                let mut written = pool.take().unwrap();
                token.write(SOURCE, &mut written);
                prop_assert_eq!(&written[14..35], &frame[14..35]);
                prop_assert_eq!(&written[36..44], &frame[36..44]);
            }
        }
    }
}
