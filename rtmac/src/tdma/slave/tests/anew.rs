//! Calibration that is done again, or with several masters.

use super::*;
use crate::tdma::DelayOf;

const BACKUP: Address = Address([2, 0, 0, 0, 0, 7]);

fn bench(rounds: u32, on_master_change: OnMasterChange) -> Bench {
    Bench::of(SlaveConfig { rounds, on_master_change, ..SlaveConfig::default() })
}

impl Bench {
    /// A Synchronisation in time, of either master: they agree.
    fn hear_of(&mut self, from: Address, cycle: u32, way: u64) {
        let at = u64::from(cycle) * PERIOD;
        let (rx, sched) = (Instant::from_nanos(at + way), GlobalTime::from_nanos(at + AHEAD));
        self.slave.on_sync(rx, from, cycle, sched, sched, &mut self.events).unwrap();
    }

    /// A request in this cycle and its reply, each on its way for so long.
    fn round(&mut self, cycle: u32, way: u64) -> Result<bool, Refusal> {
        assert!(self.slave.calibration_mut().begin_round());
        let sent = u64::from(cycle) * PERIOD + 100_000;
        self.slave.calibration_mut().sent(Instant::from_nanos(sent));
        let [there, back] = [sent + way, sent + way + 200].map(|at| at + AHEAD);
        let rx = Instant::from_nanos(sent + 2 * way + 200);
        self.slave.on_reply(rx, sent, there, back, &mut self.events)
    }

    fn delay(&self) -> Option<i64> {
        self.slave.calibration().delay().map(Span::nanos)
    }
}

/// Locked after two rounds, at cycle 4.
fn calibrated(on_master_change: OnMasterChange) -> Bench {
    let mut bench = bench(2, on_master_change);
    (1..=2).for_each(|cycle| bench.hear_of(MASTER, cycle, 700));
    for cycle in 3..=4 {
        bench.hear_of(MASTER, cycle, 700);
        bench.round(cycle, 700).unwrap();
    }
    assert_eq!((bench.delay(), bench.slave.state()), (Some(700), SyncState::Locked));
    bench.told();
    bench
}

#[test]
fn a_delay_that_is_measured_anew_replaces_the_old_one_after_the_last_round() {
    let mut bench = calibrated(OnMasterChange::Keep);
    assert_eq!(
        bench.slave.on_reply(Instant::default(), 0, 0, 0, &mut bench.events),
        Err(Refusal::UnexpectedReply)
    );
    // The way has become longer: cycles begin late by as much, until that is known.
    (5..60).for_each(|cycle| bench.hear_of(MASTER, cycle, 1_700));
    assert_eq!(bench.slave.line().unwrap().start.nanos(), 59 * PERIOD + 1_000);
    bench.slave.calibration_mut().measure_anew(3, &mut Room::of(3));
    for (cycle, measured) in [(60, 1), (61, 2)] {
        bench.hear_of(MASTER, cycle, 1_700);
        assert_eq!(bench.round(cycle, 1_700), Ok(false));
        assert_eq!((bench.delay(), bench.slave.state()), (Some(700), SyncState::Locked));
        assert_eq!(bench.slave.calibration().progress(), Some((measured, 3)));
    }
    bench.hear_of(MASTER, 62, 1_700);
    assert_eq!(bench.round(62, 1_700), Ok(false), "its slots are aligned already");
    assert_eq!((bench.delay(), bench.slave.calibration().progress()), (Some(1_700), None));
    assert_eq!(bench.told(), [(62, EventKind::CalibratedAnew)]);
    let line = bench.slave.line().unwrap();
    assert_eq!((line.start.nanos(), line.offset.nanos()), (62 * PERIOD, AHEAD), "right at once");
    let report = bench.slave.calibration().report().unwrap();
    assert_eq!((report.rounds, report.mean.nanos()), (3, 1_700), "of the new one");
    hear_all(&mut bench, 63..64);
}

#[test]
fn a_sync_that_takes_longer_than_a_round_is_known_to_when_it_is_measured_anew_too() {
    let mut bench = bench(20, OnMasterChange::Keep);
    (1..=2).for_each(|cycle| bench.hear_of(MASTER, cycle, 5_700));
    for cycle in 3..=22 {
        bench.hear_of(MASTER, cycle, 5_700);
        bench.round(cycle, 1_700).unwrap();
    }
    assert_eq!(bench.delay(), Some(5_700));
    bench.slave.calibration_mut().repeat();
    for cycle in 23..=42 {
        bench.hear_of(MASTER, cycle, 5_700);
        bench.round(cycle, 1_700).unwrap();
    }
    assert_eq!((bench.delay(), bench.told().last().unwrap().1), (Some(5_700), EventKind::CalibratedAnew));
}

#[test]
fn a_delay_that_nobody_answers_for_stays_and_is_not_asked_for_any_more() {
    let mut bench = calibrated(OnMasterChange::Keep);
    bench.slave.calibration_mut().measure_anew(1, &mut Room::default());
    let requests = (0..100).take_while(|_| bench.slave.calibration_mut().begin_round()).count();
    assert_eq!((requests, bench.slave.calibration().is_measuring(), bench.delay()), (23, false, Some(700)));
}

#[test]
fn more_rounds_than_there_is_room_for_take_the_room_that_is_brought() {
    let mut calibration = Calibration::new(2, Servo::Linear, DelayOf::Quartile);
    let mut room = Room::of(9);
    calibration.measure_anew(9, &mut room);
    assert_eq!((calibration.progress(), room.samples.capacity()), (Some((0, 9)), 2), "the old one goes back");
    calibration.measure_anew(4, &mut room);
    assert_eq!((calibration.progress(), room.samples.capacity()), (Some((0, 4)), 2), "there is room already");
}

#[test]
fn rounds_go_on_where_masters_change_often() {
    let mut bench = bench(20, OnMasterChange::Keep);
    (1..=2).for_each(|cycle| bench.hear_of(MASTER, cycle, 700));
    let done = (3..100).position(|cycle| {
        bench.hear_of(if cycle / 5 % 2 == 0 { MASTER } else { BACKUP }, cycle, 700);
        bench.round(cycle, 700).unwrap()
    });
    assert_eq!((done, bench.delay()), (Some(19), Some(700)), "each round counts, whoever answered");
    assert_eq!(bench.slave.calibration().rate(), None, "but those of one master alone show no rate");
}

#[test]
fn a_reply_of_a_master_before_this_one_is_refused() {
    let mut bench = bench(1, OnMasterChange::Keep);
    (1..=2).for_each(|cycle| bench.hear_of(MASTER, cycle, 700));
    bench.slave.calibration_mut().begin_round();
    let sent = 2 * PERIOD + 100_000;
    bench.slave.calibration_mut().sent(Instant::from_nanos(sent));
    bench.hear_of(BACKUP, 3, 700);
    let late = Instant::from_nanos(3 * PERIOD + 100_000);
    assert_eq!(
        bench.slave.on_reply(late, sent, 0, 998_600, &mut bench.events),
        Err(Refusal::UnexpectedReply)
    );
    assert_eq!(bench.delay(), None);
}

#[test]
fn with_another_master_the_delay_is_kept_or_measured_again_as_configured() {
    let mut kept = calibrated(OnMasterChange::Keep);
    kept.hear_of(BACKUP, 5, 700);
    assert!(!kept.slave.calibration().is_measuring(), "as in RTnet");

    let mut bench = calibrated(OnMasterChange::Repeat);
    bench.hear_of(MASTER, 5, 700);
    assert!(!bench.slave.calibration().is_measuring(), "it is the same");
    bench.hear_of(BACKUP, 6, 1_200);
    assert_eq!((bench.slave.calibration().progress(), bench.delay()), (Some((0, 2)), Some(700)));
    bench.round(6, 1_200).unwrap();
    bench.hear_of(MASTER, 7, 700);
    assert_eq!(bench.slave.calibration().progress(), Some((0, 2)), "of the first again, and of it alone");
    for cycle in 8..=9 {
        bench.hear_of(MASTER, cycle, 700);
        bench.round(cycle, 700).unwrap();
    }
    assert_eq!((bench.delay(), bench.slave.state()), (Some(700), SyncState::Locked));
    assert_eq!(bench.told().last(), Some(&(9, EventKind::CalibratedAnew)));
}

#[test]
fn who_is_to_measure_each_master_counts_no_round_of_another() {
    let mut bench = bench(2, OnMasterChange::Repeat);
    (1..=2).for_each(|cycle| bench.hear_of(MASTER, cycle, 700));
    bench.round(2, 700).unwrap();
    bench.hear_of(BACKUP, 3, 900);
    assert_eq!(bench.slave.calibration().progress(), Some((0, 2)));
    for cycle in 4..=5 {
        bench.hear_of(BACKUP, cycle, 900);
        bench.round(cycle, 900).unwrap();
    }
    assert_eq!(bench.delay(), Some(900));
}
