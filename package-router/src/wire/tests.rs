use super::*;
use proptest::prelude::*;

fn bytes(hex: &str) -> [u8; HEAD_LEN] {
    let hex = hex.replace(' ', "");
    core::array::from_fn(|i| u8::from_str_radix(&hex[2 * i..2 * i + 2], 16).unwrap())
}

fn head(
    orders: (Endian, Endian),
    (kind, priority, id): (i8, u8, u8),
    (to, from): (u32, u32),
    len: u32,
) -> Head {
    let (to, from) = (MailboxName(to), MailboxName(from));
    let (head_order, body_order) = orders;
    Head { head_order, body_order, priority, id, len, ..Head::new(kind, to, from) }
}

const JAVA: (Endian, Endian) = (Endian::Big, Endian::Big);
const FORWARDED: (Endian, Endian) = (Endian::Little, Endian::Big);
const OURS: (Endian, Endian) = (Endian::Little, Endian::Little);
const BIG_HEAD_ONLY: (Endian, Endian) = (Endian::Big, Endian::Little);

/// What was seen between real peers: all whole heads of section 5.3 of the reference.
fn seen() -> Vec<(&'static str, Head)> {
    vec![
        ("000d0000 00000000 00000000 00000014", head(JAVA, (13, 0, 0), (0, 0), 20)),
        ("03000000 00000000 00000000 10000000", head(OURS, (OK, 0, 0), (0, 0), 16)),
        ("00154d2a 00100200 00100100 00000015", head(JAVA, (21, 77, 42), (0x0010_0200, 0x0010_0100), 21)),
        (
            "01154d2a 00021000 00011000 15000000",
            head(FORWARDED, (21, 77, 42), (0x0010_0200, 0x0010_0100), 21),
        ),
        ("0003052b 00106300 00100100 00000010", head(JAVA, (3, 5, 43), (0x0010_6300, 0x0010_0100), 16)),
        (
            "03fd052b 00011000 00631000 10000000",
            head(OURS, (NOT_AVAILABLE, 5, 43), (0x0010_0100, 0x0010_6300), 16),
        ),
        ("03110000 00000000 00000000 10000000", head(OURS, (17, 0, 0), (0, 0), 16)),
        ("00000000 00000000 00000000 00000010", head(JAVA, (OK, 0, 0), (0, 0), 16)),
        ("0106000a 00001100 00070200 18000000", head(FORWARDED, (6, 0, 10), (0x0011_0000, 0x0002_0700), 24)),
        ("03fa000a 01070200 00001100 34000000", head(OURS, (-6, 0, 10), (0x0002_0701, 0x0011_0000), 52)),
        ("03840100 00000100 00001100 1b000000", head(OURS, (-124, 1, 0), (0x0001_0000, 0x0011_0000), 27)),
    ]
}

#[test]
fn what_real_peers_say_and_heads_are_the_same_thing_in_both_directions() {
    for (hex, head) in seen() {
        assert_eq!(Head::parse(&bytes(hex)), Ok(head), "{hex}");
        assert_eq!(head.to_bytes(), bytes(hex), "{hex}");
    }
}

#[test]
fn head_and_body_have_an_order_each_in_all_four_ways() {
    let ways = [
        ("00154d2a 00100200 00100100 00000015", JAVA),
        ("01154d2a 00021000 00011000 15000000", FORWARDED),
        ("02154d2a 00100200 00100100 00000015", BIG_HEAD_ONLY),
        ("03154d2a 00021000 00011000 15000000", OURS),
    ];
    for (hex, orders) in ways {
        let head = head(orders, (21, 77, 42), (0x0010_0200, 0x0010_0100), 21);
        assert_eq!(Head::parse(&bytes(hex)), Ok(head), "{hex}");
        assert_eq!(head.to_bytes(), bytes(hex), "{hex}");
        assert_eq!((head.body_len(), head.is_command()), (5, true));
    }
}

#[test]
fn parts_and_unknown_flags_are_told_apart_from_orders() {
    for (flags, part) in [(0x03, Part::Whole), (0x07, Part::First), (0x0b, Part::Middle), (0x0f, Part::Last)]
    {
        for unknown in [0x00, 0x10, 0xa0, 0xf0] {
            let mut bytes = Head::default().to_bytes();
            bytes[0] = flags | unknown;
            let head = Head { part, other_flags: unknown, ..Head::default() };
            assert_eq!((Head::parse(&bytes), head.to_bytes()), (Ok(head), bytes));
            assert_eq!(head.is_whole(), part == Part::Whole);
        }
    }
    let meddled = Head { other_flags: 0xff, ..Head::default() };
    assert_eq!(meddled.to_bytes()[0], 0xf3, "they do not reach the flags that are known");
}

#[test]
fn a_reply_goes_back_in_our_order_whatever_the_commands_was() {
    for (hex, command) in seen() {
        let reply = command.answer(NOT_AVAILABLE);
        let expected = head(OURS, (-3, command.priority, command.id), (command.from.0, command.to.0), 16);
        assert_eq!(reply, expected, "{hex}");
    }
    let part = Head { part: Part::First, other_flags: 0x70, ..Head::default() };
    assert_eq!(part.answer(OK), Head::default());
    let command = Head::parse(&bytes("0003052b 00106300 00100100 00000010")).unwrap();
    assert_eq!(command.answer(NOT_AVAILABLE).to_bytes(), bytes("03fd052b 00011000 00631000 10000000"));
}

#[test]
fn what_is_0_or_less_is_no_command() {
    for (kind, is_command) in [(i8::MIN, false), (-1, false), (0, false), (1, true), (i8::MAX, true)] {
        assert_eq!(Head { kind, ..Head::default() }.is_command(), is_command, "{kind}");
    }
}

#[test]
fn every_prefix_of_a_head_is_refused_and_says_how_much_there_was() {
    for (hex, _) in seen() {
        for got in 0..HEAD_LEN {
            assert_eq!(Head::parse(&bytes(hex)[..got]), Err(HeadError::TooShort { got }), "{hex}");
        }
    }
}

#[test]
fn every_lie_about_the_length_is_refused_and_named() {
    let most = MAX_LEN as u32;
    for order in [Endian::Big, Endian::Little] {
        let parse = |len| Head::parse(&Head { head_order: order, len, ..Head::default() }.to_bytes());
        for len in 0..16 {
            assert_eq!(parse(len), Err(HeadError::LenBelowHead { len }));
        }
        for len in [16, 17, 65_507, 65_508, most - 1, most] {
            assert_eq!(parse(len).map(|head| (head.len, head.body_len())), Ok((len, len as usize - 16)));
        }
        for len in [most + 1, 0x1000_0000, u32::MAX] {
            assert_eq!(parse(len), Err(HeadError::LenAboveMost { len }));
        }
    }
    assert_eq!(
        HeadError::LenAboveMost { len: 262_145 }.to_string(),
        "a package of 262145 bytes: head and body together have 262144 at the most"
    );
}

#[test]
fn a_body_that_no_package_has_is_refused_before_it_is_written() {
    let head = |bytes| Head::default().with_body(bytes).map(|head| head.len);
    assert_eq!(head(0), Ok(16));
    assert_eq!(head(MAX_LEN - HEAD_LEN), Ok(262_144));
    assert_eq!(head(MAX_LEN - HEAD_LEN + 1), Err(HeadError::LenAboveMost { len: 262_145 }));
    assert_eq!(head(usize::MAX), Err(HeadError::LenAboveMost { len: u32::MAX }));
    assert_eq!(Head { len: 3, ..Head::default() }.body_len(), 0, "a head that nobody parsed");
}

proptest! {
    #[test]
    fn any_16_bytes_are_refused_or_written_back_as_they_were(
        mut bytes in any::<[u8; HEAD_LEN]>(),
        len in prop_oneof![16u32..=262_144, any::<u32>()],
        behind in prop::collection::vec(any::<u8>(), 0..8),
    ) {
        let order = if bytes[0] & 1 == 0 { len.to_be_bytes() } else { len.to_le_bytes() };
        bytes[12..].copy_from_slice(&order);
        match Head::parse(&[&bytes[..], &behind].concat()) {
            Ok(head) => prop_assert_eq!((head.to_bytes(), head.len), (bytes, len)),
            Err(HeadError::LenBelowHead { len: said }) => prop_assert!(said == len && len < 16),
            Err(HeadError::LenAboveMost { len: said }) => prop_assert!(said == len && len > 262_144),
            Err(error) => prop_assert!(false, "{}", error),
        }
    }
}
