//! Calibration replies that cannot make the instant asked for, and stations that never ask twice.

use rtmac::tdma::TdmaCommand;
use rtmac::tdma::change::{Activation, Book};
use rtnet::discipline::{EventKind, SyncState};
use rtnet::sim::Host;
use rtnet::time::Span;
use tests::host::figure;
use tests::networks::{Lab, Plan};
use tests::seeds;

fn seeded(mut plan: Plan, seed: u64) -> Plan {
    plan.scenario.seed = seed;
    plan
}

#[test]
fn peers_get_ready_under_a_master_late_in_its_slots() {
    // One wake-up in twenty is late, mostly by more than a slot bears.
    let late = Host { outage_ppm: 50_000, longest_outage: Span::from_millis(1), ..Host::IDEAL };
    seeds::each(20, move |seed| {
        let plan = Plan { peers: vec![1, 3], ..Plan::lab(4).with_drift(|_| 0).with_rounds(100) };
        let mut lab = seeded(plan, seed).build();
        lab.network.member_mut(0).host = late.clone().into();
        // 200 cycles without a late reply; each that is late takes one or two more.
        lab.run_cycles(400);
        // Who misses a sync of its just now is locked by the next one.
        lab.network.member_mut(0).host = Host::IDEAL.into();
        lab.run_cycles(5);
        for id in 1..4 {
            assert_eq!(lab.state(id), SyncState::Locked, "station {id}");
        }
        assert_eq!(lab.peer_status(1).requests_sent, 100, "one a round");
        let judge = lab.judge();
        assert_eq!((&judge.overlaps[..], &judge.faults[..]), (&[][..], &[][..]));
        let counters = lab.status(0).counters;
        let again = lab.status(2).calibration_repeats;
        let given_up = counters.replies_given_up;
        assert!(given_up <= again, "{given_up} given up, ours asked again {again} times");
        let (late_replies, overruns) = (judge.late_replies, counters.overruns);
        let figures = format!("{late_replies} late replies, {overruns} of the master's slots missed");
        figure("late_replies", &figures);
        assert!(late_replies > 0 && overruns > 0, "it is late: {late_replies} {overruns}");
    });
}

/// A master and a slave of ours in cycles of 2 ms, and three peers that the schedule knows nothing of. They measure for ever.
fn with_asking_peers(seed: u64) -> Lab {
    let mut options = Plan::lab_options(5);
    options.cycle = Span::from_millis(2);
    let mut plan = Plan { peers: vec![2, 3, 4], changes: true, ..Plan::of(&options).with_rounds(5) };
    for &id in &plan.peers {
        plan.scenario.stations[id].rounds = u32::MAX;
    }
    let mut lab = seeded(plan, seed).build();
    lab.run_cycles(60);
    lab
}

/// Ours have the same slots in a cycle of this length, as soon as can be.
fn change_cycle(lab: &mut Lab, cycle: Span) {
    let mut scenario = lab.plan.scenario.clone();
    scenario.cycle = cycle;
    scenario.stations.truncate(2);
    let book: Book = scenario.book().unwrap();
    let before = lab.cycles_with(1, EventKind::ScheduleSwitched).len();
    lab.command(0, TdmaCommand::Propose(book, Some(Activation::Soon))).unwrap();
    // Asked for, committed, sealed and fresh: less than 200 cycles, in cycles of the first length.
    lab.run_cycles(500);
    assert_eq!(lab.cycles_with(1, EventKind::ScheduleSwitched).len(), before + 1);
    assert_eq!(lab.status(1).period, Some(cycle));
}

#[test]
fn a_switch_leaves_no_calibration_request_unanswered() {
    let lengths = [2_500, 2_000, 4_000, 1_900, 3_333, 2_000].map(Span::from_micros);
    seeds::each(4, move |seed| {
        let mut lab = with_asking_peers(seed);
        for cycle in lengths.into_iter().cycle().take(24) {
            let asked = [2, 3, 4].map(|id| lab.peer_status(id).requests_sent);
            change_cycle(&mut lab, cycle);
            for (id, before) in [2, 3, 4].into_iter().zip(asked) {
                let rounds = lab.peer_status(id).requests_sent - before;
                assert!(rounds > 100, "station {id}: {rounds} rounds, one in two cycles");
            }
        }
        let counters = lab.status(0).counters;
        // Each late one took a turn of the master's, in place of data.
        let turns = lab.cycles_with(0, EventKind::CalibrationTurn).len();
        assert_eq!((counters.replies_given_up, counters.replies_late), (0, turns as u64));
        let asked: u64 = [2, 3, 4].map(|id| lab.peer_status(id).requests_sent).iter().sum();
        let waiting = asked + lab.status(1).counters.requests_sent - counters.replies_sent;
        assert!(waiting <= 3, "of each peer one at the most: {waiting}");
        figure("replies_at_switches", &format!("{turns} late replies at 24 switches"));
        assert!(turns >= 10, "peers ask in every other cycle: {turns}");
    });
}
