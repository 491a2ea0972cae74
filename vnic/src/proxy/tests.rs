use core::net::Ipv4Addr;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use rtnet::buf::Pool;
use rtnet::discipline::SendError;
use rtnet::ip::route::{HostRoute, Interface, Network, NetworkRoute, Origin};
use rtnet::time::GlobalTime;
use rtnet::wire::ipv4::{Fields, Protocol};

use super::*;
use crate::tunnel::LOOKED_AT;

const STATION: Address = Address([2, 0, 0, 0, 0, 3]);
const OTHER: Address = Address([2, 0, 0, 0, 0, 1]);
const GATEWAY: Address = Address([2, 0, 0, 0, 0, 9]);
const OWN_IP: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 3);
const OTHER_IP: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 1);

fn small(buffers: usize) -> (Proxy, Mouth) {
    new(Config { buffers, ..Config::of(STATION) })
}

/// One host, and a network behind another.
fn routes() -> Routes {
    let mut routes = Routes::new(Interface { address: STATION, ip: OWN_IP, prefix: 24 }, 8, 8);
    let gateway = Ipv4Addr::new(10, 0, 0, 9);
    for (ip, address) in [(OTHER_IP, OTHER), (gateway, GATEWAY)] {
        routes.add_host(HostRoute { ip, address, origin: Origin::Static }).unwrap();
    }
    let network = Network::new(Ipv4Addr::new(10, 9, 0, 0), 16);
    routes.add_network(NetworkRoute { network, gateway }).unwrap();
    routes
}

/// A turn of slot 1, whose size this is.
fn turn(size: usize) -> Opportunity {
    let (begin, scheduled) = (Instant::default(), GlobalTime::default());
    Opportunity { channel: 1, cycle: 7, begin, scheduled, non_rt: Some(size) }
}

/// A segment of TCP's, by its look.
fn packet(to: Ipv4Addr, payload: &[u8]) -> Vec<u8> {
    let header = ipv4::Header::new(&Fields {
        source: OWN_IP,
        destination: to,
        protocol: Protocol(6),
        tos: 0,
        identification: 1,
        dont_fragment: true,
        more_fragments: false,
        offset: 0,
        payload_len: payload.len() as u16,
    });
    [header.as_bytes(), payload].concat()
}

/// Sends a packet as the device has read it.
fn send(mouth: &Mouth, bytes: &[u8]) -> Result<(), Loss> {
    let mut room = mouth.take_for_packet().expect("a buffer");
    room.room_mut()[PACKET..][..bytes.len()].copy_from_slice(bytes);
    mouth.send_plain(room, bytes.len())
}

/// What leaves in a turn.
fn filled(proxy: &mut Proxy, slot: &Opportunity, routes: &Routes) -> Vec<Vec<u8>> {
    let mut left = Vec::new();
    proxy.poll(slot, &mut |_, _, _| panic!("it is not real-time"));
    proxy.fill(slot, Some(routes), &mut |frame, priority, channel| {
        assert_eq!((priority, channel), (Priority::NON_RT, 1));
        let (got, limit) = (frame.len() - HEADER_LEN, slot.non_rt.unwrap());
        if got > limit {
            return Err((SendError::TooLong { channel, got, limit }, frame));
        }
        left.push(frame.to_vec());
        Ok(())
    });
    left
}

#[test]
fn a_packet_leaves_plainly_to_the_station_that_the_routes_name() {
    let (mut proxy, mouth) = small(4);
    for (to, station) in [
        ([10, 0, 0, 1], OTHER),
        ([10, 9, 1, 2], GATEWAY),
        ([10, 0, 0, 255], Address::BROADCAST),
        ([255, 255, 255, 255], Address::BROADCAST),
    ] {
        let packet = packet(to.into(), &[7; 80]);
        send(&mouth, &packet).unwrap();
        let head = [&station.0[..], &STATION.0, &[8, 0]].concat();
        assert_eq!(filled(&mut proxy, &turn(1500), &routes()), [[head, packet].concat()]);
    }
    assert_eq!((mouth.counts().sent, mouth.pool().statistics().free), (4, 4));
}

#[test]
fn a_short_packet_is_padded_and_one_without_a_route_or_that_is_no_ipv4_is_counted() {
    let (mut proxy, mouth) = small(8);
    for to in [[10, 0, 0, 77], [10, 0, 0, 3], [127, 0, 0, 1], [224, 0, 0, 22]] {
        send(&mouth, &packet(to.into(), &[1])).unwrap();
    }
    send(&mouth, &packet(OTHER_IP, &[2])).unwrap();
    let left = filled(&mut proxy, &turn(1500), &routes());
    assert_eq!(
        (left.len(), left[0].len(), left[0][34]),
        (1, 60, 2),
        "the same turn has the one that leads to somebody"
    );
    let ipv6 = [0x60; 40];
    assert_eq!(send(&mouth, &ipv6), Err(Loss::NotIp));
    assert_eq!(send(&mouth, &[]), Err(Loss::NotIp));
    let losses: Vec<_> = mouth.counts().losses().collect();
    assert_eq!(losses, [(Loss::NotIp, 2), (Loss::NoStation, 4)]);
    assert_eq!(mouth.pool().statistics().free, 8);
}

#[test]
fn a_station_without_sockets_knows_no_way() {
    let (mut proxy, mouth) = small(2);
    send(&mouth, &packet(OTHER_IP, &[0; 40])).unwrap();
    proxy.fill(&turn(1500), None, &mut |_, _, _| panic!("to whom?"));
    assert_eq!(mouth.counts().lost(Loss::NoStation), 1);
}

#[test]
fn one_packet_leaves_in_a_turn_of_its_slot_and_a_crowd_without_a_way_takes_no_more_time_than_some() {
    let (mut proxy, mouth) = small(4 * LOOKED_AT);
    (0..LOOKED_AT + 1).for_each(|_| send(&mouth, &packet([10, 0, 0, 77].into(), &[])).unwrap());
    (0..3).for_each(|n| send(&mouth, &packet(OTHER_IP, &[n])).unwrap());
    assert!(filled(&mut proxy, &Opportunity { non_rt: None, ..turn(1500) }, &routes()).is_empty());
    assert!(filled(&mut proxy, &turn(1500), &routes()).is_empty());
    assert_eq!(mouth.counts().lost(Loss::NoStation), LOOKED_AT as u64);
    for n in 0..3 {
        let left = filled(&mut proxy, &turn(1500), &routes());
        assert_eq!((left.len(), left[0][34]), (1, n));
    }
    assert_eq!((mouth.counts().sent, mouth.counts().lost(Loss::NoStation)), (3, 1 + LOOKED_AT as u64));
}

#[test]
fn the_mtu_is_what_the_slot_takes_and_what_waited_while_it_shrank_is_counted() {
    let (mut proxy, mouth) = small(4);
    assert_eq!((mouth.mtu(), mouth.most()), (1500, 1500));
    for size in [500, 1500, 104] {
        assert!(filled(&mut proxy, &turn(size), &routes()).is_empty());
        assert_eq!(mouth.mtu(), size);
        send(&mouth, &packet(OTHER_IP, &vec![0; size - 20])).unwrap();
        assert_eq!(filled(&mut proxy, &turn(size), &routes())[0].len(), HEADER_LEN + size);
    }
    assert_eq!(send(&mouth, &packet(OTHER_IP, &[0; 85])), Err(Loss::TooLong));
    send(&mouth, &packet(OTHER_IP, &[0; 80])).unwrap();
    assert!(filled(&mut proxy, &turn(60), &routes()).is_empty());
    assert_eq!((mouth.counts().lost(Loss::TooLong), mouth.pool().statistics().free), (2, 4));
}

#[test]
fn a_packet_that_missed_its_turn_is_counted_as_put_off_and_a_real_time_one_is_not() {
    let (mut proxy, mouth) = small(2);
    send(&mouth, &packet(OTHER_IP, &[0; 40])).unwrap();
    let wire = filled(&mut proxy, &turn(1500), &routes()).remove(0);
    assert!(
        proxy.still_wanted(&wire, Priority::NON_RT) && proxy.still_wanted(&wire, Priority::LAST_REAL_TIME)
    );
    assert_eq!((mouth.counts().sent, mouth.counts().put_off), (1, 1));
}

#[test]
fn what_comes_costs_an_own_buffer_and_without_one_it_is_lost_and_counted_here() {
    let (mut proxy, mouth) = small(2);
    let received = Pool::new(3);
    for n in 0..3 {
        let mut frame = received.take().unwrap();
        frame.fill(&[n; 40]);
        assert!(proxy.on_unwanted(frame).is_ok());
    }
    assert_eq!(received.statistics().free, 3, "each was paid for, or came back");
    let counts = mouth.counts();
    assert_eq!((counts.received, counts.lost(Loss::NoBuffer)), (2, 1));
    assert_eq!([0, 1].map(|_| mouth.received().unwrap()[0]), [0, 1], "in their order");
    assert!(mouth.received().is_none());
    assert_eq!(mouth.pool().statistics().free, 2);
}

#[test]
fn what_waits_to_leave_leaves_half_of_the_buffers_to_what_comes() {
    let (mut proxy, mouth) = small(4);
    (0..3).for_each(|_| send(&mouth, &packet(OTHER_IP, &[])).unwrap());
    assert!(mouth.take_for_packet().is_none() && !mouth.wait_for_buffers());
    assert!(proxy.on_unwanted(Pool::new(1).take().unwrap()).is_ok());
    assert_eq!(mouth.counts().received, 1);
    filled(&mut proxy, &turn(1500), &routes());
    assert!(mouth.take_for_packet().is_some() && mouth.wait_for_buffers());
}

#[test]
fn who_waits_for_what_comes_is_rung_once_for_all_of_it_behind_the_slot() {
    let rung = Arc::new(AtomicUsize::new(0));
    let by = rung.clone();
    let (proxy, mouth) = small(8);
    let mut proxy = proxy.ringing(Box::new(move || {
        by.fetch_add(1, Ordering::Relaxed);
    }));
    let received = Pool::new(1);
    let arrive = |proxy: &mut Proxy| assert!(proxy.on_unwanted(received.take().unwrap()).is_ok());
    assert!(!mouth.sleeps(true), "nothing has come");
    (0..2).for_each(|_| arrive(&mut proxy));
    assert_eq!(rung.load(Ordering::Relaxed), 0, "the slot is first");
    (0..2).for_each(|_| proxy.rest());
    assert_eq!(rung.load(Ordering::Relaxed), 1);
    assert!(mouth.sleeps(true), "it had better not: something has come");
    mouth.sleeps(false);
    arrive(&mut proxy);
    proxy.rest();
    assert_eq!(rung.load(Ordering::Relaxed), 1, "it is awake");
}
