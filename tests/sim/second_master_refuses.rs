//! Somebody starts another master.

use rtnet::discipline::{EventKind, SyncState};
use tests::networks::Plan;

#[test]
fn it_hears_the_first_one_and_never_speaks() {
    let mut lab = Plan::lab(4).with_drift(|_| 0).build();
    lab.run_until_locked();
    lab.judge_from_here();
    let (now, cycle) = (lab.network.now(), lab.plan.cycle());
    // Another interface and clock: those of a fifth station.
    let second = {
        let fifth = Plan::lab(5).scenario.stations.remove(4);
        lab.plan.scenario.stations.push(fifth);
        lab.clocks.push(lab.clocks[1]);
        lab.add(4, Some(cycle), now + 400_000)
    };
    lab.run_cycles(1_000);
    assert_eq!(lab.status(second).yielded_to, Some(lab.plan.address(0)));
    assert_eq!(lab.state(second), SyncState::Waiting);
    assert_eq!(lab.status(second).counters.syncs_sent, 0);
    assert_eq!(lab.status(second).counters.frames_sent, 0);
    assert_eq!(lab.cycles_with(second, EventKind::OtherMaster).len(), 1, "told once");
    assert!((0..4).all(|id| lab.state(id) == SyncState::Locked));
    assert_eq!((&lab.judge().data[..4], lab.judge().faults.len()), (&[1_000; 4][..], 0));
}
