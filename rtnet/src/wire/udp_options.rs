//! The times of a datagram: a UDP option (RFC 9868) in the surplus area, which is what an IP packet has behind the bytes that
//! UDP's length covers. Who does not know of options trims it.
//!
//! ```text
//! 0 or 1    0         2         3         4         6               14              22
//! +---------+---------+---------+---------+---------+---------------+---------------+
//! | 0, if   | check-  | kind    | length  | whose   | sent          | left          |
//! | UDP's   | sum     | 127: an | 20      | 0x5254  |               | 0: unknown    |
//! | is odd  |         | experi- |         | "RT"    | nanoseconds of global time    |
//! |         |         | ment    |         |         | modulo 2^64                   |
//! +---------+---------+---------+---------+---------+---------------+---------------+
//! ```
//!
//! The checksum is over the surplus area and its length, in words as the datagram has them. So whoever takes it for a part of
//! what UDP's checksum is over finds that as it was. What the area has is believed as a whole, or not at all; the datagram is
//! sound in any case.

use zerocopy::byteorder::network_endian::{U16, U64};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use super::checksum::Checksum;
use super::udp::to_field;
use crate::time::GlobalTime;

/// Whose experiment it is: "RT". It is registered with nobody.
pub const EXPERIMENT: u16 = 0x5254;
/// From the end of a surplus area with times back to when it left.
pub const LEFT_BEFORE_END: usize = size_of::<U64>();
/// From there back to the checksum.
pub const CHECKSUM_BEFORE_END: usize = size_of::<RawTimes>();
/// The longest that is written.
pub const LONGEST: usize = 1 + size_of::<RawTimes>();

/// The list ends.
const END: u8 = 0;
/// A byte of nothing.
const NOTHING: u8 = 1;
/// An experiment: the first two bytes of its value say whose.
const EXPERIMENTAL: u8 = 127;
/// From here on options change what the datagram is.
const UNSAFE: u8 = 192;
/// In place of a length: it follows, in two bytes.
const EXTENDED: u8 = 255;

/// When a datagram was where.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Times {
    /// A program has handed it over to its station.
    pub sent: GlobalTime,
    /// The last of its frames was given to the wire; `None`: its station does not say.
    pub left: Option<GlobalTime>,
}

/// What is written behind a datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Surplus {
    bytes: [u8; LONGEST],
    begin: usize,
}

/// Such a surplus area is none, or has been changed on the way.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("what is behind the datagram is no list of options")]
pub struct NoOptions;

#[derive(Clone, Copy, FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
struct RawTimes {
    checksum: U16,
    kind: u8,
    len: u8,
    experiment: U16,
    sent: U64,
    left: U64,
}

/// Of the option, without the checksum before it.
const OPTION_LEN: usize = size_of::<RawTimes>() - size_of::<U16>();
const _: () = assert!(OPTION_LEN == 20 && LONGEST == 23);

impl Surplus {
    /// For a datagram of so many bytes, its header among them.
    pub fn new(udp_len: usize, times: &Times) -> Self {
        let mut raw = RawTimes {
            checksum: U16::ZERO,
            kind: EXPERIMENTAL,
            len: OPTION_LEN as u8,
            experiment: U16::new(EXPERIMENT),
            sent: U64::new(times.sent.nanos()),
            left: U64::new(times.left.map_or(0, GlobalTime::nanos)),
        };
        let mut sum = Checksum::new();
        sum.add(&(len_behind(udp_len) as u16).to_be_bytes());
        sum.add(raw.as_bytes());
        raw.checksum = U16::new(to_field(sum));
        let mut bytes = [0; LONGEST];
        bytes[1..].copy_from_slice(raw.as_bytes());
        Self { bytes, begin: 1 - udp_len % 2 }
    }

    /// As it follows the datagram.
    pub fn as_bytes(&self) -> &[u8] {
        &self.bytes[self.begin..]
    }
}

/// How long the times of a datagram of so many bytes are.
pub const fn len_behind(udp_len: usize) -> usize {
    udp_len % 2 + size_of::<RawTimes>()
}

/// The times in what is behind a datagram of so many bytes, if they are there. `is_checked`: it has a checksum of its own, so
/// that its options must have one.
pub fn parse(udp_len: usize, is_checked: bool, surplus: &[u8]) -> Result<Option<Times>, NoOptions> {
    let (pad, aligned) = surplus.split_at_checked(udp_len % 2).ok_or(NoOptions)?;
    let (field, mut options) = aligned.split_at_checked(size_of::<U16>()).ok_or(NoOptions)?;
    let goes_without = !is_checked && field == [0, 0];
    let mut sum = Checksum::new();
    sum.add(&(surplus.len() as u16).to_be_bytes());
    sum.add(aligned);
    if pad != &[0][..pad.len()] || (!goes_without && (field == [0, 0] || sum.finish() != 0)) {
        return Err(NoOptions);
    }
    let mut times = None;
    while let Some((kind, value, rest)) = next(options)? {
        if kind == EXPERIMENTAL {
            times = times.or(times_in(value));
        }
        options = rest;
    }
    Ok(times)
}

type Parted<'a> = (u8, &'a [u8], &'a [u8]);

/// The first option's kind, its value, and what follows; `None`: the list ends.
fn next(options: &[u8]) -> Result<Option<Parted<'_>>, NoOptions> {
    let (kind, header, len) = match *options {
        [] | [END, ..] => return Ok(None),
        [NOTHING, ..] => (NOTHING, 1, 1),
        [UNSAFE..=u8::MAX, ..] => return Err(NoOptions),
        [kind, EXTENDED, high, low, ..] => (kind, 4, usize::from(u16::from_be_bytes([high, low]))),
        [_, EXTENDED, ..] | [_] => return Err(NoOptions),
        [kind, len, ..] => (kind, 2, usize::from(len)),
    };
    let (option, rest) = options.split_at_checked(len).ok_or(NoOptions)?;
    Ok(Some((kind, option.get(header..).ok_or(NoOptions)?, rest)))
}

/// What this experiment has to say.
fn times_in(value: &[u8]) -> Option<Times> {
    #[derive(FromBytes, KnownLayout, Immutable, Unaligned)]
    #[repr(C)]
    struct Value {
        experiment: U16,
        sent: U64,
        left: U64,
    }
    let value = Value::ref_from_bytes(value).ok().filter(|value| value.experiment.get() == EXPERIMENT)?;
    let known = |nanos: U64| (nanos.get() != 0).then(|| GlobalTime::from_nanos(nanos.get()));
    Some(Times { sent: known(value.sent)?, left: known(value.left) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::discipline::Stamp;
    use crate::time::Instant;
    use crate::wire::checksum::checksum;
    use proptest::prelude::*;

    /// Sent at 0x1122334455667788, left 258 ns later, behind 24 bytes.
    const EVEN: [u8; 22] = [
        0x0a, 0xd5, 127, 20, 0x52, 0x54, 0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0x77, 0x88, 0x11, 0x22, 0x33,
        0x44, 0x55, 0x66, 0x78, 0x8a,
    ];

    fn times(sent: u64, left: Option<u64>) -> Times {
        Times { sent: GlobalTime::from_nanos(sent), left: left.map(GlobalTime::from_nanos) }
    }

    fn known() -> Times {
        times(0x1122_3344_5566_7788, Some(0x1122_3344_5566_788a))
    }

    /// With a right checksum in front, behind an even number of bytes.
    fn list(options: &[u8]) -> Vec<u8> {
        let mut area = [&[0, 0], options].concat();
        let mut sum = Checksum::new();
        sum.add(&(area.len() as u16).to_be_bytes());
        sum.add(&area);
        area[..2].copy_from_slice(&to_field(sum).to_be_bytes());
        area
    }

    #[test]
    fn bytes_and_times_are_the_same_thing_in_both_directions() {
        assert_eq!(Surplus::new(24, &known()).as_bytes(), EVEN);
        assert_eq!(parse(24, true, &EVEN), Ok(Some(known())));
        // One byte longer, and so its checksum is less by one.
        let odd = [&[0, 0x0a, 0xd4], &EVEN[2..]].concat();
        assert_eq!(Surplus::new(25, &known()).as_bytes(), odd);
        assert_eq!(parse(25, true, &odd), Ok(Some(known())));
        assert_eq!([24, 25].map(len_behind), [EVEN.len(), odd.len()]);
    }

    /// RFC 9868, 9: who sums all of a packet by the length of all of it finds what UDP's checksum says.
    #[test]
    fn whoever_sums_the_surplus_area_too_finds_the_datagrams_checksum_as_it_was() {
        for datagram in [&[1, 2, 3, 4][..], &[1, 2, 3]] {
            let surplus = Surplus::new(datagram.len(), &known());
            let mut whole = [datagram, surplus.as_bytes()].concat();
            let mut alone = datagram.to_vec();
            alone.resize(alone.len().next_multiple_of(2), 0);
            alone.extend((datagram.len() as u16).to_be_bytes());
            let len = whole.len() as u16;
            whole.extend(len.to_be_bytes());
            assert_eq!(checksum(&whole), checksum(&alone), "{datagram:?}");
        }
    }

    #[test]
    fn when_it_left_is_written_as_it_leaves_and_as_often_as_it_has_to() {
        let mut frame = [&[9; 60], Surplus::new(24, &times(7, None)).as_bytes()].concat();
        let end = frame.len();
        let (at_byte, sum_at) = ((end - LEFT_BEFORE_END) as u16, Some((end - CHECKSUM_BEFORE_END) as u16));
        for (now, left) in [(1_000, 1_007), (u64::MAX - 7, u64::MAX), (0, 7)] {
            Stamp { at_byte, add: 7, sum_at }.write(&mut frame, Instant::from_nanos(now));
            assert_eq!(parse(24, true, &frame[60..]), Ok(Some(times(7, Some(left)))));
            assert_eq!(frame[60..], *Surplus::new(24, &times(7, Some(left))).as_bytes());
        }
        assert_eq!(frame[..60], [9; 60]);
    }

    #[test]
    fn a_checksum_that_is_wrong_or_none_where_there_must_be_one_ends_belief() {
        let mut bytes = EVEN;
        bytes[0] ^= 1;
        assert_eq!(parse(24, true, &bytes), Err(NoOptions));
        bytes[..2].fill(0);
        assert_eq!(parse(24, true, &bytes), Err(NoOptions));
        assert_eq!(parse(24, false, &bytes), Ok(Some(known())), "the datagram has none either");
        let padded = [&[1, 0x0a, 0xd4], &EVEN[2..]].concat();
        assert_eq!(parse(25, true, &padded), Err(NoOptions), "the byte between is 0");
    }

    #[test]
    fn times_are_found_among_other_options() {
        let own = &EVEN[2..];
        let others: [(&str, &[u8]); 4] = [
            ("nothing", &[1, 1, 1]),
            ("a size, safe as all below 192", &[4, 4, 5, 0xc0]),
            ("another's experiment", &[127, 4, 0x52, 0x53]),
            ("a long one", &[9, 255, 0, 6, 1, 2]),
        ];
        for (name, other) in others {
            assert_eq!(parse(24, true, &list(&[other, own].concat())), Ok(Some(known())), "{name}, before");
            assert_eq!(parse(24, true, &list(&[own, other].concat())), Ok(Some(known())), "{name}, behind");
            assert_eq!(parse(24, true, &list(other)), Ok(None), "{name}, alone");
        }
        assert_eq!(
            parse(24, true, &list(&[&[0], own].concat())),
            Ok(None),
            "what is behind the end is not read"
        );
        assert_eq!(parse(24, true, &list(&[])), Ok(None));
        let mut never = own.to_vec();
        never[4..12].fill(0);
        assert_eq!(parse(24, true, &list(&never)), Ok(None), "nobody knows when it was sent");
        let longer = [&[127, 21, 0x52, 0x54][..], &[1; 17]].concat();
        assert_eq!(parse(24, true, &list(&longer)), Ok(None), "as a later one may be");
    }

    #[test]
    fn a_cut_behind_a_checksum_that_fits_leaves_no_times() {
        let times = times(3_750_021_308_302_610_411, Some(16_154_042_484_862_848_886));
        let surplus = Surplus::new(8, &times);
        assert_eq!(surplus.as_bytes()[..2], list(&[]), "the checksum of an empty list");
        assert_eq!(parse(8, true, &surplus.as_bytes()[..2]), Ok(None));
    }

    #[test]
    fn lists_that_cannot_be_are_none() {
        let lists: [&[u8]; 7] = [&[9], &[9, 0], &[9, 1], &[9, 3], &[9, 255, 0], &[9, 255, 0, 3], &[192, 2]];
        for options in lists {
            assert_eq!(parse(24, true, &list(options)), Err(NoOptions), "{options:?}");
        }
        assert_eq!(parse(24, true, &[0]), Err(NoOptions));
        assert_eq!(parse(25, true, &[]), Err(NoOptions));
    }

    proptest! {
        #[test]
        fn no_bytes_whatever_panic(
            udp_len in 8usize..70_000, is_checked in any::<bool>(),
            bytes in prop::collection::vec(any::<u8>(), 0..60),
        ) {
            let _ = parse(udp_len, is_checked, &bytes);
            let _ = parse(24, true, &list(&bytes));
        }

        #[test]
        fn what_is_written_is_read_and_no_bit_of_it_may_change(
            udp_len in 8usize..65_000, sent in 1u64.., left in any::<u64>(),
            (at, bit) in (any::<prop::sample::Index>(), 0u8..8),
        ) {
            let times = times(sent, (left != 0).then_some(left));
            let mut bytes = Surplus::new(udp_len, &times).as_bytes().to_vec();
            prop_assert_eq!(bytes.len(), len_behind(udp_len));
            prop_assert_eq!(parse(udp_len, true, &bytes), Ok(Some(times)));
            let without_options = udp_len % 2 + size_of::<U16>();
            for end in (0..bytes.len()).filter(|&end| end != without_options) {
                let part = parse(udp_len, true, &bytes[..end]);
                prop_assert_eq!(part, Err(NoOptions));
            }
            // One checksum in 65 536 is that of an empty list, too.
            let part = parse(udp_len, true, &bytes[..without_options]);
            prop_assert!(matches!(part, Err(NoOptions) | Ok(None)), "{:?}", part);
            let at = at.index(bytes.len());
            bytes[at] ^= 1u8 << bit;
            prop_assert_eq!(parse(udp_len, true, &bytes), Err(NoOptions));
        }
    }
}
