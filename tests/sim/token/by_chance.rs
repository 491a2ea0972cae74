//! Rings by chance: sizes, hosts, clocks and faults follow from a seed.

use rtmac::token::bound::{doubling_bound, recovery_bound, rejoin_bound};
use rtnet::sim::{Host, Latency, Random};
use rtnet::time::Span;
use tests::rings::{Habits, Rings, clashes, config, longest_without_data};
use tests::seeds;

const SEEDS: usize = 100;

/// What befalls a ring.
#[derive(Clone, Copy, Debug)]
enum Fault {
    Dies,
    Freezes,
    Stalls,
    Loses,
    Deaf,
    Parted,
}

const FAULTS: [Fault; 6] =
    [Fault::Dies, Fault::Freezes, Fault::Stalls, Fault::Loses, Fault::Deaf, Fault::Parted];

#[test]
fn rings_by_chance_have_one_token_again_within_the_bounds_after_every_fault() {
    seeds::each(SEEDS, |seed| {
        run(seed);
    });
}

fn run(seed: u64) {
    let mut random = Random::new(seed);
    let stations = 2 + random.below(7) as usize;
    let config = config(stations);
    let half = config.late / 2;
    let habits: Vec<Habits> = (0..stations)
        .map(|_| Habits {
            host: Host {
                wake: Latency::Uniform(Span::ZERO, half),
                late: Latency::Uniform(Span::ZERO, half),
                ..Host::IDEAL
            },
            drift_ppb: random.between(-200_000, 200_000),
            load: (1 + random.below(4) as usize, 60 + random.below(1455) as usize),
        })
        .collect();
    let mut ring = Rings::running(config.clone(), |id| habits[id].clone(), seed);
    for n in 0..4 {
        let fault = FAULTS[random.below(FAULTS.len() as u64) as usize];
        let id = random.below(stations as u64) as usize;
        let why = format!("seed {seed}, fault {n}, {fault:?} {id} of {stations}");
        ring.runs_for(random.below(10_000_000));
        let begun = ring.network.now();
        let lasts = 1_000 + random.below(8_000_000);
        befalls(&mut ring, fault, id, lasts);
        ring.runs_for(lasts);
        is_over(&mut ring, fault, id, habits[id].load);
        // While it lasted, and once it was over, tokens may have been lost, or been two.
        let over = ring.network.now();
        let bound = recovery_bound(&config, stations, 2).nanos() as u64;
        let doubled = doubling_bound(&config, 1).nanos() as u64;
        let rejoined = rejoin_bound(&config, 1, stations).nanos() as u64;
        ring.runs_for(2 * bound + doubled + rejoined);
        let aired = ring.take_aired();
        let longest = longest_without_data(&aired, begun, over + bound);
        assert!(longest <= bound + lasts, "{why}: {longest} ns, and no more than {bound}");
        let settled: Vec<_> = aired.into_iter().filter(|seen| seen.at > over + bound + doubled).collect();
        assert!(clashes(&settled).is_empty(), "{why}: {:?}", clashes(&settled).first());
        let all = u64::MAX >> (64 - stations);
        for id in 0..stations {
            assert_eq!(ring.present(id), all, "{why}: of station {id}");
        }
    }
}

fn befalls(ring: &mut Rings, fault: Fault, id: usize, lasts: u64) {
    match fault {
        Fault::Dies => ring.network.stop(id),
        Fault::Freezes => ring.network.freeze(id, Span::from_nanos(lasts as i64)),
        Fault::Stalls => ring.network.stall_next(id, Span::from_nanos(lasts as i64)),
        Fault::Loses => ring.network.wire_mut(id).0.lose_data_ppm = 500_000,
        Fault::Deaf => ring.network.wire_mut(id).1.lose_data_ppm = 500_000,
        Fault::Parted => ring.network.cut_off(&[id]),
    }
}

fn is_over(ring: &mut Rings, fault: Fault, id: usize, load: (usize, usize)) {
    match fault {
        Fault::Dies => ring.restarts(id, load),
        Fault::Freezes | Fault::Stalls => {}
        Fault::Loses | Fault::Deaf => {
            let (sends_by, hears_by) = ring.network.wire_mut(id);
            (sends_by.lose_data_ppm, hears_by.lose_data_ppm) = (0, 0);
        }
        Fault::Parted => ring.network.cut_off(&[]),
    }
}
