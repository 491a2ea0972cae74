use std::collections::BTreeMap;

use super::*;
use crate::report::figures::GuardName;
use crate::report::histogram::Summary;
use crate::report::verdict::Word;
use crate::scenario::MAX_MISS_PPM;

fn station(name: &str) -> MemberStatus {
    MemberStatus {
        name: name.into(),
        role: "slave".into(),
        state: "locked".into(),
        pid: 1,
        address: String::new(),
        ip: None,
        frames_seen: 1_000,
        slots_missed: 0,
        stray: 0,
        payload_errors: 0,
        frames_lost: 0,
        slot_error_ns: Summary::default(),
        slot_length_ns: 0,
        guard: GuardName::Kernel,
        events: BTreeMap::new(),
        restarts: 0,
        cuts: 0,
        lost_records: 0,
        lost: false,
        failed: None,
        refusals: BTreeMap::new(),
    }
}

fn lab() -> LabStatus {
    LabStatus {
        name: "lab".into(),
        pid: 1,
        bridge: String::new(),
        bridge_namespace: "/".into(),
        cpu: 1,
        load: 0.0,
        notes: Vec::new(),
        up_seconds: 1,
        cycle_ns: 1_000_000,
        cycles: 1_000,
        frames_expected: 2_000,
        frames_seen: 2_000,
        slots_missed: 0,
        sync_slot_error_ns: Summary::default(),
        sync_window_ns: 0,
        overlaps: 0,
        out_of_slot: 0,
        syncs_missing: 0,
        schedule_changes: 0,
        time_by: "master".into(),
        rivals: Vec::new(),
        strangers: BTreeMap::new(),
        implausible_syncs: BTreeMap::new(),
        latest_frame_ns: None,
        unexplained: 0,
        unexplained_last: Vec::new(),
        causes: BTreeMap::new(),
        worst: Vec::new(),
        not_judged: 0,
        frames_lost: 0,
        verdict: Verdict::default(),
        unwritten: Vec::new(),
        stations: vec![station("master"), station("arm")],
    }
}

#[track_caller]
fn check(change: impl FnOnce(&mut LabStatus), word: Word, line: &str) {
    let mut status = lab();
    change(&mut status);
    let verdict = of(&status, &[Some(0); 2], None, None, MAX_MISS_PPM, &HostFacts::default());
    assert_eq!((verdict.word, verdict.line("all seen").as_str()), (word, line));
}

#[test]
fn verdict_is_never_ok_when_a_station_is_down() {
    check(|_| (), Word::Ok, "OK: all seen");
    for state in ["ended", "stopped", "restarting", "calibrating", "locked, no carrier"] {
        let line = format!("NOT OK: station 'arm' is {state}");
        check(|lab| lab.stations[1].state = state.into(), Word::NotOk, &line);
    }
    check(|lab| lab.stations[1].state = "lost".into(), Word::Ok, "OK: all seen");
    let is_lost = |lab: &mut LabStatus| (lab.stations[1].state, lab.stations[1].lost) = ("lost".into(), true);
    check(is_lost, Word::NotOk, "NOT OK: station 'arm' is lost");
    let failed = |lab: &mut LabStatus| lab.stations[1].failed = Some("no buffers".into());
    check(failed, Word::NotOk, "NOT OK: station 'arm': no buffers");
}

#[test]
fn each_figure_that_is_not_well_is_a_reason() {
    let line = "NOT OK: 2 unexplained misses; 1 overlap";
    check(|lab| (lab.unexplained, lab.overlaps) = (2, 1), Word::NotOk, line);
    check(|lab| lab.overlaps = 1, Word::Degraded, "DEGRADED: 1 overlap");
    check(|lab| lab.out_of_slot = 2, Word::Degraded, "DEGRADED: 2 frames out of slot");
    check(|lab| lab.not_judged = 3, Word::Inconclusive, "INCONCLUSIVE: 3 frames not judged");
    let arm = |change: fn(&mut MemberStatus)| move |lab: &mut LabStatus| change(&mut lab.stations[1]);
    check(arm(|of| of.payload_errors = 1), Word::NotOk, "NOT OK: station 'arm': 1 payload error");
    check(arm(|of| of.frames_lost = 1), Word::NotOk, "NOT OK: station 'arm' did not receive 1 frame");
    let line = "INCONCLUSIVE: station 'arm' could not tell of 1 event";
    check(arm(|of| of.lost_records = 1), Word::Inconclusive, line);
    let line = "DEGRADED: slots missed: 'arm' 1 %; 0.5 % may be";
    check(arm(|of| (of.frames_seen, of.slots_missed) = (990, 10)), Word::Degraded, line);
}

#[test]
fn verdict_is_never_ok_when_no_cycle_was_watched() {
    let nothing = |lab: &mut LabStatus| lab.stations.iter_mut().for_each(|of| of.frames_seen = 0);
    check(nothing, Word::Inconclusive, "INCONCLUSIVE: nothing was measured: 0 of 0 frames");
}

#[test]
fn verdict_is_never_ok_when_the_capture_failed() {
    let verdict =
        of(&lab(), &[Some(0); 2], Some("/full: no room"), None, MAX_MISS_PPM, &HostFacts::default());
    assert_eq!(verdict.line(""), "NOT OK: the capture is not whole: /full: no room");
}
