//! Ours and the independent station with the habits of real ones, in one network.

use rtnet::discipline::SyncState;
use rtnet::time::Span;
use tests::judge::Author;
use tests::networks::{Lab, Plan};

/// Clocks that run alike, and ten rounds of calibration.
fn plan() -> Plan {
    Plan::lab(4).with_drift(|_| 0).with_rounds(10)
}

fn check_a_thousand_cycles(lab: &mut Lab) {
    lab.judge_from_here();
    lab.run_cycles(1_000);
    let judge = lab.judge();
    assert_eq!((judge.syncs, &judge.data[..]), (1_000, &[1_000; 4][..]));
    assert_eq!((judge.slot_error.min, judge.slot_error.max), (Span::ZERO, Span::ZERO));
    assert_eq!((judge.overlaps.len(), judge.out_of_slot.len()), (0, 0));
    assert!(judge.faults.is_empty(), "{:?}", judge.faults);
    assert!(lab.tallies.iter().all(|tally| tally.received() >= 990), "all hear their neighbours");
}

#[test]
fn peers_join_our_master_and_keep_their_slots() {
    let mut lab = Plan { peers: vec![1, 3], ..plan() }.build();
    lab.run_until_locked();
    for id in [1, 3] {
        let status = lab.peer_status(id);
        assert_eq!(status.delay, Some(lab.plan.medium.propagation), "exact on an ideal host");
        assert_eq!(status.requests_sent, 10, "one a round, none repeated");
    }
    assert_eq!(lab.status(0).counters.replies_sent, 3 * 10);
    assert_eq!(lab.network.member(0).station.refusals().total(), 0);
    check_a_thousand_cycles(&mut lab);
}

#[test]
fn our_slaves_join_a_peer_that_is_the_master() {
    let mut lab = Plan { peers: vec![0], ..plan() }.build();
    lab.run_until_locked();
    for id in 1..4 {
        assert_eq!(lab.status(id).delay, Some(lab.plan.medium.propagation), "exact on an ideal host");
        assert_eq!(lab.network.member(id).station.refusals().total(), 0);
    }
    let status = lab.peer_status(0);
    assert_eq!((status.replies_sent, status.replies_discarded), (3 * 10, 0));
    check_a_thousand_cycles(&mut lab);
}

#[test]
fn peers_among_themselves_are_a_network_too() {
    let mut lab = Plan { peers: vec![0, 1, 2, 3], ..plan() }.build();
    lab.run_until_locked();
    check_a_thousand_cycles(&mut lab);
}

#[test]
fn our_slave_repeats_a_request_that_the_medium_lost() {
    let plan = Plan { peers: vec![0, 1], ..plan() };
    let medium = rtnet::sim::Medium { lose_control_ppm: 100_000, ..plan.medium };
    let mut lab = Plan { medium, ..plan }.with_rounds(100).build();
    lab.run_cycles(2_000);
    for id in [2, 3] {
        assert_ne!(lab.state(id), SyncState::Calibrating, "ours is through");
        assert!(lab.status(id).calibration_repeats > 0);
    }
    let hung = lab.peer_status(1);
    assert_eq!(lab.state(1), SyncState::Calibrating, "a real station's call hangs");
    assert!(hung.requests_sent < 100 && hung.frames_sent == 0);
}

#[test]
fn a_late_peer_sends_all_the_same_and_the_judge_sees_it() {
    let mut lab = Plan {
        peers: vec![1],
        host: rtnet::sim::Host {
            outage_ppm: 10_000,
            longest_outage: Span::from_millis(1),
            ..rtnet::sim::Host::IDEAL
        },
        ..plan()
    }
    .build();
    lab.run_until_locked();
    lab.judge_from_here();
    lab.run_cycles(5_000);
    let judge = lab.judge();
    let (theirs, ours): (Vec<Author>, Vec<Author>) =
        judge.out_of_slot.iter().partition(|author| author.from == 1);
    assert!(!theirs.is_empty() && ours.is_empty(), "{ours:?}");
}
