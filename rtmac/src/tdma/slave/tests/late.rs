//! Syncs that come late, one or many in a row.

use super::*;

#[test]
fn a_way_that_has_become_longer_is_believed_in_time() {
    let mut bench = Bench::in_state(SyncState::Locked);
    for cycle in 3..60 {
        assert_eq!(bench.hear(cycle, 10_000), Ok(Followed::Agrees));
    }
    assert_eq!(bench.slave.line().unwrap().start.nanos() - 59 * PERIOD, 10_000);
}

/// Lateness in nanoseconds, below and above a quarter of the cycle, and the number in a row that makes a new line.
const ROWS: [(i64, u32); 6] = [
    // In 63 cycles the step limit of 20 us grows by the clocks' largest drift to 32.6 us.
    (33_000, 64),
    (91_000, 64),
    (251_000, MOVED_LATE),
    (700_000, MOVED_LATE),
    (2_500_000, MOVED_LATE),
    (5_500_000, MOVED_LATE),
];

#[test]
fn late_syncs_in_a_row_move_nothing_before_the_last() {
    assert_eq!(slow_at_most(Span::from_nanos(PERIOD as i64)), 64);
    for (late, takes) in ROWS {
        let mut bench = Bench::in_state(SyncState::Locked);
        let last = 2 + takes;
        for cycle in 3..last {
            let followed = bench.hear(cycle, late + i64::from(cycle % 3) * 300);
            assert_eq!(followed, Ok(Followed::Pending), "cycle {cycle}, {late} ns late");
            assert_eq!(bench.slave.line().unwrap().start.nanos(), 2 * PERIOD);
            assert!(!bench.slave.may_send(cycle) || cycle == 3, "only one is bridged");
        }
        assert_eq!(bench.hear(last, late), Ok(Followed::NewLine), "its clock was set");
        assert_eq!(bench.slave.line().unwrap().start.nanos(), u64::from(last) * PERIOD + late as u64);
    }
}

#[test]
fn eight_late_syncs_of_another_master_are_its_line() {
    let mut bench = Bench::in_state(SyncState::Locked);
    let another = Address([2, 0, 0, 0, 0, 7]);
    let last = 2 + MOVED_LATE;
    for cycle in 3..=last {
        let at = u64::from(cycle) * PERIOD;
        let sched = GlobalTime::from_nanos(at + AHEAD);
        let rx = Instant::from_nanos(at + 91_000);
        let followed = bench.slave.on_sync(rx, another, cycle, sched, sched, &mut bench.events);
        let expected = if cycle == last { Followed::NewLine } else { Followed::Pending };
        assert_eq!(followed, Ok(expected), "cycle {cycle}");
    }
}

#[test]
fn a_slave_with_a_line_keeps_it_while_a_host_is_slow() {
    for late in [33_000, 45_000, 150_000, 249_000] {
        let mut bench = Bench::in_state(SyncState::Locked);
        let slow = 9 * 64..9 * 64 + 60;
        for cycle in 3..slow.start {
            assert_eq!(bench.hear(cycle, i64::from(cycle % 3) * 300), Ok(Followed::Agrees));
        }
        assert!(bench.slave.envelope().start_of(slow.start).is_some());
        for cycle in slow.clone() {
            bench.wait_until(u64::from(cycle) * PERIOD);
            assert_eq!(bench.hear(cycle, late), Ok(Followed::Pending), "cycle {cycle}, {late} ns late");
        }
        assert_eq!(bench.slave.state(), SyncState::Lost, "none of these says where the line is");
        assert_eq!(bench.hear(slow.end, 0), Ok(Followed::Agrees), "on time again");
        assert!(bench.slave.may_send(slow.end));
        let error = bench.slave.line().unwrap().start - Instant::from_nanos(u64::from(slow.end) * PERIOD);
        assert!(error.abs() < Span::from_micros(1), "{late} ns late: {error}");
    }
}

#[test]
fn late_syncs_of_a_jittery_host_are_another_line_all_the_same() {
    for seed in 1..=50u64 {
        let mut state = seed;
        let mut jitter = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as i64 % 10_000
        };
        let mut bench = Bench::in_state(SyncState::Locked);
        for cycle in 3..2 + MOVED_LATE {
            assert_eq!(
                bench.hear(cycle, 400_000 + jitter()),
                Ok(Followed::Pending),
                "seed {seed}, cycle {cycle}"
            );
        }
        assert_eq!(bench.hear(2 + MOVED_LATE, 400_000 + jitter()), Ok(Followed::NewLine), "seed {seed}");
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
fn overtaken_syncs_never_make_another_line() {
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
