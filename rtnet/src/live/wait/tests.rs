use super::*;
use crate::clock::EmulatedClock;
use crate::discipline::TimeView;
use crate::live::TimePublisher;
use crate::time::GlobalTime;
use std::sync::atomic::{AtomicBool, Ordering};

const CYCLE: Span = Span::from_millis(5);
/// Long enough for a loaded machine, and never waited for in full when all is well.
const PATIENCE: Duration = Duration::from_secs(20);
/// No wake-up of these tests is later than this, however busy the machine.
const SOON: Duration = Duration::from_secs(5);

/// A station whose clock is 300 ms behind and 50 ppm fast, and its time line: cycle 100 begins now.
fn station() -> (TimePublisher, TimeView) {
    let clock = EmulatedClock { anchor: monotonic(), offset: Span::from_millis(-300), drift_ppb: 50_000 };
    let publisher = TimePublisher::new(clock);
    let start = publisher.board().now();
    let offset = Offset::between(start, GlobalTime::from_nanos(1_795_000_000_000_000_000));
    let (state, period) = (SyncState::Locked, Some(CYCLE));
    let view = TimeView { state, cycle: 100, start, offset, period, drift_ppb: 50_000, holdover: 1 };
    (publisher, view)
}

/// Keeps the line of `view` up to date, as a station's loop does, until told to stop. However long a busy machine lets it
/// wait, the line is not too old.
fn kept(mut publisher: TimePublisher, view: TimeView) -> (Arc<AtomicBool>, std::thread::JoinHandle<()>) {
    let mut view = TimeView { holdover: u16::MAX, ..view };
    let stop = Arc::new(AtomicBool::new(false));
    let until = stop.clone();
    publisher.publish(&view);
    let thread = std::thread::spawn(move || {
        while !until.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_millis(2));
            let next = view.cycle.wrapping_add(1);
            let start = view.start_of(next).unwrap();
            if start <= publisher.board().now() {
                let global = view.to_global(start).unwrap();
                view = TimeView { cycle: next, start, offset: Offset::between(start, global), ..view };
                publisher.publish(&view);
            }
        }
    });
    (stop, thread)
}

#[test]
fn waiters_wake_in_cycle_after_cycle_each_with_its_number_and_start() {
    let (publisher, view) = station();
    let board = publisher.board();
    let (stop, keeper) = kept(publisher, view);
    let wait = |board: Arc<TimeBoard>| {
        let mut waiter = board.waiter();
        let cycles: Vec<Cycle> = (0..20).map(|_| waiter.wait_cycle(PATIENCE).unwrap()).collect();
        assert!(cycles.last().unwrap().start <= board.now());
        cycles
    };
    let waiters: Vec<_> = (0..3)
        .map(|_| {
            let board = board.clone();
            std::thread::spawn(move || wait(board))
        })
        .collect();
    for cycles in waiters.into_iter().map(|waiter| waiter.join().unwrap()) {
        for pair in cycles.windows(2) {
            assert!(pair[0].number < pair[1].number && pair[0].start < pair[1].start);
        }
        for Cycle { number, start, offset } in cycles {
            let (planned, sched) = (view.start_of(number).unwrap(), view.offset.global(view.start));
            assert!((start - planned).abs() <= Span::from_nanos(20), "roundings only");
            let sched = sched + CYCLE * i64::from(number - 100);
            assert!((offset.global(start) - sched).abs() <= Span::from_nanos(20));
        }
    }
    stop.store(true, Ordering::Relaxed);
    keeper.join().unwrap();
}

#[test]
fn who_waits_while_cycles_are_bridged_wakes_in_each_with_its_number() {
    let (mut publisher, view) = station();
    // So many may be bridged that the line is not too old for a long time, however busy the machine.
    let told = TimeView { holdover: u16::MAX, ..view };
    publisher.publish(&told);
    let board = publisher.board();
    let mut waiter = board.waiter();
    let mut wait = |before: u32| {
        let begun = board.now();
        let Cycle { number, start, offset } = waiter.wait_cycle(PATIENCE).unwrap();
        assert!(number > before && start == view.start_of(number).unwrap(), "{number} after {before}");
        assert!(begun <= start && start <= board.now(), "it began while it was waited for");
        let sched = view.offset.global(view.start) + CYCLE * i64::from(number - view.cycle);
        assert!((offset.global(start) - sched).abs() <= Span::from_nanos(20), "as if it had been told of");
        number
    };
    // No Synchronisation comes after that of cycle 100: first the station does not know it yet, then it does.
    let first = wait(view.cycle);
    publisher.publish(&TimeView { state: SyncState::Holdover, ..told });
    let second = wait(first);
    wait(second);
    publisher.publish(&TimeView { state: SyncState::Lost, ..told });
    let lost = board.waiter().wait_cycle(PATIENCE);
    assert_eq!(lost, Err(WaitError::NotSynchronised(SyncState::Lost)), "one more is a loss");
}

#[test]
fn a_moment_within_the_cycle_can_be_waited_for() {
    let (publisher, view) = station();
    let board = publisher.board();
    let (stop, keeper) = kept(publisher, view);
    let mut waiter = board.waiter();
    let slot = Span::from_micros(1_500);
    let begun = waiter.wait_cycle(PATIENCE).unwrap();
    let later = waiter.wait_slot(slot, PATIENCE).unwrap();
    assert!(later.start + slot <= board.now());
    assert!(later.number >= begun.number && waiter.wait_slot(slot, PATIENCE).unwrap().number > later.number);
    stop.store(true, Ordering::Relaxed);
    keeper.join().unwrap();
}

#[test]
fn a_cycle_that_takes_longer_than_one_waits_is_timed_out() {
    let (mut publisher, view) = station();
    publisher.publish(&TimeView { period: Some(Span::from_millis(100_000)), ..view });
    let begun = monotonic();
    let timeout = Duration::from_millis(30);
    assert_eq!(publisher.board().waiter().wait_cycle(timeout), Err(WaitError::TimedOut(timeout)));
    let waited = Duration::from_nanos(monotonic() - begun);
    assert!(timeout <= waited && waited < SOON, "{waited:?}");
    let at_once = publisher.board().waiter().wait_cycle(Duration::ZERO);
    assert_eq!(at_once, Err(WaitError::TimedOut(Duration::ZERO)));
}

#[test]
fn who_waits_for_sync_that_does_not_come_is_told_in_time() {
    let (publisher, _) = station();
    let waiter = publisher.board().waiter();
    let begun = monotonic();
    let timeout = Duration::from_millis(30);
    let refused = waiter.wait_synchronised(timeout).unwrap_err();
    assert_eq!(refused, WaitError::NotSynchronised(SyncState::Waiting));
    assert!(refused.to_string().contains("not synchronised (waiting)"), "{refused}");
    let waited = Duration::from_nanos(monotonic() - begun);
    assert!(timeout <= waited && waited < SOON, "{waited:?}");
}

/// Waits until a thread of this process waits for something.
pub fn until_asleep(thread: nix::unistd::Pid) {
    let (stat, deadline) =
        (format!("/proc/self/task/{thread}/stat"), monotonic() + PATIENCE.as_nanos() as u64);
    // Its state is behind its name: proc(5).
    let is_asleep = |stat: String| stat.rsplit(") ").next().is_some_and(|rest| rest.starts_with('S'));
    while !std::fs::read_to_string(&stat).is_ok_and(is_asleep) {
        assert!(monotonic() < deadline, "it never waits");
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Lets somebody wait for a cycle that is far away, and does `meanwhile`; what became of it.
fn disturbed(meanwhile: impl FnOnce(TimePublisher, TimeView)) -> Result<Cycle, WaitError> {
    let (mut publisher, view) = station();
    let long = TimeView { period: Some(Span::from_millis(100_000)), ..view };
    publisher.publish(&long);
    let board = publisher.board();
    let (told, waits) = std::sync::mpsc::channel();
    let waiter = std::thread::spawn(move || {
        told.send(nix::unistd::gettid()).unwrap();
        board.waiter().wait_cycle(PATIENCE)
    });
    until_asleep(waits.recv().unwrap());
    meanwhile(publisher, long);
    let begun = monotonic();
    let outcome = waiter.join().unwrap();
    assert!(Duration::from_nanos(monotonic() - begun) < SOON, "noticed soon");
    outcome
}

#[test]
fn who_waits_while_sync_is_lost_is_told() {
    let mut kept = None;
    let outcome = disturbed(|mut publisher, view| {
        publisher.publish(&TimeView { state: SyncState::Lost, ..view });
        kept = Some(publisher);
    });
    assert_eq!(outcome, Err(WaitError::NotSynchronised(SyncState::Lost)));
}

#[test]
fn who_waits_while_the_station_ends_is_told() {
    assert_eq!(disturbed(|publisher, _| drop(publisher)), Err(WaitError::Ended));
    let (publisher, _) = station();
    let waiter = publisher.board().waiter();
    drop(publisher);
    assert_eq!(waiter.wait_synchronised(PATIENCE), Err(WaitError::Ended));
}

#[test]
fn who_waits_while_the_line_moves_wakes_by_the_new_one() {
    let mut kept = None;
    let outcome = disturbed(|mut publisher, view| {
        // The first cycle by it that has begun since the wait did.
        let start = publisher.board().now() + CYCLE;
        let moved = TimeView { cycle: 7_000, start, ..view };
        publisher.publish(&moved);
        kept = Some(publisher);
    });
    assert!(matches!(outcome, Ok(Cycle { number: 7_000, .. })), "{outcome:?}");
}

/// What becomes of somebody who waits while the station's clock is set, by so much, and the station follows the master by
/// that: cycle 7000 begins in a moment, and another 100 s later.
fn while_the_clock_is_set(by: Span) -> Result<Cycle, WaitError> {
    let mut kept = None;
    disturbed(|mut publisher, view| {
        let board = publisher.board();
        publisher.set_clock(board.clock().stepped(by));
        publisher.publish(&TimeView { cycle: 7_000, start: board.now() + CYCLE, ..view });
        kept = Some(publisher);
    })
}

#[test]
fn who_waits_while_the_clock_is_set_back_does_not_wait_until_it_shows_that_time_again() {
    let outcome = while_the_clock_is_set(Span::from_millis(-250_000));
    assert!(matches!(outcome, Ok(Cycle { number: 7_000, .. })), "{outcome:?}");
}

#[test]
fn who_waits_while_the_clock_is_set_ahead_is_not_told_of_a_cycle_that_was_before() {
    let outcome = while_the_clock_is_set(Span::from_millis(250_000));
    assert!(matches!(outcome, Ok(Cycle { number: 7_000, .. })), "{outcome:?}");
}
