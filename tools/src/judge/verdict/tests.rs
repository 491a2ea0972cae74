use super::*;
use crate::report::host::RealTimeThread;
use crate::scenario::MAX_MISS_PPM;

fn slots(station: &str, seen: u64, expected: u64) -> Slots {
    Slots { station: station.into(), expected, seen, woke_late: Some(0), is_decided: false }
}

fn quiet() -> HostFacts {
    HostFacts { core: Some(1), ..HostFacts::default() }
}

/// Two stations: all that the first was to send was seen, and so much of the second.
fn seen(seen: u64, expected: u64) -> Evidence {
    let all = vec![slots("master", expected, expected), slots("arm", seen, expected)];
    Evidence { slots: Some(all), ..Evidence::default() }
}

fn with(weight: Weight) -> Evidence {
    Evidence { reasons: vec![Reason::new(weight, "something")], ..seen(6_000, 6_000) }
}

/// The same in which the second station woke so often more than a cycle late.
fn woke_late(mut evidence: Evidence, late: u64) -> Evidence {
    evidence.slots.as_mut().unwrap()[1].woke_late = Some(late);
    evidence
}

fn stolen(ppm: u64) -> HostFacts {
    HostFacts { core_steal_ppm: Some(ppm), ..quiet() }
}

fn beside(ppm: u64) -> HostFacts {
    let other = RealTimeThread { name: "cyclictest".into(), pid: 77, ppm };
    HostFacts { other_real_time: vec![other], ..quiet() }
}

#[track_caller]
fn check(evidence: &Evidence, host: &HostFacts, word: Word, line: &str) {
    let verdict = judge(evidence, MAX_MISS_PPM, host);
    assert_eq!((verdict.word, verdict.ok), (word, word == Word::Ok), "{verdict:?}");
    assert_eq!(verdict.line("all seen"), line);
}

#[test]
fn each_weight_has_its_word_on_each_host() {
    use Weight::{Blind, HostMay, Short, Wrong};
    let busy = "this host was disturbed: 0.6 % of cpu 1 was stolen";
    for (weight, word, on_busy, line_on_busy) in [
        (Wrong, Word::NotOk, Word::NotOk, format!("NOT OK: something; {busy}")),
        (HostMay, Word::NotOk, Word::Inconclusive, format!("INCONCLUSIVE: {busy}; something")),
        (Blind, Word::Inconclusive, Word::Inconclusive, format!("INCONCLUSIVE: {busy}; something")),
        (Short, Word::Degraded, Word::Inconclusive, format!("INCONCLUSIVE: {busy}; something")),
    ] {
        check(&with(weight), &quiet(), word, &format!("{}: something", word.name()));
        check(&with(weight), &stolen(6_000), on_busy, &line_on_busy);
    }
    check(&seen(6_000, 6_000), &stolen(6_000), Word::Ok, "OK: all seen");
}

#[test]
fn the_worst_reason_decides_and_comes_first() {
    let mut evidence = with(Weight::Short);
    evidence.reasons.push(Reason::new(Weight::Wrong, "worse"));
    check(&evidence, &quiet(), Word::NotOk, "NOT OK: worse; something");
}

#[test]
fn miss_share_decides_at_its_threshold() {
    check(&seen(5_970, 6_000), &quiet(), Word::Ok, "OK: all seen");
    check(
        &seen(5_969, 6_000),
        &quiet(),
        Word::Degraded,
        "DEGRADED: slots missed: 'arm' 0.52 %; 0.5 % may be",
    );
    let verdict = |max| judge(&seen(5_999, 6_000), max, &quiet()).word;
    assert_eq!([0, 166, 167].map(verdict), [Word::Degraded, Word::Degraded, Word::Ok]);
}

#[test]
fn the_worst_stations_are_named_and_the_others_counted() {
    let all = (0..6).map(|n| slots(&format!("s{n}"), 900 + n, 1_000)).collect();
    let evidence = Evidence { slots: Some(all), ..Evidence::default() };
    let line = "DEGRADED: slots missed: 's0' 10 %, 's1' 9.9 %, 's2' 9.8 %, 3 more stations; 0.5 % may be";
    check(&evidence, &quiet(), Word::Degraded, line);
}

#[test]
fn verdict_is_never_ok_when_a_station_was_hardly_seen() {
    let line = "NOT OK: station 'arm' was seen 10 times of 6 000";
    check(&seen(10, 6_000), &quiet(), Word::NotOk, line);
    check(&seen(0, 6_000), &quiet(), Word::NotOk, "NOT OK: station 'arm' was seen 0 times of 6 000");
}

#[test]
fn verdict_is_never_ok_when_nothing_was_measured() {
    check(&seen(0, 0), &quiet(), Word::Inconclusive, "INCONCLUSIVE: nothing was measured: 0 of 0 frames");
    let of_ring = Evidence::default();
    check(&of_ring, &quiet(), Word::Ok, "OK: all seen");
}

#[test]
fn verdict_is_never_ok_when_it_was_interrupted() {
    let after = |evidence| Evidence { interrupted: Some("3s of 60s".into()), ..evidence };
    check(&after(seen(9, 9)), &quiet(), Word::Interrupted, "INTERRUPTED after 3s of 60s");
    let line = "INTERRUPTED after 3s of 60s; something";
    check(&after(with(Weight::Wrong)), &quiet(), Word::Interrupted, line);
}

#[test]
fn each_measure_of_the_host_is_stated() {
    let missed = || seen(5_000, 6_000);
    let rest = "slots missed: 'arm' 16.7 %; 0.5 % may be";
    for (evidence, host, why) in [
        (woke_late(missed(), 100), quiet(), "threads woke more than a cycle late for 0.83 % of the slots"),
        (missed(), stolen(20_000), "2 % of cpu 1 was stolen"),
        (missed(), beside(30_000), "other real-time threads took 3 % of cpu 1 (cyclictest (77) 3 %)"),
    ] {
        let line = format!("INCONCLUSIVE: this host was disturbed: {why}; {rest}");
        check(&evidence, &host, Word::Inconclusive, &line);
    }
    // As much as may be missed is no excuse.
    let degraded = format!("DEGRADED: {rest}");
    check(&woke_late(missed(), 60), &quiet(), Word::Degraded, &degraded);
    check(&missed(), &stolen(5_000), Word::Degraded, &degraded);
    check(&missed(), &beside(5_000), Word::Degraded, &degraded);
    check(&woke_late(missed(), 6_000), &HostFacts::of_virtual_time(), Word::Degraded, &degraded);
}

#[test]
fn a_station_stopped_on_purpose_shows_nothing_of_the_host() {
    let mut evidence = seen(5_000, 6_000);
    evidence.slots.as_mut().unwrap()[1].woke_late = None;
    assert_eq!(judge(&evidence, MAX_MISS_PPM, &quiet()).word, Word::Degraded);
}

#[test]
fn an_expectation_of_the_file_decides_on_misses() {
    let mut evidence = seen(10, 6_000);
    evidence.slots.as_mut().unwrap()[1].is_decided = true;
    check(&evidence, &quiet(), Word::Ok, "OK: all seen");
    assert_eq!(judge(&seen(0, 6_000), 1_000_000, &quiet()).word, Word::Ok, "100 % may be missed");
}

#[test]
fn shares_are_written_with_the_digits_that_tell() {
    for (ppm, text) in
        [(0, "0 %"), (1, "0.0001 %"), (5_000, "0.5 %"), (123_456, "12.3 %"), (1_000_000, "100 %")]
    {
        assert_eq!(percent(ppm), text);
    }
}
