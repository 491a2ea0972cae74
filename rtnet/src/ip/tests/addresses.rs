//! Who is believed to have which address.

use super::*;
use crate::ip::route::{Hop, Network, NetworkRoute};
use crate::wire::arp::Packet;
use crate::wire::ethernet::{EtherType, HEADER_LEN as LINK_HEADER, Header};
use zerocopy::IntoBytes;

const C: Address = Address([2, 0, 0, 0, 0, 7]);
const IP_C: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 7);

/// Somebody's claim or question, from its own address.
fn frame(to: Address, packet: &Packet) -> Vec<u8> {
    let header = Header::new(to, packet.sender(), EtherType::ARP);
    [header.as_bytes(), packet.as_bytes(), &[0xa5; 18]].concat()
}

fn question(from: Address, ip: Ipv4Addr, about: Ipv4Addr) -> Vec<u8> {
    frame(Address::BROADCAST, &Packet::request(from, ip, about))
}

/// `from` says to `to` that it has `ip`.
fn answer(from: Address, ip: Ipv4Addr, to: Address, to_ip: Ipv4Addr) -> Vec<u8> {
    frame(to, &Packet::reply_to(&Packet::request(to, to_ip, ip), from))
}

fn known(end: &End) -> Vec<(Ipv4Addr, Address, Origin)> {
    end.stack.routes().hosts().iter().map(|host| (host.ip, host.address, host.origin)).collect()
}

#[test]
fn what_is_asked_for_by_hand_becomes_a_route_at_both_ends() {
    let (mut a, mut b) = (End::new(A, IP_A), End::new(B, IP_B));
    let (socket, to) = (a.socket(0, 4), b.socket(36_000, 4));
    assert_eq!(a.send(socket, b"", IP_B, 36_000), Err(SocketError::NoRoute(IP_B)));
    assert_eq!(a.sent().len(), 0, "nothing is asked by itself");
    a.stack.solicit(IP_B, &mut a.queue).unwrap();
    assert_eq!(a.queue.waiting[0].0[..6], [0xff; 6]);
    assert_eq!(cross(&mut a, &mut b), []);
    assert_eq!(cross(&mut b, &mut a), []);
    assert_eq!(known(&a), [(IP_B, B, Origin::Solicited)]);
    assert_eq!(known(&b), [(IP_A, A, Origin::Learned)]);
    a.send(socket, b"now it goes", IP_B, 36_000).unwrap();
    assert_eq!(cross(&mut a, &mut b), []);
    assert!(b.receive(to).is_some());
}

#[test]
fn who_was_not_asked_is_not_believed() {
    let (mut a, _) = (End::new(A, IP_A), ());
    for (heard, why) in [
        (answer(C, IP_B, A, IP_A), Refusal::ArpUnsolicited),
        (question(C, IP_C, IP_C), Refusal::ArpNotForUs),
        (question(C, IP_C, IP_B), Refusal::ArpNotForUs),
        (answer(C, IP_C, B, IP_B), Refusal::ArpNotForUs),
        (question(C, IP_A, IP_B), Refusal::ArpConflict),
        (question(C, IP_A, IP_A), Refusal::ArpConflict),
        (question(Address([3, 0, 0, 0, 0, 1]), IP_C, IP_A), Refusal::ForgedSource),
    ] {
        assert_eq!(a.hears(&heard), Err(why));
    }
    assert_eq!((known(&a), a.sent().len()), (Vec::new(), 0));
    assert_eq!(a.stack.counters().arp_conflicts, 2, "two claimed our own address");
}

#[test]
fn a_forger_changes_no_route() {
    let (mut a, _) = pair();
    let heard = answer(C, IP_B, A, IP_A);
    assert_eq!(a.hears(&heard), Err(Refusal::ArpConflict), "unasked");
    assert_eq!(a.hears(&question(C, IP_B, IP_B)), Err(Refusal::ArpConflict), "gratuitous");
    assert_eq!(a.hears(&question(C, IP_B, IP_A)), Err(Refusal::ArpConflict), "what was said by hand stays");
    let mut by_another = question(C, IP_C, IP_A);
    by_another[6..12].copy_from_slice(&B.0);
    assert_eq!(a.hears(&by_another), Err(Refusal::ForgedSource), "sent by another than it says");
    assert_eq!(known(&a), [(IP_B, B, Origin::Static)]);
    assert_eq!(a.stack.counters().arp_conflicts, 3);
}

#[test]
fn a_station_with_a_new_interface_is_followed_when_it_asks() {
    let mut a = End::new(A, IP_A);
    a.hears(&question(B, IP_B, IP_A)).unwrap();
    a.hears(&question(C, IP_B, IP_A)).unwrap();
    assert_eq!(known(&a), [(IP_B, C, Origin::Learned)]);
    assert_eq!(a.stack.counters().arp_changed, 1);
    assert_eq!(a.sent().len(), 2, "both were answered");
}

#[test]
fn who_only_looks_whether_an_address_is_free_is_answered_and_not_learned() {
    let mut a = End::new(A, IP_A);
    a.hears(&question(C, Ipv4Addr::UNSPECIFIED, IP_A)).unwrap();
    assert_eq!((known(&a), a.sent().len()), (Vec::new(), 1));
}

#[test]
fn an_answer_that_comes_much_later_or_twice_was_not_asked_for() {
    let mut a = End::new(A, IP_A);
    a.stack.solicit(IP_B, &mut a.queue).unwrap();
    a.hears(&answer(B, IP_B, A, IP_A)).unwrap();
    assert_eq!(a.hears(&answer(B, IP_B, A, IP_A)), Err(Refusal::ArpUnsolicited));
    a.stack.solicit(IP_C, &mut a.queue).unwrap();
    a.waits(10_000_000_000);
    assert_eq!(a.hears(&answer(C, IP_C, A, IP_A)), Err(Refusal::ArpUnsolicited));
    assert_eq!(known(&a), [(IP_B, B, Origin::Solicited)]);
}

#[test]
fn a_full_table_answers_and_says_that_it_cannot_learn() {
    let interface = Interface { address: A, ip: IP_A, prefix: 24 };
    let mut a = End::with(StackConfig { hosts: 1, ..StackConfig::new(interface) });
    a.hears(&question(B, IP_B, IP_A)).unwrap();
    assert_eq!(a.hears(&question(C, IP_C, IP_A)), Err(Refusal::RoutesFull));
    assert_eq!(a.sent().len(), 2);
    a.stack.routes_mut().delete(Network::host(IP_B)).unwrap();
    a.hears(&question(C, IP_C, IP_A)).unwrap();
}

#[test]
fn a_table_full_of_those_who_asked_makes_room_for_whom_somebody_names() {
    let interface = Interface { address: A, ip: IP_A, prefix: 24 };
    let mut a = End::with(StackConfig { hosts: 4, ..StackConfig::new(interface) });
    for last in 100..200 {
        let heard = question(C, Ipv4Addr::new(10, 0, 0, last), IP_A);
        assert_eq!(a.hears(&heard), if last < 104 { Ok(()) } else { Err(Refusal::RoutesFull) });
        a.sent();
    }
    a.knows(IP_B, B);
    a.stack.solicit(IP_C, &mut a.queue).unwrap();
    a.hears(&answer(C, IP_C, A, IP_A)).unwrap();
    let named: Vec<_> = known(&a).into_iter().filter(|(.., origin)| *origin != Origin::Learned).collect();
    assert_eq!(named, [(IP_B, B, Origin::Static), (IP_C, C, Origin::Solicited)]);
    assert_eq!(known(&a).len(), 4);
    assert_eq!(a.hears(&question(C, Ipv4Addr::new(10, 0, 0, 99), IP_A)), Err(Refusal::RoutesFull));
}

#[test]
fn who_asks_takes_nobody_out_of_a_network_whose_gateway_was_said_by_hand() {
    let (mut a, _) = pair();
    for text in ["10.9.0.0/16", "10.0.0.128/25", "10.0.0.0/8"] {
        let network = text.parse().unwrap();
        a.stack.routes_mut().add_network(NetworkRoute { network, gateway: IP_B }).unwrap();
    }
    for behind in [[10, 9, 0, 1], [10, 0, 0, 200], [10, 7, 7, 7]].map(Ipv4Addr::from) {
        assert_eq!(a.hears(&question(C, behind, IP_A)), Err(Refusal::ArpConflict), "{behind}");
        assert_eq!(a.stack.routes().lookup(behind), Some(Hop::Medium(B)), "{behind}");
    }
    a.hears(&question(C, IP_C, IP_A)).unwrap();
    assert_eq!(
        known(&a),
        [(IP_B, B, Origin::Static), (IP_C, C, Origin::Learned)],
        "a neighbour is none of them"
    );
    assert_eq!((a.stack.counters().arp_conflicts, a.sent().len()), (3, 4), "all were answered");
    let other = "172.16.0.1".parse().unwrap();
    a.hears(&question(C, other, IP_A)).unwrap();
    assert_eq!(a.stack.routes().lookup(other), Some(Hop::Medium(C)), "of whose network nothing was said");
}

#[test]
fn a_storm_of_questions_takes_its_own_buffers_only() {
    let mut a = End::new(A, IP_A);
    a.knows(IP_C, C);
    let socket = a.socket(0, 1);
    let heard = question(B, IP_B, IP_A);
    let refused = (0..1_000).filter(|_| a.hears(&heard) == Err(Refusal::PoolEmpty)).count();
    assert_eq!(refused, 1_000 - 16);
    a.send(socket, b"", IP_C, 1).unwrap();
    assert_eq!(a.sent().len(), 17);
}

#[test]
fn packets_for_others_or_from_nobody_are_refused() {
    let (mut a, mut b) = pair();
    let (from, _) = (a.socket(0, 4), b.socket(36_000, 4));
    a.send(from, b"x", IP_B, 36_000).unwrap();
    let frame = a.sent().remove(0);
    // Address, its place in the frame, the reason.
    for (ip, at, why) in [
        (IP_C, 16, Refusal::ForeignAddress),
        (Ipv4Addr::new(224, 0, 0, 1), 16, Refusal::ForeignAddress),
        (IP_B, 12, Refusal::ForgedSource),
        (Ipv4Addr::new(10, 0, 0, 255), 12, Refusal::ForgedSource),
        (Ipv4Addr::BROADCAST, 12, Refusal::ForgedSource),
        (Ipv4Addr::UNSPECIFIED, 12, Refusal::ForgedSource),
        (Ipv4Addr::LOCALHOST, 12, Refusal::ForgedSource),
        (Ipv4Addr::new(224, 0, 0, 1), 12, Refusal::ForgedSource),
    ] {
        let mut changed = frame.clone();
        changed[LINK_HEADER + at..][..4].copy_from_slice(&ip.octets());
        changed[LINK_HEADER + 10..][..2].fill(0);
        let sum = crate::wire::checksum::checksum(&changed[LINK_HEADER..][..20]);
        changed[LINK_HEADER + 10..][..2].copy_from_slice(&sum.to_be_bytes());
        assert_eq!(b.hears(&changed), Err(why), "{ip} at {at}");
    }
    assert_eq!(b.hears(&frame), Ok(()));
}
