//! A slave joins a network that has been running for a while.

use rtmac::tdma::TdmaStatus;
use rtnet::discipline::SyncState;
use rtnet::time::Span;
use tests::networks::{Lab, Plan};

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

/// Cycles until this is so of a station.
fn cycles_until(lab: &mut Lab, id: usize, is_so: fn(&TdmaStatus) -> bool) -> u64 {
    let mut next = || {
        lab.run_cycles(1);
        is_so(&lab.status(id))
    };
    (1..2_000).find(|_| next()).expect("it comes")
}

#[test]
fn a_round_takes_two_turns_of_the_slot_and_a_hundred_two_hundred_of_them() {
    for period in [1, 3] {
        let mut plan = Plan::lab(2).with_drift(|_| 0);
        plan.scenario.stations[1].slots[0].period = period;
        let mut lab = plan.build_without_slaves();
        lab.run_cycles(50);
        let late = lab.add_next(lab.network.now() + 777_777);
        cycles_until(&mut lab, late, |status| status.counters.requests_sent > 0);
        let more = cycles_until(&mut lab, late, |status| status.state == SyncState::Locked);
        assert_eq!(lab.status(late).counters.requests_sent, 100, "one for each round");
        // The first was in the first of them, the last reply in the last.
        let turns = 1 + more / u64::from(period);
        assert!((200..=210).contains(&turns), "{turns} turns of a slot of period {period}");
    }
}
