//! A station that was dead is back.

use rtmac::token::bound::{rejoin_bound, rotation_bound};
use tests::rings::{Habits, Rings, clashes, config};
use tests::seeds;

const STATIONS: usize = 5;

fn ring() -> Rings {
    Rings::running(config(STATIONS), |_| Habits { load: (1, 500), ..Habits::default() }, seeds::one("token"))
}

#[test]
fn a_station_that_was_dead_is_invited_within_the_bound_whoever_else_is_dead() {
    for dead in [vec![3], vec![0], vec![2, 3], vec![1, 3], vec![4, 0, 1], vec![1, 2, 3, 4]] {
        let mut ring = ring();
        dead.iter().for_each(|&id| ring.network.stop(id));
        ring.runs_for(100_000_000);
        let (first, alive) = (dead[0], STATIONS - dead.len());
        let expected = (0..STATIONS).filter(|id| !dead.contains(id)).fold(0, |all, id| all | 1 << id);
        let of_others = ring.present((0..STATIONS).find(|id| !dead.contains(id)).unwrap());
        // One of the absent is perhaps invited just now.
        assert!((of_others ^ expected).count_ones() <= 1, "{dead:?}: {of_others:#b}");
        ring.restarts(first, (1, 500));
        let back = ring.network.now();
        ring.take_aired();
        let bound = rejoin_bound(&ring.config, alive, dead.len()).nanos() as u64;
        ring.runs_for(bound + rotation_bound(&ring.config, STATIONS, 1).nanos() as u64);
        let aired = ring.aired();
        let sent = aired.iter().find(|seen| seen.from == first && seen.is_data());
        let took = sent.unwrap_or_else(|| panic!("{dead:?}: it never came back")).at - back;
        assert!(took <= bound, "{dead:?}: {took} ns, and no more than {bound}");
        assert!(clashes(&aired).is_empty(), "{dead:?}: {:?}", clashes(&aired).first());
        assert_eq!(ring.sum(|c| c.given_up), 0);
    }
}

#[test]
fn the_dead_are_invited_in_turn_and_cost_a_round_no_more_than_one_time_out() {
    let mut ring = ring();
    [1, 2, 4].iter().for_each(|&id| ring.network.stop(id));
    ring.runs_for(100_000_000);
    ring.take_aired();
    ring.runs_for(200_000_000);
    let aired = ring.aired();
    let invited: Vec<u8> = aired
        .iter()
        .filter_map(|seen| seen.token)
        .filter(|token| [1, 2, 4].contains(&token.to))
        .map(|token| token.to)
        .collect();
    assert!(invited.len() > 20, "{invited:?}");
    for three in invited.windows(4) {
        assert_ne!(three[0], three[1]);
        assert_eq!(three[0], three[3], "in turn: {invited:?}");
    }
    let bound = rotation_bound(&ring.config, 2, 3).nanos() as u64;
    let arrivals: Vec<u64> = aired
        .iter()
        .filter(|seen| seen.token.is_some_and(|token| token.to == 0))
        .map(|seen| seen.at)
        .collect();
    let longest = arrivals.windows(2).map(|pair| pair[1] - pair[0]).max().unwrap();
    assert!(longest <= bound, "{longest} ns, and no more than {bound}");
    assert!(longest >= ring.config.time_out().nanos() as u64);
}
