//! A program that does to what it shares with a station whatever it can, and threads that share a socket.

use nix::fcntl::{FcntlArg, OFlag, fcntl};
use nix::unistd::write;

use super::*;
use crate::api::segment::ASLEEP;
use crate::live::wait::tests::until_asleep;

#[test]
fn a_program_that_fills_what_it_may_write_and_lets_it_block_holds_nobody_up() {
    let pair = Pair::new();
    let [a, b] = pair.sockets();
    let hostile = pair.stations[1].udp().unwrap();
    hostile.bind(any(40_000)).unwrap();
    for descriptor in [hostile.0.ready.as_fd(), hostile.0.doorbell.as_fd()] {
        fcntl(descriptor, FcntlArg::F_SETFL(OFlag::empty())).unwrap();
        // So much that one more makes whoever writes it wait.
        let _ = write(descriptor, &(u64::MAX - 1).to_ne_bytes());
    }
    for n in 1..=10 {
        hostile.0.memory[ASLEEP].store(1, Ordering::SeqCst);
        a.send_to(b"it is woken for this", SocketAddrV4::new(IP[1], 40_000)).unwrap();
        pair.until("it was woken", |seen| seen.wakes.load(Ordering::Relaxed) >= n);
    }
    a.send_to(b"unharmed", to_second()).unwrap();
    assert_eq!(b.receive(&mut [0; 10]).unwrap().len, 8);
}

#[test]
fn all_threads_that_wait_are_told_when_their_line_is_ended() {
    let pair = Pair::new();
    let hostile = pair.stations[1].udp().unwrap();
    std::thread::scope(|scope| {
        let waiting = [(); 3].map(|()| scope.spawn(|| number(hostile.receive(&mut []))));
        std::thread::sleep(Duration::from_millis(20));
        hostile.0.memory[9].store(1 << 40, Ordering::SeqCst);
        assert_eq!(waiting.map(|thread| thread.join().unwrap()), [Errno::ENODEV; 3]);
    });
}

#[test]
fn who_polls_and_receives_without_waiting_is_told_of_what_comes_next_only() {
    let pair = Pair::new();
    let [a, b] = pair.sockets();
    let is_readable = |ms: u16| {
        let mut fds = [PollFd::new(b.as_fd(), PollFlags::POLLIN)];
        poll(&mut fds, PollTimeout::from(ms)) == Ok(1)
    };
    let mut room = [0; 10];
    for _ in 0..5 {
        a.send_to(b"one", to_second()).unwrap();
        assert!(is_readable(20_000));
        assert_eq!(b.receive_with(&mut room, Flags::DONTWAIT).unwrap().len, 3);
        while b.receive_with(&mut room, Flags::DONTWAIT).is_ok() {}
        assert!(!is_readable(0), "nothing has come since");
    }
}

#[test]
fn what_comes_at_once_for_several_threads_wakes_all_of_them() {
    let pair = Pair::new();
    let [a, b] = pair.sockets();
    for _ in 0..50 {
        std::thread::scope(|scope| {
            let threads = [(); 4].map(|()| scope.spawn(|| b.receive(&mut [0; 10])));
            let held = pair.held.lock().unwrap();
            (0..4).for_each(|_| a.send_to(b"one each", to_second()).unwrap());
            drop(held);
            for thread in threads {
                assert_eq!(thread.join().unwrap().unwrap().len, 8);
            }
        });
    }
}

#[test]
fn a_close_does_not_wait_for_the_answer_that_another_thread_waits_for() {
    let pair = Pair::new();
    let [_, b] = pair.sockets();
    let held = pair.held.lock().unwrap();
    std::thread::scope(|scope| {
        let (told, waits) = std::sync::mpsc::channel();
        let b = &b;
        let asks = scope.spawn(move || {
            told.send(nix::unistd::gettid()).unwrap();
            b.local_addr()
        });
        until_asleep(waits.recv().unwrap());
        b.close();
        // Where that waits, no answer comes within two seconds, and the other thread is told so.
        assert_eq!(number(asks.join().unwrap()), Errno::ENODEV);
    });
    drop(held);
}
