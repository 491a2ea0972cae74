//! Backups of our own: the master dies, comes back, is not heard, or is there twice.

use rtmac::tdma::Mastery;
use rtnet::discipline::{EventKind, SyncState};
use rtnet::sim::Host;
use rtnet::time::Span;
use tests::networks::{Lab, Plan};

const FIRST: usize = 1;
const SECOND: usize = 2;
const SLAVES: [usize; 2] = [3, 4];
/// How long after a cycle's start they look; all slots are later.
const LOOK: [(usize, Span); 2] = [(FIRST, Span::from_micros(100)), (SECOND, Span::from_micros(200))];
/// How far a station may be off the grid for a moment, when its master changes.
const OFF: Span = Span::from_micros(10);

fn plan() -> Plan {
    let mut options = Plan::lab_options(5);
    options.cycle = Span::from_millis(2);
    let mut plan = Plan::of(&options).on(Host::IDEAL).with_backups(&LOOK);
    plan.tolerance = OFF;
    plan
}

fn running(plan: &Plan) -> Lab {
    let mut lab = plan.build();
    lab.run_until_locked();
    lab.run_cycles(10);
    for (id, mastery) in [(0, Mastery::Active), (FIRST, Mastery::StandBy), (SECOND, Mastery::StandBy)] {
        assert_eq!(lab.status(id).mastery, Some(mastery), "station {id}");
    }
    lab.judge_from_here();
    lab
}

fn sent(lab: &Lab, id: usize) -> u64 {
    lab.status(id).counters.syncs_sent
}

/// One Synchronisation in every cycle, on one grid; nobody was silent, nor met anybody.
fn check_undisturbed(lab: &Lab, cycles: u64, stations: &[usize]) {
    let judge = lab.judge();
    assert!(judge.faults.is_empty(), "on one grid, each number once: {:?}", judge.faults);
    assert_eq!(judge.syncs, cycles, "one in every cycle");
    assert_eq!((judge.overlaps.len(), judge.out_of_slot.first()), (0, None));
    for &id in stations {
        assert_eq!((lab.state(id), judge.data[id]), (SyncState::Locked, cycles), "station {id}");
        for kind in
            [EventKind::TimeStep, EventKind::DuplicateCycle, EventKind::Holdover, EventKind::SlotSilent]
        {
            assert!(lab.cycles_with(id, kind).is_empty(), "station {id}: {kind:?}");
        }
    }
}

#[test]
fn the_backup_that_looks_first_takes_over_in_the_very_cycle_and_the_next_after_it() {
    // The grid goes on by the backup's clock, which the judge does not have.
    let mut lab = running(&plan().with_drift(|_| 0));
    lab.run_cycles(10);
    lab.network.stop(0);
    lab.run_cycles(1_000);
    check_undisturbed(&lab, 1_010, &[FIRST, SECOND, 3, 4]);
    assert_eq!((sent(&lab, FIRST), sent(&lab, SECOND)), (1_000, 0));
    assert_eq!(lab.cycles_with(FIRST, EventKind::TookOver).len(), 1);

    lab.network.stop(FIRST);
    lab.run_cycles(1_000);
    check_undisturbed(&lab, 2_010, &[SECOND, 3, 4]);
    assert_eq!(sent(&lab, SECOND), 1_000);
}

#[test]
fn a_primary_that_returns_calibrates_and_goes_on_without_a_gap_or_a_doubled_number() {
    // The primary continues the grid of the backup, whose clock has drifted meanwhile.
    let mut plan = plan();
    plan.tolerance = OFF + plan.moved_without_master(100 + 310);
    let mut lab = running(&plan);
    lab.network.stop(0);
    lab.run_cycles(100);
    let (cycle, at) = (lab.plan.cycle(), lab.network.now() + 123_456);
    let returned = lab.add(0, Some(cycle), at);
    lab.run_cycles(1_000);
    check_undisturbed(&lab, 1_100, &[FIRST, SECOND, 3, 4]);
    assert_eq!(lab.status(returned).mastery, Some(Mastery::Active));
    assert_eq!(lab.status(returned).counters.requests_sent, lab.plan.rounds());
    assert_eq!(sent(&lab, returned) + sent(&lab, FIRST), 1_100, "in each cycle one of the two");
    assert!((300..=310).contains(&sent(&lab, FIRST)), "it listens, and a round takes two cycles");
    assert_eq!(lab.cycles_with(FIRST, EventKind::SteppedDown).len(), 1);
    assert_eq!(lab.status(FIRST).mastery, Some(Mastery::StandBy));
}

#[test]
fn a_backup_that_took_over_answers_who_joins_then() {
    let plan = plan();
    let mut lab = plan.build_without_slaves();
    for _ in 1..4 {
        lab.add_next(lab.network.now());
    }
    lab.run_until_locked();
    lab.network.stop(0);
    let late = lab.add_next(lab.network.now() + 5_000_000);
    lab.run_cycles(500);
    assert_eq!(lab.state(late), SyncState::Locked);
    assert_eq!(lab.status(FIRST).counters.replies_sent, plan.rounds());
}

#[test]
fn a_backup_without_a_master_gives_the_time_itself() {
    let mut lab = plan().build_without_slaves();
    lab.network.stop(0);
    for _ in 1..5 {
        lab.add_next(lab.network.now());
    }
    lab.run_cycles(1_000);
    assert!((970..1_000).contains(&sent(&lab, FIRST)), "after it has listened: {}", sent(&lab, FIRST));
    assert_eq!(lab.status(SECOND).mastery, Some(Mastery::StandBy));
    assert!(SLAVES.iter().all(|&id| lab.state(id) == SyncState::Locked));
}

#[test]
fn a_backup_that_misses_a_synchronisation_repeats_it_and_disturbs_nobody() {
    let mut lab = running(&plan());
    lab.network.medium_mut().lose_control_ppm = 10_000;
    lab.run_cycles(10_000);
    let judge = lab.judge();
    assert!(judge.overlaps.is_empty(), "{:?}", judge.overlaps);
    assert!(judge.out_of_slot.is_empty(), "{:?}", judge.out_of_slot);
    assert!(sent(&lab, FIRST) > 50 && sent(&lab, FIRST) < 200, "one in a hundred: {}", sent(&lab, FIRST));
    // Two syncs in a row are lost once in 10 000 cycles, which costs a slot. More than nine times: one run in ten million.
    for id in SLAVES {
        assert_eq!(lab.state(id), SyncState::Locked);
        assert!(
            judge.data[id] >= 9_990,
            "a missing one is bridged, a repeated one harmless: {}",
            judge.data[id]
        );
    }
    assert_eq!(lab.status(0).mastery, Some(Mastery::Active));
}

#[test]
fn a_backup_that_gave_the_time_in_its_half_makes_way_for_the_primary_after_a_cut() {
    let mut lab = running(&plan());
    lab.network.cut_off(&[SECOND, 4]);
    lab.run_cycles(100);
    assert_eq!(lab.status(SECOND).mastery, Some(Mastery::Active), "in its half");
    lab.network.cut_off(&[]);
    lab.run_cycles(100);
    assert_eq!(lab.status(0).mastery, Some(Mastery::Active));
    assert_eq!(lab.status(SECOND).mastery, Some(Mastery::StandBy), "a backup makes way in the next cycle");
    assert!((1..5).all(|id| lab.state(id) == SyncState::Locked));
    lab.judge_from_here();
    lab.run_cycles(100);
    check_undisturbed(&lab, 100, &[0, 1, 2, 3, 4]);
}

#[test]
fn backups_that_have_a_line_in_common_all_follow_the_primary_after_a_cut() {
    let cycle = plan().cycle().nanos() as u64;
    for part in 0..16 {
        let mut lab = running(&plan());
        lab.network.stop(0);
        lab.run_cycles(10);
        let returned = lab.add(0, Some(lab.plan.cycle()), lab.network.now() + cycle * part / 16);
        lab.network.cut_off(&[returned]);
        lab.run_cycles(20);
        let masters = [returned, FIRST, SECOND].map(|id| lab.status(id).mastery);
        let (active, stands_by) = (Some(Mastery::Active), Some(Mastery::StandBy));
        assert_eq!(masters, [active, active, stands_by], "of two lines");
        lab.network.cut_off(&[]);
        lab.run_cycles(10);
        let masters = [returned, FIRST, SECOND].map(|id| lab.status(id).mastery);
        assert_eq!(masters, [active, stands_by, stands_by], "{part} parts of a cycle later");
        lab.judge_from_here();
        lab.run_cycles(100);
        assert_eq!(lab.judge().syncs, 100, "one in every cycle");
    }
}

#[test]
fn backups_whose_line_has_drifted_from_the_primarys_follow_it_after_a_cut() {
    // Of 0.1 us in a millisecond: as late as a hold-up explains, and with the same numbers.
    let plan = plan().with_drift(|id| if id == 0 { -50_000 } else { 50_000 });
    for (cut, cycles) in
        [(&[FIRST][..], 600), (&[FIRST], 2_000), (&[FIRST, SECOND], 600), (&[FIRST, SECOND], 2_000)]
    {
        let mut lab = running(&plan);
        lab.network.cut_off(cut);
        lab.run_cycles(cycles);
        assert_eq!(lab.status(FIRST).mastery, Some(Mastery::Active), "in its half");
        lab.network.cut_off(&[]);
        lab.run_cycles(10);
        let masters = [0, FIRST, SECOND].map(|id| lab.status(id).mastery);
        let stands_by = Some(Mastery::StandBy);
        assert_eq!(masters, [Some(Mastery::Active), stands_by, stands_by], "{cut:?} for {cycles} cycles");
        lab.judge_from_here();
        lab.run_cycles(100);
        assert_eq!(lab.judge().syncs, 100, "one in every cycle");
        assert!((1..5).all(|id| lab.state(id) == SyncState::Locked));
    }
}
