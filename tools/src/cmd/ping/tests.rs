//! Rounds of questions, without a station.

use clap::Parser;
use rtnet::time::Span;

use super::*;

#[derive(Parser)]
struct Line {
    #[command(flatten)]
    ping: PingArgs,
}

fn args(line: &str) -> PingArgs {
    Line::parse_from(["ping"].into_iter().chain(line.split(' '))).ping
}

#[test]
fn a_spread_is_of_values_that_occurred() {
    assert_eq!(Spread::of(Vec::new(), 7), None);
    let all = Spread::of((1..=200).rev().collect(), 210);
    assert_eq!(all, Some(Spread { min: 1, p50: 100, p99: 198, max: 200, n: 200, gaps: 10 }));
    assert_eq!(Spread::of(vec![7], 1), Some(Spread { min: 7, p50: 7, p99: 7, max: 7, n: 1, gaps: 0 }));
}

#[test]
fn questions_come_as_often_as_was_said_and_everywhere_in_a_cycle() {
    let (cycle, every) = (Duration::from_millis(1), Duration::from_millis(4));
    let args = args("-S a -i 4ms 10.0.0.1");
    assert_eq!(args.interval, Span::from_millis(4));
    let asked = |n| due(n, &args, Some(cycle));
    let mut within: Vec<Duration> = (0..100).map(|n| asked(n) - every * n as u32).collect();
    within.sort_unstable();
    let gaps = within.windows(2).map(|pair| pair[1] - pair[0]);
    let largest = gaps.chain([within[0], cycle - within[99]]).max().unwrap();
    assert!(largest < Duration::from_micros(20), "{largest:?}");
    assert!((1..100).all(|n| asked(n) > asked(n - 1)));
    assert_eq!(due(3, &args, None), every * 3, "where there is no cycle");
    // After a hold-up there is no burst.
    let late = |micros| held_up(Duration::from_micros(micros), &args, Some(cycle)).as_micros();
    assert_eq!([0, 250, 251, 9_000].map(late), [0, 0, 251, 9_000]);
}

#[test]
fn what_fails_counts_by_its_reason_and_the_rest_as_lost_or_received() {
    let args = args("-S a -i 4ms --json 10.0.0.1");
    let mut run = Run::new(&args.which, &args);
    run.tried = 100;
    (0..30).for_each(|n| run.fails(n, &format!("reason {}", n / 2)).unwrap());
    (0..10).for_each(|n| run.fails(n, &format!("later reason {n}")).unwrap());
    run.received = 40;
    let round = run.round(None, None);
    assert_eq!((round.sent, round.failed, round.lost, round.loss), (60, 40, 20, 20.0 / 60.0));
    assert_eq!((round.failures.len(), round.failures["reason 3"]), (17, 2));
    assert_eq!(round.failures["another reason"], 9);
    let text = summary(&args.which.place, &round);
    assert!(text.starts_with("10.0.0.1: 60 sent, 40 came back, 33.3 % lost, 40 were not asked:\n"), "{text}");
    assert!(text.contains("\n  2 times: reason 3\n"), "{text}");
}

#[test]
fn a_summary_says_how_many_round_trips_are_without_a_time() {
    let args = args("-S a --json 10.0.0.1");
    let mut round = Run::new(&args.which, &args).round(None, None);
    round.round_trip_ns = Spread::of(vec![7_000], 3);
    let text = summary(&args.which.place, &round);
    assert!(
        text.ends_with("round trip: min 7.00, p50 7.00, p99 7.00, max 7.00 us; n 1, 2 more without\n"),
        "{text}"
    );
}

#[test]
fn round_trips_are_compared_with_the_schedule_beyond_the_jitter_of_what_is_no_waiting() {
    let args = args("-S a --json 10.0.0.1");
    let mut run = Run::new(&args.which, &args);
    // A rest of 300 us, one in 20 of them 5 us longer, one that was a cycle late, and one that came before it can.
    run.answers = (0..100)
        .map(|n| {
            let rest = 300_000 + if n % 20 == 7 { 5_000 } else { n };
            let late = if n == 50 { 1_000_000 } else { 0 };
            // The first was chosen as late as can be, the last before it can have been.
            let waited = if n % 99 == 0 { 0 } else { 50_000 + n * 10_000 };
            let rest = if n == 99 { 200_000 } else { rest };
            let (round_trip_ns, waited_ns) = (Some(rest + late + waited), Some(waited));
            Answer { sequence: n as u16, bytes: 56, round_trip_ns, waited_ns }
        })
        .collect();
    let beside = run.beside([350_000, 1_350_000, 50_000], 2);
    assert_eq!((beside.quicker, beside.longer, beside.slots_missed), (1, 1, 2));
    assert!((1..=5_000).contains(&beside.jitter_ns), "{beside:?}");
    let text = summary(&args.which.place, &run.round(None, Some(beside)));
    assert!(text.contains("schedule: best 350, worst 1 350 us, or up to 50.0 us less; "), "{text}");
    assert!(
        text.ends_with("1 were quicker and 1 took longer, while the two stations missed 2 slots\n"),
        "{text}"
    );
}

#[test]
fn an_answer_that_is_lost_is_looked_for_no_longer_than_it_may_take_and_one_that_is_late_is_taken() {
    let args = args("-S a --json 10.0.0.1");
    let (mut run, since) = (Run::new(&args.which, &args), Instant::now());
    assert!(!run.is_due(since));
    run.open.insert(1, Open { asked: 5, since });
    assert!(run.is_due(since) && !run.is_due(since + DUE_WITHIN));
    // Others are waited for all the same.
    run.open.insert(2, Open { asked: 6, since: since + DUE_WITHIN });
    assert!(run.is_due(since + DUE_WITHIN));
    run.open.remove(&2);
    run.forget(since + DUE_WITHIN * 2);
    assert!(run.open.contains_key(&1), "it may come late");
    run.forget(since + FORGOTTEN_AFTER);
    assert!(run.open.is_empty());
}

#[test]
fn what_never_left_is_told_with_its_reason_and_the_remedy_at_that_station() {
    let args = args("-S a --json 10.0.0.1");
    let silent = |is_still| Some(("it is silent (`rtnet tdma status`)".to_owned(), is_still));
    let round = |received, silent, left| {
        let mut run = Run::new(&args.which, &args);
        (run.tried, run.received, run.silent, run.behind) = (10, received, silent, 2);
        (8..10).for_each(|n| run.fails(n, "it is behind others").unwrap());
        run.round(left, None)
    };
    let told = |round: Round| {
        let text = summary(&args.which.place, &round);
        text.lines().find(|line| line.starts_with("station 'a': ")).map(|line| line[13..].to_owned())
    };
    let why = "it is silent (`rtnet tdma -S a status`)";
    let all = format!("10 of 10 questions never left: {why}");
    assert_eq!(told(round(0, silent(true), Some(0))), Some(all));
    let midway = round(5, silent(false), Some(6));
    assert_eq!(midway.lost, 3, "one of them on its way");
    let for_a_while = format!("4 of 10 questions never left: for a while nothing did: {why}");
    assert_eq!(told(midway), Some(for_a_while));
    let slow = told(round(6, None, Some(6))).unwrap();
    assert!(slow.starts_with("4 of 10 questions never left: their slot has not come yet"), "{slow}");
    // To itself no question leaves.
    assert_eq!(round(8, silent(false), Some(0)).never_left, 2);
    // Nobody knows.
    assert_eq!(told(round(0, silent(true), None)), None);
}
