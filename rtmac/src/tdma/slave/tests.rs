mod anew;
mod holdover;
mod servo;
mod settled;
mod transitions;

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
fn a_way_that_has_become_longer_is_believed_in_time() {
    let mut bench = Bench::in_state(SyncState::Locked);
    for cycle in 3..60 {
        assert_eq!(bench.hear(cycle, 10_000), Ok(Followed::Agrees));
    }
    assert_eq!(bench.slave.line().unwrap().start.nanos() - 59 * PERIOD, 10_000);
}

#[test]
fn late_syncs_in_a_row_move_nothing_before_the_eighth() {
    // Beside the line by a little, by more than a quarter of the cycle, and by more than cycles.
    for late in [25_000, 91_000, 251_000, 700_000, 2_500_000, 5_500_000] {
        let mut bench = Bench::in_state(SyncState::Locked);
        for cycle in 3..2 + MOVED_LATE {
            let followed = bench.hear(cycle, late + i64::from(cycle % 3) * 300);
            assert_eq!(followed, Ok(Followed::Pending), "cycle {cycle}, {late} ns late");
            assert_eq!(bench.slave.line().unwrap().start.nanos(), 2 * PERIOD);
            assert!(!bench.slave.may_send(cycle) || cycle == 3, "only one is bridged");
        }
        let eighth = 2 + MOVED_LATE;
        assert_eq!(bench.hear(eighth, late), Ok(Followed::NewLine), "its clock was set");
        assert_eq!(bench.slave.line().unwrap().start.nanos(), u64::from(eighth) * PERIOD + late as u64);
    }
}

#[test]
fn one_sync_on_the_line_refutes_all_late_ones_before() {
    let mut bench = Bench::in_state(SyncState::Locked);
    for first in [3, 3 + MOVED_LATE, 3 + 2 * MOVED_LATE] {
        for cycle in first..first + MOVED_LATE - 1 {
            assert_eq!(bench.hear(cycle, 400_000), Ok(Followed::Pending));
        }
        let on_time = first + MOVED_LATE - 1;
        assert_eq!(bench.hear(on_time, 0), Ok(Followed::Agrees));
        assert_eq!(bench.slave.line().unwrap().start.nanos(), u64::from(on_time) * PERIOD);
    }
}

/// Syncs that a medium delays by `late`, of `parts` one by chance, in the order in which they come.
fn delayed(seed: u64, late: u64, parts: u64) -> Vec<(u64, u32)> {
    let mut state = seed;
    let mut arrivals: Vec<_> = (3..20_000)
        .map(|cycle| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let is_late = (state >> 33).is_multiple_of(parts);
            (u64::from(cycle) * PERIOD + if is_late { late } else { 0 }, cycle)
        })
        .collect();
    arrivals.sort_unstable();
    arrivals
}

#[test]
fn overtaken_sync_never_moves_the_time_base() {
    for seed in 1..=20 {
        for late in [150_000, 300_000, 700_000, 1_500_000, 2_500_000, 5_500_000] {
            let mut bench = Bench::in_state(SyncState::Locked);
            for (at, cycle) in delayed(seed, late, 10) {
                let (_, line) =
                    (bench.hear(cycle, (at - u64::from(cycle) * PERIOD) as i64), bench.slave.line());
                let error = line.unwrap().start_of(cycle) - Instant::from_nanos(u64::from(cycle) * PERIOD);
                assert_eq!(error, Span::ZERO, "seed {seed}, {late} ns late, cycle {cycle}");
            }
        }
    }
}

#[test]
fn a_master_that_moves_its_grid_is_followed_from_the_second_sync_on() {
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
fn a_sync_sent_before_its_cycle_shows_that_its_master_was_set_back() {
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
fn synchronisations_that_were_overtaken_are_no_other_line_however_many() {
    let mut bench = Bench::in_state(SyncState::Locked);
    for cycle in [5, 8, 11] {
        assert_eq!(bench.hear(cycle, 0), Ok(Followed::Agrees));
        for late in [cycle - 2, cycle - 1] {
            assert_eq!(bench.hear(late, 2_500_000), Ok(Followed::Late), "of cycle {late}");
        }
        assert_eq!(bench.slave.line().unwrap().start.nanos(), u64::from(cycle) * PERIOD);
        assert!(bench.slave.may_send(cycle) && bench.slave.may_send(cycle + 1));
    }
    assert!(!bench.told().iter().any(|(_, kind)| *kind == EventKind::TimeStep));
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
fn a_delay_that_becomes_known_late_holds_for_the_line_that_has_lasted() {
    let mut bench = Bench::new(1);
    bench.hear(1, 0).unwrap();
    bench.hear(2, 0).unwrap();
    hear_all(&mut bench, 3..1_000);
    bench.slave.calibration_mut().begin_round();
    let sent = 999 * PERIOD + 1_000;
    bench.slave.calibration_mut().sent(Instant::from_nanos(sent));
    // It takes 700 ns each way.
    let [there, back] = [sent + 700, sent + 900].map(|at| at + AHEAD - 700);
    let done = bench.slave.on_reply(Instant::from_nanos(sent + 1_600), sent, there, back, &mut bench.events);
    assert_eq!((done, bench.slave.calibration().delay()), (Ok(true), Some(Span::from_nanos(700))));
    hear_all(&mut bench, 1_000..1_010);
    assert_eq!(bench.slave.line().unwrap().start.nanos(), 1_009 * PERIOD - 700);
}

/// Feeds Synchronisations that are `late`, and replies until the delay is known; other frames take `way` nanoseconds.
fn hear_and_calibrate(bench: &mut Bench, cycles: core::ops::Range<u32>, late: i64, way: u64) {
    for cycle in cycles {
        bench.hear(cycle, late).unwrap();
        if bench.slave.calibration().delay().is_none() {
            bench.slave.calibration_mut().begin_round();
            let sent = u64::from(cycle) * PERIOD + 100_000;
            bench.slave.calibration_mut().sent(Instant::from_nanos(sent));
            let [there, back] = [way, way + 200].map(|after| sent + after + AHEAD);
            let rx = Instant::from_nanos(sent + 2 * way + 200);
            bench.slave.on_reply(rx, sent, there, back, &mut bench.events).unwrap();
        }
    }
}

#[test]
fn who_calibrates_while_the_host_is_busy_is_right_when_it_is_quiet_again() {
    let mut bench = Bench::new(20);
    bench.hear(1, 5_000).unwrap();
    // A frame takes 700 ns, a sync too, but for now it is 5 us late.
    hear_and_calibrate(&mut bench, 2..200, 5_000, 700);
    assert_eq!(bench.slave.calibration().delay(), Some(Span::from_micros(5)));
    assert_eq!(bench.slave.line().unwrap().start.nanos(), 199 * PERIOD);
    for cycle in 200..1_500 {
        bench.hear(cycle, 700).unwrap();
    }
    assert_eq!(bench.slave.calibration().delay(), Some(Span::from_nanos(700)));
    assert_eq!(bench.slave.line().unwrap().start.nanos(), 1_499 * PERIOD);
}

#[test]
fn who_calibrates_while_a_sync_takes_much_longer_is_right_in_the_end() {
    let mut bench = Bench::new(20);
    bench.hear(1, 20_000).unwrap();
    // A frame takes 4 us, a sync too, but for now 20 us.
    hear_and_calibrate(&mut bench, 2..700, 20_000, 4_000);
    assert_eq!(bench.slave.calibration().delay(), Some(Span::from_micros(20)));
    assert!(bench.slave.drift_ppb().is_some());
    bench.hear(700, 4_000).unwrap();
    bench.hear(701, 4_000).unwrap();
    bench.hear(702, 4_000).unwrap();
    assert_eq!(bench.slave.drift_ppb(), None, "the line begins anew");
    for cycle in 703..3_000 {
        bench.hear(cycle, 4_000).unwrap();
    }
    assert_eq!(bench.slave.calibration().delay(), Some(Span::from_micros(4)));
    assert_eq!(bench.slave.line().unwrap().start.nanos(), 2_999 * PERIOD);
}

#[test]
fn who_calibrates_for_long_enough_corrects_a_slow_way_as_soon_as_it_is_quicker_and_moves_nothing() {
    let mut bench = Bench::new(600);
    bench.hear(1, 33_000).unwrap();
    // A frame for one station takes 4 us or a little more, a sync behind many ports 33 and, from cycle 800 on, 15.
    for cycle in 2..800 {
        hear_and_calibrate(&mut bench, cycle..cycle + 1, 33_000, 4_000 + u64::from(cycle * 7_919 % 97));
    }
    let delay = |bench: &Bench| bench.slave.calibration().delay().unwrap().nanos();
    assert!((32_900..33_100).contains(&delay(&bench)), "{}", delay(&bench));
    assert!(bench.slave.is_settled(), "it has a line since calibration");
    for cycle in 800..1_000 {
        bench.hear(cycle, 15_000).unwrap();
        let error = (bench.slave.line().unwrap().start_of(cycle)
            - Instant::from_nanos(u64::from(cycle) * PERIOD))
        .abs();
        assert!(error < Span::from_micros(1), "cycle {cycle}: {error}");
    }
    assert!((14_000..16_000).contains(&delay(&bench)), "{}", delay(&bench));
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
fn rounds_of_a_master_that_is_gone_say_nothing_of_the_next() {
    let mut bench = Bench::new(1);
    let first = 100_000;
    bench.hear(first - 1, 700).unwrap();
    bench.hear(first, 700).unwrap();
    bench.slave.calibration_mut().begin_round();
    let sent = u64::from(first) * PERIOD + 100_000;
    bench.slave.calibration_mut().sent(Instant::from_nanos(sent));
    let [there, back] = [sent + 700, sent + 900].map(|at| at + AHEAD);
    bench.slave.on_reply(Instant::from_nanos(sent + 1_600), sent, there, back, &mut bench.events).unwrap();
    let delay = bench.slave.calibration().delay();
    assert_eq!(delay, Some(Span::from_nanos(700)));
    // It counts from 1, its clock is 3 us beside: as much as syncs might be late.
    let at = |cycle: u32| u64::from(first + 50 + cycle) * PERIOD;
    for cycle in 1..1_000 {
        let (rx, sched) =
            (Instant::from_nanos(at(cycle) + 700), GlobalTime::from_nanos(at(cycle) + AHEAD - 3_000));
        bench.slave.on_sync(rx, MASTER, cycle, sched, sched, &mut bench.events).unwrap();
    }
    assert_eq!((bench.slave.calibration().delay(), bench.slave.drift_ppb()), (delay, Some(0)));
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
