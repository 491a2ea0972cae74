//! How long the most urgent frame waits.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use rtmac::token::RingConfig;
use rtmac::token::bound::access_delay_bound;
use rtnet::buf::Pool;
use rtnet::sim::{Host, Latency, Random};
use rtnet::time::Span;
use tests::rings::{Habits, Rings, config};
use tests::seeds;

const STATIONS: usize = 5;
const URGENT: u8 = 9;

/// All send as much as they may, in the longest frames.
fn full(config: RingConfig, host: &Host) -> Rings {
    Rings::running(
        config,
        |_| Habits { host: host.clone(), load: (8, 1514), ..Habits::default() },
        seeds::one("token"),
    )
}

/// How long a frame waits that is queued at a station so many nanoseconds from now.
fn waits(ring: &mut Rings, id: usize, after: u64) -> u64 {
    let pool = Pool::new(1);
    ring.runs_for(after);
    let queued = ring.network.now();
    ring.queues_urgent(id, &pool, 60, URGENT);
    ring.take_aired();
    ring.runs_for(2 * access_delay_bound(&ring.config, STATIONS, 1).nanos() as u64);
    let sent = ring.aired().into_iter().find(|seen| seen.is_data() && seen.mark == URGENT);
    sent.expect("it leaves").at - queued
}

#[test]
fn the_worst_wait_of_the_most_urgent_frame_is_reached_where_all_send_all_that_they_may() {
    let config = RingConfig { late: Span::ZERO, ..config(STATIONS) };
    let bound = access_delay_bound(&config, STATIONS, 0).nanos() as u64;
    // The last frame of a visit begins: the token goes behind it, that is decided by now.
    let mut ring = full(config.clone(), &Host::IDEAL);
    ring.runs_for(50_000_000);
    let now = ring.network.now();
    ring.take_aired();
    ring.runs_for(20_000_000);
    let aired = ring.aired();
    let is_last = |pair: &&[tests::rings::Seen]| pair[0].from == 2 && pair[0].is_data() && !pair[1].is_data();
    let last = aired.windows(2).find(is_last).expect("station 2 sends")[0].at;

    let mut again = full(config, &Host::IDEAL);
    again.runs_for(50_000_000);
    let waited = waits(&mut again, 2, last - now);
    assert_eq!(waited, bound, "ns");
}

#[test]
fn no_urgent_frame_waits_longer_than_the_bound_whatever_hosts_and_loads_are() {
    let config = config(STATIONS);
    let bound = access_delay_bound(&config, STATIONS, 0).nanos() as u64;
    let longest = Arc::new(AtomicU64::new(0));
    let noted = longest.clone();
    seeds::each(300, move |seed| {
        let mut random = Random::new(seed);
        // Woken and held up before a frame: both together no later than is configured.
        let half =
            |random: &mut Random| Span::from_nanos(random.below(config.late.nanos() as u64 / 2 + 1) as i64);
        let habits: Vec<Habits> = (0..STATIONS)
            .map(|_| {
                let wake = Latency::Uniform(Span::ZERO, half(&mut random));
                let late = Latency::Uniform(Span::ZERO, half(&mut random));
                let load = (random.below(9) as usize, 60 + random.below(1455) as usize);
                let drift_ppb = random.between(-100_000, 100_000);
                Habits { host: Host { wake, late, ..Host::IDEAL }, load, drift_ppb }
            })
            .collect();
        let mut ring = Rings::running(config.clone(), |id| habits[id].clone(), seed);
        for _ in 0..5 {
            let id = random.below(STATIONS as u64) as usize;
            let waited = waits(&mut ring, id, random.below(5_000_000));
            assert!(waited <= bound, "{waited} ns, and no more than {bound}");
            noted.fetch_max(waited, Ordering::Relaxed);
        }
        assert_eq!((ring.sum(|c| c.claims), ring.sum(|c| c.repeats), ring.sum(|c| c.overdue)), (1, 0, 0));
        assert!(tests::rings::clashes(&ring.aired()).is_empty());
    });
    let longest = longest.load(Ordering::Relaxed);
    assert!(longest > bound / 2 || seeds::asked().is_some(), "{longest} of {bound} ns: nothing ever waited");
}
