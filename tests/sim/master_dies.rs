//! The Synchronisations stop, and come back.

use rtnet::discipline::{EventKind, SyncState};
use tests::networks::{Lab, Plan};

fn running() -> Lab {
    let mut lab = Plan::lab(4).with_drift(|_| 0).build();
    lab.run_until_locked();
    lab.judge_from_here();
    lab
}

fn slaves() -> std::ops::Range<usize> {
    1..4
}

#[test]
fn one_missing_sync_is_bridged_and_told_of() {
    let mut lab = running();
    lab.network.medium_mut().lose_control_ppm = 1_000_000;
    lab.run_cycles(1);
    lab.network.medium_mut().lose_control_ppm = 0;
    lab.run_cycles(99);
    assert_eq!(lab.judge().data, [100; 4], "nobody missed a slot");
    for id in slaves() {
        assert_eq!(lab.cycles_with(id, EventKind::Holdover).len(), 1);
        assert!(lab.cycles_with(id, EventKind::SyncLost).is_empty());
        assert_eq!(lab.state(id), SyncState::Locked);
    }
}

#[test]
fn after_the_bridged_cycle_there_is_silence() {
    let mut lab = running();
    lab.run_cycles(10);
    lab.network.stop(0);
    lab.run_cycles(1_000);
    let last = lab.judge().syncs as u32;
    for id in slaves() {
        assert_eq!(lab.judge().data[id], 11, "ten cycles and the bridged one");
        assert_eq!(lab.state(id), SyncState::Lost);
        let lost = lab.cycles_with(id, EventKind::SyncLost);
        let held = lab.cycles_with(id, EventKind::Holdover);
        assert_eq!((lost.len(), held.len()), (1, 1));
        assert_eq!(lost[0], held[0] + 1);
    }
    assert_eq!(last, 10);
    assert!(lab.judge().overlaps.is_empty() && lab.judge().out_of_slot.is_empty());
}

#[test]
fn syncs_that_come_back_on_the_same_line_lock_everybody_again() {
    let mut lab = running();
    lab.network.medium_mut().lose_control_ppm = 1_000_000;
    lab.run_cycles(50);
    assert!(slaves().all(|id| lab.state(id) == SyncState::Lost));
    lab.network.medium_mut().lose_control_ppm = 0;
    lab.run_cycles(50);
    for id in slaves() {
        assert_eq!(lab.state(id), SyncState::Locked);
        let sent = lab.judge().data[id];
        assert!((50..=52).contains(&sent), "silent while lost, there from then on: {sent}");
    }
    assert!(lab.judge().overlaps.is_empty() && lab.judge().out_of_slot.is_empty());
    assert_eq!(lab.judge().slot_error.max.nanos(), 0);
}

#[test]
fn a_restarted_master_with_a_new_line_is_followed() {
    let mut lab = running();
    lab.network.stop(0);
    lab.run_cycles(20);
    assert!(slaves().all(|id| lab.state(id) == SyncState::Lost));
    let now = lab.network.now();
    let cycle = lab.plan.cycle();
    lab.add(0, Some(cycle), now + 123_456);
    lab.run_cycles(10);
    for id in slaves() {
        assert_eq!(lab.state(id), SyncState::Locked);
        assert_eq!(lab.cycles_with(id, EventKind::TimeStep).len(), 1, "the line has moved");
    }
    lab.judge_from_here();
    lab.run_cycles(100);
    assert_eq!(lab.judge().data, [100; 4]);
    assert_eq!(lab.judge().slot_error.max.nanos(), 0);
}
