//! Frames 23 to 28, those of IPv4 and ARP; and an independent decoder's opinion of these headers.

use std::net::Ipv4Addr;

use pnet_packet::Packet;
use pnet_packet::arp::{ArpOperations, ArpPacket};
use pnet_packet::icmp::echo_request::EchoRequestPacket;
use pnet_packet::icmp::{self, IcmpPacket};
use pnet_packet::ip::IpNextHeaderProtocol;
use pnet_packet::ipv4::{self as their_ipv4, Ipv4Flags, Ipv4Packet, MutableIpv4Packet};
use pnet_packet::udp::{self as their_udp, MutableUdpPacket, UdpPacket};
use proptest::prelude::*;
use rtnet::wire::checksum::checksum;
use rtnet::wire::ethernet::{Address, EtherType, Header, MIN_FRAME};
use rtnet::wire::icmpv4::{self, Echo, Kind};
use rtnet::wire::ipv4::{self, Fields, Protocol};
use rtnet::wire::{arp, udp};
use tests::captures;
use tests::vectors::vector;
use zerocopy::IntoBytes;

use super::{ALL, MASTER, SLAVE};

const MASTERS: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 1);
const SLAVES: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 3);

/// Frame 23's packet, from which the others differ.
const DATAGRAM: Fields = Fields {
    source: SLAVES,
    destination: MASTERS,
    protocol: Protocol::UDP,
    tos: 0,
    identification: 0,
    dont_fragment: true,
    more_fragments: false,
    offset: 0,
    payload_len: 24,
};

/// Frames of IPv4: number, who sends, to whom, header and payload.
fn described() -> [(usize, Address, Address, Fields, Vec<u8>); 4] {
    let cut = Fields { identification: 1, dont_fragment: false, payload_len: 104, ..DATAGRAM };
    let first = Fields { more_fragments: true, ..cut };
    let last = Fields { offset: 104, ..cut };
    let long = datagram(SLAVES, MASTERS, 1025, 37_000, &ascending(200));
    let ping = Fields {
        source: MASTERS,
        destination: SLAVES,
        protocol: Protocol::ICMP,
        identification: 2,
        payload_len: 64,
        ..DATAGRAM
    };
    let echo = Echo::new(Kind::Request, 0xbeef, 1, &ping_data());
    [
        (23, SLAVE, MASTER, DATAGRAM, datagram(SLAVES, MASTERS, 1024, 36_000, &[0; 16])),
        (24, SLAVE, MASTER, first, long[..104].to_vec()),
        (25, SLAVE, MASTER, last, long[104..].to_vec()),
        (28, MASTER, SLAVE, ping, [echo.as_bytes(), &ping_data()].concat()),
    ]
}

pub(super) fn ascending(len: u8) -> Vec<u8> {
    (0..len).collect()
}

/// What `rtping` sends: when, in the order of its own machine, and a pattern.
pub(super) fn ping_data() -> Vec<u8> {
    [&600_123_456_789u64.to_le_bytes()[..], &ascending(48)].concat()
}

/// A UDP datagram with its checksum.
fn datagram(source: Ipv4Addr, destination: Ipv4Addr, from: u16, to: u16, data: &[u8]) -> Vec<u8> {
    let mut header = udp::Header::new(from, to, data.len() as u16);
    let mut sum = udp::pseudo_header(source, destination, header.len());
    sum.add(header.as_bytes());
    sum.add(data);
    header.set_checksum(udp::to_field(sum));
    [header.as_bytes(), data].concat()
}

/// A frame, padded with zeros.
fn frame(from: Address, to: Address, kind: EtherType, parts: &[&[u8]]) -> Vec<u8> {
    let mut frame = [Header::new(to, from, kind).as_bytes(), &parts.concat()].concat();
    frame.resize(frame.len().max(MIN_FRAME), 0);
    frame
}

/// What follows the Ethernet header of frame `number`, which is of this type.
fn payload(number: usize, kind: EtherType) -> Vec<u8> {
    let bytes = vector(number).bytes;
    let (header, rest) = Header::parse(&bytes).expect("long enough");
    assert_eq!(header.ether_type(), kind, "frame {number}");
    rest.to_vec()
}

#[test]
fn the_four_ip_frames_are_produced_to_the_bit() {
    for (number, from, to, fields, payload) in described() {
        let header = ipv4::Header::new(&fields);
        let built = frame(from, to, EtherType::IPV4, &[header.as_bytes(), &payload]);
        assert_eq!(built, vector(number).bytes, "frame {number}");
    }
}

#[test]
fn the_four_ip_frames_are_parsed_to_the_bit() {
    for (number, _, _, expected, payload) in described() {
        let packet = self::payload(number, EtherType::IPV4);
        let (header, parsed) = ipv4::parse(&packet).expect("a sound packet");
        assert_eq!((header.fields(), parsed), (expected, &payload[..]), "frame {number}");
        assert_eq!((header.ttl(), header.header_len()), (255, 20));
        assert_eq!(header.is_fragment(), number == 24 || number == 25);
    }
}

#[test]
fn the_datagrams_in_the_ip_frames_are_whole_and_right() {
    let parse = |number| {
        let packet = payload(number, EtherType::IPV4);
        ipv4::parse(&packet).expect("a sound packet").1.to_vec()
    };
    let joined = [parse(24), parse(25)].concat();
    for (bytes, ports, data) in
        [(parse(23), (1024, 36_000), vec![0; 16]), (joined, (1025, 37_000), ascending(200))]
    {
        let (header, rest) = udp::parse(&bytes).expect("a sound datagram");
        assert_eq!(((header.source_port(), header.destination_port()), rest), (ports, &data[..]));
        assert_eq!(usize::from(header.len()), bytes.len());
        let mut sum = udp::pseudo_header(SLAVES, MASTERS, header.len());
        sum.add(&bytes);
        assert_eq!(sum.finish(), 0);
    }
    let first = parse(24);
    let (header, rest) = udp::parse(&first).expect("its header is in its first fragment");
    assert!(usize::from(header.len()) > udp::HEADER_LEN + rest.len(), "and says how long the whole is");

    let ping = parse(28);
    let (echo, data) = icmpv4::parse(&ping).expect("a sound request");
    assert_eq!((echo.kind(), echo.identifier(), echo.sequence()), (Kind::Request, 0xbeef, 1));
    assert_eq!(data, ping_data());
}

#[test]
fn the_two_arp_frames_are_produced_and_parsed_to_the_bit() {
    let request = arp::Packet::request(MASTER, MASTERS, SLAVES);
    let asked = frame(MASTER, ALL, EtherType::ARP, &[request.as_bytes()]);
    assert_eq!(asked, vector(26).bytes);
    let (heard, answer) = (payload(26, EtherType::ARP), payload(27, EtherType::ARP));
    let heard = arp::parse(&heard).expect("a request");
    assert_eq!((heard, heard.operation()), (&request, arp::Operation::Request));

    let reply = arp::Packet::reply_to(heard, SLAVE);
    let answered = frame(SLAVE, reply.target(), EtherType::ARP, &[reply.as_bytes()]);
    assert_eq!(answered, vector(27).bytes);
    let heard = arp::parse(&answer).expect("a reply");
    assert_eq!((heard, heard.operation()), (&reply, arp::Operation::Reply));
    assert_eq!((heard.sender(), heard.sender_ip()), (SLAVE, SLAVES));
    assert_eq!((heard.target(), heard.target_ip()), (MASTER, MASTERS));
}

#[test]
fn stale_bytes_behind_what_the_lengths_say_change_nothing() {
    for (number, ether_type, len) in
        [(23, EtherType::IPV4, 44), (26, EtherType::ARP, 28), (27, EtherType::ARP, 28)]
    {
        let clean = payload(number, ether_type);
        let mut stale = clean.clone();
        stale[len..].fill(0xa5);
        stale.extend([0x5a; 900]);
        match ether_type {
            EtherType::ARP => assert_eq!(arp::parse(&stale), arp::parse(&clean)),
            _ => assert_eq!(ipv4::parse(&stale), ipv4::parse(&clean)),
        }
    }
}

#[test]
fn another_decoder_agrees_on_the_arp_frames() {
    for (number, operation) in [(26, ArpOperations::Request), (27, ArpOperations::Reply)] {
        let bytes = payload(number, EtherType::ARP);
        let (ours, theirs) =
            (arp::parse(&bytes).expect("sound"), ArpPacket::new(&bytes).expect("long enough"));
        assert_eq!(theirs.get_operation(), operation);
        assert_eq!(theirs.get_sender_hw_addr().octets(), ours.sender().0);
        assert_eq!(theirs.get_target_hw_addr().octets(), ours.target().0);
        assert_eq!(theirs.get_sender_proto_addr(), ours.sender_ip());
        assert_eq!(theirs.get_target_proto_addr(), ours.target_ip());
    }
}

/// Every IP and ARP frame of the captures of real stations, which is built again from what it says; their
/// datagrams' checksums are right, in fragments, too.
#[test]
fn what_real_stations_sent_is_understood_and_built_again() {
    let (mut pings, mut datagrams, mut arps, mut collected) = (0, 0, 0, vec![]);
    for frame in ["rtnet-real.pcap", "rtnet-real-backup.pcap"].into_iter().flat_map(captures::read) {
        let (ethernet, rest) = Header::parse(&frame.bytes).expect("long enough");
        if ethernet.ether_type() == EtherType::ARP {
            built_again(arp::parse(rest).expect("a sound packet"));
            arps += 1;
        }
        if ethernet.ether_type() != EtherType::IPV4 {
            continue;
        }
        let (header, payload) = ipv4::parse(rest).expect("a sound packet");
        // Two pings are by Linux beside the stack, which gives them 64 hops.
        if header.ttl() == ipv4::TTL {
            assert_eq!(ipv4::Header::new(&header.fields()), *header, "frame {}", frame.number);
        }
        if header.protocol() == Protocol::ICMP {
            let (echo, data) = icmpv4::parse(payload).expect("a sound echo");
            assert_eq!(Echo::new(echo.kind(), echo.identifier(), echo.sequence(), data), *echo);
            pings += 1;
            continue;
        }
        assert_eq!(usize::from(header.offset()), collected.len(), "fragments ascend");
        collected.extend(payload);
        if !header.more_fragments() {
            let (udp, data) = udp::parse(&collected).expect("a sound datagram");
            let (from, to) = (udp.source_port(), udp.destination_port());
            assert_eq!(datagram(header.source(), header.destination(), from, to, data), collected);
            collected.clear();
            datagrams += 1;
        }
    }
    assert_eq!((pings, datagrams, arps, collected.len()), (14, 12, 6, 0));
}

/// A request from who asks and for whom; a reply from the request that it answers.
fn built_again(packet: &arp::Packet) {
    let asked = match packet.operation() {
        arp::Operation::Request => (packet.sender(), packet.sender_ip(), packet.target_ip()),
        arp::Operation::Reply => (packet.target(), packet.target_ip(), packet.sender_ip()),
    };
    let request = arp::Packet::request(asked.0, asked.1, asked.2);
    match packet.operation() {
        arp::Operation::Request => assert_eq!(*packet, request),
        arp::Operation::Reply => assert_eq!(*packet, arp::Packet::reply_to(&request, packet.sender())),
    }
}

/// Any header, with a payload of at most 1400 bytes and no length yet.
fn any_fields() -> impl Strategy<Value = Fields> {
    let addresses = (any::<u32>(), any::<u32>());
    let bytes = (any::<u8>(), any::<u8>(), any::<u16>());
    let fragment = (any::<bool>(), any::<bool>(), 0u16..8_000);
    (addresses, bytes, fragment).prop_map(
        |((source, destination), (protocol, tos, identification), fragment)| {
            let (dont_fragment, more_fragments, offset) = fragment;
            Fields {
                source: source.into(),
                destination: destination.into(),
                protocol: Protocol(protocol),
                tos,
                identification,
                dont_fragment,
                more_fragments,
                offset: offset * 8,
                payload_len: 0,
            }
        },
    )
}

/// A packet as the other encoder makes it.
fn their_packet(fields: &Fields, payload: &[u8]) -> Vec<u8> {
    let mut bytes = vec![0; ipv4::HEADER_LEN + payload.len()];
    let mut theirs = MutableIpv4Packet::new(&mut bytes).expect("long enough");
    theirs.set_version(4);
    theirs.set_header_length(5);
    theirs.set_dscp(fields.tos >> 2);
    theirs.set_ecn(fields.tos & 3);
    theirs.set_total_length((ipv4::HEADER_LEN + payload.len()) as u16);
    theirs.set_identification(fields.identification);
    let flag = |set, flag| if set { flag } else { 0 };
    let dont_fragment = flag(fields.dont_fragment, Ipv4Flags::DontFragment);
    theirs.set_flags(dont_fragment | flag(fields.more_fragments, Ipv4Flags::MoreFragments));
    theirs.set_fragment_offset(fields.offset / 8);
    theirs.set_ttl(255);
    theirs.set_next_level_protocol(IpNextHeaderProtocol(fields.protocol.0));
    theirs.set_source(fields.source);
    theirs.set_destination(fields.destination);
    theirs.set_payload(payload);
    theirs.set_checksum(their_ipv4::checksum(&theirs.to_immutable()));
    bytes
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..Default::default() })]

    #[test]
    fn another_encoder_makes_the_same_packets(
        fields_in in any_fields(),
        payload in prop::collection::vec(any::<u8>(), 8..1400),
    ) {
        let payload = &payload[..if fields_in.more_fragments { payload.len() & !7 } else { payload.len() }];
        let fields_in = Fields { payload_len: payload.len() as u16, ..fields_in };
        let theirs = their_packet(&fields_in, payload);
        let ours = [ipv4::Header::new(&fields_in).as_bytes(), payload].concat();
        prop_assert_eq!(&ours, &theirs);
        let (header, parsed) = ipv4::parse(&theirs).expect("sound");
        prop_assert_eq!((header.fields(), parsed), (fields_in, payload));
        let decoded = Ipv4Packet::new(&ours).expect("long enough");
        prop_assert_eq!(decoded.payload(), payload);
    }

    #[test]
    fn another_encoder_makes_the_same_datagrams(
        (source, destination) in (any::<u32>(), any::<u32>()),
        (from, to) in (any::<u16>(), any::<u16>()),
        data in prop::collection::vec(any::<u8>(), 0..1400),
    ) {
        let (source, destination) = (Ipv4Addr::from(source), Ipv4Addr::from(destination));
        let ours = datagram(source, destination, from, to, &data);
        let mut bytes = vec![0; udp::HEADER_LEN + data.len()];
        let mut theirs = MutableUdpPacket::new(&mut bytes).expect("long enough");
        theirs.set_source(from);
        theirs.set_destination(to);
        theirs.set_length((udp::HEADER_LEN + data.len()) as u16);
        theirs.set_payload(&data);
        let sum = their_udp::ipv4_checksum(&theirs.to_immutable(), &source, &destination);
        // It leaves the other zero to who writes it.
        theirs.set_checksum(if sum == 0 { 0xffff } else { sum });
        prop_assert_eq!(&ours, &bytes);
        let decoded = UdpPacket::new(&ours).expect("long enough");
        let (header, _) = udp::parse(&bytes).expect("sound");
        prop_assert_eq!((decoded.get_source(), decoded.get_checksum()), (header.source_port(), header.checksum()));
    }

    #[test]
    fn another_decoder_agrees_on_pings(
        (identifier, sequence) in (any::<u16>(), any::<u16>()),
        data in prop::collection::vec(any::<u8>(), 0..1400),
    ) {
        let ours = [Echo::new(Kind::Request, identifier, sequence, &data).as_bytes(), &data[..]].concat();
        let theirs = EchoRequestPacket::new(&ours).expect("long enough");
        prop_assert_eq!((theirs.get_identifier(), theirs.get_sequence_number()), (identifier, sequence));
        prop_assert_eq!((theirs.get_icmp_type(), theirs.payload()), (icmp::IcmpTypes::EchoRequest, &data[..]));
        prop_assert_eq!(theirs.get_checksum(), icmp::checksum(&IcmpPacket::new(&ours).expect("long enough")));
    }

    #[test]
    fn another_checksum_is_the_same(bytes in prop::collection::vec(any::<u8>(), 1..3000)) {
        prop_assert_eq!(checksum(&bytes), pnet_packet::util::checksum(&bytes, usize::MAX));
    }
}
