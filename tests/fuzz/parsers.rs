//! Each parser of the wire against an independent opinion of the same bytes.

use pnet_packet::Packet;
use pnet_packet::arp::ArpPacket;
use pnet_packet::ethernet::EthernetPacket;
use pnet_packet::icmp::{self, IcmpPacket};
use pnet_packet::ipv4::{self as their_ipv4, Ipv4Packet};
use pnet_packet::udp::UdpPacket;
use rtmac::wire::change::Extension;
use rtmac::wire::{self, Message, Rtmac};
use rtnet::buf::{Pool, ROOM};
use rtnet::counters::Refusal;
use rtnet::time::GlobalTime;
use rtnet::wire::checksum::{Checksum, checksum};
use rtnet::wire::ethernet::{Address, EtherType, Header};
use rtnet::wire::offload::{HEADER_LEN, Offload};
use rtnet::wire::udp_options::{self, Surplus};
use rtnet::wire::{arp, icmpv4, ipv4, udp};
use tests::peer;
use tools::observe::decode::{What, decode};

use super::engine::{Target, fuzz, outcome};
use super::{frames, mutate};

/// What came of it: the reason, or what was read.
fn read<T>(result: Result<T, Refusal>, what: impl FnOnce(T) -> u64) -> u64 {
    match result {
        Ok(read) => outcome([1, what(read)]),
        Err(reason) => outcome([0, reason as u64]),
    }
}

#[test]
fn ethernet_takes_any_bytes() {
    fuzz(&Target {
        name: "ethernet",
        seeds: frames::all(),
        has_corpus: true,
        mutate: frames::change,
        run: |bytes| vec![ethernet(bytes)],
    });
}

fn ethernet(bytes: &[u8]) -> u64 {
    let (ours, theirs) = (Header::parse(bytes), EthernetPacket::new(bytes));
    assert_eq!(ours.is_some(), theirs.is_some());
    let (Some((header, rest)), Some(theirs)) = (ours, theirs) else { return 0 };
    assert_eq!(header.destination.0, theirs.get_destination().octets());
    assert_eq!(header.source.0, theirs.get_source().octets());
    assert_eq!((header.ether_type().0, rest), (theirs.get_ethertype().0, theirs.payload()));
    assert_eq!(header.source.to_string().parse(), Ok(header.source));
    let known = [EtherType::IPV4, EtherType::ARP, EtherType::RTMAC];
    known.iter().position(|&known| known == header.ether_type()).map_or(9, |place| 1 + place as u64)
}

/// An offload header and a frame of any bytes: the frames that are cut are sound and have all bytes once.
#[test]
fn uncut_frames_take_any_bytes() {
    let change = |random: &mut _, bytes: &mut Vec<u8>, other: &[u8]| {
        let mut frame = bytes.split_off(HEADER_LEN.min(bytes.len()));
        mutate::bytes(random, bytes, &other[..HEADER_LEN.min(other.len())]);
        bytes.resize(HEADER_LEN, 0);
        frames::change(random, &mut frame, other.get(HEADER_LEN..).unwrap_or_default());
        bytes.append(&mut frame);
    };
    // UDP to be cut into 24 bytes each, TCP into 100, and a checksum to be completed.
    let heads = [
        [1, 5, 42, 0, 24, 0, 34, 0, 6, 0],
        [1, 1, 54, 0, 100, 0, 34, 0, 16, 0],
        [1, 0, 0, 0, 0, 0, 34, 0, 6, 0],
    ];
    let seeds = frames::all().into_iter().flat_map(|frame| heads.map(|head| [&head[..], &frame].concat()));
    fuzz(&Target {
        name: "offload",
        seeds: seeds.collect(),
        has_corpus: false,
        mutate: change,
        run: |bytes| vec![offload(bytes)],
    });
}

fn offload(bytes: &[u8]) -> u64 {
    let Some((head, frame)) = bytes.split_first_chunk::<HEADER_LEN>() else { return 0 };
    let offload: Offload = zerocopy::transmute!(*head);
    let mut frame = frame.to_vec();
    if !offload.is_uncut() {
        offload.complete(&mut frame);
        return 1;
    }
    let Ok(cut) = offload.cut(&frame) else { return 2 };
    let (mut room, mut contents) = ([0; ROOM], 0);
    for number in 0..cut.count() {
        let len = cut.write(&frame, number, &mut room);
        let packet = Ipv4Packet::new(&room[14..len]).expect("it is long enough");
        assert_eq!(usize::from(packet.get_total_length()), len - 14);
        let head = usize::from(packet.get_header_length()) * 4;
        assert_eq!(checksum(&packet.packet()[..head]), 0, "the header's sum is right");
        contents += len;
    }
    assert!(contents > 0);
    outcome([3, cut.count() as u64])
}

#[test]
fn ipv4_takes_any_bytes() {
    let change = |random: &mut _, packet: &mut Vec<u8>, other: &[u8]| {
        // Changes are of whole frames.
        let in_frame = |packet: &[u8]| [&[0; 12][..], &[8, 0], packet].concat();
        let mut frame = in_frame(packet);
        frames::change(random, &mut frame, &in_frame(other));
        *packet = frame.split_off(14.min(frame.len()));
    };
    fuzz(&Target {
        name: "ipv4",
        seeds: frames::payloads(0x0800),
        has_corpus: true,
        mutate: change,
        run: |bytes| vec![ipv4(bytes)],
    });
}

fn ipv4(bytes: &[u8]) -> u64 {
    let ours = ipv4::parse(bytes);
    assert_eq!(ours.as_ref().err().copied(), refused_by_another(bytes));
    read(ours, |(header, payload)| {
        let theirs = Ipv4Packet::new(bytes).expect("long enough");
        assert_eq!((header.source(), header.destination()), (theirs.get_source(), theirs.get_destination()));
        assert_eq!(header.protocol().0, theirs.get_next_level_protocol().0);
        assert_eq!(header.identification(), theirs.get_identification());
        assert_eq!(header.offset() / 8, theirs.get_fragment_offset());
        assert_eq!(header.tos(), theirs.get_dscp() << 2 | theirs.get_ecn());
        assert_eq!(header.header_len() + payload.len(), usize::from(theirs.get_total_length()));
        assert_eq!(payload, &bytes[header.header_len()..usize::from(theirs.get_total_length())]);
        let shape =
            [header.is_fragment(), header.more_fragments(), payload.is_empty(), header.header_len() > 20];
        outcome(shape.map(u64::from).into_iter().chain([header.protocol().0.into()]))
    })
}

/// What is to be refused, and why, by somebody else's reading of the fields.
fn refused_by_another(bytes: &[u8]) -> Option<Refusal> {
    let Some(theirs) = Ipv4Packet::new(bytes) else { return Some(Refusal::Truncated) };
    let begin = usize::from(theirs.get_header_length()) * 4;
    let total = usize::from(theirs.get_total_length());
    let offset = usize::from(theirs.get_fragment_offset()) * 8;
    let more = theirs.get_flags() & their_ipv4::Ipv4Flags::MoreFragments != 0;
    // Of one's complement's two zeros theirs writes one.
    let sum = their_ipv4::checksum(&theirs);
    let is_sum = theirs.get_checksum() == sum || sum == 0 && theirs.get_checksum() == 0xffff;
    match () {
        () if theirs.get_version() != 4 => Some(Refusal::IpVersion),
        () if begin < 20 || begin > bytes.len() => Some(Refusal::IpHeaderLength),
        () if !is_sum => Some(Refusal::IpChecksum),
        () if total < begin || total > bytes.len() => Some(Refusal::IpLength),
        () if theirs.get_ttl() == 0 => Some(Refusal::IpTtl),
        () if more && (total == begin || (total - begin) % 8 != 0) => Some(Refusal::IpFragment),
        () if offset + (total - begin) > 65_515 => Some(Refusal::IpFragment),
        () => None,
    }
}

#[test]
fn udp_takes_any_bytes() {
    fuzz(&Target {
        name: "udp",
        seeds: frames::ip_payloads(17),
        has_corpus: true,
        mutate: mutate::bytes,
        run: |bytes| vec![udp(bytes)],
    });
}

fn udp(bytes: &[u8]) -> u64 {
    let ours = udp::parse(bytes);
    let Some(theirs) = UdpPacket::new(bytes) else {
        assert_eq!(ours.err(), Some(Refusal::Truncated));
        return 0;
    };
    assert_eq!(ours.is_ok(), theirs.get_length() >= 8);
    read(ours, |(header, rest)| {
        assert_eq!(header.source_port(), theirs.get_source());
        assert_eq!(header.destination_port(), theirs.get_destination());
        assert_eq!((header.len(), header.checksum()), (theirs.get_length(), theirs.get_checksum()));
        assert_eq!(rest, &bytes[8..]);
        let len = usize::from(header.len());
        outcome([(len > bytes.len()).into(), (len < bytes.len()).into(), (header.checksum() == 0).into()])
    })
}

#[test]
fn udp_options_takes_any_bytes() {
    // How long the datagram is and whether it has a checksum, and what is behind it.
    let times = udp_options::Times { sent: GlobalTime::from_nanos(7 << 60), left: None };
    let seed = |len: u8| [&[len, 1], Surplus::new(len.into(), &times).as_bytes()].concat();
    let change = |random: &mut rtnet::sim::Random, input: &mut Vec<u8>, other: &[u8]| {
        mutate::bytes(random, input, other);
        let Some(at) = input.first().map(|len| 2 + usize::from(len % 2)) else { return };
        if random.below(4) > 0 && input.len() >= at + 2 {
            let len = (input.len() - 2) as u16;
            input[at..at + 2].fill(0);
            let mut sum = Checksum::new();
            sum.add(&len.to_be_bytes());
            sum.add(&input[at..]);
            input[at..at + 2].copy_from_slice(&udp::to_field(sum).to_be_bytes());
        }
    };
    fuzz(&Target {
        name: "udp_options",
        seeds: vec![seed(24), seed(25)],
        has_corpus: false,
        mutate: change,
        run: |bytes| vec![udp_options(bytes)],
    });
}

fn udp_options(bytes: &[u8]) -> u64 {
    let [len, checked, surplus @ ..] = bytes else { return 0 };
    let ours = udp_options::parse((*len).into(), checked % 2 == 1, surplus);
    assert_eq!(ours.ok(), read_by_another(len % 2 == 1, checked % 2 == 1, surplus));
    match ours {
        Err(_) => 1,
        Ok(None) => outcome([2, surplus.len() as u64]),
        Ok(Some(times)) => outcome([3, surplus.len() as u64, times.left.is_some().into()]),
    }
}

/// The same, read from place to place; `None`: nothing of it is to be believed.
fn read_by_another(is_odd: bool, is_checked: bool, all: &[u8]) -> Option<Option<udp_options::Times>> {
    let at = |place: usize| all.get(place).copied().map(u64::from);
    let begin = usize::from(is_odd);
    let field = at(begin)? << 8 | at(begin + 1)?;
    let words =
        (begin..all.len()).step_by(2).map(|place| at(place).unwrap_or(0) << 8 | at(place + 1).unwrap_or(0));
    // All ones, and nothing, are the two zeros of one's complement.
    let sum = words.sum::<u64>() + all.len() as u64;
    let is_sum = field != 0 && sum.is_multiple_of(0xffff);
    if is_odd && at(0)? != 0 || !(is_sum || field == 0 && !is_checked) {
        return None;
    }
    let (mut place, mut times) = (begin + 2, None);
    while let Some(kind) = at(place).filter(|&kind| kind != 0) {
        if kind == 1 {
            place += 1;
            continue;
        }
        let short = at(place + 1).filter(|_| kind < 192)?;
        let (header, len) = if short == 255 { (4, at(place + 2)? << 8 | at(place + 3)?) } else { (2, short) };
        let end = place + len as usize;
        if len < header || end > all.len() {
            return None;
        }
        let value = &all[place + header as usize..end];
        if kind == 127 && value.len() == 18 && value[..2] == *b"RT" && times.is_none() {
            let number = |from: usize| u64::from_be_bytes(value[from..from + 8].try_into().unwrap());
            let global = |from| (number(from) > 0).then(|| GlobalTime::from_nanos(number(from)));
            times = global(2).map(|sent| udp_options::Times { sent, left: global(10) });
        }
        place = end;
    }
    Some(times)
}

#[test]
fn icmp_takes_any_bytes() {
    let change = |random: &mut rtnet::sim::Random, message: &mut Vec<u8>, other: &[u8]| {
        mutate::bytes(random, message, other);
        if random.below(2) == 0 && message.len() >= icmpv4::HEADER_LEN {
            message[2..4].fill(0);
            let sum = rtnet::wire::checksum::checksum(message).to_be_bytes();
            message[2..4].copy_from_slice(&sum);
        }
    };
    fuzz(&Target {
        name: "icmp",
        seeds: frames::ip_payloads(1),
        has_corpus: true,
        mutate: change,
        run: |bytes| vec![icmp(bytes)],
    });
}

fn icmp(bytes: &[u8]) -> u64 {
    let ours = icmpv4::parse(bytes);
    let theirs = IcmpPacket::new(bytes).filter(|_| bytes.len() >= icmpv4::HEADER_LEN);
    let Some(theirs) = theirs else {
        assert_eq!(ours.err(), Some(Refusal::Truncated));
        return 0;
    };
    let sum = icmp::checksum(&theirs);
    let is_sum = theirs.get_checksum() == sum || sum == 0 && theirs.get_checksum() == 0xffff;
    let is_echo = matches!(theirs.get_icmp_type().0, 0 | 8) && theirs.get_icmp_code().0 == 0;
    let reason = match () {
        () if !is_sum => Some(Refusal::IcmpChecksum),
        () => (!is_echo).then_some(Refusal::IcmpType),
    };
    assert_eq!(ours.as_ref().err().copied(), reason);
    read(ours, |(echo, data)| {
        assert_eq!(data, &bytes[8..]);
        assert_eq!(echo.kind() == icmpv4::Kind::Request, theirs.get_icmp_type().0 == 8);
        theirs.get_icmp_type().0.into()
    })
}

#[test]
fn arp_takes_any_bytes() {
    fuzz(&Target {
        name: "arp",
        seeds: frames::payloads(0x0806),
        has_corpus: true,
        mutate: mutate::bytes,
        run: |bytes| vec![arp(bytes)],
    });
}

fn arp(bytes: &[u8]) -> u64 {
    let ours = arp::parse(bytes);
    let Some(theirs) = ArpPacket::new(bytes) else {
        assert_eq!(ours.err(), Some(Refusal::Truncated));
        return 0;
    };
    let lengths = (theirs.get_hw_addr_len(), theirs.get_proto_addr_len());
    let is_ours = matches!(theirs.get_hardware_type().0, 1 | 6)
        && (theirs.get_protocol_type().0, lengths) == (0x0800, (6, 4))
        && matches!(theirs.get_operation().0, 1 | 2);
    assert_eq!(ours.as_ref().err().copied(), (!is_ours).then_some(Refusal::ArpFormat));
    read(ours, |packet| {
        assert_eq!(packet.sender().0, theirs.get_sender_hw_addr().octets());
        assert_eq!(packet.target().0, theirs.get_target_hw_addr().octets());
        assert_eq!(packet.sender_ip(), theirs.get_sender_proto_addr());
        assert_eq!(packet.target_ip(), theirs.get_target_proto_addr());
        theirs.get_operation().0.into()
    })
}

#[test]
fn rtmac_takes_any_bytes() {
    fuzz(&Target {
        name: "rtmac",
        seeds: frames::all(),
        has_corpus: true,
        mutate: frames::change,
        run: |bytes| vec![rtmac(bytes)],
    });
}

fn rtmac(bytes: &[u8]) -> u64 {
    let parsed = wire::parse(bytes);
    let is_rtmac = Header::parse(bytes).is_some_and(|(header, _)| header.ether_type() == EtherType::RTMAC);
    let is_tdma = matches!(parsed, Ok(Rtmac::Tdma(_)));
    assert_eq!(is_tdma, peer::understands(bytes), "in the opinion of another station");
    let harmless = matches!(parsed, Ok(_) | Err(Refusal::TdmaVersion | Refusal::TdmaMessage));
    assert!(!is_rtmac || !harmless || !wire::is_lethal(bytes), "what is understood may leave");
    read(parsed, |parsed| match parsed {
        Rtmac::Tunnel(inner, payload) => {
            assert_eq!((&inner.0.to_be_bytes()[..], payload), (&bytes[14..16], &bytes[18..]));
            u64::from(payload.is_empty())
        }
        Rtmac::Extension(extension) => {
            let mut frame = Pool::new(1).take().expect("a new pool is full");
            extension.write(Address::BROADCAST, Address::default(), &mut frame);
            assert_eq!(wire::parse(&frame), Ok(Rtmac::Extension(extension)), "written as it was read");
            match extension {
                Extension::Part(_) => 5,
                Extension::Answer(_) => 6,
            }
        }
        Rtmac::Tdma(message) => {
            let mut frame = Pool::new(1).take().expect("a new pool is full");
            message.write(Address::BROADCAST, Address::default(), &mut frame);
            assert_eq!(wire::parse(&frame), Ok(Rtmac::Tdma(message)), "written as it was read");
            match message {
                Message::Sync { .. } => 2,
                Message::Request { .. } => 3,
                Message::Reply { .. } => 4,
            }
        }
    })
}

#[test]
fn dump_takes_any_bytes() {
    fuzz(&Target {
        name: "dump",
        seeds: frames::all(),
        has_corpus: true,
        mutate: frames::change,
        run: |bytes| vec![dump(bytes)],
    });
}

fn dump(bytes: &[u8]) -> u64 {
    let decoded = decode(bytes, bytes.len());
    assert_eq!(matches!(decoded.what, What::Refused(Refusal::Runt)), bytes.len() < 14);
    let (line, kind) = (decoded.what.to_string(), decoded.what.kind());
    assert!(!line.is_empty() && line.chars().all(|c| c.is_ascii() && !c.is_control()), "{line:?}");
    let _ = decoded.what.scheduled();
    let reason = if let What::Refused(reason) = decoded.what { reason as u64 } else { u64::MAX };
    outcome(kind.bytes().map(u64::from).chain([reason]))
}
