//! A network that is parted, and whole again.

use rtmac::token::bound::{doubling_bound, recovery_bound, rejoin_bound, rotation_bound};
use tests::rings::{Habits, Rings, clashes, config};
use tests::seeds;

const STATIONS: usize = 5;
const MOMENTS: u64 = 40;

fn ring() -> Rings {
    Rings::running(config(STATIONS), |_| Habits { load: (2, 500), ..Habits::default() }, seeds::one("token"))
}

#[test]
fn each_part_has_a_token_of_its_own_and_one_is_left_once_they_meet() {
    let config = config(STATIONS);
    let round = rotation_bound(&config, STATIONS, 0).nanos() as u64;
    for part in [vec![0], vec![3], vec![0, 1], vec![1, 3], vec![2, 3, 4]] {
        for moment in 0..MOMENTS {
            let mut ring = ring();
            ring.runs_for(moment * round / MOMENTS);
            ring.network.cut_off(&part);
            ring.runs_for(2 * recovery_bound(&config, STATIONS - 1, 0).nanos() as u64);
            ring.take_aired();
            ring.runs_for(20_000_000);
            let aired = ring.aired();
            for id in 0..STATIONS {
                assert!(aired.iter().any(|seen| seen.from == id && seen.is_data()), "{part:?}, {id}");
            }
            let beside = |inside: bool| {
                let of_part: Vec<_> =
                    aired.iter().filter(|seen| part.contains(&seen.from) == inside).copied().collect();
                clashes(&of_part).len()
            };
            assert_eq!((beside(true), beside(false)), (0, 0), "{part:?}: each part is at peace");

            ring.network.cut_off(&[]);
            let met = ring.network.now();
            ring.take_aired();
            let longer = part.len().max(STATIONS - part.len());
            ring.runs_for(rejoin_bound(&config, STATIONS - longer, longer).nanos() as u64);
            let aired = ring.aired();
            let last_clash = clashes(&aired).iter().map(|(_, second)| second.at).max().unwrap_or(met);
            let bound = doubling_bound(&config, 0).nanos() as u64;
            assert!(last_clash <= met + bound, "{part:?}: {} ns behind it", last_clash - met);
            assert_eq!([0, 1, 2, 3, 4].map(|id| ring.present(id)), [0b11111; 5], "{part:?}, {moment}");
        }
    }
}
