use rtnet::discipline::{Cause, EventKind};
use rtnet::time::Span;

use super::super::tests::{author, finding, told_of};
use super::*;
use crate::judge::absences::Absence;
use crate::judge::findings::FindingKind;

#[test]
fn a_programs_frame_that_was_held_up_into_a_later_cycle_is_explained_by_who_told_of_it() {
    let ms = Span::from_millis(1);
    let with = |unmarked| {
        let mut records = Records { unmarked, cycle: ms, ..Records::default() };
        records.note(author(7, 2), EventKind::StalledInSend, ms * 3, Some(Cause::Preempted));
        records
    };
    let records = with(vec![(2, ms)]);
    let late = |cycle, by| Finding { span: by, ..finding(cycle, FindingKind::OutOfSlot, 2) };
    let explained = |cycle, by| records.explain(&late(cycle, by)).is_some();
    // Of a turn in cycle 7 that came at its end it may be, if it was held up for no longer than it told.
    assert_eq!([7, 8, 10, 11, 12].map(|cycle| explained(cycle, ms / 2)), [true, true, true, false, false]);
    assert_eq!([10, 11].map(|cycle| explained(cycle, Span::ZERO)), [true, true]);
    assert!(!explained(8, ms * 3 + Span::from_nanos(1)), "by more than it was held up");
    assert!(!explained(8, -ms / 2), "nothing is early for it");
    assert!(!explained(6, ms / 2), "it was not yet");
    for kind in [FindingKind::Overlap, FindingKind::Repeated, FindingKind::WithoutSync] {
        let mut short = with(vec![(2, ms)]);
        short.note(author(20, 2), EventKind::StalledInSend, ms / 2, None);
        assert_eq!(short.explain(&finding(21, kind, 2)), None, "it was over before the next turn");
        assert_eq!(records.explain(&finding(9, kind, 2)), Some("preempted"));
        assert_eq!(records.explain(&finding(9, kind, 3)), None, "another's");
        assert_eq!(
            with(Vec::new()).explain(&finding(9, kind, 2)),
            None,
            "test traffic says which turn it is of"
        );
    }
}

#[test]
fn a_held_up_synchronisation_explains_what_follows_in_its_cycle() {
    let mut records = Records::default();
    records.note(author(9, 0), EventKind::StalledInSend, Span::from_nanos(5), None);
    let out_of_slot = |by| Finding { span: Span::from_nanos(by), ..finding(9, FindingKind::OutOfSlot, 4) };
    assert!(records.explain(&out_of_slot(5)).is_some());
    assert!(records.explain(&out_of_slot(6)).is_none(), "by more than it was held up");
    assert!(records.explain(&out_of_slot(-1)).is_none(), "nor is anything early for it");
    assert!(records.explain(&finding(9, FindingKind::SlotMissed, 4)).is_none());
    assert!(records.explain(&finding(9, FindingKind::SyncGap, 0)).is_none(), "it was sent");
}

#[test]
fn a_held_up_calibration_reply_explains_what_it_hits_and_nothing_else() {
    let [ms, ns] = [Span::from_millis(1), Span::from_nanos(1)];
    let told = |station, by| {
        let mut records = Records { backups: vec![1], cycle: ms, ..Records::default() };
        records.note(told_of(9, station), EventKind::ReplyStalled, by, None);
        records
    };
    let records = told(MASTER, ms * 2);
    let hit = |cycle| records.explain(&finding(cycle, FindingKind::Overlap, 4)).is_some();
    assert_eq!([8, 9, 10, 12, 13].map(hit), [false, true, true, true, false], "so far it was held up");
    assert!(records.explain(&finding(9, FindingKind::OutOfSlot, 4)).is_none());
    let of = |records: Records, cycle| records.explain(&finding(cycle, FindingKind::Overlap, 4)).is_some();
    assert!(!of(told(MASTER, ms * 2 - ns), 12), "for less");
    assert!(of(told(1, ms * 2), 9), "a backup's");
    let authors = [4, 5].map(|station| Some(author(9, station)));
    let others = Finding { authors, ..finding(9, FindingKind::Overlap, 4) };
    assert!(records.explain(&others).is_none(), "two others have met");
}

#[test]
fn a_frame_that_hits_the_next_cycles_sync_is_explained_by_its_own_cycle() {
    let mut records = Records::default();
    let [late, sync] = [author(9, 5), author(10, MASTER)];
    let authors = [Some(late), Some(sync)];
    let overlap = Finding { cycle: 10, kind: FindingKind::Overlap, authors, span: Span::ZERO };
    records.note(author(10, 5), EventKind::StalledInSend, Span::ZERO, None);
    assert!(records.explain(&overlap).is_none());
    records.note(author(9, 5), EventKind::StalledInSend, Span::ZERO, None);
    assert!(records.explain(&overlap).is_some());
}

#[test]
fn a_frame_that_a_held_up_synchronisation_has_moved_to_another_turn_is_explained_by_that() {
    let ms = Span::from_millis(1);
    let why = |by, cycle, kind, station, late| {
        let mut records = Records { unmarked: vec![(2, ms / 8)], cycle: ms, ..Records::default() };
        records.note(Author::sync(MASTER, 7), EventKind::StalledInSend, by, Some(Cause::Preempted));
        records.explain(&Finding { span: late, ..finding(cycle, kind, station) }).is_some()
    };
    for kind in [FindingKind::SlotMissed, FindingKind::Repeated] {
        assert!(why(ms / 4, 7, kind, 2, Span::ZERO) && why(ms / 4, 8, kind, 2, Span::ZERO));
        assert!(!why(ms / 4, 6, kind, 2, Span::ZERO), "it was not yet");
        assert!(!why(ms / 4, 10, kind, 2, Span::ZERO), "not so far");
        assert!(!why(ms / 9, 7, kind, 2, Span::ZERO), "by less than from one turn to the next");
        assert!(
            !why(ms / 4, 7, kind, 3, Span::ZERO),
            "what says which turn it is of is not taken for another's"
        );
    }
    // Moved by as much as from one turn to the next, and late there by what is left.
    assert!(why(ms / 4, 8, FindingKind::OutOfSlot, 2, ms / 8));
    assert!(!why(ms / 4, 8, FindingKind::OutOfSlot, 2, ms / 8 + Span::from_nanos(1)));
}

#[test]
fn a_synchronisation_that_came_behind_a_later_one_is_missing_for_that_and_so_is_what_waited_for_it() {
    let ms = Span::from_millis(1);
    let records = |by| {
        let mut records = Records { cycle: ms, ..Records::default() };
        records.note(Author::sync(MASTER, 9), EventKind::StalledInSend, by, None);
        records.note(told_of(10, MASTER), EventKind::SyncSkipped, Span::ZERO, None);
        records.note(author(10, 2), EventKind::SlotSilent, Span::ZERO, None);
        records
    };
    // A backup's next one may be sent after a while, and one that it is held against, too: not by half of a cycle.
    let [gap, silent] = [finding(9, FindingKind::SyncGap, MASTER), finding(10, FindingKind::SlotMissed, 2)];
    for (what, at_least) in [(gap, ms / 2), (silent, ms)] {
        let [held_up, in_its_cycle] = [at_least, at_least - Span::from_nanos(1)].map(records);
        assert!(held_up.explain(&what).is_some(), "{what:?}");
        assert!(in_its_cycle.explain(&what).is_none(), "{what:?}: it was there");
    }
}

#[test]
fn backups_that_have_heard_each_other_wait_for_each_other_and_nobody_sends_for_that() {
    let ms = Span::from_millis(1);
    let why = |told: &[(u32, usize, EventKind, Span)], cycle| {
        let mut records = Records { cycle: ms, backups: vec![1, 2], ..Records::default() };
        records.absences.begin(MASTER, Absence::Down, 1);
        records.note(told_of(5, 1), EventKind::TookOver, Span::ZERO, None);
        records.note(told_of(9, 1), EventKind::SteppedDown, Span::ZERO, None);
        records.note(author(cycle, 3), EventKind::SlotSilent, Span::ZERO, None);
        told.iter().for_each(|&(cycle, of, kind, by)| records.note(told_of(cycle, of), kind, by, None));
        let gap = Finding::of(Author::sync(1, cycle), FindingKind::SyncGap, Span::ZERO);
        let silent = finding(cycle, FindingKind::SlotMissed, 3);
        [gap, silent].map(|of| records.explain(&of).is_some())
    };
    use EventKind::*;
    assert_eq!(
        why(&[], 11),
        [false, true],
        "who is silent has nobody to follow; why that is, nobody has told"
    );
    assert_eq!(
        why(&[(9, 2, StalledInSend, ms / 8)], 11),
        [true, true],
        "it came behind this one's, and both make way"
    );
    assert_eq!(why(&[(9, 2, StalledInSend, ms / 8)], 12), [false, true], "not for so long");
    assert_eq!(why(&[(9, 2, StalledInSend, ms)], 12), [true, true], "it came in 10");
    assert_eq!(why(&[(9, 1, DuplicateCycle, Span::ZERO)], 11), [true, true], "two have sent one of 9");
    let sleeps = [(9, 2, StalledInSend, ms / 8), (12, 2, SyncSkipped, ms)];
    assert_eq!(why(&sleeps, 12), [true, true], "who was to be next slept");
    assert_eq!(why(&sleeps[1..], 12), [false, true], "that alone is no reason to make way");
    assert_eq!(why(&[(9, 1, StalledInSend, ms)], 11), [false, true], "its own");
}

#[test]
fn a_frame_whose_synchronisation_was_held_up_before_is_late_by_both() {
    let [ms, ns] = [Span::from_millis(1), Span::from_nanos(1)];
    let mut records = Records { cycle: ms, ..Records::default() };
    records.note(Author::sync(MASTER, 9), EventKind::StalledInSend, ms, None);
    records.note(author(9, 2), EventKind::StalledInSend, ms / 2, None);
    let late = |by, station| {
        let late = Finding { span: by, ..finding(9, FindingKind::OutOfSlot, station) };
        records.explain(&late).is_some()
    };
    assert!(late(ms * 3 / 2, 2) && !late(ms * 3 / 2 + ns, 2));
    assert!(late(ms, 3) && !late(ms + ns, 3), "that of a station that was not");
}
