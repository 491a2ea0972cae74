//! A slave without a filter.

use super::*;

fn bench(rounds: u32) -> Bench {
    Bench::of(SlaveConfig { rounds, servo: Servo::None, ..SlaveConfig::default() })
}

fn locked() -> Bench {
    let mut bench = bench(0);
    assert_eq!(bench.hear(1, 0), Ok(Followed::Pending), "of one alone no period is known");
    assert_eq!(bench.hear(2, 0), Ok(Followed::NewLine));
    assert_eq!(bench.slave.state(), SyncState::Locked);
    bench
}

/// Start of the line's cycle less where the master's is.
fn error(bench: &Bench) -> i64 {
    let line = bench.slave.line().unwrap();
    line.start.nanos() as i64 - i64::from(line.cycle) * PERIOD as i64
}

/// The example frames of RTnet's description, with those that are missing between them.
#[test]
fn without_a_filter_a_line_is_exactly_what_the_last_synchronisation_says() {
    let mut bench = bench(1);
    let mut hear = |cycle: u32, xmit: u64, sched: u64, rx: u64| {
        let (xmit, sched) = (GlobalTime::from_nanos(xmit), GlobalTime::from_nanos(sched));
        bench.slave.on_sync(Instant::from_nanos(rx), MASTER, cycle, xmit, sched, &mut bench.events).unwrap();
    };
    hear(100, 1_000_100_003_250, 1_000_100_000_000, 600_099_924_794);
    hear(101, 1_000_101_003_000, 1_000_101_000_000, 600_100_924_544);
    let line = bench.slave.line().unwrap();
    assert_eq!((line.offset.nanos(), line.start.nanos()), (400_000_078_456, 600_100_921_544));
    let sent = 600_100_323_344;
    bench.slave.calibration_mut().begin_round();
    bench.slave.calibration_mut().sent(Instant::from_nanos(sent));
    let (reception, xmit, rx) = (1_000_100_492_000, 1_000_101_402_000, Instant::from_nanos(600_101_323_344));
    assert_eq!(bench.slave.on_reply(rx, sent, reception, xmit, &mut bench.events), Ok(true));
    assert_eq!(bench.slave.calibration().delay(), Some(Span::from_nanos(45_000)));
    let line = bench.slave.line().unwrap();
    assert_eq!(line.offset.nanos(), 400_000_123_456, "45 us more at once");
    let rx = Instant::from_nanos(600_101_924_444);
    let [xmit, sched] = [1_000_102_002_900, 1_000_102_000_000].map(GlobalTime::from_nanos);
    bench.slave.on_sync(rx, MASTER, 102, xmit, sched, &mut bench.events).unwrap();
    let line = bench.slave.line().unwrap();
    assert_eq!(
        (line.cycle, line.offset.nanos(), line.start.nanos()),
        (102, 400_000_123_456, 600_101_876_544)
    );
}

#[test]
fn without_a_filter_every_synchronisation_overwrites_the_line_however_late_it_is() {
    let mut bench = locked();
    for (cycle, late) in [(3, 15_000), (4, 249_000), (5, -50_000), (6, 999_000), (7, 0)] {
        assert_eq!(bench.hear(cycle, late), Ok(Followed::Agrees));
        assert_eq!((error(&bench), bench.slave.may_send(cycle)), (late, true), "cycle {cycle}");
    }
    assert_eq!(bench.slave.deviation(), Span::from_micros(-999));
    assert_eq!((bench.slave.drift_ppb(), bench.told()), (None, vec![(2, EventKind::Locked)]), "and no doubt");
    let [rx, far] = [8, 10].map(|cycle| cycle * PERIOD);
    let [xmit, sched] = [rx, far].map(|at| GlobalTime::from_nanos(at + AHEAD));
    let refused = bench.slave.on_sync(Instant::from_nanos(rx), MASTER, 8, xmit, sched, &mut bench.events);
    assert_eq!(refused, Err(Refusal::ImplausibleSync), "but no start is two cycles away");
}

#[test]
fn without_a_filter_numbers_may_repeat_or_go_back_and_the_period_stays() {
    let mut bench = locked();
    assert_eq!(bench.hear(2, 700), Ok(Followed::Agrees), "a repeated one");
    assert_eq!(error(&bench), 700);
    let restarted = |cycle: u32| (6_000 + u64::from(cycle)) * PERIOD + 123_456;
    assert_eq!(bench.hear_from_line(1, restarted(1), 0), Ok(Followed::NewLine), "slots begin anew");
    let line = *bench.slave.line().unwrap();
    assert_eq!((line.cycle, line.start.nanos(), line.period.nanos()), (1, restarted(1), PERIOD as i64));
    assert_eq!(bench.hear_from_line(2, restarted(2), 0), Ok(Followed::Agrees));
    // A primary that moves by more than half a cycle: no slave counts its cycles by that.
    let moved = restarted(3) + 3 * PERIOD / 4;
    assert_eq!(bench.hear_from_line(3, moved, 0), Ok(Followed::Agrees));
    assert_eq!(bench.slave.line().unwrap().start.nanos(), moved);
}

#[test]
fn without_a_filter_there_is_silence_too_without_synchronisations() {
    let mut bench = locked();
    assert!(bench.slave.may_send(3) && !bench.slave.may_send(4));
    assert_eq!(bench.wait_until(3 * PERIOD + PERIOD / 2), SyncState::Holdover);
    assert_eq!(bench.wait_until(4 * PERIOD + PERIOD / 2), SyncState::Lost);
    assert_eq!(bench.hear(5, 0), Ok(Followed::Agrees));
    assert_eq!(bench.slave.state(), SyncState::Locked);
    assert!(bench.slave.is_settled(), "it will not become clearer");
}

#[test]
fn without_a_filter_a_loss_that_ends_with_a_number_that_was_passed_over_begins_a_new_line() {
    let mut bench = locked();
    bench.wait_until(700 * PERIOD);
    assert_eq!(bench.slave.state(), SyncState::Lost);
    // The master was started anew meanwhile: its 500th cycle is where the 700th would be.
    assert_eq!(bench.hear_from_line(500, 700 * PERIOD, 0), Ok(Followed::Pending));
    assert_eq!(bench.hear_from_line(501, 701 * PERIOD, 0), Ok(Followed::NewLine), "slots begin anew");
    let line = bench.slave.line().unwrap();
    assert_eq!((line.cycle, line.period.nanos()), (501, PERIOD as i64), "not what 700 make of 500");
}

#[test]
fn without_a_filter_a_loss_that_ends_with_the_number_that_is_due_or_one_held_up_goes_on() {
    for late in [0, 999_000] {
        let mut bench = locked();
        bench.wait_until(6 * PERIOD + PERIOD / 2);
        assert_eq!(bench.slave.state(), SyncState::Lost);
        assert_eq!(bench.hear(7, late), Ok(Followed::Agrees));
    }
}
