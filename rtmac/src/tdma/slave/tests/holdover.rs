//! How long a slave goes on without Synchronisations, and how far off it may be then.

use super::*;
use crate::tdma::MAX_HOLDOVER;

fn locked(holdover: u32, rounds: u32) -> Bench {
    let mut bench = Bench::of(SlaveConfig { rounds, holdover, ..SlaveConfig::default() });
    bench.hear(1, 0).unwrap();
    bench.hear(2, 0).unwrap();
    bench
}

/// So long after cycle 2, and half a cycle.
fn later(cycles: u32) -> u64 {
    (2 + u64::from(cycles)) * PERIOD + PERIOD / 2
}

#[test]
fn as_many_missing_synchronisations_as_configured_are_bridged_and_one_more_is_a_loss() {
    for holdover in [0, 1, 2, 20, MAX_HOLDOVER] {
        let mut bench = locked(holdover, 0);
        bench.told();
        assert!(bench.slave.may_send(2 + holdover) && !bench.slave.may_send(3 + holdover), "{holdover}");
        for missing in 1..=holdover {
            assert_eq!(bench.wait_until(later(missing)), SyncState::Holdover, "{missing} of {holdover}");
            assert_eq!(bench.slave.missing(), missing);
        }
        assert_eq!(bench.wait_until(later(holdover + 1)), SyncState::Lost, "{holdover}");
        let mut expected = vec![(3 + holdover, EventKind::SyncLost)];
        if holdover > 0 {
            expected.insert(0, (3, EventKind::Holdover));
        }
        assert_eq!(bench.told(), expected, "each is told of once");
        assert_eq!(bench.hear(3 + holdover, 0), Ok(Followed::Agrees), "the line was good all the time");
    }
}

#[test]
fn who_bridges_wakes_for_each_cycle_and_who_does_not_for_the_first() {
    for (holdover, first) in [(0, 1), (1, 2), (20, 2)] {
        let mut bench = locked(holdover, 0);
        let grace = PERIOD / 8;
        for wakes in first..first + 3 {
            let deadline = bench.slave.deadline().unwrap().nanos();
            assert_eq!(deadline, (2 + wakes) * PERIOD + grace, "{holdover}");
            bench.wait_until(deadline);
        }
    }
}

#[test]
fn a_longer_holdover_than_a_line_lasts_is_refused() {
    let check =
        |holdover| SlaveConfig { holdover, ..SlaveConfig::default() }.check().map_err(|e| e.to_string());
    assert_eq!(check(MAX_HOLDOVER), Ok(()));
    assert!(check(MAX_HOLDOVER + 1).unwrap_err().contains("holdover of 1000 cycles: at most 999"));
}

#[test]
fn what_may_be_off_grows_by_200_ppm_while_no_rate_is_known() {
    let mut bench = locked(20, 1);
    hear_and_calibrate(&mut bench, 3..100, 700, 700);
    let at = |cycle: u64| Instant::from_nanos(cycle * PERIOD);
    let bound = |cycle| bench.slave.error_bound(at(cycle)).unwrap().nanos();
    // 700 ns for the way, and of the 20 us of a time step what 97 Synchronisations have left.
    assert!((700..800).contains(&bound(99)), "{}", bound(99));
    assert_eq!(bound(119) - bound(99), 20 * PERIOD as i64 / 5_000);
}

#[test]
fn what_may_be_off_grows_less_once_the_rate_is_known() {
    let mut bench = locked(MAX_HOLDOVER, 1);
    hear_and_calibrate(&mut bench, 3..3 + 17 * 64, 0, 0);
    assert!(bench.slave.is_settled());
    let at = |cycle: u64| Instant::from_nanos(cycle * PERIOD);
    let [now, later] = [1_090, 2_090].map(|cycle| bench.slave.error_bound(at(cycle)).unwrap());
    assert!(later > now && later < Span::from_micros(5), "{now} .. {later} after a second");
}

#[test]
fn who_has_measured_no_delay_says_nothing_of_how_far_it_is_off() {
    assert_eq!(locked(1, 0).slave.error_bound(Instant::from_nanos(3 * PERIOD)), None);
    assert_eq!(Bench::new(1).slave.error_bound(Instant::default()), None, "nor who follows nobody");
}
