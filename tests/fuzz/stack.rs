//! A stack between a hostile medium and programs that do whatever comes to their mind.

use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;

use pnet_packet::Packet;
use pnet_packet::arp::ArpPacket;
use pnet_packet::ethernet::EthernetPacket;
use pnet_packet::ipv4::Ipv4Packet;
use pnet_packet::udp::{self as their_udp, UdpPacket};
use rtnet::buf::Pool;
use rtnet::counters::Refusal;
use rtnet::ip::route::{HostRoute, NetworkRoute, Origin};
use rtnet::socket::{Flags, LinkMode, LinkType, Options, Socket, SocketId};
use rtnet::time::Span;
use rtnet::wire::ethernet::EtherType;
use tests::ends::{A, B, C, End};

use super::engine::{Target, fuzz, in_turn, outcome};
use super::frames;
use super::steps::{self, Step};

const OWN_TYPE: EtherType = EtherType(0x88b6);
const BEHIND: Ipv4Addr = Ipv4Addr::new(10, 9, 0, 1);
const SLOTS: [usize; 4] = [1500, 576, 96, 27];

#[test]
fn stack_takes_any_frames_and_calls() {
    fuzz(&Target { name: "stack", seeds: seeds(), has_corpus: true, mutate: steps::change, run });
}

struct Victim {
    end: End,
    sockets: [SocketId; 5],
    /// Whom it has asked for by hand.
    asked: Vec<Ipv4Addr>,
    outcomes: Vec<u64>,
}

fn run(input: &[u8]) -> Vec<u64> {
    let mut victim = Victim::new();
    for step in steps::read(input) {
        victim.step(&step);
        victim.end.check_buffers();
    }
    victim.end.check_all_comes_home();
    in_turn(&victim.outcomes)
}

impl Victim {
    fn new() -> Self {
        let mut end = End::new(A);
        end.queue.room = 32;
        end.knows(B);
        let network = NetworkRoute { network: "10.9.0.0/16".parse().expect("a network"), gateway: B.1 };
        end.stack.routes_mut().add_network(network).expect("room");
        let udp = [end.socket(36_000, 16), end.socket(37_000, 8), end.socket(5_000, 4)];
        end.stack.connect(udp[2], Some(SocketAddrV4::new(B.1, 36_000))).expect("a peer");
        let mut packet = |mode, link_type| {
            end.open(Socket::packet(mode, link_type, Arc::new(Pool::with_room(4, 64)))).expect("room")
        };
        let tap = packet(LinkMode::Raw, LinkType::All);
        let own = packet(LinkMode::Datagram, LinkType::Only(OWN_TYPE));
        Self { end, sockets: [udp[0], udp[1], udp[2], tap, own], asked: Vec::new(), outcomes: Vec::new() }
    }

    fn step(&mut self, Step { kind, argument, bytes }: &Step) {
        let (kind, n) = (kind % 14, usize::from(*argument));
        let socket = self.sockets[n % 5];
        let end = &mut self.end;
        let came_of_it = match kind {
            0..5 => self.hear(bytes),
            5 => {
                let ip = [B.1, A.1, Ipv4Addr::BROADCAST, C.1, BEHIND, Ipv4Addr::LOCALHOST][n / 5 % 6];
                let to = (n < 200).then_some(SocketAddrV4::new(ip, [36_000, 37_000][n / 30 % 2]));
                end.send(socket, &bytes.repeat(1 + n / 64), to)
                    .map_or_else(|error| error.errno() as u64, |()| 0)
            }
            6 => {
                let flags = if n > 127 { Flags::PEEK } else { Flags::NONE };
                end.receive(socket, bytes.len(), flags)
                    .map_or(1, |(received, _)| u64::from(received.is_truncated()))
            }
            7 => end.leaves(n).len() as u64,
            8 => {
                end.waits(Span::from_micros((n * n * 100) as i64));
                0
            }
            9 => {
                let ip = [C.1, B.1, BEHIND][n % 3];
                self.asked.push(ip);
                end.stack.solicit(ip, &mut end.queue).map_or_else(|error| error.errno() as u64, |()| 0)
            }
            10 => {
                let (to, which) = ([B.1, A.1, C.1][n % 3], (7, n as u16));
                let asked = end.stack.ask_echo(to, which, bytes, Options::default(), &mut end.queue);
                asked.map_or_else(|error| error.errno() as u64, |()| 0)
            }
            11 => {
                end.queue.limit = SLOTS[n % SLOTS.len()];
                0
            }
            12 => {
                let to = (n > 127).then_some((B.0, OWN_TYPE));
                end.send_frame(socket, bytes, to).map_or_else(|error| error.errno() as u64, |()| 0)
            }
            _ => {
                let (_, socket) = end.stack.sockets().nth(n % 5).expect("all stay open");
                let pool = socket.pool();
                let changed = if n > 127 { pool.extend(n % 8) } else { pool.shrink(n % 8) };
                changed as u64
            }
        };
        self.outcomes.push(outcome([kind.into(), came_of_it]));
        while self.end.stack.next_pong().is_some() {}
    }

    fn hear(&mut self, frame: &[u8]) -> u64 {
        let end = &mut self.end;
        let hosts = end.stack.routes().hosts().to_vec();
        let (waited, delivered) = (end.queue.waiting.len(), delivered(end));
        let result = end.hears(frame);
        let came = self::delivered(&self.end) - delivered;
        assert!(came <= u64::from(result.is_ok()), "what is refused is not delivered, {result:?}");
        self.check_answers(frame, waited);
        self.check_routes(&hosts, frame);
        if result.is_ok() {
            check_sound(frame);
        }
        result.map_or_else(|reason| 2 + reason as u64, |()| came)
    }

    /// No answer is longer than its question, beside the headers.
    fn check_answers(&self, frame: &[u8], waited: usize) {
        let answers = self.end.queue.waiting.iter().skip(waited);
        let content: usize = answers.clone().map(|(answer, _)| answer.len().saturating_sub(60)).sum();
        assert!(content <= frame.len() && answers.count() <= 1 + frame.len() / 8);
    }

    /// A route comes of what was addressed to this station alone, and by who it says.
    fn check_routes(&mut self, before: &[HostRoute], frame: &[u8]) {
        let after = self.end.stack.routes().hosts();
        assert!(before.iter().all(|route| after.iter().any(|there| there.ip == route.ip)), "one is gone");
        let changed: Vec<_> = after.iter().filter(|route| !before.contains(route)).collect();
        let [route] = changed[..] else {
            assert!(changed.is_empty(), "{changed:?}");
            return;
        };
        let there = before.iter().find(|there| there.ip == route.ip);
        let ethernet = EthernetPacket::new(frame).expect("a whole frame");
        assert_eq!(ethernet.get_ethertype().0, EtherType::ARP.0);
        let arp = ArpPacket::new(ethernet.payload()).expect("a whole packet");
        assert_eq!((arp.get_target_proto_addr(), arp.get_sender_proto_addr()), (A.1, route.ip));
        assert_eq!(arp.get_sender_hw_addr(), ethernet.get_source());
        assert_eq!(arp.get_sender_hw_addr().octets(), route.address.0);
        assert!(!route.address.is_group() && route.ip != A.1 && !route.ip.is_broadcast());
        match arp.get_operation().0 {
            1 => {
                assert_eq!(route.origin, Origin::Learned);
                assert!(there.is_none_or(|there| there.origin != Origin::Static), "said by hand");
                assert!(route.ip.octets()[..2] != [10, 9], "a network's whose gateway was said by hand");
            }
            _ => assert!(self.asked.contains(&route.ip) && route.origin == Origin::Solicited),
        }
    }
}

/// Datagrams that have come for UDP sockets.
fn delivered(end: &End) -> u64 {
    let of_udp = end.stack.sockets().filter(|(id, _)| end.stack.local_address(*id).is_ok());
    of_udp.map(|(_, socket)| socket.counters().received).sum()
}

/// What is accepted of UDP is right, in somebody else's opinion.
fn check_sound(frame: &[u8]) {
    let ethernet = EthernetPacket::new(frame).expect("a whole frame");
    if ethernet.get_ethertype().0 != EtherType::IPV4.0 {
        return;
    }
    let packet = Ipv4Packet::new(ethernet.payload()).expect("a whole packet");
    assert!(packet.get_ttl() > 0 && packet.get_source() != A.1);
    let own = [A.1, Ipv4Addr::new(10, 0, 0, 255), Ipv4Addr::BROADCAST];
    assert!(own.contains(&packet.get_destination()), "{}", packet.get_destination());
    let is_whole = packet.get_fragment_offset() == 0 && packet.get_flags() & 1 == 0;
    if packet.get_next_level_protocol().0 != 17 || !is_whole {
        return;
    }
    let begin = usize::from(packet.get_header_length()) * 4;
    let payload = &packet.packet()[begin..usize::from(packet.get_total_length())];
    let len = usize::from(UdpPacket::new(payload).expect("a whole header").get_length());
    let datagram = UdpPacket::new(&payload[..len]).expect("as long as it says");
    assert!([36_000, 37_000, 5_000].contains(&datagram.get_destination()));
    let sum = their_udp::ipv4_checksum(&datagram, &packet.get_source(), &packet.get_destination());
    let is_sum = datagram.get_checksum() == sum || sum == 0 && datagram.get_checksum() == 0xffff;
    assert!(datagram.get_checksum() == 0 || is_sum, "{:04x} for {sum:04x}", datagram.get_checksum());
}

/// What another station would send, and what programs would do.
fn seeds() -> Vec<Vec<u8>> {
    let frame = |bytes: Vec<u8>| Step { kind: 0, argument: 0, bytes };
    let call = |kind, argument, len| Step { kind, argument, bytes: (0..len).map(|n: u16| n as u8).collect() };
    let mut b = End::new(B);
    b.knows(A);
    let socket = b.socket(36_000, 64);
    let mut heard = |act: &dyn Fn(&mut End)| {
        act(&mut b);
        b.leaves(usize::MAX).into_iter().map(frame).collect::<Vec<_>>()
    };
    let datagram = |len: usize, port| {
        move |b: &mut End| b.send(socket, &vec![7; len], Some(SocketAddrV4::new(A.1, port))).expect("room")
    };
    let small = [heard(&datagram(16, 36_000)), heard(&datagram(40, 5_000))].concat();
    let large = heard(&datagram(5_000, 37_000));
    let ping = heard(&|b| {
        b.stack.ask_echo(A.1, (7, 1), &[1; 56], Options::default(), &mut b.queue).expect("room");
    });
    let arp = heard(&|b| b.stack.solicit(A.1, &mut b.queue).expect("room"));
    let far = heard(&|b| {
        let mut behind = End::new((B.0, BEHIND));
        behind.stack.solicit(A.1, &mut behind.queue).expect("room");
        b.queue.waiting.append(&mut behind.queue.waiting);
    });
    let read = || vec![call(6, 0, 100), call(6, 1, 9_000)];
    let sends = [0, 5, 10, 15, 20, 25, 30, 210].map(|argument| call(5, argument, 300)).to_vec();
    let asks = vec![call(9, 0, 0), call(10, 0, 56), call(10, 1, 56), call(12, 4 + 125, 80), call(7, 255, 0)];
    let mut all = vec![
        [small, read()].concat(),
        [large.clone(), read()].concat(),
        [ping, arp.clone(), asks, arp, far].concat(),
        [sends, read(), vec![call(11, 2, 0), call(5, 0, 1_000), call(7, 9, 0), call(13, 200, 0)]].concat(),
        [large[..2].to_vec(), vec![call(8, 200, 0)], large].concat(),
    ];
    let heard: Vec<Step> = frames::all().into_iter().map(frame).collect();
    all.extend(heard.chunks(12).map(<[Step]>::to_vec));
    all.iter().map(|steps| steps::write(steps)).collect()
}

#[test]
fn the_seeds_of_the_stack_come_to_something() {
    let mut victim = Victim::new();
    let mut came = 0;
    for step in seeds().iter().take(3).flat_map(|seed| steps::read(seed)) {
        if step.kind == 0 {
            assert_ne!(victim.hear(&step.bytes), 2 + Refusal::IpChecksum as u64);
            came += 1;
        }
    }
    assert!(came >= 9 && delivered(&victim.end) == 3, "{came}");
    assert_eq!(victim.end.stack.counters().echoes_answered, 1);
}
