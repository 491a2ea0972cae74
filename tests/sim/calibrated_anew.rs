//! The delay is measured again in a network that goes on: on demand, or since another master gives the time.

use rtmac::tdma::{Mastery, NewRounds, OnMasterChange, SlaveConfig, TdmaCommand};
use rtnet::discipline::{EventKind, SyncState};
use rtnet::sim::{Host, StationId};
use rtnet::time::Span;
use tests::networks::{Lab, Plan};
use tools::scenario::ServoName;

const LONGER: Span = Span::from_micros(3);

fn calibrate(rounds: u32) -> TdmaCommand {
    TdmaCommand::Calibrate(NewRounds::of(rounds).expect("so many can be"))
}

fn running(plan: &Plan) -> Lab {
    let mut lab = plan.build();
    lab.run_until_locked();
    lab.run_cycles(1_000);
    lab.judge_from_here();
    lab
}

fn check_nothing_is_disturbed(lab: &Lab) {
    let judge = lab.judge();
    assert!(judge.overlaps.is_empty(), "{:?}", judge.overlaps);
    assert_eq!(judge.out_of_slot.first(), None, "and {} more", judge.out_of_slot.len());
    assert!(judge.faults.is_empty(), "{:?}", judge.faults);
}

#[test]
fn a_slave_measures_a_longer_way_while_it_keeps_its_slot() {
    let plan = Plan { tolerance: Span::from_nanos(200), ..Plan::lab(4) };
    let mut lab = running(&plan.with_drift(|id| 20_000 * id as i64));
    lab.network.medium_mut().propagation = LONGER;
    lab.run_cycles(100);
    assert!(lab.status(2).deviation > LONGER / 2, "Synchronisations are later than the line, which stays");
    lab.judge_from_here();
    lab.command(2, calibrate(50)).unwrap();
    for _ in 0..200 {
        lab.run_cycles(1);
        assert_eq!(lab.state(2), SyncState::Locked, "all the while");
    }
    lab.run_cycles(4);
    let status = lab.status(2);
    assert_eq!((status.calibrating, status.counters.calibration_timeouts), (None, 0));
    let delay = status.delay.expect("it has calibrated");
    assert!((delay - LONGER).abs() < Span::from_nanos(50), "{delay}");
    assert!(status.deviation.abs() < Span::from_nanos(100), "now they are on it: {}", status.deviation);
    assert!(lab.line_error(2).abs() < Span::from_nanos(100), "{}", lab.line_error(2));
    assert_eq!(lab.cycles_with(2, EventKind::CalibratedAnew).len(), 1);
    check_nothing_is_disturbed(&lab);
    let data = &lab.judge().data;
    assert!((100..=106).contains(&data[2]), "two of four turns are for data: {}", data[2]);
    assert_eq!((data[0], data[1], data[3]), (204, 204, 204), "and nobody else notices");
    assert_eq!(lab.cycles_with(2, EventKind::CalibrationTurn).len() as u64 + data[2], 204, "each is told of");
}

#[test]
fn a_line_that_was_late_all_the_while_is_right_once_the_delay_is_measured_anew() {
    let mut plan = Plan::lab(4).with_drift(|_| 0);
    plan.scenario.servo = ServoName::None;
    for servo in [ServoName::None, ServoName::Linear] {
        plan.scenario.servo = servo;
        let mut lab = running(&plan);
        lab.network.medium_mut().propagation = LONGER;
        // Until nothing is known any more of when the way was shorter.
        lab.run_cycles(40_000);
        let late = lab.line_error(2);
        assert!((late - Span::from_nanos(2_500)).abs() < Span::from_nanos(50), "{servo:?}: {late}");
        lab.command(2, calibrate(50)).unwrap();
        lab.run_cycles(204);
        assert!(lab.line_error(2).abs() < Span::from_nanos(50), "{servo:?}: {}", lab.line_error(2));
    }
}

#[test]
fn on_a_busy_host_with_lost_frames_it_gets_there_too() {
    let mut plan = Plan::lab(4).on(Host::VIRTUAL_MACHINE);
    plan.medium.lose_control_ppm = 50_000;
    let mut lab = running(&plan);
    for id in 1..4 {
        // A station that has just lost two syncs in a row refuses it.
        let is_taken = (0..100).any(|_| {
            lab.run_cycles(1);
            lab.command(id, calibrate(100)).is_ok()
        });
        assert!(is_taken, "station {id}");
    }
    lab.run_cycles(1_000);
    // A station that has just missed a sync is locked by the next ones.
    lab.network.medium_mut().lose_control_ppm = 0;
    (0..4).for_each(|id| lab.network.member_mut(id).host = Host::IDEAL.into());
    lab.run_cycles(5);
    for id in 1..4 {
        let status = lab.status(id);
        assert_eq!((status.state, status.calibrating), (SyncState::Locked, None), "station {id}");
        assert_eq!(lab.cycles_with(id, EventKind::CalibratedAnew).len(), 1);
    }
    assert!(lab.judge().faults.is_empty(), "{:?}", lab.judge().faults);
}

const BACKUP: StationId = 1;

fn with_backup(on_master_change: OnMasterChange) -> Plan {
    let plan = Plan::lab(4).with_backups(&[(BACKUP, Span::from_micros(100))]).with_drift(|_| 0);
    Plan { follow: SlaveConfig { on_master_change, ..plan.follow }, ..plan }
}

#[test]
fn a_backup_that_stands_by_measures_anew_and_takes_over_all_the_same() {
    let mut lab = running(&with_backup(OnMasterChange::Keep));
    assert_eq!(lab.status(BACKUP).mastery, Some(Mastery::StandBy));
    lab.command(BACKUP, calibrate(20)).unwrap();
    lab.run_cycles(100);
    assert_eq!(lab.cycles_with(BACKUP, EventKind::CalibratedAnew).len(), 1);
    assert_eq!(lab.status(BACKUP).mastery, Some(Mastery::StandBy));
    let refused = lab.command(0, calibrate(20)).unwrap_err();
    assert!(refused.contains("gives the time itself"), "{refused}");
    lab.command(BACKUP, calibrate(20)).unwrap();
    lab.run_cycles(10);
    lab.network.stop(0);
    lab.run_cycles(100);
    assert_eq!(lab.status(BACKUP).mastery, Some(Mastery::Active), "in the midst of it");
    check_nothing_is_disturbed(&lab);
    assert!((2..4).all(|id| lab.state(id) == SyncState::Locked));
}

#[test]
fn when_a_backup_takes_over_slaves_keep_their_delay_or_measure_it_again() {
    for (policy, again) in [(OnMasterChange::Keep, 0), (OnMasterChange::Repeat, 1)] {
        let mut lab = running(&with_backup(policy));
        let rounds = lab.plan.rounds();
        lab.network.stop(0);
        for _ in 0..500 {
            lab.run_cycles(1);
            assert!((2..4).all(|id| lab.state(id) == SyncState::Locked), "{policy:?}: all the while");
        }
        for id in 2..4 {
            assert_eq!(lab.status(id).counters.requests_sent, rounds * (1 + again), "{policy:?}");
            assert_eq!(lab.cycles_with(id, EventKind::CalibratedAnew).len() as u64, again, "{policy:?}");
        }
        assert_eq!(lab.status(BACKUP).counters.replies_sent, 2 * rounds * again, "{policy:?}");
        check_nothing_is_disturbed(&lab);
    }
}
