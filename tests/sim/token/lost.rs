//! A token that is lost on its way.

use rtmac::token::bound::{recovery_bound, rotation_bound, waits_for_one};
use tests::rings::{Habits, Rings, Seen, clashes, config, longest_without_data};
use tests::seeds;

const STATIONS: usize = 4;

fn ring() -> Rings {
    Rings::running(config(STATIONS), |_| Habits { load: (2, 500), ..Habits::default() }, seeds::one("token"))
}

/// When the token is passed on by a station next, seen from a ring that runs the same way.
fn next_pass(from: usize) -> u64 {
    let mut ring = ring();
    ring.runs_for(rotation_bound(&ring.config, STATIONS, 0).nanos() as u64 * 2);
    let is_pass = |seen: &&Seen| seen.from == from && seen.token.is_some();
    ring.aired().iter().find(is_pass).expect("it goes round").at
}

#[test]
fn a_ring_that_begins_has_one_token_that_goes_round() {
    let mut ring = ring();
    ring.runs_for(100_000_000);
    let aired = ring.aired();
    assert_eq!((ring.sum(|c| c.claims), ring.sum(|c| c.repeats), ring.sum(|c| c.given_up)), (1, 0, 0));
    assert!(clashes(&aired).is_empty(), "{:?}", clashes(&aired).first());
    let tokens: Vec<_> = aired.iter().filter_map(|seen| seen.token).collect();
    for pair in tokens.windows(2) {
        assert_eq!((pair[1].from, pair[1].sequence), (pair[0].to, pair[0].sequence + 1));
        assert_eq!(usize::from(pair[1].to), (usize::from(pair[1].from) + 1) % STATIONS);
    }
    let per_station = |id| aired.iter().filter(|seen| seen.is_data() && seen.from == id).count();
    let counts = [0, 1, 2, 3].map(per_station);
    assert!(counts.iter().all(|count| count.abs_diff(counts[0]) <= 2), "{counts:?}");
}

#[test]
fn a_token_that_is_lost_is_sent_once_more_and_nobody_is_skipped() {
    let passes = next_pass(1);
    let mut ring = ring();
    ring.network.run_until(passes - 1_000);
    ring.network.wire_mut(2).1.down = true;
    ring.network.run_until(passes + 1_000);
    ring.network.wire_mut(2).1.down = false;
    ring.network.run_until(passes + 50_000_000);
    assert_eq!((ring.counters(1).repeats, ring.sum(|c| c.repeats)), (1, 1));
    assert_eq!((ring.sum(|c| c.skips), ring.sum(|c| c.claims), ring.sum(|c| c.given_up)), (0, 1, 0));
    let aired = ring.aired();
    assert!(clashes(&aired).is_empty(), "{:?}", clashes(&aired).first());
    // No longer than it is waited for, and its way.
    let config = &ring.config;
    let longest = longest_without_data(&aired, aired[0].at, ring.network.now() - 1_000_000);
    let gap = config.gap() + config.delay;
    let bound = waits_for_one(config) + gap + config.rate.air_time(500) + gap;
    assert!(longest <= bound.nanos() as u64, "{longest} ns, and no more than {bound}");
    assert!(longest >= config.time_out().nanos() as u64, "{longest} ns: it was not lost");
    assert!(bound <= recovery_bound(config, 0, 1));
}

#[test]
fn a_token_that_nobody_has_heard_is_sent_once_more_by_both_who_wait_for_it() {
    let passes = next_pass(1);
    let mut ring = ring();
    ring.network.run_until(passes - 1_000);
    ring.network.wire_mut(1).0.down = true;
    ring.network.run_until(passes + 1_000);
    ring.network.wire_mut(1).0.down = false;
    ring.network.run_until(passes + 50_000_000);
    assert_eq!([0, 1, 2, 3].map(|id| ring.counters(id).repeats), [1, 1, 0, 0]);
    assert_eq!((ring.sum(|c| c.skips), ring.sum(|c| c.claims), ring.sum(|c| c.given_up)), (0, 1, 0));
    assert!(clashes(&ring.aired()).is_empty());
}

#[test]
fn a_station_whose_token_is_lost_twice_is_skipped_and_invited_back() {
    let passes = next_pass(1);
    let mut ring = ring();
    ring.network.run_until(passes - 1_000);
    ring.network.wire_mut(1).0.down = true;
    ring.network.run_until(passes + ring.config.time_out().nanos() as u64 + 1_000);
    ring.network.wire_mut(1).0.down = false;
    ring.network.run_until(passes + 50_000_000);
    // Who passed it on to that one skips it, and so it goes on.
    assert_eq!((ring.counters(0).skips, ring.sum(|c| c.skips), ring.sum(|c| c.claims)), (1, 1, 1));
    assert!(clashes(&ring.aired()).is_empty());
    assert_eq!(ring.sum(|c| c.invitations), 1);
    assert_eq!([0, 1, 2, 3].map(|id| ring.present(id)), [0b1111; 4], "it is back");
}
