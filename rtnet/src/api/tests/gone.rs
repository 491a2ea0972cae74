//! Stations and programs that go, each with the other left behind.

use super::*;

#[test]
fn a_station_that_is_gone_is_no_device_any_more() {
    let mut pair = Pair::new();
    let [a, b] = pair.sockets();
    assert_eq!(number(b.try_receive(&mut [])), Errno::EAGAIN);
    a.send_to(b"last words", to_second()).unwrap();
    let mut fds = [PollFd::new(b.as_fd(), PollFlags::POLLIN)];
    assert_eq!(poll(&mut fds, PollTimeout::from(20_000u16)), Ok(1));
    pair.end();
    let mut room = [0; 20];
    assert_eq!(b.receive(&mut room).unwrap().len, 10, "what has come is there");
    assert_eq!(number(b.receive(&mut room)), Errno::ENODEV);
    assert_eq!(number(a.send_to(b"", to_second())), Errno::ENODEV);
    assert_eq!(number(a.bind(any(1))), Errno::ENODEV);
    assert_eq!(number(pair.stations[0].udp()), Errno::ENODEV);
}

#[test]
fn who_waits_at_a_station_that_is_killed_is_told_once_there_is_nothing_more_to_read() {
    let mut pair = Pair::new();
    let [a, b] = pair.sockets();
    b.set_timeout(None);
    a.send_to(b"last words", to_second()).unwrap();
    std::thread::scope(|scope| {
        let waits = scope.spawn(|| {
            let mut room = [0; 20];
            (b.receive(&mut room).unwrap().len, number(b.receive(&mut room)))
        });
        std::thread::sleep(Duration::from_millis(50));
        pair.kill();
        assert_eq!(waits.join().unwrap(), (10, Errno::ENODEV));
    });
    assert_eq!(number(b.try_receive(&mut [])), Errno::ENODEV);
    b.set_timeout(Some(Duration::ZERO));
    assert_eq!(number(b.receive(&mut [])), Errno::ENODEV, "who does not wait, either");
    assert_eq!(number(b.bind(any(1))), Errno::ENODEV);
}

#[test]
fn who_sends_to_a_station_that_is_killed_is_told_at_the_second_datagram() {
    let mut pair = Pair::new();
    let [a, b] = pair.sockets();
    a.send_to(b"last words", to_second()).unwrap();
    assert_eq!(b.receive(&mut [0; 20]).unwrap().len, 10);
    pair.kill();
    a.send_to(b"nobody can know yet", to_second()).unwrap();
    for _ in 0..3 {
        assert_eq!(number(a.send_to(b"", to_second())), Errno::ENODEV);
    }
}

#[test]
fn who_spins_at_a_station_that_is_killed_is_told_after_some_looks() {
    let mut pair = Pair::new();
    let [_, b] = pair.sockets();
    pair.kill();
    let spin = |_| number(b.receive_with(&mut [], Flags::DONTWAIT));
    assert!((0..2_000).map(spin).any(|error| error == Errno::ENODEV));
}

#[test]
fn a_program_that_dies_leaves_nothing() {
    let pair = Pair::new();
    let [a, b] = pair.sockets();
    let free = || pair.seen.free.load(Ordering::Relaxed);
    pair.until("there is one socket", |seen| seen.sockets.load(Ordering::Relaxed) == 1);
    for _ in 0..200 {
        let dying = pair.stations[1].udp().unwrap();
        dying.bind(any(40_000)).unwrap();
        a.send_to(b"it does not read this", SocketAddrV4::new(IP[1], 40_000)).unwrap();
        dying.send_to(b"nor does anybody this", SocketAddrV4::new(IP[0], 9)).unwrap();
        drop(dying);
    }
    pair.until("all are closed", |seen| seen.sockets.load(Ordering::Relaxed) == 1);
    pair.until("its buffers are home", |_| free() == 16);
    a.send_to(b"unharmed", to_second()).unwrap();
    assert_eq!(b.receive(&mut [0; 10]).unwrap().len, 8);
}
