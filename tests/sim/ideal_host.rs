//! `lab run --stations 8 --cycle 1ms` on hosts that are never late, with clocks up to a second apart that run alike.

use rtnet::time::Span;
use tests::networks::Plan;
use tests::seeds;
use tools::scenario::Uniform;

fn plan(stations: usize) -> Plan {
    Plan::lab(stations).with_drift(|_| 0)
}

#[test]
fn every_frame_leaves_at_its_scheduled_instant_to_the_nanosecond() {
    seeds::each(5, |seed| {
        let options = Uniform { seed, ..Plan::lab_options(8) };
        let mut lab = Plan::of(&options).with_drift(|_| 0).build();
        lab.run_until_locked();
        lab.judge_from_here();
        lab.run_cycles(2_000);
        let judge = lab.judge();
        assert_eq!((judge.slot_error.min, judge.slot_error.max), (Span::ZERO, Span::ZERO));
        assert_eq!((judge.sync_error.min, judge.sync_error.max), (Span::ZERO, Span::ZERO));
        assert_eq!((judge.syncs, &judge.data[..]), (2_000, &[2_000; 8][..]), "one frame each a cycle");
        assert!(judge.faults.is_empty(), "{:?}", judge.faults);
    });
}

#[test]
fn nobody_transmits_in_anothers_slot_from_the_very_first_frame_on() {
    let mut lab = plan(8).build();
    lab.run_cycles(2_000);
    let judge = lab.judge();
    assert!(judge.calibration >= 7 * 2 * lab.plan.rounds(), "seven slaves, 100 rounds");
    assert_eq!((&judge.overlaps[..], &judge.out_of_slot[..], &judge.faults[..]), (&[][..], &[][..], &[][..]));
}

#[test]
fn the_measured_delay_is_the_propagation_to_the_nanosecond() {
    let mut lab = plan(8).build();
    lab.run_until_locked();
    for id in 1..8 {
        assert_eq!(lab.status(id).delay, Some(lab.plan.medium.propagation));
    }
}

#[test]
fn every_frame_reaches_its_neighbour() {
    let mut lab = plan(4).build();
    lab.run_until_locked();
    let before: Vec<u64> = lab.tallies.iter().map(|tally| tally.received()).collect();
    lab.run_cycles(100);
    let heard: Vec<u64> = lab.tallies.iter().zip(before).map(|(tally, n)| tally.received() - n).collect();
    // The last frame of a cycle is read at the neighbour's next turn.
    assert!(heard.iter().all(|n| (99..=101).contains(n)), "{heard:?}");
    for id in 0..4 {
        assert_eq!(lab.network.member(id).station.refusals().total(), 0);
    }
}
