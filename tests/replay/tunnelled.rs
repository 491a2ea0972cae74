//! What real stations sent through their tunnels, as a station with a tunnel gives it to Linux, in another's opinion.

use pnet_packet::Packet;
use pnet_packet::arp::{ArpOperation, ArpOperations, ArpPacket};
use pnet_packet::ethernet::{EtherTypes, EthernetPacket};
use pnet_packet::icmp::echo_request::EchoRequestPacket;
use pnet_packet::icmp::{IcmpPacket, IcmpType, IcmpTypes};
use pnet_packet::ip::IpNextHeaderProtocols;
use pnet_packet::ipv4::Ipv4Packet;
use pnet_packet::{icmp, ipv4};
use rtnet::counters::Refusal;
use tests::captures;
use vnic::tunnel::{self, Config, Inner};

use super::{ADDRESS, is_rtmac, replay_to, slave};

type Mac = [u8; 6];
type Ip = [u8; 4];

const ONE: (Mac, Ip) = ([0x52, 0x54, 0, 0, 0, 1], [10, 0, 0, 1]);
const TWO: (Mac, Ip) = ([0x52, 0x54, 0, 0, 0, 2], [10, 0, 0, 2]);
const NOBODY: Mac = [0; 6];
const ALL: Mac = [0xff; 6];

/// What Linux reads in a frame.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Read {
    /// Of address resolution: sender and target.
    Arp(ArpOperation, (Mac, Ip), (Mac, Ip)),
    /// An echo, or its answer, of this sequence number, with its checksums right.
    Echo(IcmpType, (Mac, Ip), (Mac, Ip), u16),
}

fn read(frame: &[u8]) -> ((Mac, Mac), Read) {
    let link = EthernetPacket::new(frame).expect("a header");
    let (to, from) = (link.get_destination().octets(), link.get_source().octets());
    let content = match link.get_ethertype() {
        EtherTypes::Arp => {
            let arp = ArpPacket::new(link.payload()).expect("a whole packet");
            let sender = (arp.get_sender_hw_addr().octets(), arp.get_sender_proto_addr().octets());
            let target = (arp.get_target_hw_addr().octets(), arp.get_target_proto_addr().octets());
            Read::Arp(arp.get_operation(), sender, target)
        }
        EtherTypes::Ipv4 => {
            let ip = Ipv4Packet::new(link.payload()).expect("a whole header");
            assert_eq!(ip.get_checksum(), ipv4::checksum(&ip));
            assert_eq!(ip.get_next_level_protocol(), IpNextHeaderProtocols::Icmp);
            assert_eq!(
                usize::from(ip.get_total_length()),
                link.payload().len(),
                "no ping of these is padded"
            );
            let echo = IcmpPacket::new(ip.payload()).expect("a whole header");
            assert_eq!(echo.get_checksum(), icmp::checksum(&echo));
            let numbered = EchoRequestPacket::new(ip.payload()).expect("an echo, or its answer");
            let [sender, target] =
                [(from, ip.get_source()), (to, ip.get_destination())].map(|(mac, ip)| (mac, ip.octets()));
            Read::Echo(echo.get_icmp_type(), sender, target, numbered.get_sequence_number())
        }
        other => panic!("{other} is not in the capture"),
    };
    ((to, from), content)
}

#[test]
fn what_real_stations_tunnelled_comes_out_as_the_arp_and_the_pings_that_it_is() {
    let frames = captures::read("rtnet-real.pcap");
    let (tunnel, mouth) = tunnel::new(Config::of(ADDRESS));
    let replay = replay_to(slave(frames[0].at, Some(tunnel)), &frames);
    let came: Vec<Vec<u8>> =
        std::iter::from_fn(|| mouth.received()).map(|of| Inner::of(&of).unwrap().pieces().concat()).collect();

    // As another program would unwrap them: version 2, and the tunnel flag.
    let tunnelled = frames.iter().filter(|frame| is_rtmac(frame) && frame.bytes[16..18] == [2, 1]);
    let inside =
        tunnelled.map(|frame| [&frame.bytes[..12], &frame.bytes[14..16], &frame.bytes[18..]].concat());
    assert_eq!(came, inside.collect::<Vec<_>>(), "all of them, in their order, padding included");

    let asks = |who: (Mac, Ip), whom| Read::Arp(ArpOperations::Request, who, (NOBODY, whom));
    let answers = |who, whom| Read::Arp(ArpOperations::Reply, who, whom);
    let ping = |sequence| {
        let asked = Read::Echo(IcmpTypes::EchoRequest, TWO, ONE, sequence);
        [((ONE.0, TWO.0), asked), ((TWO.0, ONE.0), Read::Echo(IcmpTypes::EchoReply, ONE, TWO, sequence))]
    };
    let expected = [
        vec![((ALL, TWO.0), asks(TWO, ONE.1)), ((TWO.0, ONE.0), answers(ONE, TWO))],
        [0, 1, 2].map(ping).concat(),
        // Later the other one makes sure that it is still there.
        vec![((TWO.0, ONE.0), asks(ONE, TWO.1)), ((ONE.0, TWO.0), answers(TWO, ONE))],
    ];
    assert_eq!(came.iter().map(|frame| read(frame)).collect::<Vec<_>>(), expected.concat());

    assert_eq!(mouth.counts().received, 10);
    let refusals = replay.bench.station.refusals();
    assert_eq!((refusals.get(Refusal::NoTunnel), refusals.get(Refusal::PoolEmpty)), (0, 0));
    // The rest is what it is for a station without a tunnel.
    let foreign = frames.iter().filter(|frame| !is_rtmac(frame)).count() as u64;
    assert_eq!(refusals.total(), 40 + foreign);
    assert_eq!(mouth.pool().statistics().free, mouth.config().buffers);
}

/// Its real-time frames are those of a station without a tunnel, each at its instant.
#[test]
fn a_tunnel_that_takes_what_real_stations_send_changes_nothing_of_what_a_station_sends() {
    let frames = captures::read("rtnet-real.pcap");
    let (tunnel, _mouth) = tunnel::new(Config::of(ADDRESS));
    let [with, without] =
        [Some(tunnel), None].map(|tunnel| replay_to(slave(frames[0].at, tunnel), &frames).bench.sent);
    assert!(with.len() > 200);
    assert_eq!(with, without);
}
