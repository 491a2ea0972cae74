//! One address for real-time sockets and for Linux: each has what is its own, and Linux never takes a real-time turn.

use std::cell::RefCell;
use std::net::Ipv4Addr;
use std::rc::Rc;

use rtmac::tdma::Tdma;
use rtnet::clock::True;
use rtnet::counters::Refusal;
use rtnet::queue::Priority;
use rtnet::sim::{Host, Network};
use rtnet::socket::{Flags, Options, SocketId};
use rtnet::station::Station;
use rtnet::wire::ethernet::{Address, EtherType, HEADER_LEN, Header, MIN_FRAME};
use rtnet::wire::ipv4::{self, Fields, Protocol};
use rtnet::wire::udp;
use tests::stacks::{
    SETTLES, address, assert_pools_full, at, bytes, cycles, in_slots, ip, network, slot, stack,
    udp as udp_socket,
};
use vnic::proxy::{self, PACKET};
use vnic::tunnel::{Config, Loss, Mouth};
use zerocopy::IntoBytes;

const TCP: Protocol = Protocol(6);
const WHOLE: (u16, bool) = (0, false);
/// Where each station's two slots begin in the cycle, microseconds.
const SLOTS: [[i64; 2]; 3] = [[100, 200], [300, 400], [500, 600]];

/// Three stations, the last two with a proxy of 8 buffers, all of which follow the master.
fn proxies() -> (Network<Tdma>, [Mouth; 2], SocketId) {
    let mut mouths = Vec::new();
    let mut socket = None;
    let mut station = |id: usize| {
        let mut stack = stack(id, Vec::new());
        if id == 1 {
            socket = Some(udp_socket(&mut stack, 2_000, 4));
        }
        let [first, second] = SLOTS[id];
        let discipline = in_slots(id, &[slot(0, first), slot(1, second)]);
        let services = match id {
            0 => Vec::new(),
            _ => {
                let (proxy, mouth) = proxy::new(Config { buffers: 8, ..Config::of(address(id)) });
                mouths.push(mouth);
                vec![Box::new(proxy) as Box<_>]
            }
        };
        Station::new(discipline, services).with_stack(stack)
    };
    let stations = (0..3).map(&mut station).collect();
    let mut network = network(stations, Host::IDEAL);
    cycles(&mut network, SETTLES);
    (network, mouths.try_into().ok().expect("two of them"), socket.expect("it has one"))
}

/// A packet from one station to another.
fn packet(
    (from, to): (usize, usize),
    protocol: Protocol,
    (offset, more_fragments): (u16, bool),
    content: &[u8],
) -> Vec<u8> {
    let header = ipv4::Header::new(&Fields {
        source: ip(from),
        destination: ip(to),
        protocol,
        tos: 0,
        identification: 9,
        dont_fragment: false,
        more_fragments,
        offset,
        payload_len: content.len() as u16,
    });
    [header.as_bytes(), content].concat()
}

fn framed(packet: &[u8], from: Address, to: Address) -> Vec<u8> {
    [Header::new(to, from, EtherType::IPV4).as_bytes(), packet].concat()
}

/// A datagram to a port, of so many bytes, of which these are there.
fn datagram(port: u16, whole: usize, there: &[u8]) -> Vec<u8> {
    [udp::Header::new(7, port, whole as u16).as_bytes(), there].concat()
}

/// What came for Linux.
fn came(mouth: &Mouth) -> Vec<Vec<u8>> {
    std::iter::from_fn(|| mouth.received()).map(|frame| frame.to_vec()).collect()
}

fn send(mouth: &Mouth, packet: &[u8]) -> Result<(), Loss> {
    let mut room = mouth.take_for_packet().expect("a buffer");
    room.room_mut()[PACKET..][..packet.len()].copy_from_slice(packet);
    mouth.send_plain(room, packet.len())
}

/// Of the packets on the medium: how long after the cycle's sync, and the bytes.
type Aired = Rc<RefCell<Vec<(True, Vec<u8>)>>>;

fn aired(network: &mut Network<Tdma>) -> Aired {
    let aired = Aired::default();
    let (notes, mut sync) = (aired.clone(), 0);
    network.observe(move |frame| {
        match Header::parse(frame.bytes).map(|(header, _)| (header.destination, header.ether_type())) {
            Some((Address::BROADCAST, EtherType::RTMAC)) => sync = frame.at,
            Some((_, EtherType::IPV4)) => notes.borrow_mut().push((frame.at - sync, frame.bytes.to_vec())),
            _ => {}
        }
    });
    cycles(network, 1);
    aired
}

/// Whether a frame was sent in the slot that begins then.
fn is_in(slot: i64, after_sync: True) -> bool {
    (after_sync as i64 - slot * 1_000).abs() < 5_000
}

#[test]
fn sockets_have_what_is_theirs_and_linux_the_rest_as_it_came() {
    let (mut network, [mouth, other], socket) = proxies();
    let (from, to) = (address(0), address(1));
    let mine = datagram(2_000, 20, &[1; 20]);
    let whole = datagram(2_000, 80, &[2; 80]);
    let real_time =
        [packet((0, 1), Protocol::UDP, WHOLE, &mine), packet((0, 1), Protocol::UDP, (0, true), &whole[..48])];
    let linux = [
        packet((0, 1), TCP, WHOLE, &bytes(20)),
        packet((0, 1), TCP, WHOLE, &bytes(1480)),
        packet((0, 1), Protocol::UDP, WHOLE, &datagram(2_001, 3, b"xyz")),
        // The first fragment says whose a datagram is, the others are orphans here.
        packet((0, 1), Protocol::UDP, (0, true), &datagram(2_001, 64, &[3; 24])),
        packet((0, 1), Protocol(1), WHOLE, &[3, 1, 0xfc, 0xfe, 0, 0, 0, 0]),
    ];
    for packet in real_time.iter().chain(&linux) {
        network.inject(&framed(packet, from, to));
        cycles(&mut network, 1);
    }
    // Of another datagram than the one that the socket waits for: one number less, and that much more in the sum.
    let mut orphan = packet((0, 1), Protocol::UDP, (32, false), &[4; 32]);
    (orphan[5], orphan[11]) = (orphan[5] - 1, orphan[11] + 1);
    network.inject(&framed(&orphan, from, to));
    network.inject(&framed(&packet((0, 1), Protocol::UDP, (48, false), &whole[48..]), from, to));
    cycles(&mut network, 1);

    let expected: Vec<_> = linux.iter().chain([&orphan]).map(|packet| framed(packet, from, to)).collect();
    assert_eq!(came(&mouth), expected);
    assert!(came(&other).is_empty());
    let station = &mut network.member_mut(1).station;
    assert_eq!(station.refusals().total(), 0, "all was somebody's");
    let (stack, _) = station.stack_mut().unwrap();
    let mut room = [0; 100];
    for len in [20, 80] {
        let received = stack.receive(socket, &mut room, Flags::NONE, &Default::default()).unwrap();
        assert_eq!(received.len, len);
    }
    assert_pools_full(stack, "station 1");
    assert_eq!((mouth.counts().received, mouth.counts().losses().count()), (6, 0));
}

#[test]
fn echoes_stay_with_the_station_and_answers_go_to_who_has_asked() {
    let (mut network, [one, two], _) = proxies();
    // Linux of station 1 asks station 2, whose stack answers.
    let mut echo = [&[8, 0, 0, 0, 0x12, 0x34, 0, 1][..], &bytes(40)].concat();
    let sum = rtnet::wire::checksum::checksum(&echo).to_be_bytes();
    echo[2..4].copy_from_slice(&sum);
    send(&one, &packet((1, 2), Protocol::ICMP, WHOLE, &echo)).unwrap();
    cycles(&mut network, 4);
    let answers = came(&one);
    assert_eq!(answers.len(), 1);
    let (header, message) = ipv4::parse(&answers[0][HEADER_LEN..]).unwrap();
    assert_eq!((header.source(), message[0], &message[4..]), (ip(2), 0, &echo[4..]));
    assert!(came(&two).is_empty());
    // The station itself asks, and its stack has the answer.
    let (stack, exit) = network.member_mut(1).station.stack_mut().unwrap();
    let options = Options { priority: Priority::LAST_REAL_TIME, channel: 1, tos: 0 };
    stack.ask_echo(ip(2), (7, 1), b"alphabet", options, exit).unwrap();
    cycles(&mut network, 4);
    let (stack, _) = network.member_mut(1).station.stack_mut().unwrap();
    assert!(stack.next_pong().is_some_and(|pong| pong.from == ip(2)));
    assert!(came(&one).is_empty() && came(&two).is_empty());
}

#[test]
fn what_linux_sends_leaves_plainly_in_slot_1_behind_all_that_is_real_time() {
    let (mut network, [one, two], socket) = proxies();
    let aired = aired(&mut network);
    let (stack, exit) = network.member_mut(1).station.stack_mut().unwrap();
    let options = Options { priority: Priority::LAST_REAL_TIME, channel: 1, tos: 0 };
    stack.set_options(socket, options).unwrap();
    for n in 0..2 {
        stack.send_to(socket, &[n; 9], Some(at(0, 9)), Flags::NONE, exit).unwrap();
    }
    let packets = [bytes(1), bytes(600), bytes(1_480)].map(|content| packet((1, 2), TCP, WHOLE, &content));
    packets.iter().for_each(|packet| send(&one, packet).unwrap());
    cycles(&mut network, 10);

    let mut frames: Vec<_> = packets.iter().map(|packet| framed(packet, address(1), address(2))).collect();
    assert_eq!(came(&two), frames);
    frames.iter_mut().for_each(|frame| frame.resize(frame.len().max(MIN_FRAME), 0));
    let aired = aired.borrow();
    assert!(aired.iter().all(|(after_sync, _)| is_in(SLOTS[1][1], *after_sync)), "{aired:?}");
    let of_linux: Vec<_> = aired.iter().skip(2).map(|(_, bytes)| bytes.clone()).collect();
    assert_eq!(of_linux, frames, "after the datagrams, in the next turns");
    assert_eq!((one.counts().sent, two.counts().received), (3, 3));
    assert_eq!(one.pool().statistics().free, 8);
}

#[test]
fn a_packet_without_a_route_is_counted_and_one_to_all_reaches_all() {
    let (mut network, [one, two], _) = proxies();
    send(&one, &packet((1, 77), TCP, WHOLE, &bytes(30))).unwrap();
    let to_all = packet((1, 254), Protocol::UDP, WHOLE, &datagram(5_000, 4, b"news"));
    assert_eq!(ip(254), Ipv4Addr::new(10, 0, 0, 255));
    send(&one, &to_all).unwrap();
    cycles(&mut network, 3);
    assert_eq!(came(&two), [framed(&to_all, address(1), Address::BROADCAST)]);
    assert_eq!(network.member(0).station.refusals().get(Refusal::NoSocket), 1, "who has no proxy refuses it");
    assert_eq!((one.counts().sent, one.counts().lost(Loss::NoStation)), (1, 1));
}

#[test]
fn a_flood_for_linux_takes_the_proxys_buffers_and_nobody_elses() {
    let (mut network, [mouth, _], socket) = proxies();
    for n in 0..40 {
        network.inject(&framed(&packet((0, 1), TCP, WHOLE, &[n; 40]), address(0), address(1)));
        if n % 10 == 0 {
            let mine = packet((0, 1), Protocol::UDP, WHOLE, &datagram(2_000, 3, b"own"));
            network.inject(&framed(&mine, address(0), address(1)));
            cycles(&mut network, 1);
        }
    }
    cycles(&mut network, 1);
    let counts = mouth.counts();
    assert_eq!((counts.received, counts.lost(Loss::NoBuffer), mouth.pool().statistics().free), (8, 32, 0));
    assert_eq!(network.member(1).station.refusals().total(), 0, "a loss is counted once, where it is");
    let (stack, _) = network.member_mut(1).station.stack_mut().unwrap();
    let mut room = [0; 9];
    for _ in 0..4 {
        stack.receive(socket, &mut room, Flags::NONE, &Default::default()).expect("all four");
    }
    assert_pools_full(stack, "station 1");
    assert_eq!(came(&mouth).len(), 8);
    assert_eq!(mouth.pool().statistics().free, 8);
}
