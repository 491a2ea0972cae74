use super::*;
use proptest::prelude::*;

/// The header of example frame 24, a first fragment of 104 bytes.
const BYTES: [u8; HEADER_LEN] =
    [0x45, 0, 0, 0x7c, 0, 1, 0x20, 0, 0xff, 17, 0x87, 0x6c, 10, 0, 0, 3, 10, 0, 0, 1];
const FIELDS: Fields = Fields {
    source: Ipv4Addr::new(10, 0, 0, 3),
    destination: Ipv4Addr::new(10, 0, 0, 1),
    protocol: Protocol::UDP,
    tos: 0,
    identification: 1,
    dont_fragment: false,
    more_fragments: true,
    offset: 0,
    payload_len: 104,
};

/// A packet of these fields and this payload.
fn packet(fields: &Fields, payload: &[u8]) -> Vec<u8> {
    [Header::new(fields).as_bytes(), payload].concat()
}

/// That packet of the example with some bytes of its header changed, and a right checksum.
fn changed(changes: &[(usize, u8)]) -> Vec<u8> {
    let mut bytes = packet(&FIELDS, &[7; 104]);
    changes.iter().for_each(|&(at, byte)| bytes[at] = byte);
    let header_len = usize::from(bytes[0] & 0xf) * 4;
    let header_len = header_len.clamp(HEADER_LEN, bytes.len());
    bytes[10..12].fill(0);
    let sum = checksum(&bytes[..header_len]);
    bytes[10..12].copy_from_slice(&sum.to_be_bytes());
    bytes
}

fn refusal(packet: &[u8]) -> Option<Refusal> {
    parse(packet).err()
}

#[test]
fn bytes_and_header_are_the_same_thing_in_both_directions() {
    assert_eq!(Header::new(&FIELDS).as_bytes(), BYTES);
    let packet = packet(&FIELDS, &[7; 104]);
    let (header, payload) = parse(&packet).unwrap();
    assert_eq!((header.as_bytes(), payload), (&BYTES[..], &[7; 104][..]));
    assert_eq!(header.fields(), FIELDS);
    assert_eq!((header.ttl(), header.total_len(), header.header_len()), (TTL, 124, HEADER_LEN));
    assert!(header.is_fragment());
}

#[test]
fn each_flag_and_the_offset_have_their_own_bits() {
    let whole = Fields { dont_fragment: true, more_fragments: false, ..FIELDS };
    assert_eq!(Header::new(&whole).as_bytes()[6..8], [0x40, 0]);
    assert!(!Header::new(&whole).is_fragment());
    let last = Fields { more_fragments: false, offset: 104, ..FIELDS };
    assert_eq!(Header::new(&last).as_bytes()[6..8], [0, 13]);
    assert!(Header::new(&last).is_fragment());
    let farthest = Fields { more_fragments: false, offset: 65_512, payload_len: 3, ..FIELDS };
    assert_eq!(Header::new(&farthest).as_bytes()[6..8], [0x1f, 0xfd]);
    assert_eq!(parse(&packet(&farthest, &[1; 3])).map(|(header, _)| header.fields()), Ok(farthest));
}

#[test]
fn padding_is_cut_off_whatever_it_is() {
    let mut padded = packet(&Fields { more_fragments: false, payload_len: 3, ..FIELDS }, b"abc");
    padded.extend([0xa5; 23]);
    assert_eq!(parse(&padded).unwrap().1, b"abc");
}

#[test]
fn options_are_skipped_and_are_part_of_the_checksum() {
    // No operation, no operation, end of the options.
    let mut bytes = changed(&[(0, 0x46)]);
    bytes.splice(20..20, [1, 1, 0, 0]);
    bytes[2..4].copy_from_slice(&128u16.to_be_bytes());
    bytes[10..12].fill(0);
    let sum = checksum(&bytes[..24]);
    bytes[10..12].copy_from_slice(&sum.to_be_bytes());
    let (header, payload) = parse(&bytes).unwrap();
    assert_eq!((header.header_len(), payload), (24, &[7; 104][..]));
    assert_eq!(header.fields(), FIELDS);
    bytes[21] = 0;
    assert_eq!(refusal(&bytes), Some(Refusal::IpChecksum));
}

#[test]
fn headers_that_cannot_be_are_refused_by_reason() {
    for (bytes, reason) in [
        (changed(&[(0, 0x65)]), Refusal::IpVersion),
        (changed(&[(0, 0x05)]), Refusal::IpVersion),
        (changed(&[(0, 0x44)]), Refusal::IpHeaderLength),
        (changed(&[(0, 0x40)]), Refusal::IpHeaderLength),
        (changed(&[(0, 0x46)])[..20].to_vec(), Refusal::IpHeaderLength),
        (changed(&[(8, 0)]), Refusal::IpTtl),
    ] {
        assert_eq!(refusal(&bytes), Some(reason), "{:02x?}", &bytes[..20]);
    }
    assert_eq!(refusal(&changed(&[(8, 1)])), None, "its last hop");
}

#[test]
fn a_total_length_that_lies_is_refused() {
    let with = |len: u16| changed(&[(2, len.to_be_bytes()[0]), (3, len.to_be_bytes()[1])]);
    for lie in [0, 1, 19, 125, 1_500, u16::MAX] {
        assert_eq!(refusal(&with(lie)), Some(Refusal::IpLength), "{lie}");
    }
    assert_eq!(parse(&with(116)).unwrap().1.len(), 96, "what is behind is padding");
    // Six words of header in a packet of 20 bytes.
    assert_eq!(refusal(&changed(&[(0, 0x46), (2, 0), (3, 20)])), Some(Refusal::IpLength));
}

#[test]
fn fragments_that_are_part_of_nothing_are_refused() {
    let fragment = |more_fragments, offset: u16, payload_len: u16| {
        // Not by `new`, which builds none of them.
        let flags = if more_fragments { MORE_FRAGMENTS } else { 0 };
        let [high, low] = (flags | (offset / UNIT)).to_be_bytes();
        let [len_high, len_low] = (20u16 + payload_len).to_be_bytes();
        refusal(&changed(&[(2, len_high), (3, len_low), (6, high), (7, low)]))
    };
    let refused = Some(Refusal::IpFragment);
    assert_eq!((fragment(true, 0, 8), fragment(true, 0, 0)), (None, refused), "it brings something");
    assert_eq!((fragment(true, 8, 9), fragment(true, 8, 15)), (refused, refused), "no other begins there");
    assert_eq!((fragment(false, 8, 9), fragment(false, 8, 0)), (None, None), "the last ends anywhere");
    assert_eq!((fragment(false, 65_512, 3), fragment(false, 65_512, 4)), (None, refused), "too long a whole");
    assert_eq!((fragment(true, 65_504, 8), fragment(true, 65_512, 8)), (None, refused));
}

#[test]
fn any_bit_of_a_header_that_is_changed_on_the_way_is_noticed() {
    let packet = packet(&FIELDS, &[7; 104]);
    for bit in 0..HEADER_LEN * 8 {
        let mut changed = packet.clone();
        changed[bit / 8] ^= 1 << (bit % 8);
        assert!(parse(&changed).is_err(), "bit {bit}");
    }
}

proptest! {
    #[test]
    fn no_bytes_whatever_panic(
        mut bytes in prop::collection::vec(any::<u8>(), 0..200),
        plausible in any::<bool>(),
        ihl in 0x40u8..0x50,
    ) {
        if plausible && bytes.len() >= HEADER_LEN {
            (bytes[0], bytes[2]) = (ihl, 0);
            let len = usize::from(ihl & 0xf) * 4;
            if let Some(header) = bytes.get_mut(..len).filter(|_| len >= HEADER_LEN) {
                header[10..12].fill(0);
                let sum = checksum(header);
                header[10..12].copy_from_slice(&sum.to_be_bytes());
            }
        }
        if let Ok((header, payload)) = parse(&bytes) {
            prop_assert_eq!(header.header_len() + payload.len(), usize::from(header.total_len()));
            let _ = (header.fields(), header.ttl(), header.is_fragment());
        }
        // Nor those of a header that nobody has checked.
        if let Ok((header, _)) = Header::ref_from_prefix(&bytes) {
            let _ = (header.header_len(), header.total_len(), header.offset(), header.is_fragment());
        }
    }

    #[test]
    fn what_is_built_is_parsed_and_every_part_of_it_is_refused(
        (source, destination) in (any::<u32>(), any::<u32>()),
        (protocol, tos, identification) in (any::<u8>(), any::<u8>(), any::<u16>()),
        (dont_fragment, more_fragments) in (any::<bool>(), any::<bool>()),
        (offset, payload) in (0u16..8_000, prop::collection::vec(any::<u8>(), 8..1_400)),
    ) {
        let len = if more_fragments { payload.len() & !7 } else { payload.len() };
        let fields_in = Fields {
            source: source.into(),
            destination: destination.into(),
            protocol: Protocol(protocol),
            tos,
            identification,
            dont_fragment,
            more_fragments,
            offset: offset * UNIT,
            payload_len: len as u16,
        };
        let packet = packet(&fields_in, &payload[..len]);
        let (header, parsed) = parse(&packet).unwrap();
        prop_assert_eq!(header.fields(), fields_in);
        prop_assert_eq!(parsed, &payload[..len]);
        for end in 0..packet.len() {
            let reason = if end < HEADER_LEN { Refusal::Truncated } else { Refusal::IpLength };
            prop_assert_eq!(refusal(&packet[..end]), Some(reason));
        }
    }
}
