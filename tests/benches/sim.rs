//! How many station-cycles a second virtual time gets through, for `scripts/bench-sim`.
//!
//!   sim STATIONS CYCLES [judged]     one line of JSON: seconds of the cycles alone, resident memory, frames
//!   sim STATIONS CYCLES memory       the same of as many passes through as much memory, and nothing else

// Real time is what is measured.
#![allow(clippy::disallowed_methods)]

use std::time::Instant;

use rtmac::tdma::schedule::Rate;
use rtnet::discipline::Discipline;
use rtnet::time::Span;
use tools::scenario::{Scenario, Uniform};
use tools::sim::{Options, World};

/// A network of so many stations, each of which sends in every cycle.
fn scenario(stations: usize, cycles: u64) -> Scenario {
    let cycle = Span::from_micros(10) * stations.max(20) as i64;
    let uniform = Uniform {
        stations,
        cycle,
        duration: cycle * cycles as i64,
        payload: 64,
        rate: Rate::from_bits_per_second(1_000_000_000),
        guard: None,
        seed: 1,
        vnic: None,
    };
    let mut scenario = uniform.scenario().expect("such a network can be");
    // Joining is not what is measured.
    scenario.stations.iter_mut().for_each(|station| station.rounds = 0);
    scenario
}

fn resident() -> u64 {
    let statm = std::fs::read_to_string("/proc/self/statm").unwrap_or_default();
    statm.split(' ').nth(1).and_then(|pages| pages.parse::<u64>().ok()).unwrap_or(0) * 4_096
}

/// What a station has in memory, its pools included, and as many lines of the cache as a cycle looks at, all over it:
/// counted with `valgrind --tool=lackey`.
const STATION: usize = 33_728;
const LINES: usize = 33;
const APART: usize = 576;

/// What a cycle does to memory, without what it is done for: each station once in any order, as they wake for a
/// Synchronisation, and once in the order of their slots.
fn through_memory(stations: usize, cycles: u64) -> f64 {
    let mut memory = vec![1_u8; stations * STATION];
    let mut order: Vec<usize> = (0..stations).collect();
    let mut random = rtnet::sim::Random::new(1);
    (1..stations).for_each(|last| order.swap(last, random.below(last as u64 + 1) as usize));
    let mut pass = |station: usize| {
        let lines = memory[station * STATION..][..STATION].iter_mut().step_by(APART).take(LINES);
        lines.for_each(|byte| *byte = std::hint::black_box(*byte).wrapping_add(1));
    };
    let begun = Instant::now();
    for _ in 0..cycles {
        order.iter().copied().for_each(&mut pass);
        (0..stations).for_each(&mut pass);
    }
    begun.elapsed().as_secs_f64()
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|argument| argument != "--bench").collect();
    let [stations, cycles] =
        [0, 1].map(|place| arguments.get(place).and_then(|text| text.parse::<u64>().ok()).unwrap_or(100));
    if arguments.get(2).is_some_and(|what| what == "memory") {
        println!("{{\"seconds\": {}}}", through_memory(stations as usize, cycles));
        return;
    }
    let scenario = scenario(stations as usize, cycles);
    let cycle = scenario.cycle.nanos() as u64;
    if arguments.get(2).is_some_and(|judged| judged == "judged") {
        let begun = Instant::now();
        let ended = tools::sim::run(&scenario, &Options::default()).expect("it runs");
        let seconds = begun.elapsed().as_secs_f64();
        let frames = ended.figures.simulation.frames;
        println!("{{\"seconds\": {seconds}, \"frames\": {frames}, \"resident\": {}}}", resident());
        return;
    }
    let before = resident();
    let mut world = World::new(&scenario, |_| true).expect("such a network can be");
    let network = &mut world.network;
    network.run_until(network.now() + 20 * cycle);
    let frames = network.traffic().frames;
    let begun = Instant::now();
    for _ in 0..cycles {
        network.run_until(network.now() + cycle);
        if (network.now() / cycle).is_multiple_of(64) {
            for id in 0..stations as usize {
                while network.member_mut(id).station.discipline_mut().next_event().is_some() {}
            }
        }
    }
    let seconds = begun.elapsed().as_secs_f64();
    let frames = network.traffic().frames - frames;
    let resident = resident().saturating_sub(before);
    println!("{{\"seconds\": {seconds}, \"frames\": {frames}, \"resident\": {resident}}}");
}
