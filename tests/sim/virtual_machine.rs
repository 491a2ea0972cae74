//! Hosts that wake late, lose milliseconds, and stall between the last look at the clock and the wire.

use std::collections::BTreeSet;

use rtnet::discipline::EventKind;
use rtnet::sim::Host;
use rtnet::time::Span;
use tests::judge::Author;
use tests::networks::{Lab, Plan};

fn run(host: Host, cycles: u64) -> Lab {
    let mut lab = Plan::lab(8).on(host).build();
    lab.run_until_locked();
    lab.judge_from_here();
    lab.run_cycles(cycles);
    lab
}

/// Turns in which the station itself noticed that it was held up inside `send`.
fn stalled(lab: &Lab) -> BTreeSet<Author> {
    let stalls = lab.events.iter().filter(|(_, event)| event.kind == EventKind::StalledInSend);
    stalls.map(|&(from, event)| Author { from, cycle: event.cycle }).collect()
}

#[test]
fn what_the_host_spoils_is_skipped_or_known_and_nothing_is_unexplained() {
    // A frame that is held up rarely meets another: so many are that some do.
    let lab = run(Host { stall_ppm: 500, ..Host::VIRTUAL_MACHINE }, 100_000);
    let (judge, stalled) = (lab.judge(), stalled(&lab));
    assert!(judge.slot_error.max > Span::ZERO, "the host model is on");
    assert!(!stalled.is_empty() && !judge.overlaps.is_empty(), "and has spoilt something");

    let known = |author: &Author| stalled.contains(author);
    let unexplained: Vec<_> = judge.overlaps.iter().filter(|(a, b)| !known(a) && !known(b)).collect();
    assert!(unexplained.is_empty(), "{} unexplained, such as {:?}", unexplained.len(), unexplained[0]);
    let unexplained: Vec<_> = judge.out_of_slot.iter().filter(|author| !known(author)).collect();
    assert!(unexplained.is_empty(), "{} unexplained, such as {:?}", unexplained.len(), unexplained[0]);
}

#[test]
fn syncs_stay_on_the_grid_and_are_never_made_up_for() {
    const CYCLES: u64 = 30_000;
    let lab = run(Host::VIRTUAL_MACHINE, CYCLES);
    let judge = lab.judge();
    // Numbers rise and belong to their scheduled times.
    assert!(judge.faults.is_empty(), "{:?}", judge.faults);
    let skipped = lab.cycles_with(0, EventKind::SyncSkipped).len() as u64;
    assert!(skipped > 0);
    // One more or less is at the ends of the run.
    assert!((judge.syncs + skipped).abs_diff(CYCLES) <= 4, "{} sent, {skipped} skipped", judge.syncs);
}

#[test]
fn every_slot_without_a_frame_is_an_overrun_or_was_silent_for_want_of_a_sync() {
    const CYCLES: u64 = 30_000;
    let lab = run(Host::VIRTUAL_MACHINE, CYCLES);
    let judge = lab.judge();
    for id in 0..8 {
        let of = |kind| lab.cycles_with(id, kind).len() as u64;
        let unused = of(EventKind::Overrun) + of(EventKind::SlotSilent);
        let missing = CYCLES - judge.data[id];
        assert!(missing.abs_diff(unused) <= 2, "station {id}: {missing} missing, {unused} told of");
    }
}
