//! A backup master with the habits of real ones (section 2.9 of the protocol reference), in a lab whose clocks drift.
//!
//! B is 45 us: behind the last moment at which the master may still send (37.5 us), and within the sync window, of 50 us
//! as in a network whose slots are given, which all slots lie behind.

use rtnet::discipline::{EventKind, SyncState};
use rtnet::sim::Host;
use rtnet::time::Span;
use tests::networks::{Lab, Plan};

const BACKUP: usize = 1;
const AFTER: Span = Span::from_micros(45);
const SYNC_WINDOW: Span = Span::from_micros(50);
/// How far real stations may be off the grid for a moment, when its master changes.
const OFF: Span = Span::from_micros(50);
/// Cycles of the longest test without a master.
const LONGEST: u32 = 1_000;
/// Ours, from begin to end.
const SLAVES: [usize; 2] = [2, 3];

/// Four stations of which the second is the backup; with `peers` these are peers, too.
fn plan(peers: &[usize]) -> Plan {
    let peers = [peers, &[BACKUP]].concat();
    let mut plan = Plan { peers, backups: vec![(BACKUP, AFTER)], ..Plan::lab(4).on(Host::IDEAL) };
    let begin_earlier = plan.scenario.sync_window - SYNC_WINDOW;
    plan.scenario.sync_window = SYNC_WINDOW;
    for slot in plan.scenario.stations.iter_mut().flat_map(|station| &mut station.slots) {
        slot.offset = slot.offset - begin_earlier;
    }
    plan.tolerance = OFF + plan.moved_without_master(LONGEST);
    plan
}

fn running(plan: &Plan) -> Lab {
    let mut lab = plan.build();
    lab.run_until_locked();
    lab.run_cycles(10);
    assert_eq!(lab.peer_status(BACKUP).syncs_sent, 0, "it stands by");
    lab.judge_from_here();
    lab
}

/// Nobody has left the line, nor been silent for want of it, nor met anybody on the medium.
fn check_undisturbed(lab: &Lab, cycles: u64) {
    let judge = lab.judge();
    assert_eq!(judge.syncs, cycles, "one in every cycle");
    assert!(judge.faults.is_empty(), "on one grid, each number once: {:?}", judge.faults);
    assert_eq!((&judge.overlaps[..], &judge.out_of_slot[..]), (&[][..], &[][..]));
    for id in SLAVES {
        assert_eq!((lab.state(id), judge.data[id]), (SyncState::Locked, cycles));
        for kind in
            [EventKind::TimeStep, EventKind::DuplicateCycle, EventKind::Holdover, EventKind::SlotSilent]
        {
            assert!(lab.cycles_with(id, kind).is_empty(), "station {id}: {kind:?}");
        }
    }
}

#[test]
fn our_master_dies_and_the_backup_takes_over_in_that_very_cycle() {
    let mut lab = running(&plan(&[]));
    lab.run_cycles(10);
    lab.network.stop(0);
    lab.run_cycles(1_000);
    check_undisturbed(&lab, 1_010);
    assert_eq!(lab.peer_status(BACKUP).syncs_sent, 1_000);
    assert_eq!((lab.judge().data[0], lab.judge().data[BACKUP]), (10, 1_010));
}

/// As in most real networks: B is within the slot of the master that is silent then, 200 us after it should have sent.
#[test]
fn our_slaves_wait_for_a_backup_that_looks_later_than_they_miss_their_master() {
    let plan = plan(&[]);
    let mut lab = running(&Plan { backups: vec![(BACKUP, Span::from_micros(200))], ..plan });
    lab.network.stop(0);
    lab.run_cycles(1_000);
    let judge = lab.judge();
    assert_eq!((judge.syncs, judge.overlaps.len(), judge.faults.len()), (1_000, 0, 0));
    assert!(
        judge.out_of_slot.iter().all(|author| author.from == BACKUP),
        "its Synchronisations are where it sends"
    );
    for id in SLAVES {
        assert_eq!((lab.state(id), judge.data[id]), (SyncState::Locked, 1_000));
        for kind in [EventKind::TimeStep, EventKind::SyncLost, EventKind::SlotSilent] {
            assert!(lab.cycles_with(id, kind).is_empty(), "station {id}: {kind:?}");
        }
    }
}

#[test]
fn a_backup_that_took_over_answers_who_joins_then() {
    let plan = plan(&[]);
    let mut lab = plan.build_without_slaves();
    for _ in 1..3 {
        lab.add_next(lab.network.now());
    }
    lab.run_until_locked();
    lab.network.stop(0);
    let late = lab.add_next(lab.network.now() + 5_000_000);
    lab.run_cycles(500);
    assert_eq!(lab.state(late), SyncState::Locked);
    assert_eq!(lab.peer_status(BACKUP).replies_sent, plan.rounds());
}

#[test]
fn a_backup_without_a_master_gives_the_time_itself() {
    let mut lab = plan(&[]).build_without_slaves();
    lab.network.stop(0);
    for _ in 1..4 {
        lab.add_next(lab.network.now());
    }
    lab.run_cycles(1_000);
    assert!((990..1_000).contains(&lab.peer_status(BACKUP).syncs_sent), "after it has listened");
    assert!(SLAVES.iter().all(|&id| lab.state(id) == SyncState::Locked));
}

#[test]
fn a_peer_that_returns_follows_calibrates_and_continues_the_line_and_the_backup_stands_by() {
    let mut lab = running(&plan(&[0]));
    lab.run_cycles(10);
    lab.network.stop(0);
    lab.run_cycles(100);
    let cycle = lab.plan.cycle();
    let returned = lab.add(0, Some(cycle), lab.network.now() + 123_456);
    lab.run_cycles(1_000);
    let (theirs, backups) = (lab.peer_status(returned), lab.peer_status(BACKUP));
    assert_eq!(theirs.requests_sent, lab.plan.rounds());
    assert_eq!(theirs.syncs_sent + backups.syncs_sent, 1_100, "in each cycle one of the two");
    let rounds_and_listening = 100 + 2 * lab.plan.rounds()..=100 + 2 * lab.plan.rounds() + 5;
    assert!(rounds_and_listening.contains(&backups.syncs_sent), "{backups:?}");
    check_undisturbed(&lab, 1_110);
}
