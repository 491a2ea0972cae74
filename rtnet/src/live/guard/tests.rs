use super::*;
use crate::live::clock::monotonic;
use crate::live::packet;
use crate::live::ring::tests::{in_a_namespace, loopback_up};
use socket2::Socket;

const SECOND: True = 1_000_000_000;

/// A socket whose frames are marked, on the loopback.
fn marked(interface: u32, mark: u32) -> Socket {
    let socket = packet::open().unwrap();
    packet::bind(&socket, interface, 0).unwrap();
    socket.set_mark(mark).unwrap();
    socket
}

/// A guard on the loopback of a namespace of the test's own, by each hook that this kernel has.
fn with_each_hook(test: fn(&dyn Fn() -> Guard, &Socket, u32)) {
    for (name, hook) in [("tcx", tcx as Attach), ("clsact", clsact as Attach)] {
        in_a_namespace(|| {
            let lo = nix::net::if_::if_nametoindex("lo").unwrap();
            if let Err(refused) = Guard::attach_by(hook, lo) {
                let line = format!("SKIP {name}: {refused}: {}\n", refused.remedy());
                let _ = io::Write::write_all(&mut io::stderr(), line.as_bytes());
                return;
            }
            test(&|| Guard::attach_by(hook, lo).unwrap(), &marked(lo, MARK), lo);
        });
    }
}

#[test]
fn what_is_outside_its_window_is_dropped_and_counted_by_either_hook() {
    with_each_hook(|attach, socket, _| {
        let (guard, now) = (attach(), monotonic());
        let sent = |begin, end| {
            guard.open(begin, end);
            packet::send(socket, &[0; 60])
        };
        assert_eq!(packet::send(socket, &[0; 60]), Err(libc::ENOBUFS), "no window yet");
        assert_eq!(sent(now - SECOND, now + SECOND), Ok(()));
        assert_eq!(sent(now - SECOND, now), Err(libc::ENOBUFS));
        assert_eq!(sent(now + SECOND, now + 2 * SECOND), Err(libc::ENOBUFS));
        guard.open(now - SECOND, now + SECOND);
        guard.close();
        assert_eq!(packet::send(socket, &[0; 60]), Err(libc::ENOBUFS), "closed");
        assert_eq!(guard.counters(), GuardCounters { passed: 1, late: 3, early: 1, others: 0 });
        assert_eq!(guard.drops(), 4);
    });
}

#[test]
fn others_frames_pass_and_all_do_once_the_guard_is_gone() {
    with_each_hook(|attach, socket, lo| {
        let guard = attach();
        for mark in [0, 1, MARK + 1, !MARK] {
            assert_eq!(packet::send(&marked(lo, mark), &[0; 60]), Ok(()));
        }
        assert_eq!(packet::send(socket, &[0; 60]), Err(libc::ENOBUFS));
        assert_eq!(guard.counters(), GuardCounters { passed: 0, late: 1, early: 0, others: 4 });
        drop(guard);
        assert_eq!(packet::send(socket, &[0; 60]), Ok(()));
    });
}

#[test]
fn others_that_are_kept_off_do_not_leave_and_are_counted() {
    with_each_hook(|attach, socket, lo| {
        let (guard, now) = (attach(), monotonic());
        guard.keep_others_off();
        guard.open(now - SECOND, now + SECOND);
        for mark in [0, MARK + 1] {
            assert_eq!(packet::send(&marked(lo, mark), &[0; 60]), Err(libc::ENOBUFS));
        }
        assert_eq!(packet::send(socket, &[0; 60]), Ok(()));
        assert_eq!(guard.counters(), GuardCounters { passed: 1, late: 0, early: 0, others: 2 });
        assert_eq!(guard.drops(), 0, "of its own");
        drop(guard);
        assert_eq!(packet::send(&marked(lo, 0), &[0; 60]), Ok(()));
    });
}

#[test]
fn an_interface_that_was_down_is_still_guarded_by_either_hook() {
    with_each_hook(|attach, socket, _| {
        let (guard, now) = (attach(), monotonic());
        loopback_up(false);
        assert_eq!(packet::send(socket, &[0; 60]), Err(libc::ENETDOWN));
        loopback_up(true);
        assert_eq!(packet::send(socket, &[0; 60]), Err(libc::ENOBUFS), "no window yet");
        guard.open(now - SECOND, now + SECOND);
        assert_eq!(packet::send(socket, &[0; 60]), Ok(()));
        assert_eq!(guard.counters(), GuardCounters { passed: 1, late: 1, early: 0, others: 0 });
    });
}

#[test]
fn a_filter_that_a_killed_station_left_is_replaced() {
    in_a_namespace(|| {
        let lo = nix::net::if_::if_nametoindex("lo").unwrap();
        let Ok(killed) = Guard::attach_by(clsact, lo) else {
            let _ = io::Write::write_all(&mut io::stderr(), b"SKIP: no clsact\n");
            return;
        };
        // What is never dropped removes nothing, as a killed process.
        std::mem::forget(killed);
        let (guard, socket) = (Guard::attach_by(clsact, lo).unwrap(), marked(lo, MARK));
        guard.open(0, True::MAX);
        assert_eq!(packet::send(&socket, &[0; 60]), Ok(()), "the one left would have dropped it");
        drop(guard);
        assert_eq!(packet::send(&socket, &[0; 60]), Ok(()));
    });
}

#[test]
fn an_interface_that_is_not_there_is_refused_in_one_line() {
    let refused = Guard::attach(u32::MAX >> 1).err().unwrap();
    let line = format!("{refused}: {}", refused.remedy());
    assert!(!line.contains('\n'), "{line}");
}

#[test]
fn a_program_that_was_there_before_and_passes_everything_does_not_help() {
    in_a_namespace(|| {
        let lo = nix::net::if_::if_nametoindex("lo").unwrap();
        let other = bpf::load(&program::pass_everything(), NAME)
            .and_then(|program| bpf::attach(&program, lo, bpf::Hook::Egress));
        let (Ok(_other), Ok(guard)) = (other, Guard::attach_by(tcx, lo)) else {
            let _ = io::Write::write_all(&mut io::stderr(), b"SKIP: no tcx\n");
            return;
        };
        assert_eq!(packet::send(&marked(lo, MARK), &[0; 60]), Err(libc::ENOBUFS));
        assert_eq!(guard.drops(), 1);
    });
}

#[test]
fn a_time_namespace_is_noticed() {
    assert!(!is_set_off(""));
    assert!(!is_set_off("monotonic           0         0\nboottime     100         0\n"));
    assert!(is_set_off("monotonic          86400         0\nboottime       0         0\n"));
    assert!(is_set_off("monotonic           0         -7\n"));
}

#[test]
fn the_remedy_is_chosen_by_the_step_that_failed() {
    let remedy = |step, errno| GuardRefused::new(step, io::Error::from_raw_os_error(errno)).remedy();
    for (step, errno, expected) in [
        (Step::Map, libc::EPERM, "CAP_BPF and CAP_NET_ADMIN"),
        (Step::Map, libc::ENOSYS, "CONFIG_BPF_SYSCALL"),
        (Step::Map, libc::EINVAL, "Linux 5.5"),
        (Step::Mapping, libc::EAGAIN, "RLIMIT_MEMLOCK"),
        (Step::Program, libc::EINVAL, "Linux 5.5"),
        (Step::Hook, libc::EINVAL, "tcx, Linux 6.6, or clsact"),
        (Step::Hook, libc::EOPNOTSUPP, "tcx, Linux 6.6, or clsact"),
        (Step::Hook, libc::ENODEV, "gone"),
        (Step::Mark, libc::EPERM, "CAP_NET_ADMIN"),
    ] {
        assert!(remedy(step, errno).contains(expected), "{step:?}, {errno}: {}", remedy(step, errno));
    }
    let namespace = GuardRefused::new(Step::Clock, io::ErrorKind::Unsupported.into());
    assert_eq!(namespace.remedy(), "run it in the host's time namespace");
}
