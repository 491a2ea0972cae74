use super::tally::{Row, Worse};
use super::*;
use crate::report::document::Document;
use crate::scenario::Source;
use crate::sim::Options;

const NETWORK: &str = r#"cycle = "1ms"
duration = "100ms"
seed = 4
[host]
wake = "exponential 13us"
[[station]]
name = "master"
role = "master"
[[station]]
name = "arm"
role = "slave"
rounds = 10
[expect]
overlaps = 0
sync_error = "< 1ns"
frames_seen = ">= 200"
"#;

const RING: &str = r#"discipline = "token"
duration = "200ms"
[[station]]
name = "arm"
[[station]]
name = "leg"
"#;

fn subject(text: &str) -> Subject {
    Subject::new("net.toml".into(), Source::new("net.toml", text).parse_any().unwrap())
}

fn row(worse: Worse) -> Row {
    Row { what: "x".into(), line: Some(1), station: None, priority: None, worse, is_time: false }
}

fn run(value: Option<i64>, holds: bool) -> Run {
    let reasons = if holds { Vec::new() } else { vec!["x".to_owned()] };
    Run { reasons, found: vec![(value, holds)] }
}

#[test]
fn seeds_are_a_range_with_both_ends_or_one_seed() {
    let seeds: Seeds = "3..5".parse().unwrap();
    assert_eq!(
        (seeds.len(), seeds.iter().collect::<Vec<_>>(), seeds.to_string()),
        (3, vec![3, 4, 5], "3..5".into())
    );
    let one: Seeds = "7".parse().unwrap();
    assert_eq!((one.len(), one.to_string()), (1, "7".into()));
    assert_eq!(u64::MAX.to_string().parse::<Seeds>().unwrap().iter().collect::<Vec<_>>(), [u64::MAX]);
    assert_eq!("0..99999".parse::<Seeds>().unwrap().len() as u64, MOST_SEEDS);
}

#[test]
fn nonsense_instead_of_seeds_says_what_to_write() {
    let why = |text: &str| text.parse::<Seeds>().unwrap_err().to_string();
    assert_eq!(why("5..3"), "3 is less than 5: write the lower seed first, as in 3..5");
    for text in ["", "..", "1..", "..3", "1..=3", "-1..3", "a", "1...3", "1..99999999999999999999"] {
        let expected =
            format!("'{text}' names no seeds: write the first and the last, as in 1..20, or one, as in 7");
        assert_eq!(why(text), expected);
    }
    for last in [MOST_SEEDS, u64::MAX] {
        let expected = format!(
            "0..{last} are {} seeds, more than the {MOST_SEEDS} that are run at once: run parts of it",
            u128::from(last) + 1
        );
        assert_eq!(why(&format!("0..{last}")), expected);
    }
}

#[test]
fn worst_is_furthest_on_the_side_that_is_not_allowed() {
    let worst = |worse, values: [Option<i64>; 3]| {
        let mut tally = Tally::new(vec![row(worse)], "1..3".parse().unwrap());
        values.into_iter().zip(1..).for_each(|(value, seed)| tally.note(seed, run(value, true)));
        tally.worst[0].map(|worst| (worst.value, worst.seed, worst.is_of_all)).unwrap()
    };
    assert_eq!(worst(Worse::More, [Some(1), Some(3), Some(3)]), (Some(3), 2, false));
    assert_eq!(worst(Worse::Less, [Some(2), Some(-1), Some(3)]), (Some(-1), 2, false));
    assert_eq!(worst(Worse::Further(5), [Some(7), Some(4), Some(2)]), (Some(2), 3, false));
    assert_eq!(
        worst(Worse::More, [Some(i64::MAX), None, Some(3)]),
        (None, 2, false),
        "nothing is worst of all"
    );
    assert_eq!(worst(Worse::Less, [Some(2); 3]), (Some(2), 1, true));
}

#[test]
fn runs_count_the_same_in_any_order() {
    let runs = [run(Some(4), true), run(Some(9), false), run(Some(9), false), Run::failed("broken".into())];
    let tally = |order: [usize; 4]| {
        let mut tally = Tally::new(vec![row(Worse::More)], "10..13".parse().unwrap());
        order.into_iter().for_each(|i| tally.note(10 + i as u64, runs[i].clone()));
        tally
    };
    let first = tally([0, 1, 2, 3]);
    assert_eq!((first.runs(), first.failed.len(), first.not_met[0]), (4, 3, 2));
    assert_eq!(first.worst[0].unwrap().seed, 11);
    for order in [[3, 2, 1, 0], [2, 0, 3, 1], [1, 3, 0, 2]] {
        assert_eq!(tally(order), first);
    }
}

#[test]
fn a_run_fails_if_its_files_expectations_do_not_hold() {
    let subject = subject(NETWORK);
    assert_eq!(subject.own_seed(), 4);
    let rows = subject.rows();
    let run = subject.run(3, &Options::default());
    let reasons = run.reasons.join("; ");
    assert!(reasons.starts_with("line 15: expected sync_error < 1ns, found "), "{reasons}");
    assert_eq!((run.reasons.len(), run.found.len()), (1, rows.len()));
    let [overlaps, sync_error, frames_seen] = run.found[..3] else { panic!("three expectations") };
    assert_eq!((overlaps, sync_error.1, frames_seen), ((Some(0), true), false, (Some(200), true)));
    assert!(sync_error.0.is_some_and(|ns| ns > 1), "{sync_error:?}");
    let figures: Vec<_> = rows[3..].iter().map(|row| row.what.as_str()).collect();
    assert!(
        figures.contains(&"unexplained") && !figures.contains(&"overlaps"),
        "it is expected: {figures:?}"
    );
    assert_eq!(subject.run(3, &Options::default()), run, "one seed is one run");
    assert_ne!(subject.run(5, &Options::default()).found, run.found);
}

#[test]
fn a_run_that_breaks_off_fails_with_the_reason() {
    let until = Some(rtnet::time::Span::from_millis(1));
    let run = subject(NETWORK).run(1, &Options { until, ..Options::default() });
    assert_eq!(
        run,
        Run::failed("the stations were not all locked after 1ms: give it a longer --until".into())
    );
}

#[test]
fn a_ring_is_run_with_its_seed_and_has_rows() {
    let subject = subject(RING);
    let run = subject.run(3, &Options::default());
    assert_eq!((&run.reasons[..], run.found.len()), (&[][..], subject.rows().len()));
    let rotation = subject.rows().iter().position(|row| row.what == "rotation").unwrap();
    assert!(run.found[rotation].0.is_some_and(|ns| ns > 0));
}

#[test]
fn a_report_has_the_worst_seed_and_the_command_of_each_failure() {
    let subject = subject(NETWORK);
    let seeds: Seeds = "1..4".parse().unwrap();
    let mut tally = Tally::new(subject.rows(), seeds);
    [1, 2, 3].into_iter().for_each(|seed| tally.note(seed, subject.run(seed, &Options::default())));
    let report = SeedsReport::new(seeds, &[(&subject, &tally)], true, |file, seed| {
        format!("rtnet sim run {file} --seed {seed}")
    });
    assert_eq!((report.runs, report.met, report.failed, report.interrupted), (3, 0, 3, true));
    let json = serde_json::to_string(&Document::of(&report)).unwrap();
    assert!(
        json.starts_with(r#"{"kind":"sim-seeds","version":1,"first_seed":1,"last_seed":4,"runs":3,"#),
        "{json}"
    );
    let of = &report.files[0];
    assert_eq!(of.failures[1].command, "rtnet sim run net.toml --seed 2");
    let [overlaps, sync_error, _] = &of.expectations[..] else { panic!("three") };
    assert_eq!((overlaps.not_met, overlaps.worst, overlaps.in_all), (Some(0), Some(0), true));
    let errors: Vec<_> =
        (1..=3).map(|seed| subject.run(seed, &Options::default()).found[1].0.unwrap()).collect();
    let most = errors.iter().max().unwrap();
    assert_eq!((sync_error.not_met, sync_error.worst), (Some(3), Some(*most)));
    assert_eq!(sync_error.seed, errors.iter().position(|ns| ns == most).map(|i| i as u64 + 1));
    let screen = render(&report, 100);
    assert!(
        screen.contains("  FAILED with seeds 1, 2, 3\n  $ rtnet sim run net.toml --seed 1\n"),
        "{screen}"
    );
}
