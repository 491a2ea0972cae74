//! Datagrams in fragments: sent in ascending order, taken in no other.

use super::*;
use crate::ip::collect::{CollectorCounters, PER_SOCKET, PER_SOURCE};
use crate::wire::ethernet::{EtherType, HEADER_LEN as LINK_HEADER, Header as LinkHeader};
use crate::wire::ipv4::{self, Fields, Header, Protocol};
use zerocopy::IntoBytes;

/// The frames of a datagram of `len` bytes from A to port 37 000 of B, in slots of `limit` bytes.
fn frames(len: usize, limit: usize) -> Vec<Vec<u8>> {
    let (mut a, _) = pair();
    a.queue.limit = limit;
    let socket = a.socket(0, 600);
    a.send(socket, &bytes(len), IP_B, 37_000).unwrap();
    a.sent()
}

/// A station with a socket that has so many buffers.
fn receiver(buffers: usize) -> (End, SocketId) {
    let (_, mut b) = pair();
    let socket = b.socket(37_000, buffers);
    (b, socket)
}

fn ip_header(frame: &[u8]) -> &Header {
    ipv4::parse(&frame[LINK_HEADER..]).unwrap().0
}

/// The first fragment of some datagram, 8 bytes of it, from `source` with this identification.
fn beginning(source: Ipv4Addr, identification: u16, port: u16) -> Vec<u8> {
    let head = crate::wire::udp::Header::new(9, port, 100);
    let fields = Fields {
        source,
        destination: IP_B,
        protocol: Protocol::UDP,
        tos: 0,
        identification,
        dont_fragment: false,
        more_fragments: true,
        offset: 0,
        payload_len: 8,
    };
    let link = LinkHeader::new(B, A, EtherType::IPV4);
    let mut frame = [link.as_bytes(), Header::new(&fields).as_bytes(), head.as_bytes()].concat();
    frame.resize(60, 0);
    frame
}

#[test]
fn a_datagram_arrives_whole_in_as_few_fragments_as_slots_allow() {
    for (len, limit) in [(0, 1500), (1472, 1500), (1473, 1500), (200, 128), (65_507, 1500), (4_096, 96)] {
        let sent = frames(len, limit);
        let each = (limit - 20) & !7;
        let expected = if len + 8 <= limit - 20 { 1 } else { (len + 8).div_ceil(each) };
        assert_eq!(sent.len(), expected, "{len} bytes in slots of {limit}");
        assert!(sent.iter().all(|frame| frame.len() <= limit + LINK_HEADER || frame.len() == 60));
        let (mut b, socket) = receiver(64);
        sent.iter().for_each(|frame| b.hears(frame).unwrap());
        let (received, data) = b.receive(socket).expect("it is complete");
        assert_eq!((received.whole, data), (len, bytes(len)), "{len} bytes in slots of {limit}");
        assert_eq!(
            received.rx,
            Some(Instant::from_nanos(1_000 * (1 + sent.len() as u64))),
            "of the last frame"
        );
        let pool = b.stack.sockets().next().unwrap().1.pool().statistics();
        assert_eq!((pool.free, pool.capacity), (64, 64), "and all buffers are home");
    }
}

#[test]
fn only_whole_datagrams_forbid_to_fragment_them() {
    for (sent, flags) in [(frames(100, 1500), 0x40), (frames(3000, 1500), 0x20)] {
        assert_eq!(sent[0][LINK_HEADER + 6] & 0xe0, flags);
    }
    let offsets: Vec<_> = frames(3000, 1500).iter().map(|frame| ip_header(frame).offset()).collect();
    assert_eq!(offsets, [0, 1480, 2960]);
}

#[test]
fn a_slot_too_small_for_any_fragment_is_refused_before_anything_left() {
    let (mut a, _) = pair();
    let socket = a.socket(0, 16);
    a.queue.limit = 27;
    let refused = a.send(socket, &bytes(100), IP_B, 1).unwrap_err();
    assert_eq!((refused.errno(), a.sent().len()), (libc::EMSGSIZE, 0));
}

#[test]
fn a_datagram_for_which_buffers_are_missing_does_not_leave_in_part() {
    let (mut a, _) = pair();
    let socket = a.socket(0, 4);
    let refused = a.send(socket, &bytes(7_000), IP_B, 1).unwrap_err();
    assert_eq!(refused, SocketError::NeverFits { needed: 5, capacity: 4, most: 5_912 });
    assert_eq!((refused.errno(), a.sent().len()), (libc::EMSGSIZE, 0));
    a.send(socket, &bytes(100), IP_B, 1).unwrap();
    let refused = a.send(socket, &bytes(5_000), IP_B, 1).unwrap_err();
    assert_eq!(refused, SocketError::NoBuffers { needed: 4, free: 3, capacity: 4 });
    assert_eq!((refused.errno(), a.sent().len()), (libc::ENOBUFS, 1));
    a.send(socket, &bytes(5_000), IP_B, 1).unwrap();
    assert_eq!(a.sent().len(), 4);
}

#[test]
fn the_longest_datagram_that_a_refusal_names_is_sent() {
    for (buffers, limit) in [(1, 1500), (4, 1500), (16, 1500), (7, 128), (3, 999)] {
        let (mut a, _) = pair();
        a.queue.limit = limit;
        let socket = a.socket(0, buffers);
        let most = match a.send(socket, &bytes(30_000), IP_B, 1).unwrap_err() {
            SocketError::NeverFits { most, .. } => most,
            other => panic!("{other}"),
        };
        assert!(matches!(a.send(socket, &bytes(most + 8), IP_B, 1), Err(SocketError::NeverFits { .. })));
        a.send(socket, &bytes(most), IP_B, 1).unwrap();
        assert_eq!(a.sent().len(), buffers, "{most} bytes in slots of {limit}");
    }
}

#[test]
fn fragments_in_any_other_order_end_the_datagram() {
    let sent = frames(5_000, 1500);
    for order in [&[0, 2, 1, 3][..], &[1, 0, 2, 3], &[0, 1, 3], &[0, 1, 1, 3], &[1], &[3]] {
        let (mut b, socket) = receiver(16);
        let refused: Vec<_> = order.iter().filter_map(|&n| b.hears(&sent[n]).err()).collect();
        let known = [Refusal::FragmentOrder, Refusal::FragmentOrphan, Refusal::FragmentRepeated];
        assert!(!refused.is_empty() && refused.iter().all(|reason| known.contains(reason)), "{refused:?}");
        assert!(b.receive(socket).is_none(), "{order:?}");
        sent.iter().for_each(|frame| b.hears(frame).unwrap());
        assert_eq!(b.receive(socket).unwrap().1, bytes(5_000), "the next is not disturbed by {order:?}");
    }
}

#[test]
fn a_fragment_that_comes_twice_changes_nothing() {
    let sent = frames(5_000, 1500);
    for order in [&[0, 0, 1, 2, 3][..], &[0, 1, 1, 2, 3], &[0, 1, 0, 2, 1, 2, 3], &[0, 1, 2, 2, 0, 3]] {
        let (mut b, socket) = receiver(4);
        let refused: Vec<_> = order.iter().filter_map(|&n| b.hears(&sent[n]).err()).collect();
        assert_eq!(refused, vec![Refusal::FragmentRepeated; order.len() - 4], "{order:?}");
        assert_eq!(b.receive(socket).unwrap().1, bytes(5_000), "{order:?}");
        assert_eq!(b.stack.counters().collectors, CollectorCounters::default());
    }
    // The last one: its datagram is complete.
    let (mut b, socket) = receiver(4);
    sent.iter().for_each(|frame| b.hears(frame).unwrap());
    assert_eq!(b.hears(&sent[3]), Err(Refusal::FragmentOrphan));
    assert_eq!(b.receive(socket).unwrap().1, bytes(5_000));
}

#[test]
fn another_datagram_of_the_same_number_begins_again() {
    let sent = frames(5_000, 1500);
    let mut others = sent.clone();
    for other in &mut others {
        *other.last_mut().unwrap() ^= 0xff;
    }
    let (mut b, socket) = receiver(16);
    for frame in [&others[0], &others[1], &sent[0], &sent[1], &sent[2], &sent[3]] {
        b.hears(frame).unwrap();
    }
    assert_eq!(b.receive(socket).unwrap().1, bytes(5_000));
    assert_eq!(b.stack.counters().collectors.given_up, 1);
    // Other bytes where some have come are not of this datagram: it is given up, and never mixed.
    b.hears(&sent[0]).unwrap();
    b.hears(&sent[1]).unwrap();
    assert_eq!(b.hears(&others[1]), Err(Refusal::FragmentOrder));
    assert_eq!(b.hears(&sent[2]), Err(Refusal::FragmentOrphan));
}

#[test]
fn a_lost_tail_is_waited_for_no_longer_than_the_time_out() {
    let sent = frames(5_000, 1500);
    let (mut b, _) = receiver(16);
    b.hears(&sent[0]).unwrap();
    b.hears(&sent[1]).unwrap();
    assert_eq!(b.stack.sockets().next().unwrap().1.pool().available(), 14);
    let late = b.now + 1_000_000_001;
    b.stack.poll(Instant::from_nanos(late), &mut b.queue);
    assert_eq!(b.stack.sockets().next().unwrap().1.pool().available(), 16);
    assert_eq!(b.stack.counters().collectors.timed_out, 1);
    assert_eq!(b.hears(&sent[2]), Err(Refusal::FragmentOrphan));
}

#[test]
fn a_sender_that_begins_many_datagrams_gives_up_its_own_oldest() {
    let (mut b, _) = receiver(64);
    let other = beginning(Ipv4Addr::new(10, 0, 0, 7), 1, 37_000);
    b.hears(&other).unwrap();
    for identification in 0..=u16::MAX {
        b.hears(&beginning(IP_A, identification, 37_000)).unwrap();
    }
    assert_eq!(b.stack.collectors.active(), 1 + PER_SOURCE);
    assert_eq!(b.stack.counters().collectors.given_up, 65_536 - PER_SOURCE as u64);
    let taken = 64 - b.stack.sockets().next().unwrap().1.pool().available();
    assert_eq!(taken, 1 + PER_SOURCE, "the other sender's is still waited for");
}

#[test]
fn a_storm_of_first_fragments_to_one_socket_takes_nothing_from_another() {
    let (mut b, stormed) = receiver(16);
    let calm = b.socket(38_000, 8);
    for n in 0..u16::MAX {
        let source = Ipv4Addr::new(10, 0, 0, 100 + (n % 50) as u8);
        let began = b.hears(&beginning(source, n, 37_000));
        assert!(began == Ok(()) || began == Err(Refusal::FragmentLimit), "{began:?}");
    }
    assert_eq!(b.stack.collectors.active(), PER_SOCKET);
    assert_eq!(b.stack.socket_counters(stormed).unwrap().dropped, 0, "its buffers were not what was missing");
    let (mut a, _) = pair();
    let socket = a.socket(0, 16);
    for _ in 0..10 {
        a.send(socket, &bytes(9_000), IP_B, 38_000).unwrap();
        assert_eq!(cross(&mut a, &mut b), []);
        assert_eq!(b.receive(calm).unwrap().1, bytes(9_000));
    }
    assert!(b.receive(stormed).is_none());
    b.stack.close(stormed).unwrap();
    assert_eq!(b.stack.collectors.active(), 0, "nothing is waited for that nobody wants");
}

#[test]
fn a_socket_without_a_buffer_for_a_fragment_loses_the_datagram_and_gets_all_back() {
    let (mut b, socket) = receiver(3);
    let refused: Vec<_> = frames(5_000, 1500).iter().filter_map(|frame| b.hears(frame).err()).collect();
    assert_eq!(refused, [Refusal::PoolEmpty]);
    assert_eq!(b.stack.sockets().next().unwrap().1.pool().available(), 3);
    assert_eq!(b.stack.counters().collectors.pool_empty, 1);
    assert_eq!(b.stack.socket_counters(socket).unwrap().dropped, 1, "as the socket's own loss, too");
    frames(3_000, 1500).iter().for_each(|frame| b.hears(frame).unwrap());
    assert_eq!(b.receive(socket).unwrap().1, bytes(3_000));
}

#[test]
fn a_wrong_checksum_of_a_fragmented_datagram_is_tolerated_and_counted_unless_told_otherwise() {
    let mut sent = frames(3_000, 1500);
    // Of the data: the IP headers stay right.
    sent[1][700] ^= 1;
    let (mut b, socket) = receiver(16);
    sent.iter().for_each(|frame| b.hears(frame).unwrap());
    assert_eq!(b.receive(socket).unwrap().0.len, 3_000);
    assert_eq!(b.stack.counters().checksums_tolerated, 1);

    let interface = Interface { address: B, ip: IP_B, prefix: 24 };
    let mut strict = End::with(StackConfig { fragment_checksums: true, ..StackConfig::new(interface) });
    let socket = strict.socket(37_000, 16);
    let refused: Vec<_> = sent.iter().filter_map(|frame| strict.hears(frame).err()).collect();
    assert_eq!(refused, [Refusal::UdpChecksum]);
    assert!(strict.receive(socket).is_none());
}

#[test]
fn a_datagram_whose_fragments_are_not_as_long_as_it_says_is_refused() {
    let (mut b, socket) = receiver(16);
    let mut sent = frames(3_000, 1500);
    sent[0][LINK_HEADER + 20 + 5] ^= 8;
    let refused: Vec<_> = sent.iter().filter_map(|frame| b.hears(frame).err()).collect();
    assert_eq!(refused, [Refusal::UdpLength]);
    assert!(b.receive(socket).is_none());
}
