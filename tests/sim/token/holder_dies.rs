//! A station dies, at every moment of a round.

use rtmac::token::bound::{recovery_bound, rotation_bound};
use tests::rings::{Habits, Rings, clashes, config, longest_without_data};
use tests::seeds;

const STATIONS: usize = 4;
/// Moments of a round that are tried.
const MOMENTS: u64 = 500;

fn ring() -> Rings {
    Rings::running(config(STATIONS), |_| Habits { load: (2, 500), ..Habits::default() }, seeds::one("token"))
}

/// Kills these stations at every moment of two rounds; tells the longest time without data behind that, and how often a token
/// was claimed.
fn killed(stations: &[usize]) -> (u64, u64) {
    let config = config(STATIONS);
    let round = rotation_bound(&config, STATIONS, 0).nanos() as u64;
    let (mut longest, mut claims) = (0, 0);
    for moment in 0..MOMENTS {
        let mut ring = ring();
        ring.runs_for(moment * round / MOMENTS);
        let dies = ring.network.now();
        stations.iter().for_each(|&id| ring.network.stop(id));
        let until = dies + 2 * recovery_bound(&config, stations.len(), 0).nanos() as u64;
        ring.network.run_until(until + 4 * round);
        let aired = ring.aired();
        assert!(clashes(&aired).is_empty(), "{moment}: {:?}", clashes(&aired).first());
        longest = longest.max(longest_without_data(&aired, dies, until));
        claims += ring.sum(|c| c.claims) - 1;
    }
    (longest, claims)
}

#[test]
fn a_holder_that_dies_is_skipped_within_the_bound_whenever_that_is() {
    for id in 0..STATIONS {
        let (longest, claims) = killed(&[id]);
        let bound = recovery_bound(&config(STATIONS), 1, 0).nanos() as u64;
        assert!(longest <= bound, "station {id}: {longest} ns, and no more than {bound}");
        assert!(longest > bound / 3, "station {id}: {longest} ns: it was never missed");
        assert_eq!(claims, 0, "whoever passed it on is alive");
    }
}

#[test]
fn a_holder_that_dies_with_the_one_before_it_has_its_token_claimed_within_the_bound() {
    for first in 0..STATIONS {
        let (longest, claims) = killed(&[first, (first + 1) % STATIONS]);
        let bound = recovery_bound(&config(STATIONS), 2, 0).nanos() as u64;
        assert!(longest <= bound, "stations {first} and next: {longest} ns, and no more than {bound}");
        assert!(longest > bound / 2, "stations {first} and next: {longest} ns: it was never missed");
        assert!(claims > 0, "nobody was there to send it once more");
    }
}
