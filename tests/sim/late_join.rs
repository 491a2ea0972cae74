//! A slave joins a network that has been running for a while.

use rtnet::discipline::SyncState;
use rtnet::time::Span;
use tests::networks::Plan;

#[test]
fn it_is_locked_after_its_calibration_and_disturbs_nobody() {
    let mut lab = Plan::lab(4).with_drift(|_| 0).build_without_slaves();
    let begin = lab.network.now();
    lab.add_next(begin + 1_000_000);
    lab.add_next(begin + 2_000_000);
    lab.run_until_locked();
    lab.run_cycles(500);
    lab.judge_from_here();

    let late = lab.add_next(lab.network.now() + 777_777);
    lab.run_cycles(50);
    assert_eq!(lab.state(late), SyncState::Calibrating);
    assert_eq!(lab.judge().data[late], 0, "no data before the calibration is over");
    lab.run_cycles(250);
    assert_eq!(lab.state(late), SyncState::Locked, "100 rounds take 200 cycles");

    lab.judge_from_here();
    lab.run_cycles(100);
    let judge = lab.judge();
    assert_eq!(judge.data, [100; 4]);
    assert_eq!((judge.slot_error.min, judge.slot_error.max), (Span::ZERO, Span::ZERO));
    assert!(judge.overlaps.is_empty() && judge.out_of_slot.is_empty() && judge.faults.is_empty());
}
