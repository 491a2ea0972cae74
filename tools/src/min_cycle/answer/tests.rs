use super::*;
use crate::min_cycle::screen;
use crate::report::document::Document;
use crate::report::verdict::{Verdict, Word};

const ASKED: Asked = Asked {
    stations: 8,
    payload: 64,
    rate: 1_000_000_000,
    guard_ns: None,
    miss_ppm: 1_000,
    warm_core: false,
    trial_ns: 5_000_000_000,
    proof_ns: 30_000_000_000,
};
const MILLISECOND: (i64, i64) = (1_000_000, 110_000);

fn figures(missed_in_parts: [u64; 20], reasons: &[&str]) -> Figures {
    Figures {
        frames_expected: 40_000,
        slots_missed: missed_in_parts.iter().sum::<u64>() - 1,
        out_of_slot: 1,
        verdict: match reasons {
            [] => Verdict::default(),
            _ => Verdict::new(Word::NotOk, reasons.iter().map(|&why| why.into()).collect()),
        },
        ..Figures::default()
    }
}

fn answer(cycle_ns: Option<i64>) -> Answer {
    Answer { asked: ASKED, cycle_ns, runs: Vec::new(), host: HostFacts::default() }
}

/// Of 40 000 slots, 2 000 to a part, 0.1 % is 40, and 2 to a part.
#[test]
fn one_bad_moment_fails_a_proof_and_no_trial_and_a_busy_core_fails_both() {
    let run =
        |purpose, parts| Run::of(purpose, MILLISECOND, 5_000_000_000, (&figures(parts, &[]), parts), 1_000);
    let mut outage = [1; 20];
    outage[7] = 200;
    let held = [Purpose::Trial, Purpose::Proof].map(|purpose| run(purpose, outage).holds);
    assert_eq!(held, [Some(true), Some(false)]);
    let of_it = run(Purpose::Proof, outage);
    assert_eq!((of_it.missed, of_it.missed_share, of_it.usual_share), (219, 0.005_475, 0.0005));

    let held = |parts| [Purpose::Trial, Purpose::Proof].map(|purpose| run(purpose, parts).holds);
    assert_eq!((held([2; 20]), held([3; 20])), ([Some(true); 2], [Some(false); 2]));
}

#[test]
fn a_run_with_a_bad_verdict_and_one_that_did_not_come_up_hold_nothing_and_say_why() {
    let bad = figures([1; 20], &["1 unexplained miss", "2 payload errors"]);
    let run = Run::of(Purpose::Trial, MILLISECOND, 5_000_000_000, (&bad, [1; 20]), 1_000);
    assert_eq!(run.holds, Some(false));
    assert_eq!(run.note.as_deref(), Some("1 unexplained miss; 2 payload errors"));
    let run = Run::without(Purpose::Trial, MILLISECOND, 5_000_000_000, "not locked".into());
    assert_eq!((run.holds, run.note.as_deref()), (Some(false), Some("not locked")));
}

/// Too many misses decide on any host. The host may have caused whatever else is wrong in an inconclusive run.
#[test]
fn inconclusive_run_decides_nothing_but_by_its_misses() {
    let run = |purpose, missed| {
        let mut figures = figures([missed; 20], &[]);
        figures.verdict = Verdict::new(Word::Inconclusive, vec!["this host was disturbed".into()]);
        Run::of(purpose, MILLISECOND, 5_000_000_000, (&figures, [missed; 20]), 1_000)
    };
    for purpose in [Purpose::Trial, Purpose::Proof] {
        assert_eq!([2, 3].map(|missed| run(purpose, missed).holds), [None, Some(false)]);
    }
    let ended = |runs| {
        let answer = Answer { runs, ..answer(None) };
        let last_line = screen::render(&answer, 1_000).lines().last().unwrap_or_default().to_owned();
        (answer.exit_status(None), answer.exit_status(Some(&self::answer(Some(1)))), last_line)
    };
    let [undecided, failed] = [2, 3].map(|missed| run(Purpose::Trial, missed));
    let (alone, compared, line) = ended(vec![failed.clone(), undecided.clone()]);
    let begin = "INCONCLUSIVE: 5 runs of 1ms decided nothing, the last since this host was disturbed. ";
    assert!((alone, compared) == (3, 3) && line.starts_with(begin), "{alone} {compared} {line}");
    let (alone, compared, line) = ended(vec![undecided, failed]);
    assert!((alone, compared) == (1, 1) && line.starts_with("NOT FOUND: "), "{alone} {compared} {line}");
}

#[test]
fn exit_status_tells_found_from_not_found_and_from_longer() {
    let kept = answer(Some(1_000_000));
    let statuses = [1_250_000, 1_250_001].map(|ns| answer(Some(ns)).exit_status(Some(&kept)));
    assert_eq!((answer(Some(9)).exit_status(None), statuses), (0, [0, 1]));
}

#[test]
fn an_answer_far_from_what_trials_held_is_one_of_outages() {
    let trial = |us: i64, missed| {
        let run = (us * 1_000, 100_000);
        Run::of(Purpose::Trial, run, 5_000_000_000, (&figures([missed; 20], &[]), [missed; 20]), 1_000)
    };
    let why = |proven_us: Option<i64>| {
        let runs = vec![trial(1_000, 1), trial(680, 9), trial(820, 1), trial(750, 9)];
        let answer = Answer { runs, ..answer(proven_us.map(|us| us * 1_000)) };
        answer.decided_by_outages().map(|run| run.cycle_ns)
    };
    assert_eq!([820, 1_000].map(|us| why(Some(us))), [None, None]);
    assert_eq!([Some(1_100), None].map(why), [Some(820_000); 2]);
    assert_eq!(answer(None).decided_by_outages().map(|run| run.cycle_ns), None, "no trial held");
}

#[test]
fn what_is_longer_by_more_than_a_quarter_is_a_regression() {
    let compared = |now, kept| answer(now).compared_with(&answer(kept));
    let of = Some;
    assert_eq!(compared(of(750_000), of(600_000)), Compared::AsGood);
    assert_eq!(compared(of(750_001), of(600_000)), Compared::Regression);
    assert_eq!(compared(of(600_000), of(750_000)), Compared::AsGood);
    assert_eq!(compared(of(599_999), of(750_000)), Compared::Better);
    assert_eq!(compared(None, of(10_000_000)), Compared::Regression);
    assert_eq!(compared(of(10_000_000), None), Compared::Better);
    assert_eq!(compared(None, None), Compared::AsGood);
}

#[test]
fn what_is_kept_is_read_again_and_nothing_else_is() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("kept.json");
    let mut kept = answer(Some(1_000_000));
    kept.runs.push(Run::of(
        Purpose::Proof,
        MILLISECOND,
        30_000_000_000,
        (&figures([1; 20], &[]), [1; 20]),
        1_000,
    ));
    std::fs::write(&path, serde_json::to_string(&Document::of(&kept)).unwrap()).unwrap();
    assert_eq!(Answer::load(&path).unwrap(), kept);
    kept.runs[0].holds = None;
    std::fs::write(&path, serde_json::to_string(&Document::of(&kept)).unwrap()).unwrap();
    let refused = format!("{:#}", Answer::load(&path).unwrap_err());
    assert!(refused.contains("kept.json is of a search that was INCONCLUSIVE"), "{refused}");

    let error = |text: &str| {
        std::fs::write(&path, text).unwrap();
        format!("{:#}", Answer::load(&path).unwrap_err()).replace(&path.display().to_string(), "FILE")
    };
    assert!(error("cycle = 1").starts_with("FILE is not JSON: "));
    assert!(error("{\"stations\": 8}").starts_with("FILE is not an answer of this version: "));
    let half = "{\"kind\": \"find-min-cycle\", \"version\": 1, \"runs\": []}";
    assert!(error(half).starts_with("FILE is not whole: "), "{}", error(half));
    assert!(error(half).ends_with("keep an answer with `rtnet find-min-cycle --json`"));
}
