//! What is refused, and how a program hears of it.

use super::*;

#[test]
fn what_cannot_be_is_refused_by_the_number_that_sockets_give() {
    let pair = Pair::new();
    let [a, b] = pair.sockets();
    let other = pair.stations[1].udp().unwrap();
    assert_eq!(number(other.bind(any(36_000))), Errno::EADDRINUSE);
    assert_eq!(number(other.bind(SocketAddrV4::new(IP[0], 1))), Errno::EADDRNOTAVAIL);
    assert_eq!(number(other.peer_addr()), Errno::ENOTCONN);
    assert_eq!(number(a.send_to(&bytes(65_508), to_second())), Errno::EMSGSIZE);
    assert_eq!(number(a.set_priority(Priority::NON_RT)), Errno::EINVAL);
    let packet = pair.stations[0].packet(LinkMode::Datagram, LinkType::Nothing).unwrap();
    assert_eq!(number(packet.0.ask(Ask::Bind(any(1)))), Errno::EOPNOTSUPP);
    assert_eq!(number(pair.stations[0].udp_with(1 << 20)), Errno::ENOMEM);
    // What is found out in the station's thread is told of at the next call.
    let nowhere = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 99), 1);
    for (send, expected) in [(nowhere, Errno::EHOSTUNREACH), (any(1), Errno::EINVAL)] {
        a.send_to(b"", send).unwrap();
        let turn = pair.seen.turns.load(Ordering::Relaxed);
        pair.until("two turns", |seen| seen.turns.load(Ordering::Relaxed) > turn + 2);
        assert_eq!(number(a.send_to(b"x", to_second())), expected, "of the one before");
    }
    a.set_channel(7);
    a.send_to(b"", to_second()).unwrap();
    let turn = pair.seen.turns.load(Ordering::Relaxed);
    pair.until("two turns", |seen| seen.turns.load(Ordering::Relaxed) > turn + 2);
    assert_eq!(number(a.send_to(b"x", to_second())), Errno::EAGAIN, "there is no such slot");
    let flags = Flags::DONTROUTE;
    assert_eq!(
        number(packet.send_to_with(b"", Address::BROADCAST, EtherType::EXPERIMENTAL, flags)),
        Errno::EINVAL
    );
    assert_eq!(number(packet.send_with(b"", Flags::from_bits(libc::MSG_OOB))), Errno::EOPNOTSUPP);
    drop(b);
}

/// What is found by looking again and again, for some seconds.
fn sooner_or_later<T>(mut look: impl FnMut() -> Option<T>) -> T {
    let looks = (0..5_000_000).map(|_| std::thread::yield_now());
    looks.into_iter().find_map(|()| look()).expect("it is told")
}

#[test]
fn who_waits_for_an_answer_to_what_could_not_leave_is_told_why_there_is_none() {
    let pair = Pair::new();
    let [a, b] = pair.sockets();
    let nowhere = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 99), 1);
    a.connect(Some(to_second())).unwrap();
    a.set_timeout(None);
    a.send_to(b"", nowhere).unwrap();
    assert_eq!(number(a.receive(&mut [])), Errno::EHOSTUNREACH);
    a.send_to(b"it is told of once", to_second()).unwrap();
    assert_eq!(b.receive(&mut [0; 20]).unwrap().len, 18);
    a.send_to(b"", nowhere).unwrap();
    let spins = || number(a.receive_with(&mut [], Flags::DONTWAIT));
    assert_eq!(
        sooner_or_later(|| Some(spins()).filter(|error| *error != Errno::EAGAIN)),
        Errno::EHOSTUNREACH
    );
    a.send_to(b"", nowhere).unwrap();
    let error = sooner_or_later(|| a.take_error());
    assert_eq!(number::<()>(Err(error)), Errno::EHOSTUNREACH);
    assert_eq!((a.take_error().is_none(), spins()), (true, Errno::EAGAIN));
    // Who hears all goes on with the others.
    b.send_to(b"", nowhere).unwrap();
    b.set_timeout(Some(Duration::from_millis(50)));
    assert_eq!(number(b.receive(&mut [])), Errno::ETIMEDOUT);
    assert_eq!(b.take_error().map(|error| number::<()>(Err(error))), Some(Errno::EHOSTUNREACH));
}

#[test]
fn a_station_that_does_not_take_what_is_sent_is_not_waited_for() {
    let pair = Pair::new();
    let [a, b] = pair.sockets();
    let held = pair.held.lock().unwrap();
    let sent = (0..100_000).take_while(|_| a.send_to(&bytes(1_000), to_second()).is_ok()).count();
    assert!((100..1_000).contains(&sent), "{sent} wait in the ring");
    assert_eq!(number(a.send_to(&bytes(1_000), to_second())), Errno::ENOBUFS);
    drop(held);
    let mut room = [0; 1_000];
    for _ in 0..sent {
        assert_eq!(b.receive(&mut room).unwrap().len, 1_000);
    }
}
