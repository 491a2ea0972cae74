//! The kernel guard on a real medium: what is outside its window does not get there, even from a process that
//! is stopped between its last look at the clock and `send`.

// fork, and giving up privileges for one thread
#![allow(unsafe_code)]

use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use nix::libc;
use nix::sys::signal::{Signal, kill, raise};
use nix::sys::wait::{WaitPidFlag, WaitStatus, waitpid};
use nix::unistd::{ForkResult, fork};
use rtmac::tdma::schedule;
use rtnet::clock::EmulatedClock;
use rtnet::discipline::{Sent, SyncState, Transmission};
use rtnet::live::clock::monotonic;
use rtnet::live::guard::{Guard, GuardCounters, MARK, tolerance};
use rtnet::live::interface::Interface;
use rtnet::live::{GuardMode, OpenError, Port};
use rtnet::time::Span;
use rtnet::wire::ethernet::{Address, EtherType};
use rtnet::{Instant, Pool};
use tests::bare::Bare;
use tests::host::{alone, skip};
use tools::lab::namespace::{Namespace, Segment};

use crate::live::{Extras, Medium, clock, our_master, our_slave};

const HERE: Address = Address([2, 0, 0, 0, 0, 1]);
const THERE: Address = Address([2, 0, 0, 0, 0, 2]);
const SECOND: u64 = 1_000_000_000;
/// How long after its instant a frame of these tests may leave, and how long its process is stopped.
const LATEST: Span = Span::from_millis(20);
const STOPPED: Duration = Duration::from_millis(60);
const ATTEMPTS: usize = 10;
const PATIENCE: Duration = Duration::from_secs(30);
/// Exit statuses of the process that is stopped.
const LEFT_LATE: i32 = 1;
const DROPPED: i32 = 2;
const OTHERWISE: i32 = 3;

#[test]
fn what_the_guard_tolerates_leaves_the_clocks_their_share() {
    for (n, guard) in (0..1_000_000).step_by(997).map(Span::from_nanos).enumerate() {
        let time = schedule::latest(guard, n % 40);
        let late = time + Span::from_nanos(tolerance(time.nanos() as u64) as i64);
        assert!(late <= guard - schedule::clock_share(guard, n % 40), "{guard}: {late}");
    }
}

/// One end of a medium sends, the other listens.
struct Wire {
    here: Namespace,
    listener: Port,
    _there: Namespace,
    _segment: Segment,
}

impl Wire {
    fn new() -> Self {
        let (here, there) = (Namespace::new().unwrap(), Namespace::new().unwrap());
        let mut segment = Segment::new().unwrap();
        segment.attach(&here, "port0", "rt0", HERE.0).unwrap();
        segment.attach(&there, "port1", "rt0", THERE.0).unwrap();
        let listener = there.run(|| open(GuardMode::User).unwrap()).unwrap();
        Self { here, listener, _there: there, _segment: segment }
    }

    /// When frames have arrived, and the last byte of each: as many as are expected are waited for, more only for a moment.
    fn arrived(&mut self, expected: usize) -> Vec<(Instant, u8)> {
        let (mut frames, deadline) = (Vec::new(), std::time::Instant::now() + PATIENCE);
        loop {
            self.listener.wait_for_frame(20);
            self.listener.drain_control(|_, _| panic!("nobody sent a control frame"));
            self.listener.drain_data(|rx, frame| frames.push((rx.unwrap(), frame[59])));
            if frames.len() >= expected || std::time::Instant::now() > deadline {
                return frames;
            }
        }
    }

    /// The last byte of the only frame that arrives.
    fn number(&mut self) -> u8 {
        let arrived = self.arrived(1);
        assert_eq!(arrived.len(), 1, "{arrived:?}");
        arrived[0].1
    }
}

/// A port on the clock that they all share.
fn open(guard: GuardMode) -> Result<Port, OpenError> {
    let data = [EtherType::EXPERIMENTAL];
    Port::open(&Interface::find("rt0").unwrap(), &data, EmulatedClock::default(), 50_000, guard)
}

fn frame(last: u8) -> [u8; 60] {
    let mut frame = [0; 60];
    frame[..6].copy_from_slice(&THERE.0);
    frame[6..12].copy_from_slice(&HERE.0);
    frame[12..14].copy_from_slice(&EtherType::EXPERIMENTAL.0.to_be_bytes());
    frame[59] = last;
    frame
}

/// Runs a test where this host can guard; if it cannot, says so.
fn guarded(test: &str, body: impl Fn()) {
    alone(test, || {
        let opened = Wire::new().here.run(|| open(GuardMode::Auto).unwrap()).unwrap();
        match opened.guard_refused() {
            Some(line) => skip(test, line),
            None => body(),
        }
    });
}

#[test]
fn what_is_outside_its_window_does_not_reach_the_medium() {
    guarded("what_is_outside_its_window_does_not_reach_the_medium", || {
        let mut wire = Wire::new();
        let attach = || {
            let interface = Interface::find("rt0").unwrap();
            let (ours, others) = (Bare::open(&interface).unwrap(), Bare::open(&interface).unwrap());
            ours.mark(MARK).unwrap();
            (Guard::attach(interface.index).unwrap(), ours, others)
        };
        let (guard, ours, others) = wire.here.run(attach).unwrap();
        let now = monotonic();

        assert!(!ours.send(&frame(1)), "before the first window");
        guard.open(now, now + 60 * SECOND);
        assert!(ours.send(&frame(2)), "in its window");
        assert_eq!(wire.number(), 2);
        guard.open(now, monotonic());
        assert!(!ours.send(&frame(3)), "late");
        guard.open(now + 60 * SECOND, now + 61 * SECOND);
        assert!(!ours.send(&frame(4)), "early");
        guard.open(now, now + 60 * SECOND);
        guard.close();
        assert!(!ours.send(&frame(5)), "behind a window that is closed");
        assert!(others.send(&frame(6)), "somebody else's, whatever the window");
        assert_eq!(wire.number(), 6);
        assert_eq!(guard.counters(), GuardCounters { passed: 1, late: 3, early: 1, others: 1 });

        drop(guard);
        assert!(ours.send(&frame(7)), "nobody guards any more");
        assert_eq!(wire.number(), 7);
    });
}

/// What becomes of a frame whose process is stopped between its last look at the clock and `send`, until long
/// after `latest`: the process's exit status, and when the frame arrived after its `latest`, if it did.
fn stopped_before_send(wire: &mut Wire, guard: GuardMode) -> (i32, Option<Span>) {
    for _ in 0..ATTEMPTS {
        let mut port = wire.here.run(|| open(guard).unwrap()).unwrap();
        port.hold_before_send(|| {
            // The parent sees whether it worked.
            let _ = raise(Signal::SIGSTOP);
        });
        let mut buf = Pool::new(1).take().unwrap();
        buf.fill(&frame(0));
        let at = port.now() + Span::from_millis(5);
        let transmission = Transmission { frame: buf, at, latest: at + LATEST, stamp: None };
        // SAFETY: the child sends and ends, for which it needs no lock that another thread might hold: a
        // port's `transmit` neither allocates nor locks.
        let child = match unsafe { fork() }.unwrap() {
            ForkResult::Parent { child } => child,
            ForkResult::Child => {
                let status = match port.transmit(transmission) {
                    Sent::StalledUntil(_) => LEFT_LATE,
                    Sent::Guarded(..) => DROPPED,
                    _ => OTHERWISE,
                };
                // SAFETY: ends the process at once.
                unsafe { libc::_exit(status) }
            }
        };
        // A process that the host held up was late at its last look, and did not get as far.
        if let WaitStatus::Exited(_, OTHERWISE) = waitpid(child, Some(WaitPidFlag::WUNTRACED)).unwrap() {
            continue;
        }
        std::thread::sleep(STOPPED);
        kill(child, Signal::SIGCONT).unwrap();
        let WaitStatus::Exited(_, status) = waitpid(child, None).unwrap() else { panic!("it was killed") };
        let expected = usize::from(status == LEFT_LATE);
        return (status, wire.arrived(expected).first().map(|&(rx, _)| rx - (at + LATEST)));
    }
    panic!("this host held it up {ATTEMPTS} times");
}

#[test]
fn a_process_that_is_stopped_before_send_puts_no_late_frame_on_a_guarded_medium() {
    guarded("a_process_that_is_stopped_before_send_puts_no_late_frame_on_a_guarded_medium", || {
        let mut wire = Wire::new();
        let (status, late) = stopped_before_send(&mut wire, GuardMode::User);
        assert_eq!(status, LEFT_LATE);
        assert!(late.unwrap() > Span::ZERO, "{late:?}: what the guard is for");
        assert_eq!(stopped_before_send(&mut wire, GuardMode::Kernel), (DROPPED, None));
    });
}

#[test]
fn a_station_whose_frames_the_kernel_drops_tells_of_it_and_goes_on() {
    guarded("a_station_whose_frames_the_kernel_drops_tells_of_it_and_goes_on", || {
        static SENT: AtomicU32 = AtomicU32::new(0);
        /// Every seventh is held up for longer than any of its frames may be.
        fn hold() {
            if SENT.fetch_add(1, Ordering::Relaxed) % 7 == 6 {
                std::thread::sleep(Duration::from_millis(2));
            }
        }
        let mut medium = Medium::new();
        let ideal = clock(Span::ZERO, 0);
        let held = Extras { hold: Some(hold), ..Extras::default() };
        let mut master = medium
            .start_with(ideal, 1, held, |address| our_master(address, &ideal, Span::from_micros(3_500)));
        let mut slave = medium.start(clock(Span::from_millis(700), 50_000), 0, |address| {
            our_slave(address, 5, Span::from_micros(2_000))
        });
        slave.wait_until("locked", |status| status.state == SyncState::Locked);
        master.wait_for_frames(50);
        slave.wait_for_frames(50);
        let counters =
            master.wait_until("frames are dropped", |status| status.counters.guard_drops >= 20).counters;
        assert!(counters.syncs_skipped > 0, "some of them were syncs: {counters:?}");
        assert_eq!(counters.send_failed, 0);
    });
}

/// Gives up all privileges of the calling thread but raw sockets, for good.
fn keep_raw_sockets_only() {
    const VERSION_3: u32 = 0x2008_0522;
    const CAP_NET_RAW: u32 = 1 << 13;
    let header = [VERSION_3, 0];
    // Effective, permitted, inheritable; the lower half of each first.
    let sets = [CAP_NET_RAW, CAP_NET_RAW, 0, 0, 0, 0];
    // SAFETY: the kernel reads a header of 8 bytes and, in this version, sets of 24, which are alive.
    let done = unsafe { libc::syscall(libc::SYS_capset, header.as_ptr(), sets.as_ptr()) };
    assert_eq!(done, 0, "{}", std::io::Error::last_os_error());
}

#[test]
fn without_privileges_a_port_goes_on_unguarded_and_says_why_in_one_line() {
    alone("without_privileges_a_port_goes_on_unguarded_and_says_why_in_one_line", || {
        let mut wire = Wire::new();
        let opened = wire.here.run(|| {
            keep_raw_sockets_only();
            [GuardMode::Auto, GuardMode::User, GuardMode::Kernel].map(open)
        });
        let [auto, user, kernel] = opened.unwrap();
        let mut auto = auto.unwrap();
        assert!(!auto.is_guarded());
        let line = auto.guard_refused().unwrap();
        assert!(line.starts_with("kernel guard: ") && line.contains("Operation not permitted"), "{line}");
        assert!(line.contains("CAP_BPF") && !line.contains('\n'), "{line}");
        assert_eq!(user.unwrap().guard_refused(), None, "nobody asked for one");
        let refused = kernel.err().unwrap();
        assert!(matches!(refused, OpenError::Guard(..)), "{refused}");

        let mut buf = Pool::new(1).take().unwrap();
        buf.fill(&frame(8));
        let at = auto.now();
        let sent = auto.transmit(Transmission {
            frame: buf,
            at,
            latest: at + Span::from_millis(1_000),
            stamp: None,
        });
        assert!(matches!(sent, Sent::At(_)), "{sent:?}");
        assert_eq!(wire.number(), 8);
    });
}
