mod anew;
mod delay;
mod holdover;
mod late;
mod servo;
mod settled;
mod transitions;

use super::super::mark::{MOVED_LATE, slow_at_most};
use super::super::round::Room;
use super::*;
use crate::tdma::OnMasterChange;

const MASTER: Address = Address([2, 0, 0, 0, 0, 1]);
const PERIOD: u64 = 1_000_000;
/// The master's clock is ahead of ours by this much.
const AHEAD: u64 = 5_000_000_000;

/// A slave with what it tells, fed with the Synchronisations of an exact master.
struct Bench {
    slave: Slave,
    events: Events,
}

impl Bench {
    fn new(rounds: u32) -> Self {
        Self::of(SlaveConfig { rounds, ..SlaveConfig::default() })
    }

    fn of(config: SlaveConfig) -> Self {
        Self { slave: Slave::new(config), events: Events::new() }
    }

    /// The Synchronisation of a cycle, `late` nanoseconds held up after its stamp was taken.
    fn hear(&mut self, cycle: u32, late: i64) -> Result<Followed, Refusal> {
        self.hear_from_line(cycle, u64::from(cycle) * PERIOD, late)
    }

    fn hear_from_line(&mut self, cycle: u32, at: u64, late: i64) -> Result<Followed, Refusal> {
        let sched = GlobalTime::from_nanos(at + AHEAD);
        let rx = Instant::from_nanos(at.wrapping_add_signed(late));
        self.slave.on_sync(rx, MASTER, cycle, sched, sched, &mut self.events)
    }

    fn wait_until(&mut self, at: u64) -> SyncState {
        self.slave.on_timeout(Instant::from_nanos(at), &mut self.events);
        self.slave.state()
    }

    fn told(&mut self) -> Vec<(u32, EventKind)> {
        std::iter::from_fn(|| self.events.take()).map(|event| (event.cycle, event.kind)).collect()
    }

    fn in_state(state: SyncState) -> Self {
        let mut bench = Bench::new(if state == SyncState::Calibrating { 1 } else { 0 });
        if state == SyncState::Waiting {
            return bench;
        }
        assert_eq!(bench.hear(1, 0), Ok(Followed::Pending));
        assert_eq!(bench.hear(2, 0), Ok(Followed::NewLine));
        match state {
            SyncState::Holdover => drop(bench.wait_until(3 * PERIOD + PERIOD / 2)),
            SyncState::Lost => drop(bench.wait_until(4 * PERIOD + PERIOD / 2)),
            _ => {}
        }
        assert_eq!(bench.slave.state(), state);
        bench.told();
        bench
    }
}

#[test]
fn one_missing_synchronisation_is_bridged_and_two_are_silence() {
    let mut bench = Bench::in_state(SyncState::Locked);
    assert!(bench.slave.may_send(2) && bench.slave.may_send(3) && !bench.slave.may_send(4));
    assert_eq!(bench.wait_until(3 * PERIOD + PERIOD / 2), SyncState::Holdover);
    assert_eq!(bench.wait_until(4 * PERIOD + PERIOD / 2), SyncState::Lost);
    assert_eq!(bench.told(), [(3, EventKind::Holdover), (4, EventKind::SyncLost)]);
    assert_eq!(bench.hear(5, 0), Ok(Followed::Agrees), "the line was good all the time");
    assert!(bench.slave.may_send(5));
    assert_eq!(bench.told(), [(5, EventKind::Locked)]);
}

#[test]
fn a_line_without_synchronisations_is_given_up() {
    let mut bench = Bench::in_state(SyncState::Lost);
    bench.wait_until(2_000 * PERIOD);
    assert_eq!((bench.slave.line(), bench.slave.deadline()), (None, None));
    assert_eq!(bench.hear(2_001, 0), Ok(Followed::Pending));
    assert_eq!(bench.hear(2_002, 0), Ok(Followed::NewLine));
}

#[test]
fn a_held_up_synchronisation_is_bridged_as_a_missing_one_and_moves_nothing() {
    let mut bench = Bench::in_state(SyncState::Locked);
    assert_eq!(bench.hear(3, 249_000), Ok(Followed::Pending));
    assert_eq!(bench.told(), [(3, EventKind::TimeStep)]);
    assert!(bench.slave.may_send(3) && !bench.slave.may_send(4), "one is bridged");
    assert_eq!(bench.hear(4, 0), Ok(Followed::Agrees));
    assert!(bench.slave.may_send(4));
    assert_eq!(bench.slave.line().unwrap().start.nanos(), 4 * PERIOD);
}

#[test]
fn what_is_beside_the_line_early_or_very_late_silences_its_cycle_and_moves_nothing() {
    for by in [-500_000, -50_000, 251_000, 999_000] {
        let mut bench = Bench::in_state(SyncState::Locked);
        assert_eq!(bench.hear(3, by), Ok(Followed::Pending));
        assert_eq!(bench.told(), [(3, EventKind::TimeStep)]);
        assert!(!bench.slave.may_send(3), "no hold-up explains {by}");
        assert_eq!(bench.hear(4, 0), Ok(Followed::Agrees));
        assert!(bench.slave.may_send(4));
        assert_eq!(bench.slave.line().unwrap().start.nanos(), 4 * PERIOD);
    }
}

#[test]
fn a_small_hold_up_moves_the_line_by_an_eighth_of_what_is_believed() {
    let mut bench = Bench::in_state(SyncState::Locked);
    assert_eq!(bench.hear(3, 15_000), Ok(Followed::Agrees));
    let line = bench.slave.line().unwrap();
    let error = line.start.nanos() - 3 * PERIOD;
    assert_eq!(error, PERIOD / 300 / 8 + PERIOD / 5_000);
    assert_eq!(bench.slave.deviation(), Span::from_micros(15));
    assert_eq!(bench.hear(4, 0), Ok(Followed::Agrees));
    assert_eq!(bench.slave.line().unwrap().start.nanos(), 4 * PERIOD);
}

#[test]
fn an_early_synchronisation_moves_the_line_by_a_300th_of_the_cycle_at_most() {
    let mut bench = Bench::in_state(SyncState::Locked);
    assert_eq!(bench.hear(3, -15_000), Ok(Followed::Agrees));
    let line = bench.slave.line().unwrap();
    assert_eq!(3 * PERIOD - line.start.nanos(), PERIOD / 300 + PERIOD / 5_000);
}

#[test]
fn a_master_that_moves_its_grid_is_followed_from_sync_two_on() {
    for by in [-400_000, 400_000, 200_000] {
        let mut bench = Bench::in_state(SyncState::Locked);
        let moved = |cycle: u32| (u64::from(cycle) * PERIOD).wrapping_add_signed(by);
        assert_eq!(bench.hear_from_line(3, moved(3), 0), Ok(Followed::Pending), "{by}");
        assert_eq!(bench.slave.may_send(3), by == 200_000, "{by}: one that is a little late is bridged");
        assert_eq!(bench.hear_from_line(4, moved(4), 0), Ok(Followed::NewLine), "{by}: it says so itself");
        assert_eq!(bench.slave.line().unwrap().start.nanos(), moved(4));
        assert_eq!(bench.told(), [(3, EventKind::TimeStep)], "each that is not followed");
    }
}

#[test]
fn a_sync_sent_early_shows_that_its_master_was_set_back() {
    let mut bench = Bench::in_state(SyncState::Locked);
    // The master chose the moment of cycle 3 by the clock before, which was 100 us ahead.
    let mut hear = |cycle: u32, at: u64, xmit: u64| {
        let [xmit, sched] = [xmit, u64::from(cycle) * PERIOD].map(|at| GlobalTime::from_nanos(at + AHEAD));
        bench.slave.on_sync(Instant::from_nanos(at), MASTER, cycle, xmit, sched, &mut bench.events)
    };
    assert_eq!(hear(3, 3 * PERIOD, 3 * PERIOD - 100_000), Ok(Followed::Pending));
    assert_eq!(hear(4, 4 * PERIOD + 100_000, 4 * PERIOD), Ok(Followed::NewLine), "as the one before says");
    assert_eq!(bench.slave.line().unwrap().start.nanos(), 4 * PERIOD + 100_000);
}

#[test]
fn a_synchronisation_whose_number_is_wrong_is_told_of_in_the_cycle_that_it_silences() {
    for number in [3 ^ 4, 3 ^ 1 << 9, 3 ^ 1 << 31] {
        let mut bench = Bench::in_state(SyncState::Locked);
        // It was sent as of cycle 3.
        assert_eq!(bench.hear_from_line(number, 3 * PERIOD, 700), Ok(Followed::Pending));
        assert_eq!(bench.told(), [(3, EventKind::TimeStep)], "{number}");
        assert!(!bench.slave.may_send(3));
    }
}

#[test]
fn a_repeated_cycle_is_refused_and_silences_itself() {
    let mut bench = Bench::in_state(SyncState::Locked);
    assert_eq!(bench.hear(3, 0), Ok(Followed::Agrees));
    let sched = GlobalTime::from_nanos(4 * PERIOD + AHEAD);
    let again =
        bench.slave.on_sync(Instant::from_nanos(4 * PERIOD), MASTER, 3, sched, sched, &mut bench.events);
    assert_eq!(again, Err(Refusal::DuplicateCycle), "the number of the cycle before");
    assert!(!bench.slave.may_send(3) && bench.slave.may_send(4));
    assert_eq!(bench.told(), [(3, EventKind::DuplicateCycle)]);
}

#[test]
fn sync_on_the_line_counts_after_a_changed_copy_of_it() {
    // The medium has doubled it, and changed the stamp of the first copy.
    for by in [-500_000, -50_000, 251_000] {
        let mut bench = Bench::in_state(SyncState::Locked);
        assert_eq!(bench.hear(3, by), Ok(Followed::Pending));
        assert_eq!(bench.hear(3, 900), Ok(Followed::Agrees));
        assert_eq!(bench.told(), [(3, EventKind::TimeStep), (3, EventKind::DuplicateCycle)]);
        assert!(!bench.slave.may_send(3), "its number came twice");
        assert_eq!(bench.wait_until(4 * PERIOD + PERIOD / 2), SyncState::Holdover);
        assert!(bench.slave.may_send(4), "the next one is lost, and bridged");
    }
}

#[test]
fn a_synchronisation_that_the_medium_doubles_is_refused_and_silences_nothing() {
    let mut bench = Bench::in_state(SyncState::Locked);
    assert_eq!(bench.hear(3, 0), Ok(Followed::Agrees));
    for late in [900, 700_000] {
        assert_eq!(bench.hear(3, late), Err(Refusal::DuplicateCycle));
        assert!(bench.slave.may_send(3), "{late} ns later");
    }
}

#[test]
fn what_a_master_that_was_set_back_says_of_the_lines_last_cycle_is_no_copy_of_it() {
    let mut bench = Bench::in_state(SyncState::Locked);
    bench.hear(5, 0).unwrap();
    let set_back = Address([2, 0, 0, 0, 0, 7]);
    let mut hear = |cycle: u32| {
        let sched = GlobalTime::from_nanos(u64::from(cycle) * PERIOD + AHEAD);
        let rx = Instant::from_nanos(u64::from(cycle) * PERIOD + PERIOD * 4 / 3);
        bench.slave.on_sync(rx, set_back, cycle, sched, sched, &mut bench.events)
    };
    assert_eq!((hear(4), hear(5)), (Ok(Followed::Late), Err(Refusal::DuplicateCycle)));
    assert!(!bench.slave.may_send(5), "a copy would come from who was followed");
}

#[test]
fn a_backup_that_has_not_heard_its_master_says_the_same_and_silences_nothing() {
    let backup = Address([2, 0, 0, 0, 0, 7]);
    let repeated = |xmit_late: i64, sched_off: i64| {
        let mut bench = Bench::in_state(SyncState::Locked);
        bench.hear(3, 0).unwrap();
        let (sched, late) = (3 * PERIOD + AHEAD, Span::from_nanos(xmit_late));
        let sched = GlobalTime::from_nanos(sched) + Span::from_nanos(sched_off);
        let rx = Instant::from_nanos(3 * PERIOD) + late;
        let refused = bench.slave.on_sync(rx, backup, 3, sched + late, sched, &mut bench.events);
        assert_eq!(refused, Err(Refusal::DuplicateCycle));
        assert_eq!(bench.slave.line().unwrap().start.nanos(), 3 * PERIOD, "nothing moves");
        bench.slave.may_send(3)
    };
    assert!(repeated(200_000, 0));
    assert!(!repeated(200_000, 1_000), "of another grid");
}

#[test]
fn a_restarted_master_with_small_numbers_is_followed() {
    let mut bench = Bench::new(0);
    for cycle in 5_000..5_003 {
        bench.hear(cycle, 0).unwrap();
    }
    let restarted = |cycle: u32| (6_000 + u64::from(cycle)) * PERIOD + 123_456;
    assert_eq!(bench.hear_from_line(1, restarted(1), 0), Ok(Followed::Pending));
    assert!((1..5_004).all(|cycle| !bench.slave.may_send(cycle)), "that was not held up");
    assert_eq!(bench.hear_from_line(2, restarted(2), 0), Ok(Followed::NewLine));
    assert!(bench.slave.may_send(2));
}

#[test]
fn times_that_cannot_be_meant_are_refused() {
    let mut bench = Bench::in_state(SyncState::Locked);
    let (rx, sched) = (Instant::from_nanos(3 * PERIOD), GlobalTime::from_nanos(3 * PERIOD + AHEAD));
    let far = GlobalTime::from_nanos(sched.nanos().wrapping_add(u64::MAX / 2));
    let result = bench.slave.on_sync(rx, MASTER, 3, sched, far, &mut bench.events);
    assert_eq!(result, Err(Refusal::ImplausibleSync));
    assert_eq!(bench.slave.line().unwrap().cycle, 2);
}

/// Feeds Synchronisations in time.
fn hear_all(bench: &mut Bench, cycles: core::ops::Range<u32>) {
    for cycle in cycles {
        assert_eq!(bench.hear(cycle, 0), Ok(Followed::Agrees), "cycle {cycle}");
    }
}

/// Feeds Synchronisations that are `late`, and replies until the delay is known; other frames take `way` nanoseconds.
fn hear_and_calibrate(bench: &mut Bench, cycles: core::ops::Range<u32>, late: i64, way: u64) {
    for cycle in cycles {
        bench.hear(cycle, late).unwrap();
        if bench.slave.calibration().delay().is_none() {
            round_of(bench, cycle, way);
        }
    }
}

/// A request in a cycle, and its reply; each takes `way` nanoseconds.
fn round_of(bench: &mut Bench, cycle: u32, way: u64) {
    bench.slave.calibration_mut().begin_round();
    let sent = u64::from(cycle) * PERIOD + 100_000;
    bench.slave.calibration_mut().sent(Instant::from_nanos(sent));
    let [there, back] = [way, way + 200].map(|after| sent + after + AHEAD);
    let rx = Instant::from_nanos(sent + 2 * way + 200);
    bench.slave.on_reply(rx, sent, there, back, &mut bench.events).unwrap();
}

#[test]
fn a_line_that_has_lasted_is_left_as_soon_as_a_new_one() {
    let mut bench = Bench::in_state(SyncState::Locked);
    hear_all(&mut bench, 3..1_000);
    let moved = |cycle: u32| u64::from(cycle) * PERIOD + 400_000;
    assert_eq!(bench.hear_from_line(1_000, moved(1_000), 0), Ok(Followed::Pending));
    assert_eq!(bench.hear_from_line(1_001, moved(1_001), 0), Ok(Followed::NewLine));
    for cycle in 1_002..1_010 {
        assert_eq!(bench.hear_from_line(cycle, moved(cycle), 0), Ok(Followed::Agrees));
        assert_eq!(bench.slave.line().unwrap().start.nanos(), moved(cycle));
    }
    assert_eq!(bench.slave.drift_ppb(), None, "that was of the old one");
}

#[test]
fn a_sync_that_comes_at_the_end_of_its_window_after_a_missing_one_is_no_loss() {
    let mut bench = Bench::in_state(SyncState::Locked);
    assert_eq!(bench.wait_until(4 * PERIOD + PERIOD / 8 - 1), SyncState::Holdover);
    assert_eq!(bench.hear(4, 0), Ok(Followed::Agrees));
    assert_eq!(bench.told(), [(3, EventKind::Holdover)]);
}

#[test]
fn of_the_first_two_synchronisations_the_one_that_was_held_up_less_counts() {
    for (first, second) in [(0, 19_000), (19_000, 0)] {
        let mut bench = Bench::new(0);
        assert_eq!(bench.hear(1, first), Ok(Followed::Pending));
        assert_eq!(bench.hear(2, second), Ok(Followed::NewLine));
        assert_eq!(bench.slave.line().unwrap().start.nanos(), 2 * PERIOD, "{first} {second}");
    }
}

#[test]
fn a_slave_has_settled_once_its_line_is_long_enough() {
    let mut bench = Bench::in_state(SyncState::Locked);
    hear_all(&mut bench, 3..3 + 16 * 64);
    assert!(bench.slave.drift_ppb().is_some() && !bench.slave.is_settled());
    hear_all(&mut bench, 3 + 16 * 64..3 + 17 * 64);
    assert!(bench.slave.is_settled(), "it is surer than 2 ppm after a second");

    let (mut long, cycle) = (Bench::new(0), 32 * PERIOD);
    // Two for a line, and eight windows of two seconds.
    let needed = 2 + 8 * 62;
    for number in 1..=needed {
        assert!(!long.slave.is_settled(), "{number}");
        long.hear_from_line(number, u64::from(number) * cycle, 0).unwrap();
    }
    assert!(long.slave.is_settled());
    assert_eq!(long.wait_until((u64::from(needed) + 3) * cycle), SyncState::Lost);
    assert!(!long.slave.is_settled());
}

#[test]
fn another_master_has_another_drift() {
    let mut bench = Bench::in_state(SyncState::Locked);
    hear_all(&mut bench, 3..1_000);
    assert_eq!(bench.slave.drift_ppb(), Some(0));
    let backup = Address([2, 0, 0, 0, 0, 7]);
    bench.hear(1_000, 0).unwrap();
    let sched = |cycle: u32| GlobalTime::from_nanos(u64::from(cycle) * PERIOD + AHEAD);
    let rx = Instant::from_nanos(1_001 * PERIOD);
    bench.slave.on_sync(rx, backup, 1_001, sched(1_001), sched(1_001), &mut bench.events).unwrap();
    assert_eq!(bench.slave.drift_ppb(), None);
}

#[test]
fn another_master_is_noticed_even_if_its_first_synchronisation_is_late() {
    let mut bench = Bench::in_state(SyncState::Locked);
    hear_all(&mut bench, 3..1_000);
    let backup = Address([2, 0, 0, 0, 0, 7]);
    for (cycle, late) in [(1_000, 90_000), (1_001, 0)] {
        let sched = GlobalTime::from_nanos(u64::from(cycle) * PERIOD + AHEAD);
        let rx = Instant::from_nanos(u64::from(cycle) * PERIOD + late);
        bench.slave.on_sync(rx, backup, cycle, sched, sched, &mut bench.events).unwrap();
    }
    assert_eq!(bench.slave.drift_ppb(), None);
}
