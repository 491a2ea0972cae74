//! Programs that have a station's time by its control socket.

use std::io::Read;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::JoinHandle;
use std::time::Duration;

use nix::errno::Errno;
use socket2::{Domain, SockAddr, Socket, Type};

use super::{PATIENCE, number};
use crate::api::client::Station;
use crate::api::door;
use crate::api::handshake::Ask;
use crate::clock::EmulatedClock;
use crate::discipline::{SyncState, TimeView};
use crate::live::{TimePublisher, WaitError};
use crate::time::{GlobalTime, Offset, Span};

const CYCLE: Span = Span::from_millis(5);

/// How a station ends.
#[derive(Clone, Copy, PartialEq)]
enum End {
    /// It was told to.
    Told,
    /// It was killed: all that happens is that its connections are closed.
    Killed,
}

/// A station with this line, from cycle 100 on, whose thread keeps it up to date and lets programs in.
struct Clock {
    station: Station,
    view: TimeView,
    ends: Sender<End>,
    thread: Option<JoinHandle<()>>,
    _scratch: tempfile::TempDir,
}

impl Clock {
    fn new(period: Span) -> Self {
        let scratch = tempfile::tempdir().unwrap();
        let path = scratch.path().join("clock.sock");
        let listener = Socket::new(Domain::UNIX, Type::SEQPACKET, None).unwrap();
        listener.bind(&SockAddr::unix(&path).unwrap()).unwrap();
        listener.listen(16).unwrap();
        listener.set_nonblocking(true).unwrap();
        let clock = EmulatedClock { offset: Span::from_millis(-300), ..EmulatedClock::default() };
        let publisher = TimePublisher::new(clock);
        let start = publisher.board().now();
        let offset = Offset::between(start, GlobalTime::from_nanos(1_795_000_000_000_000_000));
        // However long a busy machine lets the thread wait that shows it, the line is not too old.
        let (state, period) = (SyncState::Locked, Some(period));
        let view =
            TimeView { state, cycle: 100, start, offset, period, holdover: u16::MAX, ..TimeView::default() };
        let (ends, until) = channel();
        let thread = Some(std::thread::spawn(move || show(&listener, publisher, view, &until)));
        Self { station: Station::at(path), view, ends, thread, _scratch: scratch }
    }

    fn end(&mut self, how: End) {
        if let Some(thread) = self.thread.take() {
            self.ends.send(how).unwrap();
            thread.join().unwrap();
        }
    }
}

impl Drop for Clock {
    fn drop(&mut self) {
        self.end(End::Told);
    }
}

fn show(listener: &Socket, mut publisher: TimePublisher, mut view: TimeView, until: &Receiver<End>) {
    let mut programs = Vec::new();
    publisher.publish(&view);
    let how = loop {
        if let Ok(how) = until.try_recv() {
            break how;
        }
        if let Ok((program, _)) = listener.accept() {
            let mut packet = [0; 64];
            let len = (&program).read(&mut packet).unwrap();
            assert_eq!(Ask::parse(&packet[..len]), Some(Ask::Time));
            door::reply_with_time(&program, &publisher.board()).unwrap();
            programs.push(program);
        }
        let next = view.cycle + 1;
        let start = view.start_of(next).unwrap();
        if start <= publisher.board().now() {
            view = TimeView { cycle: next, start, ..view };
            publisher.publish(&view);
        }
        std::thread::sleep(Duration::from_millis(1));
    };
    if how == End::Killed {
        std::mem::forget(publisher);
    }
}

#[test]
fn programs_wait_in_cycle_after_cycle_of_a_station_that_is_another_process() {
    let clock = Clock::new(CYCLE);
    std::thread::scope(|scope| {
        for _ in 0..3 {
            scope.spawn(|| {
                let time = clock.station.time().unwrap();
                let mut waiter = time.waiter();
                waiter.wait_synchronised(PATIENCE).unwrap();
                let mut last = 100;
                for _ in 0..20 {
                    let cycle = waiter.wait_cycle(PATIENCE).unwrap();
                    assert!(cycle.number > last, "{} after {last}", cycle.number);
                    last = cycle.number;
                    assert_eq!(cycle.start, clock.view.start_of(last).unwrap());
                    assert!(cycle.start <= time.now());
                    assert_eq!(time.to_global(cycle.start), Some(cycle.offset.global(cycle.start)));
                }
                assert!(time.state().is_synchronised() && !time.has_ended());
            });
        }
    });
}

#[test]
fn who_waits_for_the_cycle_of_a_station_that_ends_or_is_killed_is_told() {
    for how in [End::Told, End::Killed] {
        let mut clock = Clock::new(Span::from_millis(100_000));
        let time = clock.station.time().unwrap();
        let waiter = std::thread::spawn({
            let time = time.clone();
            move || time.waiter().wait_cycle(PATIENCE)
        });
        std::thread::sleep(Duration::from_millis(30));
        let begun = std::time::Instant::now();
        clock.end(how);
        assert_eq!(waiter.join().unwrap(), Err(WaitError::Ended));
        assert!(begun.elapsed() < PATIENCE / 2, "noticed soon");
        assert!(time.has_ended());
        assert_eq!(time.state(), SyncState::Lost);
        assert_eq!(time.waiter().wait_synchronised(PATIENCE), Err(WaitError::Ended));
        assert_eq!(number(clock.station.time()), Errno::ENODEV);
    }
}
