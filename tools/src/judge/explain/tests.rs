use rtmac::wire::Message;
use rtnet::buf::{Buf, Pool};
use rtnet::time::GlobalTime;

use super::*;

const PRIMARY: Address = Address([2, 0, 0, 0, 0, 1]);
const BACKUP: Address = Address([2, 0, 0, 0, 0, 2]);

/// In the station's slot 0; the master's Synchronisation.
pub(super) fn author(cycle: u32, station: usize) -> Author {
    Author { station, cycle, slot: (station != MASTER).then_some(0) }
}

pub(super) fn told_of(cycle: u32, station: usize) -> Author {
    Author { station, cycle, slot: None }
}

pub(super) fn finding(cycle: u32, kind: FindingKind, station: usize) -> Finding {
    Finding::of(author(cycle, station), kind, Span::ZERO)
}

/// Whether something is explained where station 2 has told of one thing, in cycle 7.
fn explained_by(kind: EventKind) -> impl Fn(u32, FindingKind, usize) -> bool {
    let mut records = Records::default();
    records.note(author(7, 2), kind, Span::from_nanos(5), None);
    move |cycle, kind, station| records.explain(&finding(cycle, kind, station)).is_some()
}

#[test]
fn only_a_record_of_the_same_cycle_and_station_explains() {
    let explained = explained_by(EventKind::Overrun);
    assert!(explained(7, FindingKind::SlotMissed, 2));
    assert!(!explained(8, FindingKind::SlotMissed, 2));
    assert!(!explained(7, FindingKind::SlotMissed, 3));
    assert!(!explained(7, FindingKind::Overlap, 2), "who skips a slot overlaps nobody");
}

#[test]
fn a_frame_that_the_guard_dropped_is_missing_and_overlaps_nobody() {
    let explained = explained_by(EventKind::GuardDropped);
    assert!(explained(7, FindingKind::SlotMissed, 2));
    assert!(!explained(8, FindingKind::SlotMissed, 2));
    assert!(!explained(7, FindingKind::SlotMissed, 3));
    assert!(!explained(7, FindingKind::Overlap, 2), "it never left");
    assert!(!explained(7, FindingKind::OutOfSlot, 2), "nor that");
}

#[test]
fn a_silent_slot_is_explained_by_the_records_of_both_syncs_it_could_have_followed() {
    let silent_by = |span: i64, told: &[(u32, usize, EventKind)]| {
        let mut records = Records { cycle: Span::from_millis(1), ..Records::default() };
        records.note(author(20, 2), EventKind::SlotSilent, Span::ZERO, None);
        for &(cycle, station, kind) in told {
            records.note(told_of(cycle, station), kind, Span::from_nanos(span), None);
        }
        records.explain(&finding(20, FindingKind::SlotMissed, 2)).is_some()
    };
    let silent = |told: &[_]| silent_by(0, told);
    use EventKind::*;
    assert!(!silent(&[]), "the syncs were lost on their way");
    assert!(!silent(&[(20, 0, SyncSkipped)]), "that of 19 bridges it");
    assert!(!silent(&[(18, 0, SyncSkipped), (19, 0, SyncSkipped)]), "that of 20 was there");
    assert!(!silent(&[(19, 3, SyncLate), (20, 3, SyncLate)]), "somebody else's");
    assert!(!silent(&[(19, 0, StalledInSend), (20, 0, StalledInSend)]), "late, but they came");
    assert!(!silent(&[(19, 2, DuplicateCycle), (20, 0, SyncSkipped)]), "one of the two bridges it");
    assert!(silent(&[(19, 0, SyncSkipped), (20, 0, SyncSkipped)]));
    assert!(silent(&[(19, 2, SyncLate), (20, 2, SyncLate)]));
    assert!(silent(&[(19, 2, TimeStep), (20, 0, SyncSkipped)]), "no sync confirmed the step");
    assert!(!silent_by(50_000, &[(20, 2, TimeStep)]), "held up: that of 19 bridges it");
    assert!(silent_by(-50_000, &[(20, 2, TimeStep)]), "until it is confirmed");
    assert!(silent_by(400_000, &[(20, 2, TimeStep)]), "this one, too");
    assert!(silent(&[(20, 2, DuplicateCycle)]));
}

#[test]
fn two_slots_of_one_cycle_are_told_of_one_by_one() {
    let mut records = Records::default();
    records.note(author(7, 2), EventKind::Overrun, Span::ZERO, Some(Cause::TimerLate));
    let missed =
        |slot| Finding::of(Author { slot: Some(slot), ..author(7, 2) }, FindingKind::SlotMissed, Span::ZERO);
    assert_eq!(records.explain(&missed(0)), Some("timer_late"));
    assert_eq!(records.explain(&missed(3)), None, "nobody told of that one");
    records.note(Author { slot: Some(3), ..author(7, 2) }, EventKind::Overrun, Span::ZERO, None);
    assert!(records.explain(&missed(3)).is_some());
    assert_eq!(records.all().filter(|&(kind, _)| kind == EventKind::Overrun).count(), 2);
}

#[test]
fn who_was_not_there_missed_its_slots_for_that_and_nobody_else_did() {
    let mut records = Records::default();
    records.absences.begin(2, Absence::Down, 10);
    let why = |records: &Records, cycle, kind, station| records.explain(&finding(cycle, kind, station));
    assert_eq!(why(&records, 9, FindingKind::SlotMissed, 2), None);
    assert_eq!(why(&records, 10, FindingKind::SlotMissed, 2), Some("station_down"));
    assert_eq!(
        why(&records, 10, FindingKind::OutOfSlot, 2),
        Some("station_down"),
        "its last word is not known"
    );
    assert_eq!(why(&records, 10, FindingKind::SlotMissed, 3), None);
    records.absences.end(2, Absence::Down, 20);
    assert_eq!(why(&records, 20, FindingKind::SlotMissed, 2), None, "it was heard");
    records.note(told_of(20, 2), EventKind::Locked, Span::ZERO, None);
    let missed = [20, 21].map(|cycle| why(&records, cycle, FindingKind::SlotMissed, 2));
    assert_eq!(missed, [Some("station_down"), None], "what came before it was locked");
}

#[test]
fn who_is_stopped_tells_of_it_when_it_goes_on_and_only_what_it_tells_is_explained() {
    let mut records = Records::default();
    let why = |records: &Records, cycle, station| {
        records.explain(&finding(cycle, FindingKind::SlotMissed, station))
    };
    records.absences.begin(2, Absence::Stopped, 10);
    assert_eq!(why(&records, 12, 2), Some("station_stopped"), "it cannot tell yet");
    records.absences.end(2, Absence::Stopped, 140);
    assert_eq!(why(&records, 12, 2), None, "it could have told");
    records.note(author(12, 2), EventKind::Overrun, Span::ZERO, Some(Cause::Preempted));
    assert_eq!(why(&records, 12, 2), Some("preempted"));
}

#[test]
fn what_the_kernel_refused_and_what_was_not_there_is_told_of() {
    let mut records = Records::default();
    records.note(author(7, 2), EventKind::SendFailed, Span::ZERO, Some(Cause::Refused));
    records.note(author(8, 2), EventKind::SlotEmpty, Span::ZERO, Some(Cause::QueueEmpty));
    records.note(author(9, 2), EventKind::TurnLeft, Span::ZERO, Some(Cause::NoSync));
    records.note(author(10, 2), EventKind::CalibrationTurn, Span::ZERO, Some(Cause::Calibrating));
    let missed = |cycle| records.explain(&finding(cycle, FindingKind::SlotMissed, 2));
    let causes = ["refused", "queue_empty", "sync_lost_or_late", "calibrating"];
    assert_eq!([7, 8, 9, 10].map(missed), causes.map(Some));
    assert!(records.explain(&finding(7, FindingKind::OutOfSlot, 2)).is_none(), "it was not sent");

    records.absences.begin(2, Absence::NoCarrier, 7);
    records.absences.end(2, Absence::NoCarrier, 9);
    let missed = |cycle| records.explain(&finding(cycle, FindingKind::SlotMissed, 2));
    assert_eq!([7, 8].map(missed), [Some("no_carrier"); 2], "that is why");
    assert_eq!(records.explain(&finding(8, FindingKind::SlotMissed, 3)), None);
}

#[test]
fn without_a_master_there_are_no_syncs_and_all_are_silent() {
    let mut records = Records::default();
    records.absences.begin(MASTER, Absence::Down, 10);
    let why = |cycle, kind, station| records.explain(&finding(cycle, kind, station));
    assert_eq!(why(12, FindingKind::SyncGap, MASTER), Some("station_down"));
    assert_eq!(why(12, FindingKind::SlotMissed, 3), None, "it still knows its slots, and tells of them");
    assert_eq!(why(5_000, FindingKind::SlotMissed, 3), Some("sync_lost_or_late"));
    records.absences.end(MASTER, Absence::Down, 6_000);
    records.note(told_of(6_050, 3), EventKind::Locked, Span::ZERO, None);
    let why = |cycle, kind, station| records.explain(&finding(cycle, kind, station));
    assert_eq!(why(6_050, FindingKind::SlotMissed, 3), Some("sync_lost_or_late"), "until it follows again");
    assert_eq!(why(6_051, FindingKind::SlotMissed, 3), None);
    assert_eq!(why(12, FindingKind::WithoutSync, 3), None, "who sends without is wrong");
    assert_eq!(why(12, FindingKind::OutOfSlot, 3), None, "who sends must know when");
}

#[test]
fn a_master_whose_own_sync_was_skipped_while_a_backups_was_the_last_may_send() {
    let mut records = Records::default();
    records.note(told_of(7, MASTER), EventKind::SyncSkipped, Span::ZERO, Some(Cause::Preempted));
    let why = |cycle, station| {
        let author = Author { station, cycle, slot: Some(0) };
        records.explain(&Finding::of(author, FindingKind::WithoutSync, Span::ZERO))
    };
    assert_eq!([why(7, MASTER), why(8, MASTER), why(7, 3)], [Some("preempted"), None, None]);
}

#[test]
fn a_primary_that_gives_the_time_from_the_next_cycle_on_needs_no_sync_in_this_one() {
    let mut records = Records::default();
    records.note(told_of(8, MASTER), EventKind::MasterActive, Span::ZERO, None);
    let why = |cycle| records.explain(&finding(cycle, FindingKind::WithoutSync, MASTER)).is_some();
    assert_eq!([6, 7, 8].map(why), [false, true, false]);
}

#[test]
fn a_backup_that_steps_down_bridges_the_cycle_that_it_was_too_late_to_begin() {
    let why = |steps_down: bool, cycle, station| {
        let mut records = Records { backups: vec![1], ..Records::default() };
        records.note(told_of(6, 1), EventKind::TookOver, Span::ZERO, None);
        records.note(told_of(7, 1), EventKind::SyncSkipped, Span::ZERO, Some(Cause::TimerLate));
        if steps_down {
            records.note(told_of(7, 1), EventKind::SteppedDown, Span::ZERO, None);
        }
        records.explain(&finding(cycle, FindingKind::WithoutSync, station))
    };
    let explained = [7, 8, 9].map(|cycle| why(true, cycle, 1));
    assert_eq!(explained, [Some("timer_late"), Some("timer_late"), None]);
    assert_eq!(why(false, 8, 1), None, "it gives the time on");
    assert_eq!(why(true, 8, 2), None, "another's");
}

#[test]
fn a_master_that_was_killed_before_it_told_of_that_may_have_sent_too() {
    let mut records = Records { backups: vec![2], ..Records::default() };
    (MASTER..4).for_each(|station| records.absences.begin(station, Absence::Down, 7));
    let why = |cycle, station| {
        let author = Author { station, cycle, slot: Some(0) };
        records.explain(&Finding::of(author, FindingKind::WithoutSync, Span::ZERO))
    };
    let down = Some("station_down");
    assert_eq!([why(7, MASTER), why(6, MASTER), why(7, 2), why(7, 3)], [down, None, down, None]);
}

#[test]
fn who_has_given_its_line_up_is_silent_until_it_follows_again() {
    let mut records = Records::default();
    records.note(told_of(100, 3), EventKind::LineGivenUp, Span::ZERO, None);
    let why = |records: &Records, cycle| records.explain(&finding(cycle, FindingKind::SlotMissed, 3));
    assert_eq!(why(&records, 99), None, "it told of those before");
    assert_eq!([100, 103].map(|cycle| why(&records, cycle)), [Some("sync_lost_or_late"); 2]);
    records.forget_before(5_000);
    assert_eq!(why(&records, 5_003), Some("sync_lost_or_late"), "that still holds");
    records.note(told_of(5_004, 3), EventKind::Locked, Span::ZERO, None);
    assert_eq!([5_004, 5_005].map(|cycle| why(&records, cycle)), [Some("sync_lost_or_late"), None]);
    records.forget_before(6_000);
    assert_eq!(why(&records, 6_001), None);
    assert_eq!(records.explain(&finding(103, FindingKind::SlotMissed, 2)), None, "another");
}

#[test]
fn syncs_that_were_lost_on_the_way_explain_who_was_silent_for_two_of_them_and_are_forgotten() {
    let mut records = Records::default();
    for cycle in [7, 8] {
        records.note(author(cycle, 2), EventKind::SlotSilent, Span::ZERO, None);
    }
    let why = |records: &Records, cycle| records.explain(&finding(cycle, FindingKind::SlotMissed, 2));
    records.note_sync_lost(2, (PRIMARY, 7), false);
    assert_eq!(why(&records, 7), None, "one is bridged");
    records.note_sync_lost(2, (PRIMARY, 8), false);
    records.note_sync_lost(3, (PRIMARY, 6), false);
    assert_eq!((why(&records, 7), why(&records, 8)), (None, Some("slot_silent")), "its own, not another's");
    records.forget_before(9);
    records.note(author(8, 2), EventKind::SlotSilent, Span::ZERO, None);
    assert_eq!(why(&records, 8), None);
}

/// Of a primary, a backup, and two slaves that follow them.
fn with_a_backup() -> Records {
    Records { backups: vec![1], addresses: vec![PRIMARY, BACKUP], ..Records::default() }
}

fn sync(from: Address, cycle: u32) -> Buf {
    let mut frame = Pool::new(1).take().unwrap();
    let at = GlobalTime::from_nanos(0);
    Message::Sync { cycle, xmit: at, sched: at }.write(Address::BROADCAST, from, &mut frame);
    frame
}

#[test]
fn nobody_is_excused_by_syncs_of_the_other_part_of_a_network_that_is_cut() {
    let mut records = with_a_backup();
    for cycle in 1..10 {
        records.note_frame(&sync(PRIMARY, cycle));
    }
    // From 5 on the stations 1 and 2 are cut off, where the backup gives the time from 6 on.
    for cycle in 5..10 {
        records.note_sync_lost(2, (PRIMARY, cycle), true);
    }
    for cycle in [6, 7] {
        records.note_frame(&sync(BACKUP, cycle));
    }
    for cycle in 5..10 {
        records.note(author(cycle, 2), EventKind::SlotSilent, Span::ZERO, None);
    }
    let why = |records: &Records, cycle| records.explain(&finding(cycle, FindingKind::SlotMissed, 2));
    assert_eq!([7, 8, 9].map(|cycle| why(&records, cycle)), [None; 3], "it does not follow the primary");
    records.note_sync_lost(2, (BACKUP, 6), false);
    assert_eq!(why(&records, 6), Some("slot_silent"), "it had neither's, of 5 and of 6");
    records.note_frame(&sync(BACKUP, 8));
    records.note_frame(&sync(BACKUP, 9));
    [8, 9].iter().for_each(|&cycle| records.note_sync_lost(2, (BACKUP, cycle), false));
    assert_eq!(why(&records, 9), Some("slot_silent"), "its own master's were lost");
}

#[test]
fn nobody_is_excused_by_what_one_master_did_not_send_where_anothers_sync_came() {
    let mut records = with_a_backup();
    for cycle in [7, 8] {
        records.note(author(cycle, 2), EventKind::SlotSilent, Span::ZERO, None);
        records.note(told_of(cycle, 1), EventKind::SyncSkipped, Span::ZERO, None);
    }
    let why = |records: &Records| records.explain(&finding(8, FindingKind::SlotMissed, 2));
    assert_eq!(why(&records), Some("slot_silent"), "nobody sent any");
    records.note_frame(&sync(PRIMARY, 8));
    assert_eq!(why(&records), None, "the primary did, and the backup need not");
    records.note_sync_lost(2, (PRIMARY, 8), false);
    assert_eq!(why(&records), Some("slot_silent"));
}

#[test]
fn who_tells_that_it_is_silent_in_a_cycle_that_is_counted_again_is_so_for_that() {
    let mut records = with_a_backup();
    records.note(author(8, 2), EventKind::SlotSilent, Span::ZERO, None);
    [7, 8].iter().for_each(|&cycle| records.note_frame(&sync(PRIMARY, cycle)));
    let why = |records: &Records, cycle| records.explain(&finding(cycle, FindingKind::SlotMissed, 2));
    assert_eq!(why(&records, 8), None, "it had both");
    records.clocks = clocks::set(0, true, [50, 20]);
    assert_eq!(why(&records, 8), None, "others are counted again");
    records.clocks = clocks::set(0, true, [6, 1]);
    assert_eq!(why(&records, 8), Some("slot_silent"), "they may have come later");
    assert_eq!(why(&records, 7), None, "it has told nothing of that");
    records.note(author(4, 2), EventKind::SlotSilent, Span::ZERO, None);
    assert_eq!(why(&records, 4), None, "it came once: who gives the time goes on with its next one");
}

#[test]
fn a_sync_is_missing_from_a_cycle_that_is_counted_again_if_it_came_in_the_other_one() {
    let mut records = with_a_backup();
    [6, 9].iter().for_each(|&cycle| records.note_frame(&sync(PRIMARY, cycle)));
    let gap = |cycle| Finding::of(Author::sync(0, cycle), FindingKind::SyncGap, Span::ZERO);
    let why = |records: &Records| [6, 8, 10].map(|cycle| records.explain(&gap(cycle)));
    assert_eq!(why(&records), [None; 3]);
    records.clocks = clocks::set(0, true, [6, 1]);
    assert_eq!(
        why(&records),
        [Some("clock_set"), None, Some("clock_set")],
        "8 it has never sent, 10 may come"
    );
    [7, 10].iter().for_each(|&cycle| records.note_frame(&sync(BACKUP, cycle)));
    let backups = |cycle| Finding::of(Author::sync(1, cycle), FindingKind::SyncGap, Span::ZERO);
    let why = [8, 9].map(|cycle| records.explain(&backups(cycle)));
    assert_eq!(why, [None, Some("clock_set")], "nobody sent 8; 9 came from the primary");
}

#[test]
fn a_sync_that_did_not_get_to_a_station_did_not_move_it() {
    let mut records = with_a_backup();
    records.note(told_of(9, 0), EventKind::StalledInSend, Span::from_nanos(5), None);
    let out_of_slot = Finding { span: Span::from_nanos(5), ..finding(9, FindingKind::OutOfSlot, 2) };
    assert!(records.explain(&out_of_slot).is_some());
    records.note_sync_lost(2, (PRIMARY, 9), true);
    assert!(records.explain(&out_of_slot).is_none());
    assert!(records.explain(&finding(9, FindingKind::Overlap, 2)).is_none());
    assert!(records.explain(&finding(9, FindingKind::Overlap, 3)).is_some(), "it got to another");
}

#[test]
fn a_sync_is_missing_for_what_who_gives_the_time_told_and_not_for_a_primary_that_is_gone() {
    let mut records = with_a_backup();
    let gap = |cycle, station| Finding::of(told_of(cycle, station), FindingKind::SyncGap, Span::ZERO);
    records.absences.begin(MASTER, Absence::Down, 5);
    assert_eq!(records.explain(&gap(5, MASTER)), Some("station_down"));
    assert_eq!(records.explain(&gap(7, 1)), None);
    records.note(told_of(7, 1), EventKind::SyncSkipped, Span::ZERO, Some(Cause::TimerLate));
    assert_eq!(records.explain(&gap(7, 1)), Some("timer_late"));
    records.note(told_of(8, MASTER), EventKind::SyncSkipped, Span::ZERO, Some(Cause::Preempted));
    assert_eq!(records.explain(&gap(8, 1)), Some("preempted"), "it has just taken its place");
    records.absences.begin(1, Absence::Stopped, 9);
    assert_eq!(records.explain(&gap(9, 1)), Some("station_stopped"));
}

#[test]
fn who_follows_one_that_is_not_there_is_silent_for_that_until_another_gives_the_time() {
    let mut records = with_a_backup();
    (1..5).for_each(|cycle| records.note_frame(&sync(PRIMARY, cycle)));
    for cycle in 5..9 {
        records.note(author(cycle, 2), EventKind::SlotSilent, Span::ZERO, None);
    }
    let why = |records: &Records, cycle| records.explain(&finding(cycle, FindingKind::SlotMissed, 2));
    assert_eq!(why(&records, 6), None);
    records.absences.begin(0, Absence::Down, 5);
    assert_eq!([5, 6].map(|cycle| why(&records, cycle)), [None, Some("slot_silent")], "one is bridged");
    records.note_frame(&sync(BACKUP, 7));
    records.note_frame(&sync(BACKUP, 8));
    assert_eq!([7, 8].map(|cycle| why(&records, cycle)), [None; 2], "it could follow the backup");
}

#[test]
fn a_sync_is_missing_for_a_backup_that_repeated_the_one_before_once_its_author_has_stepped_down_for_that() {
    const SECOND: Address = Address([2, 0, 0, 0, 0, 3]);
    let gap = Finding::of(told_of(7, 1), FindingKind::SyncGap, Span::ZERO);
    let of = |sent: u32, told: &[(u32, usize, EventKind)]| {
        let (backups, addresses) = (vec![1, 2], vec![PRIMARY, BACKUP, SECOND]);
        let mut records = Records { cycle: Span::from_millis(1), backups, addresses, ..Records::default() };
        records.note_frame(&sync(BACKUP, 6));
        records.note_frame(&sync(SECOND, sent));
        told.iter().for_each(|&(cycle, of, kind)| {
            records.note(told_of(cycle, of), kind, Span::ZERO, kind.cause().or(Some(Cause::TimerLate)));
        });
        records
    };
    use EventKind::{SteppedDown, SyncSkipped, TookOver};
    let (took, down, late) = ((6, 2, TookOver), (6, 1, SteppedDown), (7, 2, SyncSkipped));
    let why = |sent, told: &[_]| of(sent, told).explain(&gap);
    assert_eq!(why(6, &[took, down, late]), Some("timer_late"));
    assert_eq!(why(6, &[took, down]), None, "nobody told why");
    assert_eq!(why(6, &[took, down, (8, 2, SyncSkipped)]), None, "of another cycle");
    assert_eq!(why(6, &[took, late]), None, "the first was to send it, too");
    assert_eq!(why(6, &[down, late]), None, "the second only stood by");
    assert_eq!(why(5, &[(5, 2, TookOver), down, late]), None, "that one gave the time no more");
    let mut stopped = of(6, &[took, down]);
    stopped.absences.begin(2, Absence::Stopped, 7);
    assert_eq!(stopped.explain(&gap), Some("station_stopped"));
}

#[test]
fn who_is_gone_is_silent_for_that_however_long_and_not_for_want_of_a_sync() {
    let mut records = Records::default();
    records.absences.begin(2, Absence::Down, 10);
    let why = |cycle, station| records.explain(&finding(cycle, FindingKind::SlotMissed, station));
    assert_eq!([11, 5_000].map(|cycle| why(cycle, 2)), [Some("station_down"); 2]);
    assert_eq!(why(5_000, 3), None, "another is there");
}

#[test]
fn slots_that_were_missed_are_those_that_stations_told_of_each_once() {
    let mut records = Records::default();
    for kind in [EventKind::SlotSilent, EventKind::TurnLeft, EventKind::StalledInSend] {
        records.note(author(7, 2), kind, Span::ZERO, None);
    }
    records.note(author(8, 3), EventKind::StalledInSend, Span::ZERO, None);
    records.note(told_of(8, MASTER), EventKind::SyncSkipped, Span::ZERO, None);
    records.note(author(20, 2), EventKind::Overrun, Span::ZERO, None);
    assert_eq!(records.slots_missed(|cycle| cycle < 15).into_iter().collect::<Vec<_>>(), [author(7, 2)]);
}
