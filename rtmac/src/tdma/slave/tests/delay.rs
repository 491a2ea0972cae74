//! The delay of a way, known late, measured on busy hosts, or of a master that is gone.

use super::*;

#[test]
fn delay_known_late_holds_for_the_line_there_is() {
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

#[test]
fn slave_corrects_a_delay_measured_on_a_busy_host() {
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
fn slave_corrects_a_delay_measured_with_slow_syncs() {
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
fn slave_corrects_a_slow_way_that_gets_quicker() {
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

/// Hears syncs of these cycles, on their way for `slow`. Returns the largest error of the line in cycles that do not wait for the next
/// sync.
fn wrong_at_most(bench: &mut Bench, cycles: core::ops::Range<u32>, slow: i64) -> Span {
    let mut worst = Span::ZERO;
    for cycle in cycles {
        if bench.hear(cycle, slow + i64::from(cycle * 7_919 % 601)).unwrap() != Followed::Pending {
            let start = bench.slave.line().unwrap().start_of(cycle);
            worst = worst.max((start - Instant::from_nanos(u64::from(cycle) * PERIOD)).abs());
        }
    }
    worst
}

/// A slave of 100 rounds, one in every second cycle, while a frame for one station takes 4 us and a sync `slow`.
fn calibrated_while_slow(slow: i64) -> (Bench, u32) {
    let mut bench = Bench::new(100);
    bench.hear(1, slow).unwrap();
    for cycle in (2..400).step_by(2) {
        hear_and_calibrate(&mut bench, cycle..cycle + 1, slow, 4_000);
        bench.hear(cycle + 1, slow).unwrap();
    }
    assert_eq!(bench.slave.calibration().delay(), Some(Span::from_nanos(slow)));
    (bench, 400)
}

#[test]
fn syncs_slow_while_it_calibrated_make_no_slave_early() {
    // They are then earlier by more than the step limit, 20 us.
    for slow in (25_000..50_000).step_by(500) {
        for lasts in [0, 100, 300, 500, 1_000, 3_000, 8_000] {
            let (mut bench, from) = calibrated_while_slow(slow);
            let quick = from + lasts;
            wrong_at_most(&mut bench, from..quick, slow);
            let worst = wrong_at_most(&mut bench, quick..quick + 3_000, 4_000);
            assert!(worst <= Span::from_micros(1), "{slow} ns for {lasts} cycles more: {worst}");
            assert!(bench.slave.calibration().delay().unwrap() < Span::from_micros(5));
        }
    }
}

#[test]
fn syncs_may_get_quicker_in_several_steps() {
    let (mut bench, from) = calibrated_while_slow(48_000);
    for (i, slow) in [26_000, 4_000].into_iter().enumerate() {
        let from = from + 100 * i as u32;
        let worst = wrong_at_most(&mut bench, from..from + 100, slow);
        assert!(worst <= Span::from_micros(1), "{slow} ns: {worst}");
    }
}

#[test]
fn a_clock_set_forward_is_no_quicker_sync() {
    // No sync is quicker than a frame for one station, so 20 us is the most that it can get quicker by.
    let (mut bench, from) = calibrated_while_slow(24_000);
    let set = |cycle: u32| u64::from(cycle) * PERIOD - 30_000;
    assert_eq!(bench.hear_from_line(from, set(from), 24_000), Ok(Followed::Pending));
    assert_eq!(bench.hear_from_line(from + 1, set(from + 1), 24_000), Ok(Followed::NewLine));
    assert_eq!(bench.slave.line().unwrap().start.nanos(), set(from + 1));
    assert_eq!(bench.slave.calibration().delay(), Some(Span::from_micros(24)));
}

#[test]
fn syncs_that_get_quicker_on_another_line_are_followed() {
    let (mut bench, from) = calibrated_while_slow(33_000);
    let moved = |cycle: u32| u64::from(cycle) * PERIOD + 400_000;
    for cycle in from..from + 1_000 {
        bench.hear_from_line(cycle, moved(cycle), 33_000).unwrap();
    }
    // On this line no round tells syncs that are quicker from a clock that was set.
    let quick = from + 1_000;
    assert_eq!(bench.hear_from_line(quick, moved(quick), 8_000), Ok(Followed::Pending));
    assert_eq!(bench.hear_from_line(quick + 1, moved(quick + 1), 8_000), Ok(Followed::NewLine));
    assert_eq!(bench.slave.calibration().delay(), Some(Span::from_micros(33)));
}

#[test]
fn rounds_before_syncs_got_quicker_do_not_count() {
    let (mut bench, from) = calibrated_while_slow(28_000);
    bench.slave.calibration_mut().repeat();
    let measures = |bench: &mut Bench, cycles: core::ops::Range<u32>, slow: i64| {
        for cycle in cycles {
            let _ = bench.hear(cycle, slow);
            if bench.slave.calibration().is_measuring() {
                round_of(bench, cycle, 4_000);
            }
        }
    };
    measures(&mut bench, from..from + 90, 28_000);
    measures(&mut bench, from + 90..from + 101, 4_000);
    assert!(!bench.slave.calibration().is_measuring(), "all rounds are done");
    let worst = wrong_at_most(&mut bench, from + 101..from + 1_000, 4_000);
    assert!(worst <= Span::from_micros(1), "{worst}");
}
