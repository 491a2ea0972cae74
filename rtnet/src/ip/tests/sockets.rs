//! UDP sockets, as BSD has them.

use super::*;
use crate::socket::{Options, Sender};
use crate::wire::ethernet::HEADER_LEN as LINK_HEADER;

fn any(port: u16) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, port)
}

fn udp(end: &mut End) -> SocketId {
    end.open(Socket::udp(Arc::new(Pool::new(4))))
}

#[test]
fn what_one_sends_the_other_receives_with_who_sent_it_and_when() {
    let (mut a, mut b) = pair();
    let (from, to) = (a.socket(5_000, 4), b.socket(36_000, 4));
    a.send(from, b"sixteen bytes ok", IP_B, 36_000).unwrap();
    assert_eq!(cross(&mut a, &mut b), []);
    let (received, data) = b.receive(to).unwrap();
    assert_eq!(data, b"sixteen bytes ok");
    assert_eq!(received.from, Sender::Udp(SocketAddrV4::new(IP_A, 5_000)));
    assert_eq!((received.rx, received.is_truncated()), (Some(Instant::from_nanos(2_000)), false));
    assert!(b.receive(to).is_none(), "once");
}

#[test]
fn ports_are_given_out_from_the_range_and_a_port_is_one_sockets() {
    let interface = Interface { address: A, ip: IP_A, prefix: 24 };
    let mut end = End::with(StackConfig { ports: 1024..=1026, ..StackConfig::new(interface) });
    let ids: Vec<_> = (0..3).map(|_| udp(&mut end)).collect();
    let ports: Vec<_> = ids.iter().map(|&id| end.stack.local_address(id).unwrap().port()).collect();
    assert_eq!(ports, [1024, 1025, 1026]);
    let (none_left, _) = end.stack.open(Socket::udp(Arc::new(Pool::new(1)))).unwrap_err();
    assert_eq!(none_left, SocketError::NoPortLeft { first: 1024, last: 1026 });

    end.stack.bind(ids[1], any(7_000)).unwrap();
    assert_eq!(end.stack.bind(ids[1], any(7_001)), Err(SocketError::AlreadyBound(7_000)));
    assert_eq!(end.stack.bind(ids[2], any(7_000)), Err(SocketError::PortInUse(7_000)));
    assert_eq!(end.stack.bind(ids[2], any(1_024)), Err(SocketError::PortInUse(1_024)));
    let fourth = udp(&mut end);
    assert_eq!(end.stack.local_address(fourth), Ok(any(1_025)), "the port that was given back");
    end.stack.close(ids[1]).unwrap();
    end.stack.bind(ids[2], any(7_000)).unwrap();
    assert_eq!(end.stack.local_address(ids[1]), Err(SocketError::NoSuchSocket));
}

#[test]
fn sockets_at_different_addresses_have_the_same_port_and_each_hears_its_own() {
    let (mut a, mut b) = pair();
    let (from, ids) = (a.socket(0, 4), [udp(&mut b), udp(&mut b), udp(&mut b), udp(&mut b)]);
    let all = Ipv4Addr::new(10, 0, 0, 255);
    for (id, ip) in ids.into_iter().zip([IP_B, Ipv4Addr::LOCALHOST, all]) {
        b.stack.bind(id, SocketAddrV4::new(ip, 7_000)).unwrap();
    }
    for ip in [IP_B, Ipv4Addr::UNSPECIFIED] {
        assert_eq!(b.stack.bind(ids[3], SocketAddrV4::new(ip, 7_000)), Err(SocketError::PortInUse(7_000)));
    }
    a.send(from, b"to one", IP_B, 7_000).unwrap();
    a.send(from, b"to all", all, 7_000).unwrap();
    assert_eq!(cross(&mut a, &mut b), []);
    b.send(ids[3], b"to itself", Ipv4Addr::LOCALHOST, 7_000).unwrap();
    let came = ids.map(|id| b.receive(id).map(|(_, bytes)| bytes));
    let expected = [Some(&b"to one"[..]), Some(b"to itself"), Some(b"to all"), None];
    assert_eq!(came.each_ref().map(|bytes| bytes.as_deref()), expected);
}

#[test]
fn as_many_sockets_as_may_be_are_opened_and_a_closed_one_makes_room() {
    let interface = Interface { address: A, ip: IP_A, prefix: 24 };
    let mut end = End::with(StackConfig { sockets: 2, ..StackConfig::new(interface) });
    let (first, _) = (udp(&mut end), udp(&mut end));
    let (error, _) = end.stack.open(Socket::udp(Arc::new(Pool::new(1)))).unwrap_err();
    assert_eq!((error, error.errno()), (SocketError::TooMany(2), libc::EAGAIN));
    end.stack.close(first).unwrap();
    let second = udp(&mut end);
    assert_ne!(first, second);
    assert_eq!(
        end.send(first, b"", IP_B, 1),
        Err(SocketError::NoSuchSocket),
        "an old name names nobody else"
    );
    assert_eq!(end.stack.close(first).err(), Some(SocketError::NoSuchSocket));
}

#[test]
fn a_socket_is_bound_to_the_stations_addresses_only() {
    let (mut a, mut b) = pair();
    let id = udp(&mut b);
    let foreign = SocketAddrV4::new(IP_A, 1);
    assert_eq!(b.stack.bind(id, foreign), Err(SocketError::NotOurAddress(IP_A)));
    b.stack.bind(id, SocketAddrV4::new(IP_B, 36_000)).unwrap();
    let sender = udp(&mut a);
    for (to, comes) in [(IP_B, true), (Ipv4Addr::new(10, 0, 0, 255), true), (Ipv4Addr::BROADCAST, false)] {
        a.send(sender, b"x", to, 36_000).unwrap();
        assert_eq!(cross(&mut a, &mut b).is_empty(), comes, "{to}");
        assert_eq!(b.receive(id).is_some(), comes, "{to}");
    }
    let everywhere = b.socket(36_001, 1);
    a.send(sender, b"x", Ipv4Addr::BROADCAST, 36_001).unwrap();
    cross(&mut a, &mut b);
    assert!(b.receive(everywhere).is_some(), "a socket bound to any address hears what is for all the world");
}

#[test]
fn a_socket_bound_to_a_broadcast_address_hears_what_is_sent_there_and_nothing_else() {
    let (mut a, mut b) = pair();
    let sender = udp(&mut a);
    let all = [IP_B, Ipv4Addr::new(10, 0, 0, 255), Ipv4Addr::BROADCAST];
    for (bound, port) in all.into_iter().zip(36_000..).skip(1) {
        let id = udp(&mut b);
        b.stack.bind(id, SocketAddrV4::new(bound, port)).unwrap();
        for to in all {
            a.send(sender, b"x", to, port).unwrap();
            cross(&mut a, &mut b);
            assert_eq!(b.receive(id).is_some(), to == bound, "{to} at {bound}");
        }
    }
}

#[test]
fn a_connected_socket_sends_to_its_peer_and_hears_nobody_else() {
    let (mut a, mut b) = pair();
    let id = a.socket(5_000, 4);
    let nowhere = a.stack.send_to(id, b"", None, Flags::NONE, &mut a.queue);
    assert_eq!(nowhere, Err(SocketError::NotConnected));
    assert_eq!(a.stack.peer_address(id), Err(SocketError::NotConnected));
    let peer = SocketAddrV4::new(IP_B, 36_000);
    a.stack.connect(id, Some(peer)).unwrap();
    a.stack.send_to(id, b"to b", None, Flags::NONE, &mut a.queue).unwrap();
    let (known, unknown) = (b.socket(36_000, 4), b.socket(36_001, 4));
    cross(&mut a, &mut b);
    assert_eq!(b.receive(known).unwrap().1, b"to b");
    b.send(unknown, b"from a stranger", IP_A, 5_000).unwrap();
    assert_eq!(cross(&mut b, &mut a), [Refusal::NoSocket]);
    b.send(known, b"from b", IP_A, 5_000).unwrap();
    assert_eq!(cross(&mut b, &mut a), []);
    assert_eq!(a.receive(id).unwrap().1, b"from b");
    a.stack.connect(id, None).unwrap();
    b.send(unknown, b"", IP_A, 5_000).unwrap();
    assert_eq!(cross(&mut b, &mut a), []);
}

#[test]
fn what_is_peeked_at_stays_and_what_does_not_fit_is_cut() {
    let (mut a, mut b) = pair();
    let (from, to) = (udp(&mut a), b.socket(36_000, 4));
    a.send(from, &bytes(100), IP_B, 36_000).unwrap();
    cross(&mut a, &mut b);
    let mut room = [0; 10];
    let view = TimeView::default();
    for flags in [Flags::PEEK, Flags::PEEK | Flags::DONTWAIT, Flags::DONTWAIT] {
        let received = b.stack.receive(to, &mut room, flags, &view).unwrap();
        assert_eq!((received.len, received.whole, received.is_truncated()), (10, 100, true));
        assert_eq!(room[..], bytes(10)[..]);
    }
    let nothing = b.stack.receive(to, &mut room, Flags::NONE, &view);
    assert_eq!(nothing.unwrap_err().errno(), libc::EAGAIN);
}

#[test]
fn wrong_flags_and_destinations_are_refused_by_the_number_that_sockets_give() {
    let (mut a, _) = pair();
    let id = udp(&mut a);
    let view = TimeView::default();
    let to = Some(SocketAddrV4::new(IP_B, 1));
    for (bits, number) in
        [(libc::MSG_OOB, libc::EOPNOTSUPP), (libc::MSG_TRUNC, libc::EINVAL), (1 << 30, libc::EINVAL)]
    {
        let flags = Flags::from_bits(bits);
        assert_eq!(a.stack.send_to(id, b"", to, flags, &mut a.queue).unwrap_err().errno(), number);
        assert_eq!(a.stack.receive(id, &mut [], flags, &view).unwrap_err().errno(), number);
    }
    for (ip, port, number) in [
        (IP_B, 0, libc::EINVAL),
        (Ipv4Addr::UNSPECIFIED, 1, libc::EINVAL),
        (FROM_NOBODY, 1, libc::EHOSTUNREACH),
        (Ipv4Addr::new(224, 0, 0, 1), 1, libc::EHOSTUNREACH),
    ] {
        assert_eq!(a.send(id, b"", ip, port).unwrap_err().errno(), number, "{ip}:{port}");
    }
    assert_eq!(a.send(id, &bytes(65_508), IP_B, 1).unwrap_err().errno(), libc::EMSGSIZE);
    let counters = a.stack.socket_counters(id).unwrap();
    assert_eq!((counters.refused, counters.no_route, counters.too_long), (8, 2, 1));
    assert_eq!(a.sent().len(), 0);
}

#[test]
fn each_sends_as_its_options_say() {
    let (mut a, _) = pair();
    let id = udp(&mut a);
    a.send(id, b"", IP_B, 1).unwrap();
    let urgent = Options { priority: Priority::FIRST, channel: 1, tos: 0x10 };
    a.stack.set_options(id, urgent).unwrap();
    a.send(id, b"", IP_B, 1).unwrap();
    let how: Vec<_> = a.queue.waiting.iter().map(|(frame, p, c)| (frame[LINK_HEADER + 1], *p, *c)).collect();
    assert_eq!(how, [(0, Priority::DEFAULT, 0), (0x10, Priority::FIRST, 1)]);
    let of_the_tunnel = Options { priority: Priority::NON_RT, ..urgent };
    assert_eq!(a.stack.set_options(id, of_the_tunnel), Err(SocketError::WrongPriority(31)));
    let nowhere = Options { channel: 2, ..urgent };
    a.stack.set_options(id, nowhere).unwrap();
    assert_eq!(a.send(id, b"", IP_B, 1), Err(SendError::NoSlot(2).into()));
    assert_eq!(a.send(id, b"", IP_A, 1), Ok(()), "to itself it needs no slot");
}

#[test]
fn a_socket_that_is_never_read_loses_its_own_datagrams_only() {
    let (mut a, mut b) = pair();
    let (unread, read, from) = (b.socket(36_000, 4), b.socket(36_001, 4), a.socket(0, 4));
    for n in 0..100 {
        a.send(from, b"to who does not read", IP_B, 36_000).unwrap();
        let refused = cross(&mut a, &mut b);
        assert_eq!(refused.is_empty(), n < 4, "{n}: {refused:?}");
        a.send(from, b"to who does", IP_B, 36_001).unwrap();
        assert_eq!(cross(&mut a, &mut b), []);
        assert!(b.receive(read).is_some());
    }
    let counters = b.stack.socket_counters(unread).unwrap();
    assert_eq!((counters.received, counters.dropped), (4, 96));
    assert_eq!(b.stack.socket_counters(read).unwrap().dropped, 0);
}

#[test]
fn a_sender_that_floods_is_refused_when_its_own_buffers_all_wait() {
    let (mut a, mut b) = pair();
    let (flooding, calm, to) = (a.socket(0, 4), a.socket(0, 4), b.socket(36_000, 8));
    for n in 0..100 {
        let sent = a.send(flooding, b"", IP_B, 36_000);
        let full = SocketError::NoBuffers { needed: 1, free: 0, capacity: 4 };
        assert_eq!(sent, if n < 4 { Ok(()) } else { Err(full) });
    }
    a.send(calm, b"still goes", IP_B, 36_000).unwrap();
    assert_eq!(cross(&mut a, &mut b), []);
    assert_eq!(b.stack.socket_counters(to).unwrap().received, 5);
    assert_eq!(a.stack.socket_counters(flooding).unwrap().no_buffers, 96);
}

#[test]
fn a_station_that_sends_to_itself_hears_it_at_once() {
    let (mut a, _) = pair();
    let (from, to) = (a.socket(5_000, 4), a.socket(36_000, 4));
    let loopback = Ipv4Addr::new(127, 0, 0, 9);
    for (ip, source) in
        [(IP_A, IP_A), (Ipv4Addr::LOCALHOST, Ipv4Addr::LOCALHOST), (loopback, Ipv4Addr::LOCALHOST)]
    {
        a.send(from, &bytes(4_000), ip, 36_000).unwrap();
        let (received, data) = a.receive(to).unwrap();
        assert_eq!(received.from, Sender::Udp(SocketAddrV4::new(source, 5_000)));
        assert_eq!(data, bytes(4_000));
    }
    a.send(from, b"", IP_A, 1).unwrap();
    assert_eq!(a.stack.counters().loopback.get(Refusal::NoSocket), 1, "and what nobody takes is counted");
    assert_eq!(a.sent().len(), 0);
}

#[test]
fn two_sockets_with_a_loopback_address_each_hear_each_other_by_these() {
    let (mut a, _) = pair();
    let [one, other] =
        [1, 9].map(|last| SocketAddrV4::new(Ipv4Addr::new(127, 0, 0, last), 5_000 + u16::from(last)));
    let sockets = [(one, other), (other, one)].map(|(own, peer)| {
        let socket = udp(&mut a);
        a.stack.bind(socket, own).unwrap();
        a.stack.connect(socket, Some(peer)).unwrap();
        socket
    });
    for (from, to, own) in [(sockets[0], sockets[1], one), (sockets[1], sockets[0], other)] {
        a.stack.send_to(from, b"x", None, Flags::NONE, &mut a.queue).unwrap();
        assert_eq!(a.receive(to).expect("it is its peer").0.from, Sender::Udp(own));
    }
    a.knows(IP_B, B);
    a.stack.send_to(sockets[0], b"x", Some(SocketAddrV4::new(IP_B, 1)), Flags::NONE, &mut a.queue).unwrap();
    let frame = a.sent().remove(0);
    assert_eq!(frame[LINK_HEADER + 12..][..4], IP_A.octets(), "none of these leaves");
}

#[test]
fn a_wrong_checksum_of_a_whole_datagram_is_refused_and_none_is_let_in() {
    let (mut a, mut b) = pair();
    let (from, to) = (udp(&mut a), b.socket(36_000, 4));
    a.send(from, &bytes(40), IP_B, 36_000).unwrap();
    let frame = a.sent().remove(0);
    let data = LINK_HEADER + 20 + 8;
    let mut changed = frame.clone();
    changed[data] ^= 1;
    assert_eq!(b.hears(&changed), Err(Refusal::UdpChecksum));
    changed[data - 2..data].fill(0);
    assert_eq!(b.hears(&changed), Ok(()), "its sender computed none");
    assert_eq!(b.receive(to).unwrap().0.len, 40);
    let mut longer = frame.clone();
    longer[data - 3] += 1;
    assert_eq!(b.hears(&longer), Err(Refusal::UdpLength));
}
